# SPDX-License-Identifier: MIT
"""What a compositional asset of the benchmark is: parts of known shape and colour, and how the start differs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fields import Array, Field, Triple
from .meshing import meshed
from .warp import Warp

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
    """What it shows, in words."""

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
    vertices, faces = meshed(shape, *box, spacing)
    return Part(name=name, vertices=vertices, faces=faces, colours=np.clip(paint(vertices), 0.0, 1.0))
