# SPDX-License-Identifier: MIT
"""Quality presets: how finely a scene is simulated."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..scene.json_fields import parse

QUALITY_FOLDER = Path(__file__).resolve().parents[2] / "presets" / "qualities"


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How finely a scene is simulated.

    description: for people.
    particles: wanted for all moving objects together, 500 to 20 million; the cell size follows from it.
    particles_per_cell: in undeformed matter, 1 to 64; 8 is usual.
    smallest_cells: grid cells across the smallest object, at least, 2 to 256; overrules ``particles``.
    grid: cells along a box four times as wide as all moving objects together, 32 to 4096; sets the cell size in
        place of the number of particles and of ``smallest_cells``. None leaves it to them.
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
    """Names of all shipped qualities, sorted."""
    return sorted(path.stem for path in QUALITY_FOLDER.glob("*.toml"))


def load_quality(name: str) -> Quality:
    """The quality ``name``. Raises InputError when there is none of that name."""
    if name not in quality_names():
        raise InputError(f"quality {name!r}: there is none of that name; choose one of {', '.join(quality_names())}")
    path = QUALITY_FOLDER / f"{name}.toml"
    try:
        return parse(Quality, tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None
