# SPDX-License-Identifier: MIT
"""How much of one object is inside another. No Taichi; vectorised numpy, deterministic. World metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.distance import DistanceLattice
from ...mpm.triangles import (
    bisected,
    check_closed,
    inside_lattice,
    signed_volume,
    squared_distances,
    validated,
    winding_numbers,
)

Array = NDArray[np.float64]

NODES, MOST_NODES = 1_000_000, 40_000_000
"""Nodes of the shared space where no spacing is given, and at most."""

FINEST = 400
"""Nodes along the longest side of a shared space that is as good as flat, at most."""

LOOKED_AT = 500
"""Places whose depth is looked at together: more take long in the middle of a ball, where all is equally far."""

PIECES = 64
"""Pieces along the longest side of an object by which the nearest of its triangles are found."""


@dataclass(frozen=True, kw_only=True)
class Penetration:
    """What of a background is in a foreground. All 0 where they are apart."""

    volume: float
    """Volume in m³ that both occupy."""

    share: float
    """Share of the background's inside, or of its points, that lies in the foreground, 0 to 1."""

    deepest: float
    """Metres from the deepest of it to the foreground's surface."""

    apart: float = 0.0
    """Metres between them where they do not touch; 0 where they do."""

    contained: str = ""
    """"background" if it lies wholly in the foreground, "foreground" if that lies wholly in it, else empty."""

    def describe(self) -> str:
        """One sentence for people."""
        if self.contained:
            other = "foreground" if self.contained == "background" else "background"
            return f"the {self.contained} lies wholly inside the {other}, {1e3 * self.deepest:.3g} mm deep"
        if self.volume == 0:
            return "they do not touch" + (f": {1e3 * self.apart:.3g} mm apart" if self.apart > 0 else "")
        return (
            f"{1e6 * self.volume:.3g} cm³ are shared, {100 * self.share:.3g} % of the background, "
            f"{1e3 * self.deepest:.3g} mm deep"
        )


def penetration_of_points(
    points: NDArray[np.floating], volumes: NDArray[np.floating] | None, lattice: DistanceLattice
) -> Penetration:
    """Of points (N, 3), each standing for a volume (N,) in m³; None: volumes are not known, and 0 is said.

    lattice: signed distances to the foreground, negative inside.
    Raises InputError on wrong shapes and numbers that are not finite.
    """
    distance = lattice.at(points)[0]
    if len(distance) == 0:
        raise InputError("penetration: there are no points: give at least one")
    if volumes is not None and np.shape(volumes) != distance.shape:
        raise InputError(f"penetration: volumes have shape {np.shape(volumes)}: give {distance.shape}, one a point")
    inside = distance < 0
    every = inside.all()
    return Penetration(
        volume=float(np.asarray(volumes)[inside].sum()) if volumes is not None else 0.0,
        share=float(inside.mean()),
        deepest=max(0.0, -float(distance.min())),
        apart=max(0.0, float(distance.min())),
        contained="background" if every else "",
    )


def penetration_of_meshes(background: Surface, foreground: Surface, *, spacing: float | None = None) -> Penetration:
    """Of two closed meshes, counted on a lattice over the space that their bounding boxes share.

    spacing: metres between nodes, above 0; None takes what gives about a million. The volume is that of the nodes
    inside both: right to a few thousandths where the shared part is some 30 nodes across. Depth is within
    a few nodes.

    Raises InputError where a mesh is open or flat, or the lattice would be too large.
    """
    checked = [_Closed(name, surface) for name, surface in (("background", background), ("foreground", foreground))]
    low = np.maximum(checked[0].low, checked[1].low)
    high = np.minimum(checked[0].high, checked[1].high)
    if not (high > low).all():
        return _apart(*checked)
    if spacing is None:
        spacing = float(np.cbrt((high - low).prod() / NODES))
        spacing = max(spacing, float((high - low).max()) / FINEST)
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"penetration: spacing is {spacing!r}: give metres above 0")
    count = np.ceil((high - low) / spacing)
    if count.prod() > MOST_NODES:
        raise InputError(f"penetration: spacing is {spacing:g} m: give a larger one, for {MOST_NODES:,} nodes at most")
    step = (high - low) / count
    inside = [one.inside(low, step, count.astype(np.int64)) for one in checked]
    nodes = np.argwhere(inside[0] & inside[1])
    if len(nodes) == 0:
        return _apart(*checked)
    volume = len(nodes) * float(step.prod())
    contained = ""
    for i, one in enumerate(checked):
        other = checked[1 - i]
        wholly = bool(((one.low >= other.low) & (one.high <= other.high)).all()) and bool(
            inside[1 - i][inside[i]].all()
        )
        contained = contained or (one.name if wholly else "")
    return Penetration(
        volume=volume,
        share=min(1.0, volume / checked[0].volume),
        deepest=_deepest(low + (nodes + 0.5) * step, background.vertices, checked[1]),
        contained=contained,
    )


