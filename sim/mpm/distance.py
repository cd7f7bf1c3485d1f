# SPDX-License-Identifier: MIT
"""What contact needs to know of a surface: signed distance, contact points, mass, whether it is sound. No Taichi.

Vectorised numpy, deterministic. World metres, kilograms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..errors import InputError
from .colliders import Surface
from .triangles import (
    Array,
    Boundary,
    Faces,
    batches,
    bisected,
    boundary,
    check_closed,
    face_normals,
    inside_lattice,
    ranges,
    sides,
    signed_volume,
    squared_distances,
    validated,
)

MAX_LATTICE_POINTS = 40_000_000
"""Largest lattice, 160 MB of distances and about 1.5 GB while it is made."""

BAND = 3.0
"""Within this many spacings of the surface distances are exact."""

FINEST_FIT = 1.25
"""Up to this factor finer than asked a lattice may be, to put more of the bounding box's planes on lattice planes."""

PIECE = 1.5
"""Longest edge, in spacings, of the pieces by which triangles near a lattice point are found."""

FINE_PIECE = 0.4
"""The same, where the surface enters another part of itself."""

THIN_OUT = 0.35
"""Contact points closer than this many spacings are thinned out."""

MAX_PAIRS = 200_000
"""Pairs of faces that are tested for whether they cross."""

MAX_NEIGHBOURS = 20_000_000
"""Pairs of neighbours that are looked through at most for those to be tested."""

THIN_SAMPLES = 2000
"""Places at which a surface's thickness is looked at."""

THIN_SHARE = 0.02
"""Share of a surface that may be thin without a warning."""

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
    """World place (3,) in metres of the point (0, 0, 0)."""

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
        """World place (3,) of the last point, opposite to ``origin``."""
        return np.asarray(self.origin + self.spacing * (np.array(self.distances.shape) - 1.0))

    def at(self, points: NDArray[np.floating]) -> tuple[Array, Array]:
        """Signed distance (N,) in metres at world points (N, 3), and its gradient (N, 3).

        Trilinear; the gradient is the derivative of just that, not of length 1, and that of the cell on the far side
        where a point lies on a plane of the lattice. Beyond the lattice it is the value at the nearest place of the
        lattice's box plus the distance to that place.

        Raises InputError on a wrong shape or a point that is not finite.
        """
        places = _places(points)
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
    """Signed distance to a closed surface, negative inside, on a lattice around it.

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
    low, extent = _box(mesh)
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


def _box(mesh: Array) -> tuple[Array, Array]:
    """Low corner and extent of a mesh's bounding box. Raises InputError where it is flat."""
    low = mesh.min(axis=(0, 1))
    extent = mesh.max(axis=(0, 1)) - low
    if not extent.min() > 1e-12 * extent.max():
        raise InputError(
            f"mesh has no volume (bounding box {extent[0]:g} x {extent[1]:g} x {extent[2]:g}): give it thickness"
        )
    return low, extent


def _fitted(extent: Array, spacing: float, margin: float) -> tuple[float, int, NDArray[np.int64]]:
    """Spacing, layers around the box, and points per axis of the lattice."""
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
    """Pieces and owners but for those that lie inside the mesh, and which are of owners that lost some.

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
    """Share of each piece (P, 3, 3) that has the mesh's inside on both sides, judged by four places of it."""
    if len(pieces) == 0:
        return np.zeros(0)
    buried = np.zeros(len(pieces))
    for corner in range(4):
        towards = pieces if corner == 3 else pieces[:, corner, None] + 0.1 * (pieces - pieces[:, corner, None])
        front, back = sides(towards, mesh, oriented=True)
        buried += (front != 0) & (back != 0)
    return buried / 4


