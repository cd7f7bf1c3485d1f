# SPDX-License-Identifier: MIT
"""Shapes as signed distance fields: primitives, smooth Booleans, meshing, smooth deformations.

A field maps points (N, 3) in metres to values (N,), negative inside. Distances are exact for the solids, except for
ellipsoids, where they are right to first order at the surface; blends only underestimate distances (Quilez, Distance
functions).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

Array = NDArray[np.float64]
Field = Callable[[Array], Array]
Triple = tuple[float, float, float]


def lengths(vectors: Array) -> Array:
    """(N,) of vectors (N, 3); several times faster than ``np.linalg.norm`` along short rows."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def sphere(centre: Triple, radius: float) -> Field:
    """A sphere."""
    return lambda p: lengths(p - np.array(centre)) - radius


def ellipsoid(centre: Triple, radii: Triple) -> Field:
    """An ellipsoid along the axes."""
    size = np.array(radii)

    def field(p: Array) -> Array:
        scaled = (p - np.array(centre)) / size
        first, second = lengths(scaled), lengths(scaled / size)
        return first * (first - 1.0) / np.maximum(second, 1e-9 / size.min())

    return field


def cone(a: Triple, b: Triple, radius_a: float, radius_b: float) -> Field:
    """The hull of two balls around ``a`` and ``b``."""
    start, along = np.array(a), np.array(b) - np.array(a)
    length = float(np.linalg.norm(along))
    unit, slope = along / length, (radius_a - radius_b) / length
    rise = np.sqrt(1.0 - slope * slope)

    def field(p: Array) -> Array:
        height = (p - start) @ unit
        radius = lengths(p - start - height[:, None] * unit)
        # The coordinate along the mantle decides which of the three parts is nearest.
        place = height * rise - radius * slope
        low, high = np.hypot(radius, height) - radius_a, np.hypot(radius, height - length) - radius_b
        mantle = radius * rise + height * slope - radius_a
        return np.where(place < 0, low, np.where(place > length * rise, high, mantle))

    return field


def limb(points: Sequence[Triple], radii: Sequence[float], blend: float) -> Field:
    """Cones from each point to the next."""
    ends = pairwise(zip(points, radii, strict=True))
    return union(*(cone(a, b, ra, rb) for (a, ra), (b, rb) in ends), blend=blend)


def box_sdf(centre: Triple, half: Triple, rounding: float) -> Field:
    """A box along the axes of half extents ``half``, its edges rounded."""

    def field(p: Array) -> Array:
        beyond = np.abs(p - np.array(centre)) - (np.array(half) - rounding)
        outside = lengths(np.maximum(beyond, 0.0))
        return outside + np.minimum(beyond.max(axis=1), 0.0) - rounding

    return field


def torus(centre: Triple, radius: float, tube: float, axis: Triple = (0.0, 0.0, 1.0)) -> Field:
    """A torus around ``axis`` through ``centre``."""
    unit = np.array(axis) / np.linalg.norm(axis)

    def field(p: Array) -> Array:
        height = (p - np.array(centre)) @ unit
        across = lengths(p - np.array(centre) - height[:, None] * unit)
        return np.hypot(across - radius, height) - tube

    return field


def revolved(profile: Sequence[tuple[float, float]], rounding: float = 0.0) -> Field:
    """Return the solid of revolution of a closed profile of (distance from the z axis, z).

    rounding: metres by which the outline is grown, which rounds its outer corners.
    """
    corners = np.array(profile)

    def field(p: Array) -> Array:
        place = np.stack([np.hypot(p[:, 0], p[:, 1]), p[:, 2]], axis=1)
        nearest, inside = np.full(len(p), np.inf), np.zeros(len(p), bool)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge, from_a = b - a, place - a
            share = np.clip(from_a @ edge / (edge @ edge), 0.0, 1.0)
            nearest = np.minimum(nearest, ((from_a - share[:, None] * edge) ** 2).sum(axis=1))
            if a[1] != b[1]:
                level = from_a[:, 1] / edge[1]
                crosses = (place[:, 1] < a[1]) != (place[:, 1] < b[1])
                inside ^= crosses & (place[:, 0] < a[0] + level * edge[0])
        return np.where(inside, -1.0, 1.0) * np.sqrt(nearest) - rounding

    return field


