# SPDX-License-Identifier: MIT
"""Pixels of the photo that correspond to each point of a body, the photo around an object, and GLB output.

A point that the camera sees corresponds to its own pixel. Unseen ones correspond to their counterpart on a primitive
(the opposite face of a box, the near side of a can or sphere), or to the photo folded over at the rim: a hidden point
corresponds to the pixel as far inside the outline as it lies behind the rim along the surface. `texture_atlas.py` makes
the texture of both.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from trimesh.visual.material import PBRMaterial

from ...scene.model import Camera, Matrix4
from ..mesh_raster import rasterise
from .inflate import Crop
from .inflated_mesh import BodyMesh
from .plain_matter import inner_colours
from .primitives import Box, Primitive, Sphere, SurfaceOfRevolution

Points = NDArray[np.float64]

GRAZING = np.cos(np.radians(89.0))
"""Faces at a larger angle to the camera count as unseen. A flat face at 86°, such as a book's fore-edge, still covers a
strip of several pixels, and the first frame is the photo only if that strip has its own."""
RIM = (2.0, 0.015)
"""Least distance of source colours from the outline for unseen points: pixels, and share of the object's size; the
larger."""
OUTSIDE = 3.0
"""Pixels outside the outline beyond which a vertex has no pixel either: the photo's border cuts the object."""
DEEPEST = 0.35
"""Largest inward distance of source colours, over the widest inscribed circle."""
NEAR = 0.06
"""Distance from the primitive's surface, over its size, up to which a vertex belongs to it."""
INSET = (0.05, 0.4)
"""Least distance of source colours from the edges of a box' face, over the box' longest side, and at most over half of
the face's own: along its edges the photo shows what lies around the corner, and a warped outline."""
FRONT_CELLS = 256
"""Cells along the longer side of the picture that tells what is in front of a hidden vertex."""
EVENED = 6
"""Rounds of averaging of how far a counterpart moves to its vertex' height."""
STEPS = 24
"""Steps of the inward march."""


def colour_pixels(camera: Camera, mesh: BodyMesh, crop: Crop, primitive: Primitive | None) -> Points:
    """Return photo pixels (V, 2) whose colours the vertices of ``mesh`` take: their own pixels where visible.

    crop: the mask of the mesh. primitive: its primitive, None for an inflated body.
    """
    corner = np.array([crop.left + 0.5, crop.top + 0.5])
    last = np.array(crop.mask.shape[::-1]) - 1.0
    at = np.clip(mesh.pixels - corner, 0.0, last)
    look = np.where(np.abs(at + corner - mesh.pixels).max(axis=1, keepdims=True) > 1e-6, at + corner, mesh.pixels)
    beyond = ndimage.map_coordinates(crop.distance, at[:, ::-1].T, order=1, mode="nearest") < -OUTSIDE
    hidden = ~seen_vertices(camera, mesh) | beyond
    if not hidden.any() or hidden.all():
        return look
    size = float(np.sqrt(crop.mask.sum()))
    target = np.full(len(look), max(RIM[0], RIM[1] * size))
    free = hidden
    if primitive is not None:
        extent = float(np.ptp(mesh.vertices, axis=0).max())
        distance = np.minimum(primitive.inside(mesh.vertices, 0.0), mesh.vertices[:, 2])
        on_it = hidden & (np.abs(distance) < NEAR * extent)
        look[on_it] = camera.project(_counterparts(camera, primitive, mesh.vertices[on_it]))[:, :2]
        free = hidden & ~on_it
    if free.any():
        look[free] = _level(camera, mesh, look, hidden)[free]
        behind = np.minimum(distance_behind(mesh, ~hidden, size), DEEPEST * float(crop.distance.max()))
        target[free] = np.maximum(target[free], behind[free])
    look[hidden] = _inwards(crop, look[hidden], target[hidden])
    return look