class _Closed:
    """A closed mesh to ask questions of."""

    def __init__(self, name: str, surface: Surface) -> None:
        self.name = name
        try:
            self._points, self._triangles = validated(surface.vertices, surface.faces)
            self._oriented = check_closed(self._triangles)
        except InputError as error:
            raise InputError(f"penetration: {name}: {error}") from None
        self.corners = self._points[self._triangles]
        self.low, self.high = self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))
        self.volume = abs(signed_volume(self._points, self._triangles))
        size = float((self.high - self.low).max())
        if not self.volume > 1e-9 * size**3:
            raise InputError(f"penetration: {name} has no volume ({self.volume:g} m³): give it thickness")
        pieces, owner = bisected(self.corners, size / PIECES)
        self.places = pieces.mean(axis=1)
        self._owner = owner
        self._tree = cKDTree(self.places)

    def inside(self, low: Array, step: Array, count: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which points ``low + (i + 0.5) step`` lie inside."""
        return inside_lattice(self._points, self._triangles, low, step, count, self._oriented)

    def holds(self, places: Array) -> NDArray[np.bool_]:
        """Which of places (N, 3) lie inside."""
        result = ((places > self.low) & (places < self.high)).all(axis=1)
        if result.any():
            result[result] = winding_numbers(places[result], self.corners, self._oriented) != 0
        return np.asarray(result)

    def distances(self, places: Array) -> Array:
        """Distances (N,) of places (N, 3) to the surface."""
        near = self._tree.query(places, k=min(4, len(self.places)))[1].reshape(len(places), -1)
        squares = [squared_distances(places, self.corners[self._owner[column]]) for column in near.T]
        return np.asarray(np.sqrt(np.min(squares, axis=0)))

    def gap(self, other: _Closed) -> float:
        """Least distance of the other's pieces to this surface."""
        some = other.places[:: max(1, len(other.places) // 100)]
        bound = float(self._tree.query(some)[0].min())
        distance = self._tree.query(other.places, distance_upper_bound=bound * (1 + 1e-9) + 1e-300)[0]
        reach = float((self.high - self.low).max()) / PIECES
        near = other.places[distance <= distance.min() + 2 * reach]
        return float(self.distances(near).min())


def _deepest(places: Array, corners: Array, foreground: _Closed) -> float:
    """Distance to the foreground's surface of the deepest of places in it, and of those of corners that are in it."""
    held = corners[foreground.holds(corners)]
    deepest = float(foreground.distances(held[:: max(1, len(held) // LOOKED_AT)]).max()) if len(held) else 0.0
    # Around the deepest of a few, the deepest of a few nearer ones, until all that are near have been looked at.
    while len(places):
        some = places[:: max(1, len(places) // LOOKED_AT)]
        distance = foreground.distances(some)
        deepest = max(deepest, float(distance.max()))
        if len(some) == len(places):
            break
        around = 2.0 * float(np.cbrt(np.maximum(np.ptp(places, axis=0), 1e-300).prod() / len(some)))
        nearer = places[np.linalg.norm(places - some[distance.argmax()], axis=1) < around]
        places = nearer if len(nearer) < len(places) else places[:0]
    return deepest


def _apart(a: _Closed, b: _Closed) -> Penetration:
    """Two that share nothing."""
    gap = min(a.gap(b), b.gap(a))
    return Penetration(volume=0.0, share=0.0, deepest=0.0, apart=gap)
