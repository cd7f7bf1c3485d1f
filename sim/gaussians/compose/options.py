# SPDX-License-Identifier: MIT
"""How objects are brought to fit each other: method, budget, weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...errors import InputError

METHODS = ("pse-sds", "sds", "ppps", "ppps+sds")
"""Algorithm 1 of PhyCAGE and its ablations (§5.4): pictures only; physics only; the two in turns."""


@dataclass(frozen=True, kw_only=True)
class ComposeOptions:
    """Raises InputError on a value out of range. Defaults are PhyCAGE's (§5.1) where it names them."""

    method: str = "pse-sds"
    """One of ``METHODS``."""

    steps: int = 500
    """K of Algorithm 1, 1 to 100,000."""

    substeps: int = 20
    """N of Algorithm 1: MPM substeps a step, 1 to 1000."""

    cells: int = 32
    """Grid cells along the longest side of the piece that yields, 8 to 256."""

    ssim_share: float = 0.2
    """λ1 of eq. 18, 0 to 1."""

    guidance_weight: float = 1e-5
    """λ3 of eq. 19 for pictures of 256² pixels, 0 to 1; scaled for others. Without a guidance it does nothing."""

    first_timestep: int = 100
    """Noise level of the guidance at the first step, 1 to 999."""

    last_timestep: int = 20
    """The same at the last step."""

    first_move: float = 1.0
    """Cells that the fastest hundredth of the points would move in the first step if they were alone, 0.01 to 4. It
    sets the factor between gradient and velocity, which then stays (but for ``last_rate``)."""

    last_rate: float = 0.3
    """What is left of that factor at the last step, 0.001 to 1: the gradient of an L1 loss does not fade by itself."""

    first_stretch: float = 0.01
    """Change of the logarithm of a splat's scale in the first step, of the fastest hundredth; 0 (held) to 0.1."""

    first_turn: float = 0.01
    """Radians that a splat turns in the first step, of the fastest hundredth; 0 (held) to 0.1."""

    keep_strain: float = 0.5
    """Share of the strain that lives on from step to step, 0 to 1. 0: every step starts undeformed, as Algorithm 1
    hands over places and velocities only. 1: an elastic body that wants its first shape back."""

    size: int = 256
    """Pixels of the longer side of what is compared with the picture, 32 to 1024; larger pictures are made smaller."""

    seed: int = 0
    """Of the noise and of the order of views."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"compose option method is {self.method!r}: choose one of {', '.join(METHODS)}")
        ranges: dict[str, tuple[float, float]] = {
            "steps": (1, 100_000),
            "substeps": (1, 1000),
            "cells": (8, 256),
            "ssim_share": (0, 1),
            "guidance_weight": (0, 1),
            "first_timestep": (1, 999),
            "last_timestep": (1, 999),
            "first_move": (0.01, 4),
            "last_rate": (0.001, 1),
            "first_stretch": (0, 0.1),
            "first_turn": (0, 0.1),
            "keep_strain": (0, 1),
            "size": (32, 1024),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise InputError(f"compose option {name} is {value!r}: give {least:g} to {most:g}")

    @property
    def sees(self) -> bool:
        """Whether the method looks at pictures."""
        return self.method != "ppps"

    @property
    def simulates(self) -> bool:
        """Whether the method runs the simulator."""
        return self.method != "sds"
