# SPDX-License-Identifier: MIT
"""Texture of a body that may be seen from all sides: the photo where it is seen well, synthesised matter elsewhere.

The picture holds the photo around the object, above charts of the rest of the surface. Faces that the camera sees
squarely show the photo pixel for pixel. Towards the rim, where one pixel covers several texels, a chart holds the
photo with grain whose mean over each pixel is zero: the camera of the photo still sees the photo, any other no
streaks. What nothing shows is plain matter: the colours of its counterpart on the visible side without marks
(`plain_matter.py`), and grain that is laid over the surface in space, so no chart has a visible border.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...composite.srgb import linear_to_srgb, srgb_to_linear
from ...mpm.geometry.triangles import area_normals
from ...scene.model import Camera
from ...smoothstep import smoothstep
from ..mesh_raster import rasterise
from .body_texture import CropTexture, TexturedSurface, distance_behind, seen_vertices
from .even_light import light_on
from .hidden_seams import blended
from .inflated_mesh import BodyMesh
from .plain_matter import PlainMatter, inner_colours, plain_matter, synthesised_grain
from .surface_charts import surface_frame, unwrap

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
BENT = (1.0, 0.4)
"""Curvature times the body's extent (2 on a ball) from which ``CLEAR`` holds not at all, and up to which fully: the
pixels along the outline of a round side are mixed with the background, and other cameras would see them as a line."""
SMOOTHINGS = 6
"""Rounds of averaging of the distance behind the rim."""
FLAT_RINGS = 2
"""Faces by which a flat side has to reach on all sides: patches that are smaller count as round."""
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


class SurfaceValues(NamedTuple):
    """What the colour of a place on the body depends on, each (P, k), interpolated over its faces."""

    place: Points
    """(P, 3)."""

    normal: Points
    """(P, 3), not of unit length between vertices."""

    counterpart: Points
    """(P, 2) px of the photo where the visible side is like it."""

    pixel: Points
    """(P, 2) px of the photo where it is itself."""

    hidden: Points
    """(P, 1) share of its faces that others hide."""

    flatness: Points
    """(P, 1) 0 where curved as a ball, 1 on a plane."""

    unlit: Points
    """(P, 1) share of the counterpart's light that is taken out."""

    blended: Points
    """(P, 3) sRGB, 0 to 255, across seams between counterparts."""

    seam: Points
    """(P, 1) share of ``blended``."""

    @classmethod
    def from_columns(cls, columns: Points) -> SurfaceValues:
        """Return the values of ``columns`` (P, 17), as ``np.column_stack`` makes them."""
        return cls(*np.split(columns, np.cumsum(WIDTHS)[:-1], axis=1))


WIDTHS = (3, 3, 2, 2, 1, 1, 1, 3, 1)
"""Columns of each of the ``SurfaceValues``."""


