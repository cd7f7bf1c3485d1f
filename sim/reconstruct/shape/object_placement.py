# SPDX-License-Identifier: MIT
"""Place bodies along the camera's rays, which changes nothing in the photo: on supports, hanging, and apart.

Where the photo shows another object right below an object's foot, the foot touches that object. Scaling a body about
the camera moves nothing in the photo, so it is moved to the depth at which the ray through its foot meets its support.

Objects whose foot lies above the horizon stand on no ground, and hang as far away as what does. Such an object is made
in a view that is turned about its own centre until the foot lies below the horizon; turning about the centre of
projection changes nothing in the photo either.

Two bodies can overlap only where the photo shows one in front of the other: their silhouettes would be disjoint
otherwise, and so would their cones of sight. Along each ray through both, the body in front should end where the one
behind begins. What reaches too far is on a side that the photo does not show, either the back of the one or the hidden
part of the other, so vertices slide along their own rays until the two are apart: silhouettes, texture coordinates and
everything visible stay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import (
    camera_above_ground,
    declination,
    ground_depth,
    pitch_and_roll,
    stands_below,
    up_in_camera,
)
from ..mesh_raster import depth_range

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

SEEN_FROM_DEG = 15.0
"""Angle below the horizontal of the foot in the turned view: things that hang are seen nearly level."""
ALONE = 3.0
"""Distance of what hangs alone, in heights of the camera."""
CLEAR = 0.05
"""Least height of its lowest point, in heights of the camera."""


def turned_view(view: Camera, mask: Mask) -> Camera | None:
    """Return ``view`` turned until the foot of ``mask`` (H, W), not empty, lies below the horizon; None if it does."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[-1]])
    foot = np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])
    if stands_below(view, foot):
        return None
    pitch, roll = pitch_and_roll(up_in_camera(view))
    turned = view
    for _ in range(4):
        # At the sides of a wide photo the angle grows more slowly than the pitch.
        pitch = min(pitch + math.radians(SEEN_FROM_DEG) - float(declination(turned, foot)), math.radians(89.0))
        pose = camera_above_ground(view.width, view.height, view.fx, pitch, roll).world_from_camera
        turned = replace(view, world_from_camera=pose)
    return turned


def hung(view: Camera, turned: Camera, vertices: Points, standing: Sequence[Points]) -> Points:
    """Return ``vertices`` (V, 3), made in the view ``turned``, in the world of ``view``, above the ground z = 0.

    standing: (W, 3) vertices of the bodies on the ground; it hangs as far away as the nearest, or at a usual distance.
    """
    made = turned.project(vertices)
    wanted = min((float(np.median(view.project(points)[:, 2])) for points in standing), default=ALONE)
    rays = view.rays(made[:, :2]) * made[:, 2:]
    factor = wanted / float(np.median(made[:, 2]))
    drop = -float(rays[:, 2].min())
    if drop > 0.0:
        factor = min(factor, (1.0 - CLEAR) * view.position[2] / drop)
    return np.asarray(view.position + factor * rays)


TriangleMesh = tuple[Points, NDArray[np.int64]]

BELOW = 0.012
"""Height of the band below a foot, over the photo's longer side."""
SHARE = 0.6
"""Share of the foot's width that another object must cover below it."""
FOOT = 0.06
"""Lowest share of an object's height that is its foot."""
NEAREST = 0.2
"""Least distance of a moved body from the camera, over its distance on the ground."""


@dataclass(frozen=True)
class Support:
    """``upper`` stands on ``lower`` (indices); ``factor``: its distance from the camera over that where it was."""

    upper: int
    lower: int
    factor: float


def resting_on(seen: Sequence[Mask]) -> dict[int, int]:
    """Return, by index of an object, the index of its support: the object that the photo shows below its foot.

    seen: (H, W) visible pixels of each object. Objects on the ground, and cycles, are left out.
    """
    found: dict[int, int] = {}
    for i, mask in enumerate(seen):
        below = _below_foot(mask)
        if not below.any():
            continue
        shares = [0.0 if j == i else float((below & other).sum() / below.sum()) for j, other in enumerate(seen)]
        best = int(np.argmax(shares))
        if shares[best] >= SHARE and not _stands_on(found, best, i):
            found[i] = best
    return found


def _stands_on(found: dict[int, int], upper: int, lower: int) -> bool:
    """Whether ``upper`` stands on ``lower``, directly or indirectly."""
    while upper in found:
        upper = found[upper]
        if upper == lower:
            return True
    return False


def _below_foot(mask: Mask) -> Mask:
    """A band of pixels (H, W) right below the lowest part of ``mask``."""
    rows = np.flatnonzero(mask.any(axis=1))
    band = max(2, round(BELOW * max(mask.shape)))
    bottom = int(rows[-1]) + 1
    foot = mask[bottom - max(1, round(FOOT * len(rows))) : bottom].any(axis=0)
    result = np.zeros_like(mask)
    # Skip the seam between two objects, which mixes both.
    result[bottom + 1 : bottom + 1 + band] = foot
    return np.asarray(result & ~mask)


