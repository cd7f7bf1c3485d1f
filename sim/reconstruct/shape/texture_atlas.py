# SPDX-License-Identifier: MIT
"""Texture of a body that may be seen from all sides: the photo where it is seen well, synthesised matter elsewhere.

The picture holds the photo around the object, above charts of the rest of the surface. Faces that the camera sees
squarely show the photo pixel for pixel. Towards the rim, where one pixel covers several texels, a chart holds the
photo with grain whose mean over each pixel is zero: the camera of the photo still sees the photo, any other no
streaks. What nothing shows is plain matter: the colours of its counterpart on the visible side without marks
(`plain_matter.py`), and grain that is laid over the surface in space, so no chart has a visible border.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...mpm.geometry.triangles import face_normals
from ...scene.model import Camera
from ...scene.shading import shading_values
from ...smoothstep import smoothstep
from ...srgb import linear_to_srgb, srgb_to_linear
from ..mesh_raster import Number, rasterise
from .body_texture import CropTexture, TexturedSurface, distance_behind, seen_vertices
from .even_light import light_on
from .hidden_seams import blended
from .inflated_mesh import BodyMesh
from .plain_matter import PlainMatter, inner_colours, plain_matter, synthesised_grain
from .surface_charts import surface_frame, unwrap
from .surface_values import (
    SurfaceValues,
    flat_sides,
    sampled,
    smoothed,
    vertex_normals,
    vertex_share,
)
from .texture_shading import corner_light, shading_of_charts, shading_of_photo

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

SQUARE = np.cos(np.radians(70.0))
"""Cosine of the angle to the camera above which a face shows the photo itself: a pixel covers up to 2.9 of its size."""
GRAIN = (np.cos(np.radians(74.0)), np.cos(np.radians(68.0)))
"""Cosines between which grain is added to the photo's pixels: all up to the first, none from the second."""
PURE = (-1.0, 2.0)
"""Pixels from the outline between which a pixel on a grazing side becomes free of the background."""
OWN = (np.cos(np.radians(84.0)), np.cos(np.radians(80.0)))
"""Cosines between which a point's own pixel replaces the one inside the outline: beyond, it is mixed with the
background."""
SHOWN = (np.cos(np.radians(89.0)), np.cos(np.radians(84.0)))
"""Cosines between which the photo replaces plain matter."""
CLEAR = (0.5, 2.0)
"""Pixels from the outline between which a point's own pixel is shown whatever its angle: a flat side at 86°, such as a
book's fore-edge, is a strip of several pixels, none of them mixed with the background."""
EVEN = 0.12
"""Distance behind the rim, over the root of the object's area, at which two thirds of its light are taken out."""
DENSITY = 1.25
"""Texels of charts per pixel of the photo, per side: the photo is resampled there."""
MOST_TEXELS = 9e5
"""Texels of all charts at most."""
CELLS = 256
"""Cells along the longer side of the depth map that tells which faces others hide."""
BEHIND = 0.015
"""Depth over the body's extent from which something is behind something else."""
OUTSIDE = 3
"""Pixels outside the outline beyond which the photo shows nothing: its border cuts the object."""
PLANES = ((1, 2), (0, 2), (0, 1))
"""Coordinates of the planes onto which grain is laid, by the axis that they are perpendicular to."""
PLANE_SHARPNESS = 6.0


