# SPDX-License-Identifier: MIT
"""Shapes as signed distance fields: negative inside, metres; what is joined or cut is rounded by a blend.

A field takes points (N, 3) in metres to values (N,). Exact distances for the solids, but for ellipsoids, where the
value is right to first order at the surface; blends only ever understate distances (Quilez, Distance functions).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Field = Callable[[Array], Array]
Triple = tuple[float, float, float]


def lengths(vectors: Array) -> Array:
    """(N,) of vectors (N, 3); several times faster than ``np.linalg.norm`` along short rows."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def ball(centre: Triple, radius: float) -> Field:
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
        # Which of three parts is nearest is told along the mantle's own direction.
        place = height * rise - radius * slope
        low, high = np.hypot(radius, height) - radius_a, np.hypot(radius, height - length) - radius_b
        mantle = radius * rise + height * slope - radius_a
        return np.where(place < 0, low, np.where(place > length * rise, high, mantle))

    return field


def limb(points: Sequence[Triple], radii: Sequence[float], blend: float) -> Field:
    """Cones from each point to the next."""
    ends = pairwise(zip(points, radii, strict=True))
    return union(*(cone(a, b, ra, rb) for (a, ra), (b, rb) in ends), blend=blend)


def block(centre: Triple, half: Triple, rounding: float) -> Field:
    """A box along the axes of half extents ``half``, its edges rounded."""

    def field(p: Array) -> Array:
        beyond = np.abs(p - np.array(centre)) - (np.array(half) - rounding)
        outside = lengths(np.maximum(beyond, 0.0))
        return outside + np.minimum(beyond.max(axis=1), 0.0) - rounding

    return field


def tyre(centre: Triple, radius: float, tube: float, axis: Triple = (0.0, 0.0, 1.0)) -> Field:
    """A torus around ``axis`` through ``centre``."""
    unit = np.array(axis) / np.linalg.norm(axis)

    def field(p: Array) -> Array:
        height = (p - np.array(centre)) @ unit
        across = lengths(p - np.array(centre) - height[:, None] * unit)
        return np.hypot(across - radius, height) - tube

    return field


def turned(profile: Sequence[tuple[float, float]], rounding: float = 0.0) -> Field:
    """What a closed outline of (distance from the z axis, z) leaves when it is turned around the axis.

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


def turned_to(field: Field, centre: Triple, matrix: Array) -> Field:
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
            value = _least(value, other(p), blend)
        return value

    return field


def common(*fields: Field, blend: float = 0.0) -> Field:
    """Where all of them are, its edges rounded."""

    def field(p: Array) -> Array:
        value = -fields[0](p)
        for other in fields[1:]:
            value = _least(value, -other(p), blend)
        return -value

    return field


def without(field: Field, *others: Field, blend: float = 0.0) -> Field:
    """``field`` with the others cut out of it, its edges rounded."""
    return common(field, *(lambda p, other=other: -other(p) for other in others), blend=blend)


def worn(body: Field, *, thickness: float | Field, where: Field, blend: float) -> Field:
    """A layer on ``body``, within ``where``. It still has to be cut by the body."""
    return common(grown(body, thickness), where, blend=blend)


def _least(a: Array, b: Array, blend: float) -> Array:
    if blend <= 0:
        return np.minimum(a, b)
    near = np.maximum(blend - np.abs(a - b), 0.0) / blend
    return np.minimum(a, b) - 0.25 * blend * near * near
