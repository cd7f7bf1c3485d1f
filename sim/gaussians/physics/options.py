# SPDX-License-Identifier: MIT
"""How the physical step is taken. No Taichi."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ...errors import InputError
from ...mpm.options import SolverOptions

EXIT_SIDES = ("bulk", "nearest")


@dataclass(frozen=True, kw_only=True)
class StepOptions:
    """Numbers of the physical step of Algorithm 1. Raises InputError on a value out of range."""

    substeps: int = 20
    """N: MPM substeps of a step of pseudo-time γ, so Δt = γ/N; 1 to 1000. More are taken where a point is so fast, or
    the body so strained, that Δt would not be stable."""

    cells_across: int = 32
    """Grid cells along the longest side of the body; 8 to 256."""

    particles_per_cell: int = 2
    """Filling particles in a grid cell of the body's inside; 1 to 8."""

    poisson_ratio: float = 0.3
    """Poisson's ratio of the body; 0 to 0.45."""

    wave_cells: float = 0.2
    """Grid cells that an elastic wave crosses in Δt, above 0, up to 0.5. It sets the stiffness, because pseudo-time has
    no seconds: Young's modulus follows from this speed by its dimension. In a step a push spreads through
    ``substeps * wave_cells`` cells."""

    recovery_cells: float = 0.25
    """Grid cells by which a step leads matter out of an obstacle at most, 0.01 to 1: gently, as neighbours come."""

    keep_strain: float = 1.0
    """Share of the strain that lives on from step to step; 0 to 1. 1: an elastic body, which wants its shape back.
    0: Algorithm 1 to the letter, which hands over x and v alone, so that every step begins without strain."""

    friction: float = 0.0
    """Coulomb's coefficient between body and obstacle, 0 to 1. 0 lets a loss slide matter along a surface."""

    margin: float = 0.0
    """Metres that points keep from the obstacles' surfaces; 0 to the size of a grid cell."""

    fill: bool = True
    """Whether the inside of the body is filled with particles, which makes it a body; else its points are all."""

    exit_side: str = "bulk"
    """Which way points leave an obstacle: "bulk": to the side of it on which the body's middle lies, also through a
    wall that they have passed wholly; "nearest": to the nearest place on its surface."""

    solver: SolverOptions = field(default_factory=SolverOptions)
    """Where to compute (arch, threads, cache_folder); its other numbers do not count here."""

    def __post_init__(self) -> None:
        for name, low, high in (("substeps", 1, 1000), ("cells_across", 8, 256), ("particles_per_cell", 1, 8)):
            value = getattr(self, name)
            if not (isinstance(value, int) and low <= value <= high):
                raise InputError(f"physical step: {name} is {value!r}: give a whole number from {low} to {high}")
        for name, least, most in (
            ("poisson_ratio", 0.0, 0.45),
            ("wave_cells", 1e-3, 0.5),
            ("recovery_cells", 0.01, 1.0),
            ("keep_strain", 0.0, 1.0),
            ("friction", 0.0, 1.0),
            ("margin", 0.0, math.inf),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise InputError(f"physical step: {name} is {value!r}: give {least:g} to {most:g}")
        if self.exit_side not in EXIT_SIDES:
            raise InputError(f"physical step: exit_side is {self.exit_side!r}: choose one of {', '.join(EXIT_SIDES)}")
