# SPDX-License-Identifier: MIT
"""How much noise there is at each timestep of a diffusion model, and which timesteps an optimisation goes through."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

Array = NDArray[np.float64]

WEIGHTINGS = ("variance", "constant", "signal-variance")

FIRST_TIMESTEP, LAST_TIMESTEP = 100, 20
"""PhyCAGE §5.1, of 1000."""


def _stable_diffusion() -> Array:
    return _cumulative(np.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000) ** 2)


def _cumulative(betas: Array) -> Array:
    return np.asarray(np.cumprod(1.0 - betas), dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseSchedule:
    """A picture x with the noise of timestep t is x_t = √ᾱ_t x + √(1-ᾱ_t) ε with ε standard normal (Ho et al. 2020,
    eq. 4). Raises InputError on numbers that are no schedule.
    """

    alphas_cumprod: NDArray[Any] = None  # type: ignore[assignment]
    """(T,) ᾱ_t, each between 0 and 1 and below the one before; 10 to 100,000 of them. None: those of Stable Diffusion,
    T = 1000, whose √β rise linearly from √0.00085 to √0.012."""

    weighting: str = "variance"
    """w(t) of the gradient: "variance" is 1-ᾱ_t (DreamFusion), "constant" is 1, "signal-variance" is √ᾱ_t (1-ᾱ_t)
    (Fantasia3D)."""

    def __post_init__(self) -> None:
        given = _stable_diffusion() if self.alphas_cumprod is None else self.alphas_cumprod
        alphas = np.array(given, dtype=np.float64)
        if alphas.ndim != 1 or not 10 <= alphas.size <= 100_000:
            raise InputError(f"alphas_cumprod has shape {alphas.shape}: give 10 to 100000 numbers, one a timestep")
        if not (np.isfinite(alphas).all() and alphas.min() > 0 and alphas.max() < 1 and (np.diff(alphas) < 0).all()):
            raise InputError(
                f"alphas_cumprod goes from {alphas[0]:g} to {alphas[-1]:g}: give numbers between 0 and 1 that fall all "
                "the way (a schedule with nothing left of the picture at its end has no noise prediction there)"
            )
        if self.weighting not in WEIGHTINGS:
            raise InputError(f"weighting is {self.weighting!r}: choose one of {', '.join(WEIGHTINGS)}")
        alphas.flags.writeable = False
        object.__setattr__(self, "alphas_cumprod", alphas)

    @classmethod
    def scaled_linear(cls, first: float = 0.00085, last: float = 0.012, *, timesteps: int = 1000) -> NoiseSchedule:
        """√β rises linearly, as in latent diffusion (Rombach et al. 2022)."""
        return cls._of_betas(first, last, timesteps, 0.5)

    @classmethod
    def linear(cls, first: float = 1e-4, last: float = 0.02, *, timesteps: int = 1000) -> NoiseSchedule:
        """β rises linearly (Ho et al. 2020)."""
        return cls._of_betas(first, last, timesteps, 1.0)

    @classmethod
    def cosine(cls, *, timesteps: int = 1000, offset: float = 0.008, most: float = 0.999) -> NoiseSchedule:
        """ᾱ falls as a squared cosine, no β above ``most`` (Nichol and Dhariwal 2021, eq. 17)."""
        if not (10 <= timesteps <= 100_000 and 0 <= offset < 1 and 0 < most < 1):
            raise InputError(
                f"cosine schedule of {timesteps} timesteps, offset {offset!r}, most {most!r}: give 10 to 100000 "
                "timesteps, an offset from 0 to 1, and a largest β between 0 and 1"
            )
        level = np.cos((np.arange(timesteps + 1) / timesteps + offset) / (1 + offset) * (math.pi / 2)) ** 2
        return cls(alphas_cumprod=_cumulative(np.minimum(1 - level[1:] / level[:-1], most)))

    @classmethod
    def _of_betas(cls, first: float, last: float, timesteps: int, power: float) -> NoiseSchedule:
        if not (0 < first <= last < 1 and 10 <= timesteps <= 100_000):
            raise InputError(
                f"betas from {first!r} to {last!r} over {timesteps!r} timesteps: give numbers between 0 and 1 that do "
                "not fall, and 10 to 100000 timesteps"
            )
        return cls(alphas_cumprod=_cumulative(np.linspace(first**power, last**power, timesteps) ** (1 / power)))

    def __len__(self) -> int:
        return len(self.alphas_cumprod)

    def alpha(self, timestep: int) -> float:
        """ᾱ at ``timestep``, 0 to T-1. Raises InputError beyond."""
        if not 0 <= timestep < len(self):
            raise InputError(f"timestep is {timestep!r}: give 0 to {len(self) - 1}, where this noise schedule ends")
        return float(self.alphas_cumprod[timestep])

    def weight(self, timestep: int) -> float:
        """w(t) of PhyCAGE eq. 17 at ``timestep``, as ``weighting`` says."""
        alpha = self.alpha(timestep)
        if self.weighting == "constant":
            return 1.0
        return (1 - alpha) * (math.sqrt(alpha) if self.weighting == "signal-variance" else 1.0)


def timestep(step: int, steps: int, *, first: int = FIRST_TIMESTEP, last: int = LAST_TIMESTEP) -> int:
    """The timestep at ``step``, 0 to ``steps`` - 1, of an optimisation: from ``first`` linearly to ``last``.

    PhyCAGE §5.1 goes from 100 to 20 of 1000: little noise, so that details change and the composition stays. Raises
    InputError on a step outside of the optimisation and on timesteps below 0.
    """
    if not 0 <= step < steps:
        raise InputError(f"step is {step!r} of {steps!r} steps: give 0 to steps - 1")
    if first < 0 or last < 0:
        raise InputError(f"timesteps go from {first!r} to {last!r}: give whole numbers from 0")
    return round(first + (last - first) * step / max(steps - 1, 1))
