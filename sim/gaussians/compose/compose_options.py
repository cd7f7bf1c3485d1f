# SPDX-License-Identifier: MIT
"""Options of a composition: method, budget and weights; the request for a scene. No heavy imports."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from ...errors import InputError
from ...validation import quantity

METHODS = ("pse-sds", "sds", "ppps", "ppps+sds")
"""Algorithm 1 of PhyCAGE and its ablations (§5.4): images only; physics only; the two alternating."""


@dataclass(frozen=True, kw_only=True)
class ComposeOptions:
    """Options of ``composition.compose``; defaults are PhyCAGE's (§5.1) where it gives them.

    Raises InputError on a value out of range.
    """

    method: str = "pse-sds"
    """One of ``METHODS``."""

    steps: int = quantity(500, 1, 100_000)
    """K of Algorithm 1: optimisation steps, 1 to 100,000."""

    substeps: int = quantity(20, 1, 1000)
    """N of Algorithm 1: MPM substeps a step, 1 to 1000."""

    cells: int = quantity(32, 8, 256)
    """Grid cells along the longest side of the deformable part, 8 to 256."""

    ssim_share: float = quantity(0.2, 0, 1)
    """λ1 of eq. 18, 0 to 1."""

    guidance_weight: float = quantity(1e-5, 0, 1)
    """λ3 of eq. 19 for images of 256² pixels, 0 to 1; scaled for others. No effect without a guidance."""

    first_timestep: int = quantity(100, 1, 999)
    """Timestep of the guidance's noise at the first step, 1 to 999."""

    last_timestep: int = quantity(20, 1, 999)
    """The same at the last step."""

    first_move: float = quantity(1.0, 0.01, 4)
    """Displacement in grid cells of the fastest hundredth of the points in the first step, without interaction, 0.01 to
    4. It sets the first factor between gradient and velocity, which decays by ``last_rate`` and, with method pse-sds,
    follows how well successive steps agree."""

    last_rate: float = quantity(0.3, 0.001, 1)
    """Decay of that factor until the last step, 0.001 to 1: the gradient of an L1 loss does not vanish by itself."""

    first_stretch: float = quantity(0.01, 0, 0.1)
    """Change of log scale of the fastest hundredth of the splats in the first step; 0 (frozen) to 0.1."""

    first_turn: float = quantity(0.01, 0, 0.1)
    """Rotation in radians of the fastest hundredth of the splats in the first step; 0 (frozen) to 0.1."""

    keep_strain: float = quantity(0.5, 0, 1)
    """Fraction of the strain carried over from step to step, 0 to 1. 0: every step starts undeformed, as Algorithm 1
    passes on positions and velocities only. 1: an elastic body that returns to its initial shape."""

    seat: float = quantity(0.0, 0, 0.02)
    """Thickness by which deformable parts, once composed, close the air in contacts and bulge beside them, over their
    largest extent, 0 to 0.02: so that a composition stands under gravity. 0: not. No effect with method sds."""

    size: int = quantity(256, 32, 1024)
    """Longer side in pixels of the images compared, 32 to 1024; larger ones are scaled down."""

    seed: int = 0
    """Seed of the noise and of the order of views."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"compose option method is {self.method!r}: choose one of {', '.join(METHODS)}")
        for spec in fields(self):
            if "range" in spec.metadata:
                (least, most), value = spec.metadata["range"], getattr(self, spec.name)
                if not (math.isfinite(value) and least <= value <= most):
                    raise InputError(f"compose option {spec.name} is {value!r}: give {least:g} to {most:g}")

    @property
    def uses_images(self) -> bool:
        """Whether the method uses images."""
        return self.method != "ppps"

    @property
    def simulates(self) -> bool:
        """Whether the method runs the simulator."""
        return self.method != "sds"


MIN_SPLATS, MAX_SPLATS = 100, 2_000_000


@dataclass(frozen=True, kw_only=True)
class ComposeRequest:
    """A composition of a scene. Raises InputError on a value out of range."""

    objects: tuple[str, ...] = ()
    """Object names, the fixed one first, then the deformable ones; empty: all that touch another, frontmost first."""

    options: ComposeOptions = field(default_factory=ComposeOptions)

    splats: int = 20_000
    """Splats in total of all objects that have none of their own, 100 to 2,000,000."""

    picture: bool = True
    """Whether the scene's photo is the reference."""

    guidance: str = ""
    """``exact:FOLDER`` or ``diffusers:FOLDER``, for one object with ``OBJECT=`` before it; empty: none."""

    prompt: str = ""
    """Text prompt of a diffusion model."""

    def __post_init__(self) -> None:
        if not MIN_SPLATS <= self.splats <= MAX_SPLATS:
            raise InputError(f"splats is {self.splats!r}: give {MIN_SPLATS} to {MAX_SPLATS}")
        if not self.picture and self.options.uses_images:
            raise InputError(
                f"method {self.options.method} needs the picture: choose method ppps, which uses physics alone, or "
                "omit --no-picture"
            )
        if self.prompt and "diffusers:" not in self.guidance:
            raise InputError(f"prompt is {self.prompt!r}: only a guidance diffusers:FOLDER uses a prompt")