def textured_body(camera: Camera, body: BodyMesh, texture: CropTexture, mask: Mask) -> TexturedSurface:
    """Return ``body`` with its texture; vertices along the borders of charts occur once per chart.

    texture: the photo around the object; mask: (H, W) the object. ``body.colours`` are the photo's pixels that
    correspond to each vertex, ``body.corner_colours`` to each face's corners. Deterministic.
    """
    shown, cosine = _shown(camera, body, mask)
    photo = shown & (cosine > SQUARE)
    if photo.all():
        return TexturedSurface(body.vertices, body.faces, texture.uv(body.pixels), texture.pixels, texture.alpha)
    rest = body.faces[~photo]
    normals, areas = face_normals(body.vertices[body.faces])
    frame = surface_frame(normals, areas)
    pixels = _pixels_per_unit(camera, body.vertices)
    scale = DENSITY * pixels
    scale *= min(1.0, float(np.sqrt(MOST_TEXELS / max(areas[~photo].sum() * scale**2, 1.0))))
    height, width = texture.pixels.shape[:2]
    charts = unwrap(body.vertices, rest, frame, scale, max(width, int(np.sqrt(areas[~photo].sum()) * scale)))
    size = (max(width, charts.size[0]), height + charts.size[1])
    # One vertex list: of the faces that show the photo, then of the charts.
    used, corners = np.unique(body.faces[photo], return_inverse=True)
    place = np.concatenate([body.pixels[used] - (texture.left, texture.top), charts.texels + np.array([0.0, height])])
    faces = np.empty_like(body.faces)
    faces[photo] = corners.reshape(-1, 3)
    faces[~photo] = charts.faces + len(used)
    source = np.concatenate([used, charts.source])
    corner = (texture.left + 0.5, texture.top + 0.5)
    inside = _cropped(mask, texture)
    matter = plain_matter(texture.pixels, inside)
    light = light_on(camera, body, texture, inside)
    falling = np.zeros((*inside.shape, 3), dtype=np.float32) if light is None else light.picture
    hidden = vertex_share(body, (cosine > 0) & ~shown)
    of_vertices = _values_at_vertices(camera, body, texture, inside, matter, falling, hidden)
    of_charts = SurfaceValues(*(np.array(value[charts.source], dtype=np.float64) for value in of_vertices))
    if body.corner_colours is not None:
        of_charts.counterpart[charts.faces] = body.corner_colours[~photo]
    at = np.column_stack([charts.texels, np.ones(len(charts.texels))])
    found = rasterise(at, charts.faces, charts.size, np.ones(len(rest), dtype=bool))
    texels = SurfaceValues.from_columns(found.interpolated(charts.faces, np.column_stack(of_charts)))
    own = own_pixels(camera, texels, texture, inside)
    colour = _colours(texels, own, texture, inside, matter, falling, frame, pixels)
    if texture.alpha is not None:
        colour = np.column_stack([colour, _cover(camera, texels, texture)])
    below = found.spread(np.clip(colour + 0.5, 0, 255).astype(np.uint8), (size[0], charts.size[1]))
    whole = texture.pixels if texture.alpha is None else np.dstack([texture.pixels, texture.alpha])
    picture = _joined(whole, below)
    uv = np.column_stack([place[:, 0] / size[0], 1.0 - place[:, 1] / size[1]])
    surface = TexturedSurface(
        vertices=body.vertices[source],
        faces=faces,
        uv=uv,
        picture=np.ascontiguousarray(picture[..., :3]),
        alpha=None if texture.alpha is None else np.ascontiguousarray(picture[..., 3]),
    )
    if light is None:
        return surface
    lit = corner_light(light, body)
    of_normal = np.einsum("pk,pkc->pc", found.corners, lit[~photo][found.faces])
    above = shading_values(shading_of_photo(light, place, faces[photo], lit[photo]))
    shading = shading_values(shading_of_charts(light, texels, own.share, of_normal, corner))
    return replace(surface, shading=_joined(above, found.spread(shading, (size[0], charts.size[1]))))


def _values_at_vertices(
    camera: Camera,
    body: BodyMesh,
    texture: CropTexture,
    mask: Mask,
    matter: PlainMatter,
    light: NDArray[np.float32],
    hidden: NDArray[np.float64],
) -> SurfaceValues:
    """What the colours at the vertices (V) of ``body`` depend on.

    mask: (h, w) the object in ``texture``. light: (h, w, 3) its logarithm. hidden: (V,) by others of its faces.
    """
    size = float(np.sqrt(mask.sum()))
    colours = body.pixels if body.colours is None else body.colours
    normals, _ = face_normals(body.vertices[body.faces])
    seen = seen_vertices(camera, body)
    behind = smoothed(body, distance_behind(body, seen, size))
    flatness = flat_sides(body, normals)
    # Beyond an edge, light is another one at once.
    unlit = np.maximum(1.0 - np.exp(-behind / (EVEN * size)), flatness)[:, None]
    blend, seam = _without_seams(body, seen, colours, unlit, texture, matter, light, size)
    return SurfaceValues(
        place=body.vertices,
        normal=vertex_normals(body),
        counterpart=colours,
        pixel=body.pixels,
        hidden=hidden[:, None],
        flatness=flatness[:, None],
        unlit=unlit,
        blended=blend,
        seam=seam[:, None],
    )