def textured_body(camera: Camera, body: BodyMesh, texture: CropTexture, mask: Mask) -> TexturedSurface:
    """Return ``body`` with its texture; vertices along the borders of charts occur once per chart.

    texture: the photo around the object; mask: (H, W) the object. ``body.colours`` are the photo's pixels that
    correspond to each vertex, ``body.corner_colours`` to each face's corners. Deterministic.
    """
    shown, cosine = _shown(camera, body, mask)
    photo = shown & (cosine > SQUARE)
    colours = body.pixels if body.colours is None else body.colours
    if photo.all():
        return TexturedSurface(body.vertices, body.faces, texture.uv(body.pixels), texture.pixels, texture.alpha)
    rest = body.faces[~photo]
    normals, areas = _normals(body.vertices, body.faces)
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
    inside = _cropped(mask, texture)
    matter = plain_matter(texture.pixels, inside)
    size_px = float(np.sqrt(inside.sum()))
    seen = seen_vertices(camera, body)
    behind = _smoothed(body, distance_behind(body, seen, size_px))
    flatness = _flatness(body, normals)
    # Beyond an edge, light is another one at once.
    unlit = np.maximum(1.0 - np.exp(-behind / (EVEN * size_px)), flatness)[:, None]
    light = light_on(camera, body, texture, inside)
    blend, seam = _without_seams(body, seen, colours, unlit, texture, matter, light, size_px)
    hidden = _vertex_share(body, (cosine > 0) & ~shown)
    of_vertices = SurfaceValues(
        place=body.vertices,
        normal=_vertex_normals(body),
        counterpart=colours,
        pixel=body.pixels,
        hidden=hidden[:, None],
        flatness=flatness[:, None],
        unlit=unlit,
        blended=blend,
        seam=seam[:, None],
    )
    of_charts = SurfaceValues(*(np.array(value[charts.source], dtype=np.float64) for value in of_vertices))
    if body.corner_colours is not None:
        of_charts.counterpart[charts.faces] = body.corner_colours[~photo]
    at = np.column_stack([charts.texels, np.ones(len(charts.texels))])
    found = rasterise(at, charts.faces, charts.size, np.ones(len(rest), dtype=bool))
    texels = SurfaceValues.from_columns(found.interpolated(charts.faces, np.column_stack(of_charts)))
    soft = texture.alpha is not None
    below = np.zeros((charts.size[1], size[0], 4 if soft else 3), dtype=np.uint8)
    if len(found.rows):
        colour = _colours(camera, texels, texture, inside, matter, light, frame, pixels)
        if soft:
            colour = np.column_stack([colour, _cover(camera, texels, texture)])
        below[found.rows, found.columns] = np.clip(colour + 0.5, 0, 255).astype(np.uint8)
        covered = np.zeros(below.shape[:2], dtype=bool)
        covered[found.rows, found.columns] = True
        nearest = ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)
        below = below[tuple(nearest)]
    whole = texture.pixels if texture.alpha is None else np.dstack([texture.pixels, texture.alpha])
    above = np.pad(whole, ((0, 0), (0, size[0] - width), (0, 0)), mode="edge")
    uv = np.column_stack([place[:, 0] / size[0], 1.0 - place[:, 1] / size[1]])
    picture = np.concatenate([above, below])
    alpha = np.ascontiguousarray(picture[..., 3]) if soft else None
    return TexturedSurface(body.vertices[source], faces, uv, np.ascontiguousarray(picture[..., :3]), alpha)


def _normals(vertices: Points, faces: NDArray[np.int64]) -> tuple[Points, NDArray[np.float64]]:
    """Unit normals (T, 3) and areas (T,)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-300)[:, None], length / 2.0


def _shown(camera: Camera, body: BodyMesh, mask: Mask) -> tuple[Mask, NDArray[np.float64]]:
    """Whether the photo shows each face (T,), and the cosine (T,) of its angle to the camera.

    A face is hidden by others of the body, and where the photo's border cuts the object.
    """
    normals, _ = _normals(body.vertices, body.faces)
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


def _vertex_normals(body: BodyMesh) -> Points:
    summed = area_normals(body.vertices, body.faces)
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-300)


def _vertex_share(body: BodyMesh, faces: Mask) -> NDArray[np.float64]:
    """Share (V,) of a vertex' faces that are among ``faces`` (T,)."""
    count, total = np.zeros(len(body.vertices)), np.zeros(len(body.vertices))
    for corner in range(3):
        np.add.at(total, body.faces[:, corner], 1.0)
        np.add.at(count, body.faces[:, corner], faces)
    return count / np.maximum(total, 1.0)