def _distances(pieces: Array, whole: Array, shape: NDArray[np.int64]) -> NDArray[np.float32]:
    """Distances (nx, ny, nz) to pieces (P, 3, 3), of which each is a part of a whole (P, 3, 3), in lattice units."""
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
    del bound
    best = np.sqrt(best2)
    result = np.full(tuple(shape), np.inf, dtype=np.float32)
    inner_band = np.stack(np.unravel_index(band, tuple(wide)), axis=1) - pad
    exact = best <= BAND
    result[tuple(inner_band[exact].T)] = best[exact]
    far = np.flatnonzero(np.isinf(result.reshape(-1)))
    if len(far) == 0:
        return result
    # On the way from a far point to the nearest place of the surface, at 3 less half a cell's diagonal from it, some
    # lattice point of the band is within half a diagonal. The way through it is at most 0.53 longer; the way through
    # the nearest of its shell (which are 0.43 thick) at most 0.43 more. So what is found is at most 0.97 too far.
    shells = np.linspace(BAND - 2 * HALF_DIAGONAL - 1e-6, BAND, SHELLS + 1)
    flat_result, via = result.reshape(-1), np.zeros(len(far), dtype=np.int32)
    for least, most in pairwise(shells):
        apart = np.ones(tuple(shape), dtype=np.bool_)
        apart[tuple(inner_band[(best >= least) & (best <= most)].T)] = False
        if apart.all():
            continue
        beside = distance_transform_edt(apart, return_distances=False, return_indices=True).reshape(3, -1)
        for start in range(0, len(far), CHUNK):
            some = far[start : start + CHUNK]
            other = beside[:, some]
            place = np.unravel_index(some, tuple(shape))
            spot = index[np.ravel_multi_index(tuple(other + pad), tuple(wide))]
            gap2 = sum((place[axis] - other[axis]) ** 2 for axis in range(3))
            way = (np.sqrt(gap2) + best[spot]).astype(np.float32)
            shorter = way < flat_result[some]
            flat_result[some[shorter]] = way[shorter]
            via[start : start + CHUNK][shorter] = spot[shorter]
    for start in range(0, len(far), CHUNK):
        some = far[start : start + CHUNK]
        places = np.stack(np.unravel_index(some, tuple(shape)), axis=1).astype(np.float64)
        straight = np.sqrt(squared_distances(places, whole[nearest[via[start : start + CHUNK]]]))
        flat_result[some] = np.maximum(straight, BAND)
    return result


def _places(points: NDArray[np.floating]) -> Array:
    places = np.asarray(points, dtype=np.float64)
    if places.ndim != 2 or places.shape[1:] != (3,) or not np.isfinite(places).all():
        raise InputError(f"points have shape {places.shape}: give finite (N, 3)")
    return places


