# SPDX-License-Identifier: MIT
"""Signed distance of a surface on a lattice. No Taichi.

Vectorised numpy, deterministic. World metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ...errors import InputError
from ..colliders import Surface
from .inside_test import inside_lattice, sides
from .triangles import Array, Faces, bisected, bounding_box, check_closed, checked_places, squared_distances, validated

MAX_LATTICE_POINTS = 40_000_000
"""Maximum number of lattice points: 160 MB of distances, about 1.5 GB while they are computed."""

BAND = 3.0
"""Spacings from the surface within which distances are exact."""

FINEST_FIT = 1.25
"""Factor by which a lattice may be finer than requested, to put more of the bounding box's planes on lattice planes."""

PIECE = 1.5
"""Longest edge, in spacings, of the pieces by which triangles near a lattice point are found."""

FINE_PIECE = 0.4
"""The same, where the surface intersects itself."""


# Shells of lattice points by their distance, through which points farther away look for the surface.
SHELLS = 4
# Lattice points looked at together.
CHUNK = 50_000
# Half a lattice cell's diagonal: no place is farther from the nearest lattice point.
HALF_DIAGONAL = math.sqrt(0.75)
# Share of a spacing within which a lattice point lies on the surface.
ON_SURFACE = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceLattice:
    """Signed distances to a surface at the points of a lattice. Raises InputError on bad shapes or numbers."""

    origin: Array
    """World position (3,) in metres of the lattice point (0, 0, 0)."""

    spacing: float
    """Metres between neighbouring points, the same on all axes."""

    distances: NDArray[np.float32]
    """Metres (nx, ny, nz), each at least 2, at ``origin + (i, j, k) * spacing``; negative inside."""

    def __post_init__(self) -> None:
        origin = np.asarray(self.origin, dtype=np.float64)
        distances = np.ascontiguousarray(self.distances, dtype=np.float32)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"distance lattice: origin is {self.origin!r}: give three finite metres")
        if not (math.isfinite(self.spacing) and self.spacing > 0):
            raise InputError(f"distance lattice: spacing is {self.spacing!r}: give metres above 0")
        if distances.ndim != 3 or min(distances.shape) < 2 or not np.isfinite(distances).all():
            raise InputError(
                f"distance lattice: distances have shape {distances.shape}: give finite (nx, ny, nz), each at least 2"
            )
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "distances", distances)

    @property
    def high(self) -> Array:
        """World position (3,) of the last point, opposite to ``origin``."""
        return np.asarray(self.origin + self.spacing * (np.array(self.distances.shape) - 1.0))

    def at(self, points: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return the signed distance (N,) in metres at world points (N, 3), and its gradient (N, 3).

        Trilinear; the gradient is the derivative of just that, not of length 1, and that of the cell on the far side
        where a point lies on a plane of the lattice. Beyond the lattice it is the value at the nearest place of the
        lattice's box plus the distance to that place.

        Raises InputError on a wrong shape or a point that is not finite.
        """
        places = checked_places(points)
        number = np.array(self.distances.shape)
        local = (places - self.origin) / self.spacing
        held = np.clip(local, 0.0, number - 1.0)
        cell = np.minimum(held.astype(np.int64), number - 2)
        part = held - cell
        value, slope = np.zeros(len(places)), np.zeros((len(places), 3))
        for corner in np.ndindex(2, 2, 2):
            i, j, k = (cell[:, axis] + corner[axis] for axis in range(3))
            sample = self.distances[i, j, k].astype(np.float64)
            weight = [part[:, axis] if corner[axis] else 1.0 - part[:, axis] for axis in range(3)]
            sense = [1.0 if side else -1.0 for side in corner]
            value += sample * weight[0] * weight[1] * weight[2]
            slope[:, 0] += sample * sense[0] * weight[1] * weight[2]
            slope[:, 1] += sample * sense[1] * weight[0] * weight[2]
            slope[:, 2] += sample * sense[2] * weight[0] * weight[1]
        beyond = local - held
        length = np.linalg.norm(beyond, axis=1)
        value += self.spacing * length
        # Along an axis on which the point was clamped the value at the box does not change.
        slope = np.where(beyond == 0, slope / self.spacing, 0.0)
        return value, slope + beyond / np.where(length > 0, length, 1.0)[:, None]


def signed_distance(surface: Surface, spacing: float, *, margin: float) -> DistanceLattice:
    """Return the signed distance to a closed surface, negative inside, on a lattice around it.

    spacing: metres, above 0. The lattice's is up to a fifth smaller, such that the largest extent of the surface's
        bounding box is a whole number of it, and if there is one that does so, those of the others. The low planes of
        the box, and the high ones of such extents, are lattice planes: flat faces in them are exact.
    margin: metres around the bounding box, at least 0; one spacing at the least.

    Within 3 spacings of the surface the distances are exact (to float32); farther away they are within 1 spacing. What
    is within a hundred-thousandth of a spacing is 0. Where parts of the surface overlap by more than two spacings or
    so, it is the distance to what bounds them together, but for half a spacing along the line in which they meet.

    Raises InputError on a spacing or margin out of range, on a surface that is not closed or is flat, and on a lattice
    of more than 40 million points.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing is {spacing!r}: give metres above 0")
    if not (math.isfinite(margin) and margin >= 0):
        raise InputError(f"margin is {margin!r}: give metres from 0")
    points, triangles = validated(surface.vertices, surface.faces)
    oriented = check_closed(triangles)
    mesh = points[triangles]
    low, extent = bounding_box(mesh)
    step, layers, shape = _fitted(extent, spacing, margin)
    origin = low - layers * step
    inside = inside_lattice(points, triangles, origin - 0.5 * step, np.full(3, step), shape, oriented)
    mesh = (mesh - origin) / step
    pieces, owner = bisected(mesh, PIECE)
    whole = mesh[owner]
    if oriented:
        pieces, owner, lost = _without_buried(pieces, owner, inside, mesh)
        whole = np.where(lost[:, None, None], pieces, mesh[owner])
    distances = _distances(pieces, whole, shape)
    np.negative(distances, where=inside, out=distances)
    distances[np.abs(distances) < ON_SURFACE] = 0.0
    distances *= np.float32(step)
    return DistanceLattice(origin=origin, spacing=step, distances=distances)


def _fitted(extent: Array, spacing: float, margin: float) -> tuple[float, int, NDArray[np.int64]]:
    """Return spacing, layers around the box, and points per axis of the lattice."""
    largest = float(extent.max())

    def lattice(cells: float) -> tuple[float, float, Array]:
        step = largest / cells
        layers = max(1.0, math.ceil(min(margin / step, 1e12) - 1e-9))
        return step, layers, np.ceil(extent / step - 1e-6) + 1 + 2 * layers

    least = max(1.0, math.ceil(min(largest / spacing, 1e12) * (1 - 1e-12)))
    step, layers, shape = lattice(least)
    if not shape.prod() <= MAX_LATTICE_POINTS:
        raise InputError(
            f"spacing is {spacing:g} m for a surface of {extent[0]:g} x {extent[1]:g} x {extent[2]:g} m and a margin "
            f"of {margin:g} m, {shape.prod():.3g} lattice points of {MAX_LATTICE_POINTS:,} allowed: give a larger "
            "spacing or a smaller margin"
        )
    # The fewest cells among those that fit the most axes.
    cells = np.arange(least, math.floor(least * FINEST_FIT) + 1)
    ratio = extent / (largest / cells[:, None])
    whole = np.rint(ratio)
    fits = ((whole >= 1) & (np.abs(ratio - whole) < 1e-6)).sum(axis=1)
    finer = lattice(float(cells[fits.argmax()]))
    if finer[2].prod() <= MAX_LATTICE_POINTS:
        step, layers, shape = finer
    return step, int(layers), shape.astype(np.int64)


def _without_buried(
    pieces: Array, owner: Faces, inside: NDArray[np.bool_], mesh: Array
) -> tuple[Array, Faces, NDArray[np.bool_]]:
    """Return pieces and owners without those inside the mesh, and which belong to owners that lost some.

    All in lattice units. Nothing is looked for where all pieces have lattice points outside around them.
    """
    node = np.clip(np.rint(pieces.mean(axis=1)).astype(np.int64), 1, np.array(inside.shape) - 2)
    deep = np.ones(len(pieces), dtype=np.bool_)
    for offset in np.ndindex(3, 3, 3):
        i, j, k = (node[:, axis] + offset[axis] - 1 for axis in range(3))
        deep &= inside[i, j, k]
    if not deep.any() or (_buried(pieces[deep], mesh) == 0).all():
        return pieces, owner, np.zeros(len(pieces), dtype=np.bool_)
    share = _buried(pieces, mesh)
    lost = np.isin(owner, owner[share > 0])
    fine, of_piece = bisected(pieces[(share > 0) & (share < 1)], FINE_PIECE)
    fine_owner = owner[(share > 0) & (share < 1)][of_piece]
    kept = _buried(fine, mesh) < 1
    return (
        np.concatenate([pieces[share == 0], fine[kept]]),
        np.concatenate([owner[share == 0], fine_owner[kept]]),
        np.concatenate([lost[share == 0], np.ones(int(kept.sum()), dtype=np.bool_)]),
    )


def _buried(pieces: Array, mesh: Array) -> Array:
    """Return the share of each piece (P, 3, 3) with the mesh's inside on both sides, from four samples."""
    if len(pieces) == 0:
        return np.zeros(0)
    buried = np.zeros(len(pieces))
    for corner in range(4):
        towards = pieces if corner == 3 else pieces[:, corner, None] + 0.1 * (pieces - pieces[:, corner, None])
        front, back = sides(towards, mesh, oriented=True)
        buried += (front != 0) & (back != 0)
    return buried / 4


def _distances(pieces: Array, whole: Array, shape: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return distances (nx, ny, nz) to pieces (P, 3, 3), each part of a whole triangle (P, 3, 3), in lattice units."""
    band = _near_surface(pieces, shape)
    result = np.full(tuple(shape), np.inf, dtype=np.float32)
    exact = band.distances <= BAND
    result[tuple(band.points[exact].T)] = band.distances[exact]
    _fill_beyond(result, band, whole)
    return result


@dataclass(frozen=True, eq=False)
class _Band:
    """Lattice points near a surface. points: (n, 3) their indices. distances: (n,) to the surface, in lattice units,
    exact up to ``BAND``. nearest: (n,) the piece that is there."""

    points: NDArray[np.int64]
    distances: Array
    nearest: NDArray[np.int32]


def _near_surface(pieces: Array, shape: NDArray[np.int64]) -> _Band:
    """Return the points of the lattice of ``shape`` that may lie within ``BAND`` of ``pieces`` (P, 3, 3)."""
    centre = pieces.mean(axis=1)
    radius = np.linalg.norm(pieces - centre[:, None], axis=2).max(axis=1)
    reach = BAND + float(radius.max()) + HALF_DIAGONAL
    pad = int(reach)
    wide = shape + 2 * pad
    steps = np.arange(-pad, pad + 1)
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[(offsets**2).sum(axis=1) <= reach**2]
    node = np.rint(centre).astype(np.int64)
    rest = (centre - node).astype(np.float32)
    flat = np.ravel_multi_index(tuple((node + pad).T), tuple(wide))
    jump = offsets @ np.array([wide[1] * wide[2], wide[2], 1])
    chunk = max(1, 500_000 // len(offsets))

    def to_centres(part: slice) -> NDArray[np.float32]:
        product = rest[part] @ (-2 * offsets.T).astype(np.float32)
        product += (offsets**2).sum(axis=1).astype(np.float32)
        product += (rest[part] ** 2).sum(axis=1)[:, None]
        return np.sqrt(np.maximum(product, 0, out=product), out=product)

    # A piece's centre is on the surface: the nearest is no nearer than the surface.
    bound = np.full(int(wide.prod()), np.inf, dtype=np.float32)
    for start in range(0, len(pieces), chunk):
        part = slice(start, start + chunk)
        np.minimum.at(bound, (flat[part, None] + jump).reshape(-1), to_centres(part).reshape(-1))
    near = np.zeros(tuple(wide), dtype=np.bool_)
    inner = tuple(slice(pad, pad + int(n)) for n in shape)
    near[inner] = bound.reshape(near.shape)[inner] <= BAND + radius.max() + 1e-3
    band = np.flatnonzero(near)
    bound[~near.reshape(-1)] = -np.inf
    del near
    index = np.zeros(len(bound), dtype=np.int32)
    index[band] = np.arange(len(band))
    best2, nearest = np.full(len(band), np.inf), np.zeros(len(band), dtype=np.int32)
    for start in range(0, len(pieces), chunk):
        part = slice(start, start + chunk)
        target = flat[part, None] + jump
        close = to_centres(part) <= bound[target] + (radius[part, None] + 1e-3).astype(np.float32)
        piece, offset = np.nonzero(close)
        spot = index[target[close]]
        piece += start
        distance2 = squared_distances((node[piece] + offsets[offset]).astype(np.float64), pieces[piece])
        np.minimum.at(best2, spot, distance2)
        first = distance2 == best2[spot]
        nearest[spot[first]] = piece[first]
    points = np.stack(np.unravel_index(band, tuple(wide)), axis=1) - pad
    return _Band(points, np.sqrt(best2), nearest)


def _fill_beyond(result: NDArray[np.float32], band: _Band, whole: Array) -> None:
    """Put distances where ``result`` (nx, ny, nz) is inf: to a triangle of ``whole`` (P, 3, 3) that is nearest to some
    point of the band on the way, less than one spacing too far."""
    shape = result.shape
    far = np.flatnonzero(np.isinf(result.reshape(-1)))
    if len(far) == 0:
        return
    index = np.zeros(shape, dtype=np.int32)
    index[tuple(band.points.T)] = np.arange(len(band.points))
    # On the way from a far point to the nearest place of the surface, at 3 less half a cell's diagonal from it, some
    # lattice point of the band is within half a diagonal. The way through it is at most 0.53 longer; the way through
    # the nearest of its shell (which are 0.43 thick) at most 0.43 more. So what is found is at most 0.97 too far.
    shells = np.linspace(BAND - 2 * HALF_DIAGONAL - 1e-6, BAND, SHELLS + 1)
    flat_result, via = result.reshape(-1), np.zeros(len(far), dtype=np.int32)
    for least, most in pairwise(shells):
        apart = np.ones(shape, dtype=np.bool_)
        apart[tuple(band.points[(band.distances >= least) & (band.distances <= most)].T)] = False
        if apart.all():
            continue
        beside = distance_transform_edt(apart, return_distances=False, return_indices=True).reshape(3, -1)
        for start in range(0, len(far), CHUNK):
            some = far[start : start + CHUNK]
            other = beside[:, some]
            place = np.unravel_index(some, shape)
            spot = index[tuple(other)]
            gap2 = sum((place[axis] - other[axis]) ** 2 for axis in range(3))
            way = (np.sqrt(gap2) + band.distances[spot]).astype(np.float32)
            shorter = way < flat_result[some]
            flat_result[some[shorter]] = way[shorter]
            via[start : start + CHUNK][shorter] = spot[shorter]
    for start in range(0, len(far), CHUNK):
        some = far[start : start + CHUNK]
        places = np.stack(np.unravel_index(some, shape), axis=1).astype(np.float64)
        straight = np.sqrt(squared_distances(places, whole[band.nearest[via[start : start + CHUNK]]]))
        flat_result[some] = np.maximum(straight, BAND)


def overlap(a: Surface | NDArray[np.floating], b: DistanceLattice) -> float:
    """Return the largest depth in metres of points of ``a`` in ``b``; 0 if none is inside.

    a: a surface, sampled at its vertices and between them no farther apart than b's spacing; or points (N, 3).

    A surface that lies within ``b`` in part is found; one that encloses all of ``b`` is not: test both ways round.

    Raises InputError on bad points, and where it takes too many.
    """
    low, high = b.origin, b.high
    if isinstance(a, Surface):
        places = bisected(a.vertices[a.faces], b.spacing, box=(low, high))[0].reshape(-1, 3)
    else:
        places = checked_places(a)
    places = places[((places >= low) & (places <= high)).all(axis=1)]
    deepest = 0.0
    for start in range(0, len(places), 500_000):
        deepest = min(deepest, float(b.at(places[start : start + 500_000])[0].min()))
    return -deepest if deepest < 0 else 0.0