def corner_pixels(camera: Camera, mesh: BodyMesh, crop: Crop, box: Box) -> Points:
    """Return photo pixels (T, 3, 2) whose colours the corners of each face of ``mesh``, a ``box``, take.

    Those of its vertices where the camera sees the face. Along an edge a vertex belongs to two sides: where one is
    hidden, its colours are those of its own counterpart up to the edge.
    """
    assert mesh.colours is not None
    look = mesh.colours[mesh.faces]
    cosine, normal = _facing(camera, mesh)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    away = np.abs(np.minimum(box.inside(mesh.vertices, 0.0), mesh.vertices[:, 2])) > NEAR * extent
    hidden = (cosine <= GRAZING) & ~away[mesh.faces].any(axis=1)
    corners = mesh.vertices[mesh.faces[hidden]].reshape(-1, 3)
    found = camera.project(_on_box(camera, box, corners, np.repeat(normal[hidden], 3, axis=0)))[:, :2]
    size = float(np.sqrt(crop.mask.sum()))
    found = _inwards(crop, found, np.full(len(found), max(RIM[0], RIM[1] * size)))
    look[hidden] = found.reshape(-1, 3, 2)
    return look


def seen_vertices(camera: Camera, mesh: BodyMesh) -> NDArray[np.bool_]:
    """Return whether (V,) any face at a vertex faces the camera well enough."""
    seen = np.zeros(len(mesh.vertices), dtype=bool)
    seen[mesh.faces[_facing(camera, mesh)[0] > GRAZING]] = True
    return seen


