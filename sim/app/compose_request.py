# SPDX-License-Identifier: MIT
"""What a composition of a scene is asked for. No Taichi."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..errors import InputError
from ..gaussians.compose.options import ComposeOptions

FEWEST_SPLATS, MOST_SPLATS = 100, 2_000_000


@dataclass(frozen=True, kw_only=True)
class ComposeRequest:
    """What is to be done. Raises InputError on a value out of range."""

    objects: tuple[str, ...] = ()
    """From the one that stays to those that yield; empty: all that touch another, frontmost first."""

    options: ComposeOptions = field(default_factory=ComposeOptions)

    splats: int = 20_000
    """Of all objects together that have none of their own, 100 to 2,000,000."""

    picture: bool = True
    """Whether the scene's photo is looked at."""

    guidance: str = ""
    """``exact:FOLDER`` or ``diffusers:FOLDER``, for all that yield; ``OBJECT=KIND:FOLDER`` for one; empty: none."""

    prompt: str = ""
    """What a diffusion model is told that it sees."""

    def __post_init__(self) -> None:
        if not FEWEST_SPLATS <= self.splats <= MOST_SPLATS:
            raise InputError(f"splats is {self.splats!r}: give {FEWEST_SPLATS} to {MOST_SPLATS}")
        if not self.picture and self.options.sees:
            raise InputError(
                f"method {self.options.method} looks at the picture, and there shall be none: choose method ppps, "
                "which is physics alone, or do without --no-picture"
            )
        if self.prompt and "diffusers:" not in self.guidance:
            raise InputError(f"prompt is {self.prompt!r}: only a guidance diffusers:FOLDER is told one")