def place_on_supports(camera: Camera, seen: Sequence[Mask], meshes: Sequence[TriangleMesh]) -> list[Support]:
    """Return how bodies must be scaled about ``camera`` to stand on the supports that the photo shows.

    seen: (H, W); meshes: vertices (V, 3) and faces (T, 3) of all objects, standing on z = 0, or hanging where the foot
    lies above the horizon, in the camera's unit. Lower ones come first. A body whose ray misses its support stays.
    """
    on = resting_on(seen)
    factors = [1.0] * len(seen)
    placed: list[Support] = []
    for upper in sorted(on, key=lambda i: _height(on, i)):
        lower = on[upper]
        vertices = camera.position + factors[lower] * (meshes[lower][0] - camera.position)
        pixel = _foot_pixel(seen[upper])
        ray = camera.rays(pixel)
        depth = first_hit(camera.position, ray, vertices, meshes[lower][1])
        own = float(camera.project(meshes[upper][0])[:, 2].min())
        if stands_below(camera, pixel):
            factor = depth / (-camera.position[2] / ray[2])
            placeable = NEAREST < factor < 0.999
        else:
            projected = camera.project(meshes[upper][0])
            factor = depth / projected[np.linalg.norm(projected[:, :2] - pixel, axis=1).argmin(), 2]
            placeable = bool(np.isfinite(factor))
        if placeable and own > 0:
            factors[upper] = float(factor)
            placed.append(Support(upper, lower, float(factor)))
    return placed


def _height(on: dict[int, int], index: int) -> int:
    steps = 0
    while index in on:
        index, steps = on[index], steps + 1
    return steps


def _foot_pixel(mask: Mask) -> Points:
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[-1]])
    return np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])


def first_hit(origin: Points, ray: Points, vertices: Points, faces: NDArray[np.int64]) -> float:
    """Return the distance in lengths of ``ray`` (3,) from ``origin`` (3,) to the first triangle that it meets; inf for
    none.

    Möller & Trumbore, Journal of Graphics Tools 2(1), 1997.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    edge, other = b - a, c - a
    across = np.cross(ray, other)
    determinant = np.einsum("ti,ti->t", edge, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        start = origin - a
        u = np.einsum("ti,ti->t", start, across) / determinant
        turned = np.cross(start, edge)
        v = turned @ ray / determinant
        distance = np.einsum("ti,ti->t", other, turned) / determinant
        hit = (np.abs(determinant) > 1e-15) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-9)
    return float(distance[hit].min()) if hit.any() else float("inf")


Faces = NDArray[np.int64]

CELLS = 160
"""Cells along the longer side of the window that two silhouettes share."""
GAP = 0.002
"""Distance left between the two along a ray, over the front body's extent; contact closes it."""
THINNEST = 0.02
"""Depth that is left of a body along a ray, over its extent: with less it would have no inside there."""
MOST_THINNED = 0.5
"""Largest share of its depth that a front body of unknown shape gives way."""
TOUCHING = 0.01
"""Depth along a ray, over the front body's extent, by which bodies may share space: those that rest on each other do so
by rounding, and moving them would take their support away."""


@dataclass(frozen=True)
class PlacedBody:
    """vertices: (V, 3); faces: (T, 3), in the camera's unit. guessed: whether its depth is inflated from its outline
    rather than that of a primitive or a given mesh."""

    vertices: Points
    faces: Faces
    guessed: bool

    @property
    def extent(self) -> float:
        """Return the largest extent along the world's axes, in the camera's unit."""
        return float(np.ptp(self.vertices, axis=0).max())


@dataclass(frozen=True)
class Separation:
    """``yielding`` gave way to ``other`` (indices) by up to ``share`` of its own extent."""

    yielding: int
    other: int
    share: float


def separate(
    camera: Camera, bodies: Sequence[PlacedBody], front_to_back: Sequence[int]
) -> tuple[list[Points], list[Separation]]:
    """Return the vertices (V, 3) of ``bodies``, none of which reaches into another along any ray, and what gave way.

    front_to_back: indices of the bodies as the photo shows them. A front body whose depth is guessed gives up to half
    of it to one behind whose depth is known; else the one behind recedes. Nothing is moved below the ground z = 0.
    """
    placed = list(bodies)
    moved: dict[tuple[int, int], float] = {}

    def put(index: int, other: int, depth: Points, projected: Points) -> None:
        body = placed[index]
        away = float(np.abs(depth - projected[:, 2]).max())
        if away <= 0.0:
            return
        vertices = body.vertices.copy()
        changed = depth != projected[:, 2]
        rays = camera.rays(projected[changed, :2])
        vertices[changed] = camera.position + depth[changed, None] * rays
        placed[index] = PlacedBody(vertices, body.faces, body.guessed)
        moved[index, other] = max(moved.get((index, other), 0.0), away / max(body.extent, 1e-12))

    for place, front in enumerate(front_to_back):
        for behind in front_to_back[place + 1 :]:
            if placed[front].guessed and not placed[behind].guessed:
                near = _Pair.of(camera, placed[front], placed[behind])
                if near is not None and near.overlap:
                    put(front, behind, near.front_thinned(), near.front)
            near = _Pair.of(camera, placed[front], placed[behind])
            if near is not None and near.overlap:
                put(behind, front, near.behind_receded(camera), near.behind)
    found = [Separation(index, other, share) for (index, other), share in moved.items()]
    return [body.vertices for body in placed], found