def _facing(camera: Camera, mesh: BodyMesh) -> tuple[NDArray[np.float64], Points]:
    """Cosine (T,) of each face's angle to the camera, and its normal (T, 3), of any length."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    towards = camera.position - (a + b + c) / 3.0
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    return (normal * towards).sum(axis=1) / np.maximum(length, 1e-300), normal


def _counterparts(camera: Camera, primitive: Primitive, points: Points) -> Points:
    """Points (n, 3) on the visible side of ``primitive`` that correspond to ``points`` (n, 3) on its hidden side."""
    if isinstance(primitive, Box):
        return _on_box(camera, primitive, points)
    if isinstance(primitive, Sphere):
        return _on_sphere(camera, primitive, points)
    assert isinstance(primitive, SurfaceOfRevolution)
    foot = np.array([primitive.x, primitive.y])
    axis2 = camera.position[:2] - foot
    distance = float(np.linalg.norm(axis2))
    axis2 = axis2 / max(distance, 1e-12)
    offset = points[:, :2] - foot
    along, across2 = offset @ axis2, offset @ np.array([-axis2[1], axis2[0]])
    rho = np.hypot(along, across2)
    rim = float(np.arccos(min(max(primitive.radii) / max(distance, 1e-12), 0.95)))
    angle = np.sign(across2) * _folded(np.abs(np.arctan2(across2, along)), rim)
    turned = np.cos(angle)[:, None] * axis2 + np.sin(angle)[:, None] * np.array([-axis2[1], axis2[0]])
    radius = np.interp(points[:, 2], primitive.heights, primitive.radii)
    # The base takes the wall's lower end, radius by height.
    under = points[:, 2] < 1e-3 * primitive.height
    z = np.where(under, np.clip(radius - rho, 0.0, 0.5 * primitive.height), points[:, 2])
    radius = np.where(under, np.interp(z, primitive.heights, primitive.radii), radius)
    return np.column_stack([foot + radius[:, None] * turned, z])


def _on_sphere(camera: Camera, sphere: Sphere, points: Points) -> Points:
    """Points (n, 3) on the visible side of ``sphere`` at the height of ``points`` (n, 3), where light from above falls
    alike; at another height where none of it is visible."""
    # In units of its semi-axes it is a unit sphere.
    axis = (camera.position - sphere.centre) / sphere.axes
    distance = float(np.linalg.norm(axis))
    axis = axis / distance
    rim = float(np.arccos(min(1.0 / distance, 0.999)))
    offset = (points - sphere.centre) / sphere.axes
    offset = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
    level = float(np.hypot(axis[0], axis[1]))
    ahead = axis[:2] / max(level, 1e-12)
    left = np.array([-ahead[1], ahead[0]])
    wide = np.hypot(offset[:, 0], offset[:, 1])
    # How far around each height is visible, and the point as far from the middle of that.
    limit = (np.cos(rim) - offset[:, 2] * axis[2]) / np.maximum(wide * level, 1e-12)
    turn = np.arctan2(offset[:, :2] @ left, offset[:, :2] @ ahead)
    turn = np.sign(turn) * _folded(np.abs(turn), np.arccos(np.clip(limit, -1.0, 1.0)))
    ball = np.column_stack(
        [wide[:, None] * (np.cos(turn)[:, None] * ahead + np.sin(turn)[:, None] * left), offset[:, 2]]
    )
    along = ball @ axis
    across = ball - along[:, None] * axis
    span = np.linalg.norm(across, axis=1)
    angle = _folded(np.arctan2(span, along), rim)
    side = across / np.maximum(span, 1e-12)[:, None]
    return np.asarray(sphere.centre + sphere.axes * (np.cos(angle)[:, None] * axis + np.sin(angle)[:, None] * side))


def _folded(angle: Points, rim: float | Points) -> Points:
    """Angles from the line of sight, 0 to π, folded at ``rim`` so that π maps to 0; a little of the rim is avoided."""
    rim = np.maximum(rim - np.radians(8.0), np.radians(20.0))
    return np.asarray(np.clip(np.where(angle > rim, rim - (angle - rim) * rim / (np.pi - rim), angle), 0.0, rim))


def _on_box(camera: Camera, box: Box, points: Points, normals: Points | None = None) -> Points:
    """Points (n, 3) on a visible side of ``box`` that correspond to ``points`` (n, 3) on hidden sides.

    normals: (n, 3) of the sides that they belong to; None for the nearest ones.
    """
    frame = np.eye(3)
    frame[:2, :2] = np.stack(box.axes)
    half = np.array([box.width, box.depth, box.height]) / 2.0
    local = (points - box.centre) @ frame.T
    eye = (camera.position - box.centre) @ frame.T
    shown = np.abs(eye) > half
    towards = np.where(eye > 0, 1.0, -1.0)
    if not shown.any():
        return points
    # The face that faces the camera most.
    best = int(np.argmax(np.where(shown, np.abs(eye) - half, -np.inf)))
    axis = np.argmax(np.abs(local) - half if normals is None else np.abs(normals @ frame.T), axis=1)
    inner = half - np.minimum(INSET[0] * 2.0 * float(half.max()), INSET[1] * half)
    result = local.copy()
    for own in range(3):
        rows = axis == own
        face = own if shown[own] else best
        if not shown[own]:
            # Neither this face nor the opposite one is visible: fold the best one over their common edge.
            back = half[best] - towards[best] * local[rows, best]
            inward = back * min(1.0, half[own] / half[best])
            result[rows, own] = np.sign(local[rows, own]) * (half[own] - inward)
        result[rows] = np.clip(result[rows], -inner, inner)
        result[rows, face] = towards[face] * half[face]
    return np.asarray(result @ frame + box.centre)


def distance_behind(mesh: BodyMesh, seen: NDArray[np.bool_], size: float) -> Points:
    """Return the distance (V,) in pixels along mesh edges from the vertices ``seen`` (V,); ``size`` where there is no
    way."""
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    # Pixels per unit: the outline's size over the body's.
    extent = np.ptp(mesh.pixels, axis=0).max() / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    count = len(mesh.vertices)
    graph = sparse.coo_matrix((np.maximum(lengths * extent, 1e-9), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    distance = dijkstra(graph, directed=False, indices=np.flatnonzero(seen), min_only=True)
    return np.asarray(np.nan_to_num(distance, posinf=size))


def _level(camera: Camera, mesh: BodyMesh, look: Points, hidden: NDArray[np.bool_]) -> Points:
    """``look`` (V, 2) with those of ``hidden`` vertices where the visible side in front of them is as high as they are.

    What goes round a body, such as a ribbon, does so at one height; a camera that looks down sees the far side of it
    higher up in the photo. Where nothing is in front, ``look``.
    """
    at = camera.project(mesh.vertices)
    low, high = at[:, :2].min(axis=0), at[:, :2].max(axis=0)
    cells = FRONT_CELLS / max(float((high - low).max()), 1.0)
    size = (int((high - low)[0] * cells) + 1, int((high - low)[1] * cells) + 1)
    cell = np.column_stack([(at[:, :2] - low) * cells, at[:, 2]])
    shown = rasterise(cell, mesh.faces, size)
    front = np.full(size[::-1], np.inf)
    front[shown.rows, shown.columns] = shown.interpolated(mesh.faces, at[:, 2:])[:, 0]
    column, row = (cell[:, i].astype(np.int64).clip(0, size[i] - 1) for i in (0, 1))
    depth = np.minimum(front[row, column], at[:, 2])
    before = camera.position + depth[:, None] * camera.rays(at[:, :2])
    before[:, 2] = mesh.vertices[:, 2]
    moved = np.where(hidden[:, None], camera.project(before)[:, :2] - at[:, :2], 0.0)
    # Along the rim, where the depth in front is a steep slope, neighbours would differ.
    count = np.maximum(np.bincount(mesh.faces.ravel(), minlength=len(moved)), 1)[:, None]
    for _ in range(EVENED):
        total = np.zeros_like(moved)
        for corner in range(3):
            np.add.at(total, mesh.faces[:, corner], moved[mesh.faces].mean(axis=1))
        moved = total / count
    return np.asarray(np.where(hidden[:, None], look + moved, look))


def _inwards(crop: Crop, pixels: Points, target: Points) -> Points:
    """``pixels`` (n, 2) moved up the gradient of the distance to the outline until that is ``target`` (n,)."""
    smooth = ndimage.gaussian_filter(crop.distance, max(1.5, 0.01 * float(np.sqrt(crop.mask.sum()))))
    slope = np.gradient(smooth)
    corner = np.array([crop.left + 0.5, crop.top + 0.5])
    at = pixels - corner
    for _ in range(STEPS):
        where = at[:, ::-1].T
        here = ndimage.map_coordinates(crop.distance, where, order=1, mode="nearest")
        rise = np.stack([ndimage.map_coordinates(slope[i], where, order=1, mode="nearest") for i in (1, 0)], axis=-1)
        step = np.clip((target - here) / 2.0, 0.0, np.maximum(target / 8.0, 1.0))
        # On a ridge the slope vanishes, and so does the step.
        at = at + step[:, None] * rise
    # Far outside there may be no gradient.
    last = np.array(crop.mask.shape[::-1]) - 1
    cell = np.clip(np.round(at).astype(int), 0, last)
    nearest = ndimage.distance_transform_edt(~crop.mask, return_distances=False, return_indices=True)
    column, row = nearest[1][cell[:, 1], cell[:, 0]], nearest[0][cell[:, 1], cell[:, 0]]
    outside = ~crop.mask[cell[:, 1], cell[:, 0]]
    at[outside] = np.stack([column, row], axis=-1)[outside]
    return np.asarray(at + corner)


Mask = NDArray[np.bool_]
MARGIN = 8
"""Margin of the texture around the silhouette in pixels, for filtering."""


@dataclass(frozen=True)
class CropTexture:
    """A part of the photo. pixels: (h, w, 3) uint8; left, top: photo pixels of its first corner. alpha: (h, w) uint8,
    255 where the object covers all of a pixel; None: everywhere."""

    pixels: NDArray[np.uint8]
    left: int
    top: int
    alpha: NDArray[np.uint8] | None = None

    def uv(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return UV (n, 2), v upward as in OpenGL and Blender, of photo ``pixels`` (n, 2)."""
        height, width = self.pixels.shape[:2]
        x, y = pixels[:, 0] - self.left, pixels[:, 1] - self.top
        return np.column_stack([x / width, 1.0 - y / height])

    def photo_pixels(self, uv: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return photo pixels (n, 2) of ``uv`` (n, 2): the inverse of ``uv()``."""
        height, width = self.pixels.shape[:2]
        return np.column_stack([uv[:, 0] * width + self.left, (1.0 - uv[:, 1]) * height + self.top])


@dataclass(frozen=True)
class TexturedSurface:
    """vertices: (V, 3); faces: (T, 3); uv: (V, 2), origin at the bottom left, into picture: (h, w, 3) uint8 sRGB.
    alpha: (h, w) uint8, how much of a texel the object covers where the photo shows its outline; None: all of each.
    shading: (h, w, 3) uint8 the photo's light in it (`shading.py`), None where that is not known."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64]
    picture: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None = None
    shading: NDArray[np.uint8] | None = None


def textured(body: BodyMesh, texture: CropTexture) -> TexturedSurface:
    """Return ``body`` textured by the photo."""
    pixels = body.pixels if body.colours is None else body.colours
    return TexturedSurface(body.vertices, body.faces, texture.uv(pixels), texture.pixels, texture.alpha)


def crop_texture(photo: NDArray[np.uint8], mask: Mask, alpha: NDArray[np.float32] | None = None) -> CropTexture:
    """Return the photo around ``mask``: the photo inside it, the object's own colours extended outward around it.

    alpha: (H, W) how much of each pixel the object covers. Where it is below 1 inside the mask, ``photo`` should have
    the object's colours alone (``matting.foreground_colours``).
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = max(0, int(rows[0]) - MARGIN), max(0, int(columns[0]) - MARGIN)
    window = (slice(top, int(rows[-1]) + 1 + MARGIN), slice(left, int(columns[-1]) + 1 + MARGIN))
    inside, colours = mask[window], photo[window].copy()
    carried = ndimage.gaussian_filter(inner_colours(colours.astype(np.float32), inside), (1.0, 1.0, 0.0))
    colours[~inside] = np.clip(carried[~inside] + 0.5, 0, 255).astype(np.uint8)
    if alpha is None:
        return CropTexture(pixels=colours, left=left, top=top)
    # Outside, the outline's own alpha is carried on, so that a body which reaches a little beyond has no hard rim.
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    cover = np.clip(alpha[window][tuple(nearest)] * 255.0 + 0.5, 0, 255).astype(np.uint8)
    return CropTexture(pixels=colours, left=left, top=top, alpha=cover)


def glb_bytes(
    surface: TexturedSurface,
    base_centre: NDArray[np.floating],
    metres: float,
    *,
    roughness: float = 0.6,
    metallic: float = 0.0,
) -> bytes:
    """Return ``surface`` as a GLB in metres, Y up (glTF's convention), its origin at ``base_centre`` (3,) in its own
    unit.

    roughness, metallic: of its shader, 0 to 1. Its colour is the photo's, with the photo's light on it. The picture's
    alpha is how soft the outline is in the photo; glTF viewers ignore it, for the material is opaque.
    """
    local = (surface.vertices - base_centre) * metres
    vertices = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]])
    picture = surface.picture if surface.alpha is None else np.dstack([surface.picture, surface.alpha])
    image = Image.fromarray(picture)
    image.format = "PNG"  # trimesh embeds in this format; JPEG would change the photo's pixels
    material = PBRMaterial(
        name="photo",
        baseColorTexture=image,
        metallicFactor=metallic,
        roughnessFactor=roughness,
        doubleSided=False,
    )
    mesh = trimesh.Trimesh(
        vertices=vertices,
        faces=surface.faces,
        visual=trimesh.visual.TextureVisuals(uv=surface.uv, material=material),
        process=False,
    )
    buffer = io.BytesIO()
    # Normals are written, or glTF readers must shade every triangle flat.
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def world_from_gltf(base_centre: NDArray[np.floating]) -> Matrix4:
    """Return the 4x4 matrix from the GLB's Y-up metres to world metres; ``base_centre`` (3,) in world metres."""
    x, y, z = (float(v) for v in base_centre)
    return ((1.0, 0.0, 0.0, x), (0.0, 0.0, -1.0, y), (0.0, 1.0, 0.0, z), (0.0, 0.0, 0.0, 1.0))