def surface_points(surface: Surface, spacing: float) -> tuple[Array, Array]:
    """Points (K, 3) on a closed surface at which a rigid body touches others, and outward unit normals (K, 3).

    The vertices, and points between them so that the surface is covered by triangles of points with edges of
    ``spacing`` metres at most. Points closer than 0.35 spacings are thinned out: of a dense mesh every place has a
    point within a spacing. First come, and stay, the vertices of the convex hull: those lowest or highest along an
    axis, then those farthest from the middle.

    At a vertex the normal is the mean of its faces', by their area. Parts that lie inside others have no points.

    Raises InputError on a spacing that is not above 0, on a surface that is not closed, is flat or bounds nothing, and
    where it takes too many points.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing is {spacing!r}: give metres above 0")
    points, triangles = validated(surface.vertices, surface.faces)
    _box(points[triangles])
    triangles = _bounding(points, triangles).triangles
    corners = points[triangles]
    pieces = bisected(corners, spacing)[0]
    count = 3 * len(corners)
    places, inverse = np.unique(
        np.concatenate([corners.reshape(-1, 3), pieces.reshape(-1, 3)]), axis=0, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    given = np.zeros(len(places), dtype=np.bool_)
    given[inverse[:count]] = True
    of_faces = _mean_normals(corners, inverse[:count], len(places))
    of_pieces = _mean_normals(pieces, inverse[count:], len(places))
    normals = np.where(given[:, None], of_faces, of_pieces)
    order = _by_importance(places, given)
    kept = order[_thinned(places[order], THIN_OUT * spacing)]
    return places[kept], normals[kept]


def _mean_normals(corners: Array, corner_of: Faces, number: int) -> Array:
    """Unit normals (number, 3) at places, means by area over the triangles (T, 3, 3) whose corners (3T,) they are."""
    normals, area = face_normals(corners)
    of_corner = np.repeat(normals * area[:, None], 3, axis=0)
    total = np.stack([np.bincount(corner_of, weights=of_corner[:, k], minlength=number) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1)
    # Where the faces cancel out, as on the edge of a fold, any of them.
    single = np.zeros((number, 3))
    has_area = np.repeat(area > 0, 3)
    single[corner_of[has_area]] = np.repeat(normals, 3, axis=0)[has_area]
    scale = np.bincount(corner_of, weights=np.repeat(area, 3), minlength=number)
    cancelled = length <= 1e-9 * scale
    return np.where(cancelled[:, None], single, total / np.where(length > 0, length, 1.0)[:, None])


def _by_importance(places: Array, given: NDArray[np.bool_]) -> Faces:
    """Order of places: hull vertices at an extreme of an axis, other hull vertices, other vertices, the rest."""
    low, high = places.min(axis=0), places.max(axis=0)
    extreme = ((places == low) | (places == high)).any(axis=1)
    vertices = np.flatnonzero(given)
    hull = np.zeros(len(places), dtype=np.bool_)
    try:
        hull[vertices[ConvexHull(places[vertices]).vertices]] = True
    except QhullError:  # as good as flat
        hull[vertices] = True
    rank = np.select([hull & extreme, hull, extreme & given, given], [0, 1, 2, 3], 4)
    distance = np.linalg.norm(places - 0.5 * (low + high), axis=1) / np.linalg.norm(high - low)
    outermost = np.where(hull, -np.round(distance, 6), 0.0)
    # Scrambled, lest thinning out runs through a row of points one by one.
    scrambled = np.arange(len(places), dtype=np.uint64) * np.uint64(2654435761) % np.uint64(2**32)
    return np.lexsort((scrambled, outermost, rank))


def _thinned(places: Array, least: float) -> Faces:
    """Indices of places (N, 3) such that none is closer than ``least`` to one before it."""
    cells = np.floor((places - places.min(axis=0)) / (0.25 * least)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    pairs = cKDTree(places[first]).query_pairs(least * (1 - 1e-9), output_type="ndarray")
    kept = np.zeros(len(first), dtype=np.bool_)
    open_ = np.ones(len(first), dtype=np.bool_)
    while open_.any():
        behind = np.zeros(len(first), dtype=np.bool_)
        behind[pairs[:, 1]] = True
        chosen = open_ & ~behind
        kept |= chosen
        open_ &= ~chosen
        open_[pairs[chosen[pairs[:, 0]], 1]] = False
        pairs = pairs[open_[pairs].all(axis=1)]
    return first[kept]


@dataclass(frozen=True, kw_only=True, eq=False)
class MassProperties:
    """Mass, centre and inertia of a body. Raises InputError on bad shapes or numbers."""

    mass: float
    """Kilograms, above 0."""

    center: Array
    """Centre of mass (3,), metres."""

    inertia: Array
    """Tensor of inertia (3, 3) about the centre, kg m², symmetric."""

    def __post_init__(self) -> None:
        center, inertia = np.asarray(self.center, dtype=np.float64), np.asarray(self.inertia, dtype=np.float64)
        if not (math.isfinite(self.mass) and self.mass > 0):
            raise InputError(f"mass is {self.mass!r}: give kilograms above 0")
        if center.shape != (3,) or not np.isfinite(center).all():
            raise InputError(f"center is {self.center!r}: give three finite metres")
        if inertia.shape != (3, 3) or not np.isfinite(inertia).all():
            raise InputError(f"inertia has shape {inertia.shape}: give finite (3, 3)")
        object.__setattr__(self, "mass", float(self.mass))
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "inertia", 0.5 * (inertia + inertia.T))


def mass_properties(
    positions: NDArray[np.floating], masses: NDArray[np.floating], *, volumes: NDArray[np.floating] | None = None
) -> MassProperties:
    """Of particles at positions (N, 3), metres, with masses (N,), kg.

    volumes: (N,) m³ gives every particle the inertia of a cube of that volume; None makes them points.

    Raises InputError on bad shapes, and where a mass or volume is not above 0.
    """
    places = _places(positions)
    mass = np.asarray(masses, dtype=np.float64)
    if len(places) == 0 or mass.shape != (len(places),) or not (np.isfinite(mass) & (mass > 0)).all():
        raise InputError(f"masses have shape {mass.shape}: give ({len(places)},) kilograms above 0, N above 0")
    total = float(mass.sum())
    center = mass @ places / total
    offset = places - center
    second = np.einsum("n,ni,nj->ij", mass, offset, offset)
    if volumes is not None:
        size = np.asarray(volumes, dtype=np.float64)
        if size.shape != mass.shape or not (np.isfinite(size) & (size > 0)).all():
            raise InputError(f"volumes have shape {size.shape}: give ({len(places)},) cubic metres above 0")
        second += np.eye(3) * (mass @ size ** (2 / 3) / 12)
    return MassProperties(mass=total, center=center, inertia=np.trace(second) * np.eye(3) - second)


def solid_mass_properties(surface: Surface, *, density: float) -> MassProperties:
    """Of a closed surface filled evenly with matter of ``density`` kg/m³, exactly, by the divergence theorem.

    Hollows count as hollows, and parts inside others not again; where parts overlap in part, the overlap counts twice.

    Raises InputError on a density that is not above 0 and a surface that is not closed or has no volume.
    """
    if not (math.isfinite(density) and density > 0):
        raise InputError(f"density is {density!r}: give kg/m³ above 0")
    points, triangles = validated(surface.vertices, surface.faces)
    _box(points[triangles])
    volume, center, second = _moments(points[_bounding(points, triangles).triangles])
    if volume < 0:
        raise InputError(
            f"mesh has a volume of {volume:g} m³, its parts lie in each other and are inside out: clean it up (in "
            "Blender: Boolean modifier, Union, Self Intersection)"
        )
    return MassProperties(
        mass=density * volume,
        center=center,
        inertia=density * (np.trace(second) * np.eye(3) - second),
    )


def _moments(corners: Array) -> tuple[float, Array, Array]:
    """Volume, centre (3,) and second moments (3, 3) about the centre of what outward faces (T, 3, 3) bound."""
    middle = corners.reshape(-1, 3).mean(axis=0)
    local = corners - middle
    six = np.einsum("ti,ti->t", local[:, 0], np.cross(local[:, 1], local[:, 2]))
    volume = float(six.sum() / 6)
    total = local.sum(axis=1)
    first = six @ total / 24
    second = (np.einsum("t,tni,tnj->ij", six, local, local) + np.einsum("t,ti,tj->ij", six, total, total)) / 120
    center = first / volume
    return volume, middle + center, second - volume * np.outer(center, center)


def _bounding(points: Array, triangles: Faces) -> Boundary:
    """The faces that bound the inside, outward. Raises InputError where the mesh is not closed or has no volume."""
    found = boundary(points, triangles, check_closed(triangles))
    extent = np.ptp(points[triangles].reshape(-1, 3), axis=0)
    volume = signed_volume(points, found.triangles)
    if not abs(volume) > 1e-9 * face_normals(points[triangles])[1].sum() ** 1.5:
        raise InputError(
            f"mesh has no volume (bounding box {extent[0]:g} x {extent[1]:g} x {extent[2]:g}, volume {volume:g}): "
            "give it thickness"
        )
    return found


def overlap(a: Surface | NDArray[np.floating], b: DistanceLattice) -> float:
    """How deep points of ``a`` lie in ``b``, in metres, 0 where none does.

    a: a surface, looked at in its vertices and between them no farther apart than b's spacing; or points (N, 3).

    A surface that lies within ``b`` in part is found; one that encloses all of ``b`` is not: ask both ways round.

    Raises InputError on bad points, and where it takes too many.
    """
    low, high = b.origin, b.high
    if isinstance(a, Surface):
        places = bisected(a.vertices[a.faces], b.spacing, box=(low, high))[0].reshape(-1, 3)
    else:
        places = _places(a)
    places = places[((places >= low) & (places <= high)).all(axis=1)]
    deepest = 0.0
    for start in range(0, len(places), 500_000):
        deepest = min(deepest, float(b.at(places[start : start + 500_000])[0].min()))
    return -deepest if deepest < 0 else 0.0


def check_surface(surface: Surface, *, name: str, cell_size: float | None = None) -> tuple[str, ...]:
    """What is amiss with a surface of a body or collider called ``name``, in sentences; nothing is changed.

    cell_size: metres; says in addition where the surface is thinner than that.

    Raises InputError where it cannot be used at all: no faces with area, not closed, no volume.
    """
    try:
        points, triangles = validated(surface.vertices, surface.faces)
        _box(points[triangles])
        oriented = check_closed(triangles)
        found = _bounding(points, triangles)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    recalculate = "in Blender: Mesh > Normals > Recalculate Outside"
    unite = "unite them (in Blender: Boolean modifier, Union, Self Intersection)"
    said = []
    if not oriented:
        said.append(
            f"{name}: faces are not consistently oriented, {found.reversed} of {len(triangles)} look inward; what lies "
            f"between an even number of walls counts as outside ({recalculate})"
        )
    elif found.reversed:
        said.append(
            f"{name}: {found.reversed} of {found.parts} parts are inside out; they are taken as if they were not "
            f"({recalculate})"
        )
    if found.buried:
        said.append(f"{name}: {found.buried} of {found.parts} parts lie inside others and are ignored; delete them")
    if found.overlapping:
        what = "the surface lies inside itself in part" if found.parts == 1 else "some parts overlap others"
        said.append(f"{name}: {what}; what overlaps counts twice in the mass: {unite}")
    crossing, tested, total = _crossing_faces(points, triangles)
    if crossing:
        said.append(f"{name}: the surface crosses itself at {crossing} or more pairs of faces: {unite}")
    if tested < total:
        said.append(
            f"{name}: {tested} of about {total} pairs of neighbouring faces were tested for crossings; the mesh is "
            "very dense or tangled: simplify it (in Blender: Decimate or Remesh modifier)"
        )
    if cell_size is not None:
        share = _thin_share(points, found.triangles, cell_size)
        if share > THIN_SHARE:
            said.append(
                f"{name}: {100 * share:.0f} % of the surface is thinner than a grid cell of {cell_size:g} m; contact "
                "there is inexact: thicken it or use a finer grid (solver option grid)"
            )
    return tuple(said)


def _crossing_faces(points: Array, triangles: Faces) -> tuple[int, int, int]:
    """Pairs of faces without a common vertex that cross; pairs tested; pairs there are to test, about.

    Faces that only touch do not cross.
    """
    mesh = points[triangles]
    low, high = mesh.min(axis=1), mesh.max(axis=1)
    size = float(np.ptp(mesh.reshape(-1, 3), axis=0).max())
    area = face_normals(mesh)[1]
    longest = np.linalg.norm(np.roll(mesh, -1, axis=1) - mesh, axis=2).max(axis=1)
    cell = max(2 * float(np.median(longest)), size / 200)
    while (4 * area / cell**2 + 2 * longest / cell).sum() > 2_000_000 + 2 * len(triangles):
        cell *= 2
    pieces, owner = bisected(mesh, cell)
    start = mesh.min(axis=(0, 1))
    number = int(size / cell) + 1
    first = np.floor((pieces.min(axis=1) - start) / cell).astype(np.int64)
    wide = np.floor((pieces.max(axis=1) - start) / cell).astype(np.int64) - first + 1
    piece, order = ranges(np.zeros(len(pieces), dtype=np.int64), wide.prod(axis=1))
    i = first[piece, 0] + order // (wide[piece, 1] * wide[piece, 2])
    j = first[piece, 1] + order // wide[piece, 2] % wide[piece, 1]
    k = first[piece, 2] + order % wide[piece, 2]
    # A triangle counts once in a cell, in however many pieces it is there.
    inhabitants = np.unique(((i * number + j) * number + k) * len(triangles) + owner[piece])
    in_cell, entries = np.divmod(inhabitants, len(triangles))
    begin = np.flatnonzero(np.concatenate([[True], np.diff(in_cell) != 0]))
    count = np.diff(np.append(begin, len(entries)))
    later = np.repeat(begin + count, count) - np.arange(len(entries)) - 1
    every = max(1, -(-int(later.sum()) // MAX_NEIGHBOURS))
    looked = later.copy()
    looked[np.arange(len(entries)) % every != 0] = 0
    keys: list[Faces] = []
    for batch in batches(looked, 1_000_000):
        one, second = ranges(batch + 1, looked[batch])
        a, b = entries[batch[one]], entries[second]
        near = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
        a, b = a[near], b[near]
        apart = (triangles[a][:, :, None] != triangles[b][:, None, :]).all(axis=(1, 2))
        keys.append(np.unique(a[apart] * len(triangles) + b[apart]))
    pairs = np.unique(np.concatenate(keys)) if keys else np.zeros(0, dtype=np.int64)
    total = len(pairs) * every
    if len(pairs) > MAX_PAIRS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(np.int64)]
    beyond = _normals_beyond(triangles, mesh)
    crossing = 0
    for begin_at in range(0, len(pairs), 50_000):
        a, b = np.divmod(pairs[begin_at : begin_at + 50_000], len(triangles))
        hit = np.zeros(len(a), dtype=np.bool_)
        for one, other in ((a, b), (b, a)):
            for n in range(3):
                hit |= _pierces(mesh[one, n], mesh[one, (n + 1) % 3], mesh[other], beyond[other], 1e-9 * size)
        crossing += int(hit.sum())
    return crossing, len(pairs), total


def _normals_beyond(triangles: Faces, mesh: Array) -> Array:
    """Normals (T, 3, 3) of the faces beyond the edges, from each corner to the next; 0 where there is not just one."""
    normals = face_normals(mesh)[0]
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    two = (np.cumsum(count) - count)[count == 2]
    one, other = order[two], order[two + 1]
    # Faces that run through their edge the same way look to different sides.
    sense = np.where(ends[one, 0] == ends[other, 0], -1.0, 1.0)[:, None]
    result = np.zeros((3 * len(triangles), 3))
    result[one], result[other] = sense * normals[other // 3], sense * normals[one // 3]
    return result.reshape(-1, 3, 3)


def _pierces(start: Array, end: Array, corners: Array, beyond: Array, least: float) -> NDArray[np.bool_]:
    """Which segments (N, 3) go through their triangles (N, 3, 3), by more than the length ``least``.

    beyond: (N, 3, 3) normals of the faces beyond the edges. A segment through an edge goes through the surface where
    it goes through both faces the same way; else it touches a ridge.
    """
    normals = face_normals(corners)[0]
    before = np.einsum("ni,ni->n", normals, start - corners[:, 0])
    after = np.einsum("ni,ni->n", normals, end - corners[:, 0])
    result = (before * after < 0) & (np.minimum(np.abs(before), np.abs(after)) > least)
    some = np.flatnonzero(result)
    share = before[some] / (before[some] - after[some])
    way = end[some] - start[some]
    place = start[some] + share[:, None] * way
    for n in range(3):
        corner = corners[some, n]
        across = np.cross(normals[some], corners[some, (n + 1) % 3] - corner)
        length = np.linalg.norm(across, axis=1)
        within = np.einsum("ni,ni->n", across, place - corner) / np.where(length > 0, length, 1.0)
        also = np.einsum("ni,ni->n", beyond[some, n], way) * np.sign(after[some] - before[some]) > least
        result[some] &= within > np.where(also, -least, least)
    return result


def thin_share(surface: Surface, cell_size: float) -> float:
    """Share of a closed surface, 0 to 1, behind which the matter is thinner than ``cell_size`` metres.

    Looked at straight inward from 2000 places spread evenly over the surface, or fewer where that is too much work.

    Raises InputError on a cell size that is not above 0, and a surface that is not closed or has no volume.
    """
    points, triangles = validated(surface.vertices, surface.faces)
    _box(points[triangles])
    return _thin_share(points, _bounding(points, triangles).triangles, cell_size)


def _thin_share(points: Array, outward: Faces, cell_size: float) -> float:
    if not (math.isfinite(cell_size) and cell_size > 0):
        raise InputError(f"cell_size is {cell_size!r}: give metres above 0")
    corners = points[outward]
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    normals, area = face_normals(corners)
    if cell_size > 2 * size:
        return 1.0
    number = np.arange(THIN_SAMPLES)
    face = np.searchsorted(np.cumsum(area), (number + 0.5) / THIN_SAMPLES * area.sum())
    face = np.minimum(face, len(area) - 1)
    root, other = np.sqrt((0.5 + number * 0.7548776662466927) % 1.0), (0.5 + number * 0.5698402909980532) % 1.0
    weights = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    start = np.einsum("nk,nkc->nc", weights, corners[face])
    end = start - cell_size * normals[face]
    pieces, owner = bisected(corners, max(cell_size, size / 100))
    centre = pieces.mean(axis=1)
    radius = float(np.linalg.norm(pieces - centre[:, None], axis=2).max())
    tree = cKDTree(centre)
    middle, reach = 0.5 * (start + end), 0.5 * cell_size + radius
    work = tree.query_ball_point(middle, reach, return_length=True)
    every = max(1, -(-int(work.sum()) // MAX_NEIGHBOURS))
    looked = np.arange(0, THIN_SAMPLES, every)
    thin = np.zeros(THIN_SAMPLES, dtype=np.bool_)
    for begin in range(0, len(looked), 100):
        some = looked[begin : begin + 100]
        lists = tree.query_ball_point(middle[some], reach)
        ray = np.repeat(some, [len(entry) for entry in lists])
        piece = np.concatenate([np.asarray(entry, dtype=np.int64) for entry in lists])
        distinct = owner[piece] != face[ray]
        ray, piece = ray[distinct], piece[distinct]
        beyond = np.repeat(normals[owner[piece], None], 3, axis=1)
        hit = _pierces(start[ray], end[ray], pieces[piece], beyond, 1e-9 * size)
        thin[ray[hit]] = True
    return float(thin[looked].mean())
