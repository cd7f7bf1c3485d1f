# SPDX-License-Identifier: MIT
"""Data of a composition: parts with splats and a closed surface, the reference image, and the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.geometry.signed_distance import DistanceLattice, signed_distance
from ...scene.model import Camera
from ..splats import Splats

Pixels = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CompositionPart:
    """One object of a composition, world metres. Raises InputError for fewer than 4 splats."""

    name: str

    splats: Splats
    """Its appearance; the centres are also the particles on which the gradient acts."""

    surface: Surface
    """Its closed surface: of the simulated body if deformable, of the collider if fixed."""

    def __post_init__(self) -> None:
        if len(self.splats) < 4:
            raise InputError(f"{self.name}: has {len(self.splats)} splats: give at least 4")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """The image that the composition has to match. Raises InputError on wrong shapes and non-finite values."""

    camera: Camera

    pixels: Pixels
    """(H, W, 3) sRGB 0 to 1, of the camera's size."""

    backdrop: Pixels
    """(H, W, 3) sRGB 0 to 1, background behind the objects: white for a cut-out, the inpainted photo in a scene."""

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width, 3)
        for name in ("pixels", "backdrop"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"reference {name} have shape {value.shape}: give finite {shape}, the camera's size")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """Measures of one optimisation step, before it moved anything."""

    part: str
    """Name of the deformable part."""

    step: int
    loss: float
    """Image loss (eq. 18); NaN in steps without images."""
    psnr: float
    """dB of the composition against the reference; NaN as above."""
    inside: float
    """Fraction of the deformable part's splats inside fixed parts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composition:
    """Result of ``compose``."""

    parts: tuple[CompositionPart, ...]
    """In the given order; fixed ones are the same objects."""

    history: tuple[StepRecord, ...]
    notes: tuple[str, ...]
    """Sentences for the user about irregularities and how they were handled."""


DISTANCE_CELLS = 96
"""Cells of the distance lattice along the part's longest side."""


def part_distances(part: CompositionPart) -> DistanceLattice:
    """Return signed distances in metres to the part's surface. Raises InputError where it is open or flat."""
    spacing = float(np.ptp(part.surface.vertices, axis=0).max()) / DISTANCE_CELLS
    try:
        return signed_distance(part.surface, spacing, margin=2 * spacing)
    except InputError as error:
        raise InputError(f"{part.name}: {error}") from None


def fraction_inside(splats: Splats, lattices: Sequence[DistanceLattice]) -> float:
    """Return the fraction of the splats' centres inside any of the surfaces."""
    inside = np.zeros(len(splats), dtype=np.bool_)
    for lattice in lattices:
        inside |= lattice.at(splats.centres)[0] < 0
    return float(inside.mean())
