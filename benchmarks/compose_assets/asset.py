# SPDX-License-Identifier: MIT
"""An asset of the composition benchmark: coloured parts of known shape, and the deformation of its start."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from physgen.sim.smoothstep import smoothstep

from .sdf import Array, Field, Triple, Warp, mesh_of


def rgb(code: str) -> Array:
    """(3,) of ``rrggbb``."""
    return np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0


def plain(points: Array, code: str) -> Array:
    """(N, 3) one colour."""
    return np.broadcast_to(rgb(code), (len(points), 3)).copy()


def over(colours: Array, share: Array, code: str) -> Array:
    """``colours`` with another laid over where ``share`` says."""
    return np.asarray(colours + np.clip(share, 0.0, 1.0)[:, None] * (rgb(code) - colours))


def inside(values: Array, soft: float) -> Array:
    """Share 1 where ``values`` are below 0, fading over ``soft`` of their unit."""
    return smoothstep(0.5 - values / soft)


def bands(coordinate: Array, period: float, soft: float, duty: float = 0.5) -> Array:
    """Share of stripes that fill ``duty`` of each ``period`` of ``coordinate``."""
    middle = np.abs(coordinate / period - np.floor(coordinate / period) - 0.5)
    return inside((middle - duty / 2) * period, soft)


def dots(points: Array, spacing: float, radius: float, soft: float, seed: int) -> Array:
    """Share of round spots, one in each cube of ``spacing``, anywhere in it that keeps it whole."""
    cell = np.floor(points / spacing).astype(np.int64)
    room = max(0.0, 0.5 - radius / spacing)
    centre = np.stack([_hashed(cell, seed + axis) for axis in range(3)], axis=1) * room + 0.5
    return inside(np.linalg.norm(points / spacing - cell - centre, axis=1) * spacing - radius, soft)


def noise(points: Array, size: float, seed: int) -> Array:
    """Smooth noise of -1 to 1, about 0, whose grains are ``size`` metres wide."""
    cell = np.floor(points / size).astype(np.int64)
    part = smoothstep(points / size - cell)
    total = np.zeros(len(points))
    for corner in product((0, 1), repeat=3):
        weight = np.where(np.array(corner, bool), part, 1.0 - part).prod(axis=1)
        total += weight * _hashed(cell + np.array(corner), seed)
    return total


def grained(colours: Array, points: Array, size: float, strength: float, seed: int) -> Array:
    """``colours`` lighter and darker by up to ``strength``, in grains of ``size`` metres and of a third of that."""
    change = noise(points, size, seed) + 0.6 * noise(points, size / 3, seed + 1)
    return np.clip(colours * (1.0 + strength * change)[:, None], 0.0, 1.0)


def _hashed(cell: NDArray[np.int64], seed: int) -> Array:
    """(N,) numbers of -1 to 1 for cells (N, 3), the same everywhere."""
    mixed = cell.astype(np.uint64) @ np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint64)
    mixed = (mixed + np.uint64(seed) * np.uint64(0x27D4EB2F)) & np.uint64(0xFFFFFFFF)
    for _ in range(2):
        mixed = ((mixed >> np.uint64(15)) ^ mixed) * np.uint64(0x2C1B3C6D) & np.uint64(0xFFFFFFFF)
    mixed = (mixed >> np.uint64(13)) ^ mixed
    return mixed.astype(np.float64) / 0x7FFFFFFF - 1.0


GAP = 0.003
"""Metres of air between parts that touch, for each metre of the asset: more than what triangles cut off curves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """One object of an asset: a closed mesh, each vertex with its colour."""

    name: str

    vertices: Array
    """(V, 3) world metres, z up, the asset stands on z = 0."""

    faces: NDArray[np.int64]
    """(T, 3) wound outwards."""

    colours: Array
    """(V, 3) sRGB, 0 to 1."""

    def moved(self, vertices: Array) -> Part:
        """The same object with its vertices elsewhere."""
        return dataclasses.replace(self, vertices=vertices)


@dataclass(frozen=True, kw_only=True, eq=False)
class Asset:
    """Parts that fit each other at the truth: they touch, and none enters another."""

    name: str

    title: str
    """Human-readable description."""

    background: Part
    """O1, which yields: the one that the others hide in part."""

    foregrounds: tuple[Part, ...]
    """O2 and further ones, each worn or carried by O1; they stay where they are."""

    warp: Warp
    """Takes the true O1 to the start, which enters the foregrounds."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """O1, O2, …: part i has the label i + 1 in pictures."""
        return (self.background, *self.foregrounds)

    @property
    def size(self) -> float:
        """Metres: the largest extent of the truth along an axis."""
        return float(np.ptp(np.concatenate([part.vertices for part in self.parts]), axis=0).max())

    @property
    def start(self) -> Part:
        """O1 as the optimisation gets it, distorted."""
        return self.background.moved(self.warp(self.background.vertices))


def part(
    name: str, shape: Field, paint: Callable[[Array], Array], *, box: tuple[Triple, Triple], spacing: float
) -> Part:
    """The object that ``shape`` describes within ``box``, its vertices about ``spacing`` metres apart."""
    vertices, faces = mesh_of(shape, *box, spacing)
    return Part(name=name, vertices=vertices, faces=faces, colours=np.clip(paint(vertices), 0.0, 1.0))
