# SPDX-License-Identifier: MIT
"""Solver options and the similarity map from world metres to the engine's grid. No Taichi."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.model import Ground
from ..scene.units import ENGINE_BOX_SIZE, Similarity

__all__ = ["ARCHITECTURES", "Ground", "SolverOptions"]

ARCHITECTURES = ("cpu", "cuda", "vulkan", "metal")


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Resolution, time step and device of the engine. Raises InputError on a value out of range."""

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

    implicit: bool = False
    """Whether stiff elastic matter takes implicit steps while it flies, slides or rests, where they pay; see
    ``quiet_matter``. Of a single world on a CPU."""

    arch: str = "cpu"
    """Where to compute: "cpu", "cuda", "vulkan" or "metal"; falls back to "cpu" where it is not available."""

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
        """Return the distance in metres between neighbouring particles, for ``sample_interior``."""
        return self.cell_size(similarity) / math.cbrt(self.particles_per_cell)


def _require(condition: bool, field: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(f"solver option {field} is {value!r}: {remedy}")


MIN_CELLS_ACROSS = 3.0
"""Fewest cells that the longest side of a body may have."""


def fit_similarity(
    bodies: Sequence[NDArray[np.floating]], *, cells_across: float = 32.0, options: SolverOptions | None = None
) -> Similarity:
    """Return the map that gives the largest body ``cells_across`` cells along its longest side, bodies amid the box.

    bodies: points (N, 3) of each body in world metres: mesh vertices before sampling, or particles.

    The box is a frame of reference, not a limit: bodies may start and move outside of it. Raises InputError when
    a body would get fewer than 3 cells along its longest side.
    """
    options = options or SolverOptions()
    if not bodies:
        raise InputError("bodies is empty: give the points of at least one body")
    if not (math.isfinite(cells_across) and cells_across >= MIN_CELLS_ACROSS):
        raise InputError(f"cells_across is {cells_across!r}: give {MIN_CELLS_ACROSS:g} or more")
    for i, points in enumerate(bodies):
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
            raise InputError(f"bodies[{i}] has shape {points.shape}: give finite points (N, 3), N above 0")
    boxes = [(np.min(points, axis=0), np.max(points, axis=0)) for points in bodies]
    lengths = [float((high - low).max()) for low, high in boxes]
    if max(lengths) <= 0:
        raise InputError("bodies have no extent: give points that are not all in one place")
    cells_per_metre = cells_across / max(lengths)
    if min(lengths) * cells_per_metre < MIN_CELLS_ACROSS:
        raise InputError(
            f"a body of {min(lengths):g} m gets {min(lengths) * cells_per_metre:.1f} cells along its longest side "
            f"beside one of {max(lengths):g} m: raise cells_across ({cells_across:g}), or simulate them apart"
        )
    low = np.min([b[0] for b in boxes], axis=0).astype(np.float64)
    high = np.max([b[1] for b in boxes], axis=0).astype(np.float64)
    return centred(0.5 * (low + high), 1.0 / cells_per_metre, options)


def centred(middle: NDArray[np.float64], cell: float, options: SolverOptions) -> Similarity:
    """Return the map with cells of ``cell`` metres and the world point ``middle`` (3,) amid the box."""
    scale = ENGINE_BOX_SIZE / (options.grid * cell)
    origin = middle - 0.5 * ENGINE_BOX_SIZE / scale
    return Similarity(scale=scale, origin=(float(origin[0]), float(origin[1]), float(origin[2])))
