# SPDX-License-Identifier: MIT
"""How far parts are in each other, by counting: for judging the assets themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.distance import signed_distance
from physgen.sim.mpm.triangles import inside_lattice

from .asset import Asset, Part
from .fields import Array


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """What two parts have in common."""

    volume: float
    """Cubic metres that both fill."""

    volumes: tuple[float, float]
    """Cubic metres of each."""

    depth: float
    """Metres: how deep the first's vertices lie in the second at most."""

    gap: float
    """Metres between them where they are nearest; 0 where they overlap."""


def volume(part: Part) -> float:
    """Cubic metres that a closed mesh holds."""
    corners = part.vertices[part.faces]
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def common_volume(a: Part, b: Part, *, cells: int = 96) -> float:
    """Cubic metres that both fill.

    cells: along the longest side of the box that holds what they share; the middle of each tells for all of it.
    """
    low = np.maximum(a.vertices.min(axis=0), b.vertices.min(axis=0))
    high = np.minimum(a.vertices.max(axis=0), b.vertices.max(axis=0))
    if not (high > low).all():
        return 0.0
    step = float((high - low).max()) / cells
    counts = np.ceil((high - low) / step).astype(np.int64)
    return float((_filled(a, low, step, counts) & _filled(b, low, step, counts)).sum()) * step**3


def overlap(a: Part, b: Part) -> Overlap:
    """What ``a`` and ``b`` have in common. Takes some seconds for the distances."""
    lattice = signed_distance(
        Surface(vertices=b.vertices, faces=b.faces), float(np.ptp(b.vertices, axis=0).max()) / 80, margin=0.0
    )
    nearest = float(lattice.at(a.vertices)[0].min())
    return Overlap(
        volume=common_volume(a, b), volumes=(volume(a), volume(b)), depth=max(0.0, -nearest), gap=max(0.0, nearest)
    )


def at_truth(asset: Asset) -> list[Overlap]:
    """Of every two parts of the truth, O1 with each foreground first."""
    parts = asset.parts
    return [overlap(a, b) for i, a in enumerate(parts) for b in parts[i + 1 :]]


def at_start(asset: Asset) -> list[Overlap]:
    """Of the distorted O1 with each foreground."""
    start = asset.start
    return [overlap(start, other) for other in asset.foregrounds]


def _filled(part: Part, low: Array, step: float, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    return inside_lattice(part.vertices, part.faces, low, np.full(3, step), counts, True)
