# SPDX-License-Identifier: MIT
"""Where on the photo the colours of what the camera does not see are taken from.

What faces the camera shows the pixels that it is seen at. The rest has no pixels of its own. On a primitive it takes
those of its counterpart: a box' hidden face those of the opposite one, the far side of a can or a ball those of the
near side, folded at the rim. On other bodies the photo is folded over at the rim as well: a hidden place takes the
colours as far inside the outline as it lies behind the rim, along the surface. Either way no pixel of the rim, half
background, is drawn out over a side that the camera sees at a grazing angle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from ...scene.model import Camera
from .crop import Crop
from .mesh import BodyMesh
from .primitives import Box, Primitive, Revolved, Sphere

Points = NDArray[np.float64]

GRAZING = np.cos(np.radians(80.0))
"""Faces that look less towards the camera than this count as not seen: a pixel would cover six of its size on them."""
RIM = (2.0, 0.015)
"""Unseen places take no colours nearer to the outline than this: pixels, and share of the object's size; the larger."""
OUTSIDE = 3.0
"""Pixels outside the outline beyond which a vertex has no pixel either: the photo's border cuts the object."""
DEEPEST = 0.35
"""How far inside colours are taken because of the rim, over the widest inscribed circle; farther in, as it comes."""
NEAR = 0.06
"""Distance from the primitive's surface, over its size, up to which a vertex belongs to it."""
STEPS = 24
"""Of the way inwards."""


def colour_pixels(camera: Camera, mesh: BodyMesh, crop: Crop, primitive: Primitive | None) -> Points:
    """Photo pixels (V, 2) whose colours the vertices of ``mesh`` wear; its own pixels where the camera sees it.

    crop: the outline the mesh was made from. primitive: what it was made from, None for an inflated body.
    """
    corner = np.array([crop.left + 0.5, crop.top + 0.5])
    last = np.array(crop.mask.shape[::-1]) - 1.0
    at = np.clip(mesh.pixels - corner, 0.0, last)
    look = np.where(np.abs(at + corner - mesh.pixels).max(axis=1, keepdims=True) > 1e-6, at + corner, mesh.pixels)
    beyond = ndimage.map_coordinates(crop.distance, at[:, ::-1].T, order=1, mode="nearest") < -OUTSIDE
    hidden = ~_seen(camera, mesh) | beyond
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
        behind = np.minimum(_behind(mesh, ~hidden, size), DEEPEST * float(crop.distance.max()))
        target[free] = np.maximum(target[free], behind[free])
    look[hidden] = _inwards(crop, look[hidden], target[hidden])
    return look


def _seen(camera: Camera, mesh: BodyMesh) -> NDArray[np.bool_]:
    """Whether any face (T) at a vertex (V,) looks at the camera well enough."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    towards = camera.position - (a + b + c) / 3.0
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    facing = (normal * towards).sum(axis=1) / np.maximum(length, 1e-300) > GRAZING
    seen = np.zeros(len(mesh.vertices), dtype=bool)
    seen[mesh.faces[facing]] = True
    return seen


def _counterparts(camera: Camera, primitive: Primitive, points: Points) -> Points:
    """Places (n, 3) on the seen side of ``primitive`` for ``points`` (n, 3) on its unseen one."""
    if isinstance(primitive, Box):
        return _on_box(camera, primitive, points)
    if isinstance(primitive, Sphere):
        # In units of its semi-axes it is a ball of radius 1.
        axis = (camera.position - primitive.centre) / primitive.axes
        distance = float(np.linalg.norm(axis))
        axis = axis / distance
        offset = (points - primitive.centre) / primitive.axes
        along = offset @ axis
        across = offset - along[:, None] * axis
        span = np.linalg.norm(across, axis=1)
        angle = _folded(np.arctan2(span, along), float(np.arccos(min(1.0 / distance, 0.999))))
        side = across / np.maximum(span, 1e-12)[:, None]
        ball = np.cos(angle)[:, None] * axis + np.sin(angle)[:, None] * side
        return np.asarray(primitive.centre + primitive.axes * ball)
    assert isinstance(primitive, Revolved)
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
    # The base wears the wall's lower end, radius by height.
    under = points[:, 2] < 1e-3 * primitive.height
    z = np.where(under, np.clip(radius - rho, 0.0, 0.5 * primitive.height), points[:, 2])
    radius = np.where(under, np.interp(z, primitive.heights, primitive.radii), radius)
    return np.column_stack([foot + radius[:, None] * turned, z])


def _folded(angle: Points, rim: float) -> Points:
    """Angles from the line of sight, 0 to π, folded at ``rim`` so that π comes to 0; a little of the rim is spared."""
    rim = max(rim - np.radians(8.0), np.radians(20.0))
    return np.asarray(np.clip(np.where(angle > rim, rim - (angle - rim) * rim / (np.pi - rim), angle), 0.0, rim))


def _on_box(camera: Camera, box: Box, points: Points) -> Points:
    frame = np.eye(3)
    frame[:2, :2] = np.stack(box.axes)
    half = np.array([box.width, box.depth, box.height]) / 2.0
    local = (points - box.centre) @ frame.T
    eye = (camera.position - box.centre) @ frame.T
    shown = np.abs(eye) > half
    towards = np.where(eye > 0, 1.0, -1.0)
    if not shown.any():
        return points
    # The face that looks most towards the camera.
    best = int(np.argmax(np.where(shown, np.abs(eye) - half, -np.inf)))
    axis = np.argmax(np.abs(local) - half, axis=1)
    result = local.copy()
    for own in range(3):
        rows = axis == own
        if shown[own]:
            result[rows, own] = towards[own] * half[own]
            continue
        # Neither this face nor the opposite one is seen: fold the best one over their common edge.
        back = half[best] - towards[best] * local[rows, best]
        inward = back * min(1.0, half[own] / half[best])
        result[rows, own] = np.sign(local[rows, own]) * (half[own] - inward)
        result[rows, best] = towards[best] * half[best]
    return np.asarray(result @ frame + box.centre)


def _behind(mesh: BodyMesh, seen: NDArray[np.bool_], size: float) -> Points:
    """Distance (V,) in pixels along the edges from what is seen."""
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    # As many pixels as the outline is large, over as many units as the body is.
    extent = np.ptp(mesh.pixels, axis=0).max() / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    count = len(mesh.vertices)
    graph = sparse.coo_matrix((np.maximum(lengths * extent, 1e-9), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    distance = dijkstra(graph, directed=False, indices=np.flatnonzero(seen), min_only=True)
    return np.asarray(np.nan_to_num(distance, posinf=size))


def _inwards(crop: Crop, pixels: Points, target: Points) -> Points:
    """``pixels`` (n, 2) moved up the slope of the distance to the outline until that is ``target`` (n,)."""
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
    # From far outside there may be no slope to climb.
    last = np.array(crop.mask.shape[::-1]) - 1
    cell = np.clip(np.round(at).astype(int), 0, last)
    nearest = ndimage.distance_transform_edt(~crop.mask, return_distances=False, return_indices=True)
    column, row = nearest[1][cell[:, 1], cell[:, 0]], nearest[0][cell[:, 1], cell[:, 0]]
    outside = ~crop.mask[cell[:, 1], cell[:, 0]]
    at[outside] = np.stack([column, row], axis=-1)[outside]
    return np.asarray(at + corner)