def _smoothed(body: BodyMesh, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """``values`` (V,) averaged with those of neighbours: what begins at a row of faces would begin in teeth."""
    count = np.bincount(body.faces.ravel(), minlength=len(values))
    for _ in range(SMOOTHINGS):
        total = np.zeros(len(values))
        for corner in range(3):
            np.add.at(total, body.faces[:, corner], values[body.faces].mean(axis=1))
        values = total / np.maximum(count, 1)
    return values


def _flatness(body: BodyMesh, normals: Points) -> NDArray[np.float64]:
    """Flatness (V,) of the flattest side at each vertex, 0 where curved as a ball and 1 on a plane."""
    ends = np.sort(np.stack([body.faces, np.roll(body.faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    pairs = np.flatnonzero((ends[order][1:] == ends[order][:-1]).all(axis=1))
    first, second = order[pairs] // 3, order[pairs + 1] // 3
    middle = body.vertices[body.faces].mean(axis=1)
    bend = np.linalg.norm(normals[first] - normals[second], axis=1)
    bend /= np.maximum(np.linalg.norm(middle[first] - middle[second], axis=1), 1e-300)
    around = np.zeros((len(body.faces), 3))
    for one, edge in ((first, order[pairs]), (second, order[pairs + 1])):
        around[one, edge % 3] = bend
    extent = float(np.ptp(body.vertices, axis=0).max())
    flat = 1.0 - smoothstep(np.median(around, axis=1) * extent, *BENT[::-1])
    # A few even faces of a round side are no flat side: they would get other light than what is around them.
    for spread in (np.minimum, np.maximum):
        for _ in range(FLAT_RINGS):
            before = flat.copy()
            spread.at(flat, first, before[second])
            spread.at(flat, second, before[first])
    result = np.zeros(len(body.vertices))
    for corner in range(3):
        np.maximum.at(result, body.faces[:, corner], flat)
    return result


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
    plain = _without_light(_sampled(matter.colours, like), unlit * _sampled(light, like))
    if body.corner_colours is not None:
        return plain, np.zeros(len(plain))
    return blended(body, seen, like, plain, size)


def _colours(
    camera: Camera,
    texels: SurfaceValues,
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
    corner = (texture.left + 0.5, texture.top + 0.5)
    like, own = texels.counterpart - corner, texels.pixel - corner
    grain = _grain(matter, texels.place @ frame.T * pixels, normal @ frame.T)
    grain *= _sampled(matter.contrast[..., None], like)
    plain = _without_light(_sampled(matter.colours, like), texels.unlit * _sampled(light, like))
    plain += texels.seam * (texels.blended - plain) + grain
    towards = camera.position - texels.place
    cosine = (normal * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
    depth = ndimage.distance_transform_edt(mask).astype(np.float32)[..., None]
    away = _sampled(depth, own)[:, 0]
    clear = smoothstep(away, *CLEAR) * (cosine > SHOWN[0]) * texels.flatness[:, 0]
    weight = np.maximum(smoothstep(cosine, *SHOWN), clear)[:, None] * (1.0 - texels.hidden)
    seen = np.flatnonzero(weight[:, 0] > 0)
    if not len(seen):
        return plain
    # Grain of mean zero over each pixel of the photo.
    height, width = texture.pixels.shape[:2]
    cell = np.clip(np.floor(own[seen] + 0.5), 0, (width - 1, height - 1)).astype(np.int64)
    cell = cell[:, 1] * width + cell[:, 0]
    count = np.maximum(np.bincount(cell, minlength=height * width), 1)
    added = grain[seen]
    for i in range(3):
        added[:, i] -= (np.bincount(cell, added[:, i], minlength=height * width) / count)[cell]
    added *= (1.0 - smoothstep(cosine[seen], *GRAIN))[:, None]
    photo = _sampled(texture.pixels.astype(np.float32), own[seen])
    inner = _sampled(inner_colours(texture.pixels.astype(np.float32), mask), own[seen])
    pure = np.maximum(smoothstep(away[seen], *PURE), smoothstep(cosine[seen], *GRAIN))
    share = np.maximum(pure * smoothstep(cosine[seen], *OWN), clear[seen])
    photo = inner + share[:, None] * (photo - inner) + added
    plain[seen] += weight[seen] * (photo - plain[seen])
    return plain


def _cover(camera: Camera, texels: SurfaceValues, texture: CropTexture) -> NDArray[np.float64]:
    """Alpha (P,), 0 to 255, of ``texels``: the photo's where they face its camera, else full."""
    assert texture.alpha is not None
    own = texels.pixel - (texture.left + 0.5, texture.top + 0.5)
    towards = ((camera.position - texels.place) * texels.normal).sum(axis=1) > 0
    shown = towards * (1.0 - texels.hidden[:, 0])
    return 255.0 - shown * (255.0 - _sampled(texture.alpha[..., None].astype(np.float32), own)[:, 0])


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


def _sampled(picture: NDArray[np.float32], at: Points) -> NDArray[np.float64]:
    """``picture`` (h, w, C) at ``at`` (n, 2), x and y from the centre of the first pixel, bilinear, (n, C)."""
    # OpenCV takes at most 32767 places in a row.
    count, columns = len(at), 1024
    padded = -(-max(count, 1) // columns) * columns
    x, y = (np.pad(at[:, i].astype(np.float32), (0, padded - count)).reshape(-1, columns) for i in (0, 1))
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(padded, -1)[:count], dtype=np.float64)