@dataclass(frozen=True)
class _Pair:
    """Two bodies over the window that their silhouettes share.

    front, behind: (V, 3) pixels and depth of their vertices. corner: (2,) pixels; cell: pixels. front_range,
    behind_range: nearest and farthest depth (h, w) of each, +inf and −inf where there is none. gap, touching, kept,
    least: depths in the camera's unit: between the two, shared at most, left of the front body and of the other.
    """

    front: Points
    behind: Points
    corner: Points
    cell: float
    front_range: tuple[Points, Points]
    behind_range: tuple[Points, Points]
    gap: float
    touching: float
    kept: float
    least: float

    @staticmethod
    def of(camera: Camera, front: PlacedBody, behind: PlacedBody) -> _Pair | None:
        """Return the pair, None where the silhouettes' boxes are apart or a body reaches behind the camera."""
        first, second = camera.project(front.vertices), camera.project(behind.vertices)
        if not ((first[:, 2] > 0).all() and (second[:, 2] > 0).all()):
            return None
        low = np.maximum(first[:, :2].min(axis=0), second[:, :2].min(axis=0))
        high = np.minimum(first[:, :2].max(axis=0), second[:, :2].max(axis=0))
        if (high <= low).any():
            return None
        cell = float((high - low).max()) / CELLS
        size = tuple(int(n) for n in np.ceil((high - low) / cell) + 2)
        corner = low - cell
        return _Pair(
            front=first,
            behind=second,
            corner=corner,
            cell=cell,
            front_range=_depth_range(first, front.faces, corner, cell, size),
            behind_range=_depth_range(second, behind.faces, corner, cell, size),
            gap=GAP * front.extent,
            touching=TOUCHING * front.extent,
            kept=THINNEST * front.extent,
            least=THINNEST * behind.extent,
        )

    @property
    def overlap(self) -> bool:
        """Return whether the front body reaches into the one behind, or beyond it, along any ray."""
        return bool((self._shared() > 0).any())

    def _shared(self) -> Points:
        """Depth (h, w) by which the front body reaches too far, the gap included, also around such places; else 0."""
        with np.errstate(invalid="ignore"):
            shared = self.front_range[1] - self.behind_range[0]
        shared = np.where(np.isfinite(shared) & (shared > self.touching), shared + self.gap, 0.0)
        return np.asarray(ndimage.maximum_filter(shared, 3))

    def front_thinned(self) -> Points:
        """Return depths (V,) of the front body's vertices, its far side in front of the other where there is room."""
        near, far = self.front_range
        shared = self._shared()
        with np.errstate(invalid="ignore"):
            floor = near + np.maximum((1.0 - MOST_THINNED) * (far - near), self.kept)
            limit = np.where(np.isfinite(near) & (shared > 0), np.maximum(far - shared, floor), np.inf)
        return np.minimum(self.front[:, 2], self._at(limit, self.front, np.inf))

    def behind_receded(self, camera: Camera) -> Points:
        """Return depths (V,) of the other body's vertices, all of them behind the front body, none below the ground."""
        near, far = self.behind_range
        shared = self._shared()
        with np.errstate(invalid="ignore"):
            start = np.where(np.isfinite(near) & (shared > 0), near + shared, -np.inf)
            thick = np.where(np.isfinite(near), np.maximum(far - near, self.least), self.least)
        depth = self.behind[:, 2]
        # What was behind stays behind, also where all of the body has to recede.
        order = np.clip((depth - self._at(near, self.behind, np.inf)) / self._at(thick, self.behind, 1.0), 0.0, 1.0)
        receded = np.maximum(depth, self._at(start, self.behind, -np.inf) + self.least * order)
        below = ground_depth(camera, camera.rays(self.behind[:, :2]))
        return np.where(receded > depth, np.maximum(depth, np.minimum(receded, below)), depth)

    def _at(self, field: Points, vertices: Points, outside: float) -> Points:
        """Values (V,) of ``field`` (h, w) at the pixels of ``vertices`` (V, 3)."""
        index = np.floor((vertices[:, :2] - self.corner) / self.cell).astype(int)
        inside = ((index >= 0) & (index < field.shape[::-1])).all(axis=1)
        values = np.full(len(vertices), outside)
        values[inside] = field[index[inside, 1], index[inside, 0]]
        return values


def _depth_range(
    projected: Points, faces: Faces, corner: Points, cell: float, size: tuple[int, ...]
) -> tuple[Points, Points]:
    """Nearest and farthest depth (h, w) of a mesh with ``projected`` vertices (V, 3) at the middles of the cells.

    At the middles, not anywhere in a cell: bodies that rest on each other have the same depth there.
    """
    at = np.column_stack([(projected[:, :2] - corner) / cell, projected[:, 2]])
    return depth_range(at, faces, (size[0], size[1]))
