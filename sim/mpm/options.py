# SPDX-License-Identifier: MIT
"""Options of the solver. All defaults together are the profile of the papers (256 cells over a box of side 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..scene.model import Ground
from ..scene.units import ENGINE_BOX_SIZE, Similarity

__all__ = ["ARCHITECTURES", "Ground", "SolverOptions"]

ARCHITECTURES = ("cpu", "cuda", "vulkan", "metal")


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """How finely, how fast and where the engine computes. Raises InputError on a value out of range."""

    grid: int = 256
    """Cells along each side of the engine's box; a multiple of 4, 32 to 1024."""

    particles_per_cell: int = 8
    """Particles per grid cell of undeformed material; 1 to 64. Fewer than 8 loses accuracy, see docs/physics.md."""

    cfl_elastic: float = 0.4
    """Cells that the fastest elastic wave travels in a substep; above 0, up to 0.55."""

    cfl_velocity: float = 0.2
    """Cells that the fastest particle travels in a substep; above 0, up to 0.4."""

    max_step: float = 5e-4
    """Longest substep in seconds, whatever the wave speed; above 0. After a fall of time t the position is wrong by
    max_step / t of the way."""

    arch: str = "cpu"
    """Where to compute: "cpu", "cuda", "vulkan" or "metal"; falls back to "cpu" where that is not to be had."""

    threads: int = 0
    """CPU threads; 0 takes all. Results do not depend on it."""

    cache_folder: Path | None = None
    """Folder for compiled kernels (Taichi's offline cache); None takes Taichi's default in the user's cache folder."""

    def __post_init__(self) -> None:
        _require(
            isinstance(self.grid, int) and self.grid % 4 == 0 and 32 <= self.grid <= 1024,
            "grid",
            self.grid,
            "give a multiple of 4 from 32 to 1024",
        )
        _require(
            isinstance(self.particles_per_cell, int) and 1 <= self.particles_per_cell <= 64,
            "particles_per_cell",
            self.particles_per_cell,
            "give a whole number from 1 to 64; 8 is usual",
        )
        _require(0 < self.cfl_elastic <= 0.55, "cfl_elastic", self.cfl_elastic, "give a number above 0, up to 0.55")
        _require(0 < self.cfl_velocity <= 0.4, "cfl_velocity", self.cfl_velocity, "give a number above 0, up to 0.4")
        _require(math.isfinite(self.max_step) and self.max_step > 0, "max_step", self.max_step, "give seconds above 0")
        _require(self.arch in ARCHITECTURES, "arch", self.arch, f"choose one of {', '.join(ARCHITECTURES)}")
        _require(isinstance(self.threads, int) and self.threads >= 0, "threads", self.threads, "give 0 (all) or more")

    def cell_size(self, similarity: Similarity) -> float:
        """Side of a grid cell in metres under ``similarity``."""
        return ENGINE_BOX_SIZE / (self.grid * similarity.scale)

    def particle_spacing(self, similarity: Similarity) -> float:
        """Distance in metres between neighbouring particles, for ``sampling.sample_interior``."""
        return self.cell_size(similarity) / math.cbrt(self.particles_per_cell)


def _require(condition: bool, field: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(f"solver option {field} is {value!r}: {remedy}")
