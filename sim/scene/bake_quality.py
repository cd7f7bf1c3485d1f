# SPDX-License-Identifier: MIT
"""Quality presets: how finely a scene is simulated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ..errors import InputError
from ..files import read_toml
from ..validation import parse

MAX_BYTES = 64 * 2**10
QUALITY_FOLDER = Path(__file__).resolve().parents[2] / "presets" / "qualities"
COARSEST = "preview"
"""The quality whose cells are largest, so that a base carries least."""


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Resolution of a simulation.

    description: human-readable.
    particles: target for all moving objects together, 500 to 20 million; determines the cell size.
    particles_per_cell: in undeformed material, 1 to 64; 8 is usual.
    smallest_cells: minimum number of grid cells across the smallest object, 2 to 256; overrides ``particles``.
    grid: cells along a box four times as wide as all moving objects together, a multiple of 4 from 32 to 1024; sets the
        cell size instead of ``particles`` and ``smallest_cells``. None: those decide.
    """

    description: str
    particles: int = 30_000
    particles_per_cell: int = 8
    smallest_cells: int = 8
    grid: int | None = None

    def __post_init__(self) -> None:
        if not 500 <= self.particles <= 20_000_000:
            raise InputError(f"particles is {self.particles}: give 500 to 20 million")
        if not 2 <= self.smallest_cells <= 256:
            raise InputError(f"smallest_cells is {self.smallest_cells}: give 2 to 256")
        if not 1 <= self.particles_per_cell <= 64:
            raise InputError(f"particles_per_cell is {self.particles_per_cell}: give 1 to 64; 8 is usual")
        if self.grid is not None and not (32 <= self.grid <= 1024 and self.grid % 4 == 0):
            raise InputError(f"grid is {self.grid}: give a multiple of 4 from 32 to 1024, or leave it out")


def quality_names() -> list[str]:
    """Return the names of all shipped qualities, sorted."""
    return sorted(path.stem for path in QUALITY_FOLDER.glob("*.toml"))


@cache
def load_quality(name: str) -> Quality:
    """Return the quality ``name``. Raises InputError for an unknown name."""
    if name not in quality_names():
        raise InputError(f"quality {name!r}: unknown; choose one of {', '.join(quality_names())}")
    path = QUALITY_FOLDER / f"{name}.toml"
    return parse(Quality, read_toml(path, MAX_BYTES, what="quality"), str(path))