def below(height: float, slope: tuple[float, float] = (0.0, 0.0)) -> Field:
    """Everything under the plane z = height + slope · (x, y)."""
    length = float(np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2))
    return lambda p: (p[:, 2] - height - p[:, 0] * slope[0] - p[:, 1] * slope[1]) / length


def above(height: float, slope: tuple[float, float] = (0.0, 0.0)) -> Field:
    """Everything over that plane."""
    under = below(height, slope)
    return lambda p: -under(p)


def rotated(field: Field, centre: Triple, matrix: Array) -> Field:
    """``field`` turned by a rotation (3, 3) around ``centre``."""
    return lambda p: field((p - np.array(centre)) @ matrix + np.array(centre))


def grown(field: Field, by: float | Field) -> Field:
    """``field`` with so many metres around it; fewer where ``by``, a function of the place, says so."""
    return lambda p: field(p) - (by(p) if callable(by) else by)


def union(*fields: Field, blend: float = 0.0) -> Field:
    """All of them, joined with a fillet about ``blend`` metres wide."""

    def field(p: Array) -> Array:
        value = fields[0](p)
        for other in fields[1:]:
            value = _smooth_min(value, other(p), blend)
        return value

    return field


def intersection(*fields: Field, blend: float = 0.0) -> Field:
    """Where all of them are, its edges rounded."""

    def field(p: Array) -> Array:
        value = -fields[0](p)
        for other in fields[1:]:
            value = _smooth_min(value, -other(p), blend)
        return -value

    return field


def difference(field: Field, *others: Field, blend: float = 0.0) -> Field:
    """``field`` with the others cut out of it, its edges rounded."""
    return intersection(field, *(lambda p, other=other: -other(p) for other in others), blend=blend)


def layer_on(body: Field, *, thickness: float | Field, where: Field, blend: float) -> Field:
    """A layer on ``body``, within ``where``. It still has to be cut by the body."""
    return intersection(grown(body, thickness), where, blend=blend)


def _smooth_min(a: Array, b: Array, blend: float) -> Array:
    if blend <= 0:
        return np.minimum(a, b)
    near = np.maximum(blend - np.abs(a - b), 0.0) / blend
    return np.minimum(a, b) - 0.25 * blend * near * near


BLOCK = 4
"""Lattice points along a side of what is looked at together: far from the surface one value stands for all."""
SLACK = 1.2
"""Blocks whose middle is within so many of their sides of the surface are looked at: the farthest point of a block and
one lattice step beyond are 0.9 away, and fields may overstate distances a little."""
POLISH = 2


