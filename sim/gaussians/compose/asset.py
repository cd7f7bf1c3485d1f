# SPDX-License-Identifier: MIT
"""What is brought to fit: pieces with splats and a closed surface, and the picture that they have to match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.colliders import Surface
from ...scene.model import Camera
from ..splats import Splats

Pixels = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """One object of an asset, world metres."""

    name: str

    splats: Splats
    """What is seen of it, and what moves it: the centres are the particles on which the gradient acts."""

    surface: Surface
    """Its closed surface: the matter inside it when it yields, the boundary that nothing passes when it stays."""

    def __post_init__(self) -> None:
        if len(self.splats) < 4:
            raise InputError(f"{self.name}: has {len(self.splats)} splats: give at least 4")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """The picture that the asset has to look like. Raises InputError on bad shapes."""

    camera: Camera

    pixels: Pixels
    """(H, W, 3) sRGB 0 to 1, of the camera's size."""

    backdrop: Pixels
    """(H, W, 3) sRGB 0 to 1: what is seen where no object is; white for a cut-out, the inpainted photo in a scene."""

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width, 3)
        for name in ("pixels", "backdrop"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"reference {name} have shape {value.shape}: give finite {shape}, the camera's size")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """What one step of the optimiser found, before it moved anything."""

    piece: str
    """Name of the one that yields."""

    step: int
    loss: float
    """Image loss (eq. 18); NaN where the method does not look."""
    psnr: float
    """dB of the composition against the reference; NaN as above."""
    inside: float
    """Share of the yielding piece's points that are inside what stays."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composed:
    """What ``compose`` returns."""

    pieces: tuple[Piece, ...]
    """In the order given; those that stayed are the same objects."""

    history: tuple[StepRecord, ...]
    notes: tuple[str, ...]
    """Sentences for people: what was odd and what was done about it."""