def _joined(photo: NDArray[Number], charts: NDArray[Number]) -> NDArray[Number]:
    """``photo`` (h, w, C), its last column repeated, above ``charts`` (H, W, C)."""
    wide = charts.shape[1] - photo.shape[1]
    return np.concatenate([np.pad(photo, ((0, 0), (0, wide), (0, 0)), mode="edge"), charts])


class OwnPixels(NamedTuple):
    """What the photo shows of places. at: (P, 2) px of the texture, from the centre of the first. cosine: (P,) of the
    angle to the camera. away: (P,) px from the outline. clear: (P,) whether the pixel is shown whatever the angle.
    share: (P, 1) of the photo in their colours."""

    at: Points
    cosine: NDArray[np.float64]
    away: NDArray[np.float64]
    clear: NDArray[np.float64]
    share: Points


def own_pixels(camera: Camera, texels: SurfaceValues, texture: CropTexture, mask: Mask) -> OwnPixels:
    """Return what the photo shows of ``texels``; mask: (h, w) the object in ``texture``."""
    at = texels.pixel - (texture.left + 0.5, texture.top + 0.5)
    normal = texels.normal / np.maximum(np.linalg.norm(texels.normal, axis=1, keepdims=True), 1e-12)
    towards = camera.position - texels.place
    cosine = (normal * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
    depth = ndimage.distance_transform_edt(mask).astype(np.float32)[..., None]
    away = sampled(depth, at)[:, 0]
    clear = smoothstep(away, *CLEAR) * (cosine > SHOWN[0]) * texels.flatness[:, 0]
    share = np.maximum(smoothstep(cosine, *SHOWN), clear)[:, None] * (1.0 - texels.hidden)
    return OwnPixels(at, cosine, away, clear, share)


def _shown(camera: Camera, body: BodyMesh, mask: Mask) -> tuple[Mask, NDArray[np.float64]]:
    """Whether the photo shows each face (T,), and the cosine (T,) of its angle to the camera.

    A face is hidden by others of the body, and where the photo's border cuts the object.
    """
    normals, _ = face_normals(body.vertices[body.faces])
    middle = body.vertices[body.faces].mean(axis=1)
    towards = camera.position - middle
    cosine = (normals * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
    at = camera.project(body.vertices)
    low, high = at[:, :2].min(axis=0), at[:, :2].max(axis=0)
    cells = CELLS / max(float((high - low).max()), 1.0)
    grid = np.column_stack([(at[:, :2] - low) * cells + 1.0, at[:, 2]])
    size = (int((high - low)[0] * cells) + 3, int((high - low)[1] * cells) + 3)
    front = rasterise(grid, body.faces, size, cosine > 0)
    depth = np.full(size[::-1], np.inf)
    depth[front.rows, front.columns] = front.interpolated(body.faces, at[:, 2:])[:, 0]
    # The deepest of the cells around: along the outline nothing is hidden by its own slope.
    depth = ndimage.maximum_filter(depth, 3)
    centre = camera.project(middle)
    column, row = ((centre[:, i] - low[i]) * cells + 1.0 for i in (0, 1))
    slack = BEHIND * float(np.ptp(body.vertices, axis=0).max())
    x, y = column.clip(0, size[0] - 1).astype(np.int64), row.clip(0, size[1] - 1).astype(np.int64)
    before = centre[:, 2] <= depth[y, x] + slack
    near = ndimage.binary_dilation(mask, iterations=OUTSIDE)
    x, y = (np.floor(centre[:, i]).astype(np.int64) for i in (0, 1))
    inside = (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
    inside[inside] = near[y[inside], x[inside]]
    return np.asarray(before & inside & (cosine > 0)), cosine


def _pixels_per_unit(camera: Camera, vertices: Points) -> float:
    """Pixels of the photo that a unit of length covers at the middle of ``vertices`` (V, 3)."""
    return camera.fx / max(float(np.median(camera.project(vertices)[:, 2])), 1e-9)


def _cropped(mask: Mask, texture: CropTexture) -> Mask:
    height, width = texture.pixels.shape[:2]
    return mask[texture.top : texture.top + height, texture.left : texture.left + width]


def _without_seams(
    body: BodyMesh,
    seen: Mask,
    counterpart: Points,
    unlit: Points,
    texture: CropTexture,
    matter: PlainMatter,
    light: NDArray[np.float32],
    size: float,
) -> tuple[Points, NDArray[np.float64]]:
    """Colours (V, 3) across seams between counterparts, which a box has at its edges only, and their share (V,)."""
    like = counterpart - (texture.left + 0.5, texture.top + 0.5)
    plain = _without_light(sampled(matter.colours, like), unlit * sampled(light, like))
    if body.corner_colours is not None:
        return plain, np.zeros(len(plain))
    return blended(body, seen, like, plain, size)


def _colours(
    texels: SurfaceValues,
    own: OwnPixels,
    texture: CropTexture,
    mask: Mask,
    matter: PlainMatter,
    light: NDArray[np.float32],
    frame: Points,
    pixels: float,
) -> NDArray[np.float64]:
    """Colours (P, 3) of ``texels``.

    mask: (h, w) the object in ``texture``. light: (h, w, 3) its logarithm. pixels: of the photo per unit of length.
    """
    normal = texels.normal / np.maximum(np.linalg.norm(texels.normal, axis=1, keepdims=True), 1e-12)
    like = texels.counterpart - (texture.left + 0.5, texture.top + 0.5)
    grain = _grain(matter, texels.place @ frame.T * pixels, normal @ frame.T)
    grain *= sampled(matter.contrast[..., None], like)
    plain = _without_light(sampled(matter.colours, like), texels.unlit * sampled(light, like))
    plain += texels.seam * (texels.blended - plain) + grain
    seen = np.flatnonzero(own.share[:, 0] > 0)
    if not len(seen):
        return plain
    # Grain of mean zero over each pixel of the photo.
    height, width = texture.pixels.shape[:2]
    cell = np.clip(np.floor(own.at[seen] + 0.5), 0, (width - 1, height - 1)).astype(np.int64)
    cell = cell[:, 1] * width + cell[:, 0]
    count = np.maximum(np.bincount(cell, minlength=height * width), 1)
    added = grain[seen]
    for i in range(3):
        added[:, i] -= (np.bincount(cell, added[:, i], minlength=height * width) / count)[cell]
    added *= (1.0 - smoothstep(own.cosine[seen], *GRAIN))[:, None]
    photo = sampled(texture.pixels.astype(np.float32), own.at[seen])
    inner = sampled(inner_colours(texture.pixels.astype(np.float32), mask), own.at[seen])
    pure = np.maximum(smoothstep(own.away[seen], *PURE), smoothstep(own.cosine[seen], *GRAIN))
    share = np.maximum(pure * smoothstep(own.cosine[seen], *OWN), own.clear[seen])
    photo = inner + share[:, None] * (photo - inner) + added
    plain[seen] += own.share[seen] * (photo - plain[seen])
    return plain


def _cover(camera: Camera, texels: SurfaceValues, texture: CropTexture) -> NDArray[np.float64]:
    """Alpha (P,), 0 to 255, of ``texels``: the photo's where they face its camera, else full."""
    assert texture.alpha is not None
    own = texels.pixel - (texture.left + 0.5, texture.top + 0.5)
    towards = ((camera.position - texels.place) * texels.normal).sum(axis=1) > 0
    shown = towards * (1.0 - texels.hidden[:, 0])
    return 255.0 - shown * (255.0 - sampled(texture.alpha[..., None].astype(np.float32), own)[:, 0])


def _without_light(colours: Points, light: Points) -> NDArray[np.float64]:
    """sRGB ``colours`` (P, 3), 0 to 255, divided by the exponential of ``light`` (P, 3) in linear light."""
    return 255.0 * linear_to_srgb(srgb_to_linear(colours / 255.0) * np.exp(-light)).astype(np.float64)


def _grain(matter: PlainMatter, place: Points, normal: Points) -> NDArray[np.float64]:
    """Grain (P, 3) at places (P, 3) in pixels with ``normal`` (P, 3), blended between the planes that they face."""
    weights = np.abs(normal) ** PLANE_SHARPNESS
    weights /= np.sqrt((weights**2).sum(axis=1, keepdims=True))
    result = np.zeros((len(place), 3))
    for axis, plane in enumerate(PLANES):
        for side in (0, 1):
            used = np.flatnonzero((weights[:, axis] > 0.05) & ((normal[:, axis] > 0) == bool(side)))
            if len(used):
                made = synthesised_grain(matter.swatch, place[used][:, plane] * (1.0, -1.0), 2 * axis + side)
                result[used] += weights[used, axis, None] * made
    return result
