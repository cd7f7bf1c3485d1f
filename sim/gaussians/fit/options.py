# SPDX-License-Identifier: MIT
"""Options of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...errors import InputError
from .losses import ALPHA_WEIGHT, SSIM_SHARE
from .parameters import GROUPS


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How splats are fitted to views. Raises InputError on a value out of range.

    A rate is how far Adam moves a value in a step while all its gradients agree. Those of centres, scales and rotations
    are some four times those of 3D Gaussian Splatting, which takes 30 000 steps for a photographed room; one object
    takes some hundred.
    """

    steps: int = 600
    """Steps of descent, each on one view; 1 or more. The paper takes 3000 for the background object and 30 000 for the
    foreground one."""

    centre_rate: float = 2e-3
    """Of centres, in radii of the object (half the diagonal of the box around the first centres); 0 to 1. Falls
    exponentially to a hundredth at the last step."""

    scale_rate: float = 2e-2
    """Of the logarithm of scales; 0 to 1."""

    rotation_rate: float = 5e-3
    """Of quaternions; 0 to 1."""

    opacity_rate: float = 2.5e-2
    """Of the logit of opacities; 0 to 1."""

    colour_rate: float = 2.5e-3
    """Of colours; 0 to 1."""

    ssim_share: float = SSIM_SHARE
    """λ₁, what SSIM counts beside L1; 0 to 1."""

    alpha_weight: float = ALPHA_WEIGHT
    """λ₂, what it costs to cover a pixel that the object leaves free; 0 or more."""

    frozen: frozenset[str] = frozenset()
    """Fields of Splats that stay as they are: "centres" keeps a foreground on its surface (equation 16)."""

    label: int | None = None
    """Which object of the views' labels is fitted; None fits all that the views' masks cover."""

    seed: int = 0
    """Of the order of the views and of the backgrounds that the fit puts behind them."""

    def __post_init__(self) -> None:
        _require(isinstance(self.steps, int) and self.steps >= 1, "steps", self.steps, "give a whole number from 1")
        for name in ("centre_rate", "scale_rate", "rotation_rate", "opacity_rate", "colour_rate", "ssim_share"):
            value = getattr(self, name)
            _require(math.isfinite(value) and 0 <= value <= 1, name, value, "give a number from 0 to 1")
        _require(
            math.isfinite(self.alpha_weight) and self.alpha_weight >= 0,
            "alpha_weight",
            self.alpha_weight,
            "give 0 or more; the paper takes 1",
        )
        strange = sorted(self.frozen - set(GROUPS))
        _require(not strange, "frozen", strange, f"choose among {', '.join(GROUPS)}")
        _require(len(self.frozen) < len(GROUPS), "frozen", sorted(self.frozen), "leave at least one free")


def _require(condition: bool, field: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(f"fit option {field} is {value!r}: {remedy}")