def mesh_of(field: Field, low: Triple, high: Triple, spacing: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (T, 3), wound outwards, of the surface of ``field`` within the box.

    spacing: metres between the lattice's points. What is thinner than two of them is lost; a surface that leaves the
    box is cut open, so give a box with room.
    """
    side = BLOCK * spacing
    # A shift by no round number keeps flat faces off the lattice's planes, where marching cubes makes slivers.
    origin = np.array(low) - side * np.array([1.0137, 1.0271, 1.0093])
    blocks = np.ceil((np.array(high) - origin) / side).astype(np.int64) + 1
    index = np.stack(np.meshgrid(*(np.arange(n) for n in blocks), indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = np.stack(np.meshgrid(*(np.arange(BLOCK),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    coarse = field(origin + (index * BLOCK + (BLOCK - 1) / 2) * spacing)
    values = np.repeat(coarse[:, None], BLOCK**3, axis=1)
    near = np.abs(coarse) < SLACK * side
    points = origin + (index[near, None] * BLOCK + offsets) * spacing
    values[near] = field(points.reshape(-1, 3)).reshape(-1, BLOCK**3)
    lattice = values.reshape(*blocks, BLOCK, BLOCK, BLOCK).transpose(0, 3, 1, 4, 2, 5).reshape(blocks * BLOCK)
    vertices, faces, _, _ = marching_cubes(lattice, 0.0, gradient_direction="descent")
    placed = origin + vertices.astype(np.float64) * spacing
    return _polished(field, placed, spacing), faces.astype(np.int64)


def gradient(field: Field, points: Array, step: float) -> Array:
    """(N, 3) central differences."""
    shifts = step * np.eye(3)
    return np.stack([(field(points + s) - field(points - s)) / (2 * step) for s in shifts], axis=1)


def _polished(field: Field, points: Array, spacing: float) -> Array:
    """Newton's steps onto the surface along the slope found first, no farther than a third of a lattice cell.

    Farther, triangles would fold where the slope has a crease.
    """
    slope = gradient(field, points, 0.05 * spacing)
    slope /= np.maximum((slope**2).sum(axis=1, keepdims=True), 0.25)
    reach = spacing / 3 / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    moved = np.zeros(len(points))
    for _ in range(POLISH):
        moved = np.clip(moved - field(points + moved[:, None] * slope), -reach, reach)
    return points + moved[:, None] * slope


@dataclass(frozen=True, kw_only=True)
class Bulge:
    """A push by ``shift`` metres and a swelling by the share ``swell``, both fading as exp(-r² / 2 radius²)."""

    centre: Triple
    radius: float
    shift: Triple = (0.0, 0.0, 0.0)
    swell: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Warp:
    """Where each place x goes: x + (scale - 1)(x - base) + bend h² / height + twist + bulges, h = x_z - base_z.

    base: the point that stays. scale: factors along the axes. bend: metres by which what is ``height`` metres above
    the base leans, growing with the square. twist: radians at ``height``, growing evenly (to first order in it).
    """

    base: Triple = (0.0, 0.0, 0.0)
    height: float
    scale: Triple = (1.0, 1.0, 1.0)
    bend: tuple[float, float] = (0.0, 0.0)
    twist: float = 0.0
    bulges: tuple[Bulge, ...] = ()

    def __call__(self, points: Array) -> Array:
        """The warped places (N, 3) of ``points`` (N, 3), metres."""
        away = points - np.array(self.base)
        level = away[:, 2] / self.height
        moved = points + away * (np.array(self.scale) - 1.0)
        moved[:, :2] += np.array(self.bend) * (level**2)[:, None]
        moved[:, 0] -= self.twist * level * away[:, 1]
        moved[:, 1] += self.twist * level * away[:, 0]
        for bulge in self.bulges:
            offset, share = _fading(points, bulge)
            moved += share[:, None] * (np.array(bulge.shift) + bulge.swell * offset)
        return moved

    def jacobian(self, points: Array) -> Array:
        """(N, 3, 3) its derivative at ``points``: row i is that of coordinate i."""
        away = points - np.array(self.base)
        level = away[:, 2] / self.height
        result = np.repeat(np.diag(self.scale)[None], len(points), axis=0)
        result[:, :2, 2] += 2.0 * np.array(self.bend) * (level / self.height)[:, None]
        result[:, 0, 1] -= self.twist * level
        result[:, 1, 0] += self.twist * level
        result[:, 0, 2] -= self.twist * away[:, 1] / self.height
        result[:, 1, 2] += self.twist * away[:, 0] / self.height
        for bulge in self.bulges:
            offset, share = _fading(points, bulge)
            push = np.array(bulge.shift) + bulge.swell * offset
            slope = -offset / bulge.radius**2
            result += share[:, None, None] * (push[:, :, None] * slope[:, None, :] + bulge.swell * np.eye(3))
        return result


def _fading(points: Array, bulge: Bulge) -> tuple[Array, Array]:
    offset = points - np.array(bulge.centre)
    return offset, np.exp(-0.5 * (offset**2).sum(axis=1) / bulge.radius**2)
