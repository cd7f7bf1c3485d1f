# SPDX-License-Identifier: MIT
"""Score distillation: the ``Guidance`` protocol, noise schedules, its term of the loss, and checks of its output.

A guidance returns the direction in which a rendered image becomes more likely (PhyCAGE equations 17 and 19)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, PhysGenError, SimulationError
from ...scene.model import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """Input of a guidance. Raises InputError on a picture that is not finite floats of the camera's size."""

    picture: NDArray[Any]
    """(H, W, 3) floats, rendered sRGB, 0 to 1."""

    camera: Camera
    """The camera it was rendered from."""

    subject: str
    """Name of the object or objects in it, the default prompt of text-conditioned models."""

    def __post_init__(self) -> None:
        picture = np.asarray(self.picture)
        wanted = (self.camera.height, self.camera.width, 3)
        if picture.shape != wanted or picture.dtype.kind != "f":
            raise InputError(
                f"picture of {self.subject!r} has shape {picture.shape} {picture.dtype}: give floats {wanted}, the "
                "camera's size"
            )
        if not np.isfinite(picture).all():
            raise InputError(f"picture of {self.subject!r} has values that are not finite: check what is rendered")


class Guidance(Protocol):
    """A model of likely images: a diffusion model, or a set of images (``ideal_denoiser.IdealDenoiser``)."""

    def gradient(self, seen: RenderedView, timestep: int, random: np.random.Generator) -> Array:
        """Return (H, W, 3) w(t) (ε̂ - ε) ∂z/∂picture, ∇L_SDS by pixels (PhyCAGE eq. 17, DreamFusion eq. 3).

        z is what the model adds noise to: the picture scaled to -1 to 1, or its latents. ε is drawn from ``random``
        only, so runs are reproducible. The gradient is a sum over z, not a mean, and points uphill. The caller
        multiplies by λ3 and propagates it through the rasteriser.
        """
        ...


WEIGHTINGS = ("variance", "constant", "signal-variance")

FIRST_TIMESTEP, LAST_TIMESTEP = 100, 20
"""PhyCAGE §5.1, of 1000."""


def _stable_diffusion_alphas() -> Array:
    betas = np.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000) ** 2
    return np.asarray(np.cumprod(1.0 - betas), dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseSchedule:
    """Noise levels of a diffusion model: x_t = √ᾱ_t x + √(1-ᾱ_t) ε with ε standard normal (Ho et al. 2020, eq. 4).

    Raises InputError on invalid ᾱ and on an unknown weighting.
    """

    alphas_cumprod: NDArray[Any] = None  # type: ignore[assignment]
    """(T,) ᾱ_t, between 0 and 1, strictly decreasing, T from 10 to 100,000. None: those of Stable Diffusion, T = 1000,
    with √β rising linearly from √0.00085 to √0.012."""

    weighting: str = "variance"
    """w(t) of the gradient: "variance" is 1-ᾱ_t (DreamFusion), "constant" is 1, "signal-variance" is √ᾱ_t (1-ᾱ_t)
    (Fantasia3D)."""

    def __post_init__(self) -> None:
        given = _stable_diffusion_alphas() if self.alphas_cumprod is None else self.alphas_cumprod
        alphas = np.array(given, dtype=np.float64)
        if alphas.ndim != 1 or not 10 <= alphas.size <= 100_000:
            raise InputError(f"alphas_cumprod has shape {alphas.shape}: give 10 to 100000 numbers, one a timestep")
        if not (np.isfinite(alphas).all() and alphas.min() > 0 and alphas.max() < 1 and (np.diff(alphas) < 0).all()):
            raise InputError(
                f"alphas_cumprod goes from {alphas[0]:g} to {alphas[-1]:g}: give strictly decreasing numbers between 0 "
                "and 1 (noise cannot be predicted where nothing of the image is left)"
            )
        if self.weighting not in WEIGHTINGS:
            raise InputError(f"weighting is {self.weighting!r}: choose one of {', '.join(WEIGHTINGS)}")
        alphas.flags.writeable = False
        object.__setattr__(self, "alphas_cumprod", alphas)

    def __len__(self) -> int:
        return len(self.alphas_cumprod)

    def alpha(self, timestep: int) -> float:
        """Return ᾱ at ``timestep``, 0 to T-1. Raises InputError outside."""
        if not 0 <= timestep < len(self):
            raise InputError(f"timestep is {timestep!r}: give 0 to {len(self) - 1}, the end of this noise schedule")
        return float(self.alphas_cumprod[timestep])

    def weight(self, timestep: int) -> float:
        """Return w(t) of PhyCAGE eq. 17 at ``timestep``, according to ``weighting``."""
        alpha = self.alpha(timestep)
        if self.weighting == "constant":
            return 1.0
        return (1 - alpha) * (math.sqrt(alpha) if self.weighting == "signal-variance" else 1.0)


def annealed_timestep(step: int, steps: int, *, first: int = FIRST_TIMESTEP, last: int = LAST_TIMESTEP) -> int:
    """Return the timestep at ``step``, 0 to ``steps`` - 1, of an optimisation: linear from ``first`` to ``last``.

    PhyCAGE §5.1 anneals from 100 to 20 of 1000: little noise, so that details change and the composition stays. Raises
    InputError on a step outside the optimisation and on timesteps below 0.
    """
    if not 0 <= step < steps:
        raise InputError(f"step is {step!r} of {steps!r} steps: give 0 to steps - 1")
    if first < 0 or last < 0:
        raise InputError(f"timesteps go from {first!r} to {last!r}: give whole numbers from 0")
    return round(first + (last - first) * step / max(steps - 1, 1))


def guidance_loss_gradient(
    picture: NDArray[Any],
    camera: Camera,
    subject: str,
    *,
    step: int,
    steps: int,
    guidance: Guidance,
    random: np.random.Generator,
    weight: float = 1e-5,
    first: int = FIRST_TIMESTEP,
    last: int = LAST_TIMESTEP,
) -> Array:
    """Return λ3 ∂L_SDS/∂picture (H, W, 3), to be added to the image loss's gradient.

    picture: (H, W, 3) sRGB 0 to 1, rendered from ``camera``. step: 0 to ``steps`` - 1, over which the timestep goes
    from ``first`` to ``last``. weight: λ3, at least 0; with 0 the guidance is not evaluated. Its gradient is a sum over
    pixels and the image loss a mean: 1e-5 is about 1 / (3 · 256²), so both have similar weight in images of 256²; in
    others, 1e-5 · 256² / (H W) keeps it so. Raises InputError, and what ``guidance`` raises.
    """
    if not (math.isfinite(weight) and weight >= 0):
        raise InputError(f"weight of the guidance is {weight!r}: give at least 0; 1e-5 is usual")
    seen = RenderedView(picture=picture, camera=camera, subject=subject)
    moment = annealed_timestep(step, steps, first=first, last=last)
    if weight == 0:
        return np.zeros(seen.picture.shape)
    return weight * guidance.gradient(seen, moment, random)


MAX_BAD_IN_A_ROW = 5
"""Consecutive steps without a finite gradient after which an optimisation is aborted."""
MAX_NOTES = 20


class CheckedGuidance:
    """A ``Guidance`` that checks the output of another; use one for each optimisation, because it counts.

    A gradient that is not finite becomes zero and a line in ``notes`` with the step's timestep and subject. The
    ``most``-th of them in a row raises SimulationError: the optimiser still has the state before it. A gradient of a
    wrong shape, and any exception of the guidance, is an error at once that names it.
    """

    def __init__(self, guidance: Guidance, *, name: str = "", most: int = MAX_BAD_IN_A_ROW) -> None:
        """name: its name in messages; by default its attribute ``name``, else its class. most: 1 or more."""
        if most < 1:
            raise InputError(
                f"most is {most!r}: give the number of consecutive bad gradients that ends a run, 1 or more"
            )
        self._guidance = guidance
        self._most = most
        self.name = name or str(getattr(guidance, "name", "")) or type(guidance).__name__
        self.calls = 0
        """Gradients requested so far."""
        self.bad = 0
        """Of those, the number that were not finite."""
        self.bad_in_a_row = 0
        self.notes: list[str] = []
        """Lines for the user, at most ``MAX_NOTES``; ``bad`` keeps counting."""

    def gradient(self, seen: RenderedView, timestep: int, random: np.random.Generator) -> Array:
        """Return (H, W, 3) as ``Guidance`` defines it, always finite. Raises InputError and SimulationError."""
        self.calls += 1
        answer = checked_gradient(self._guidance, seen, timestep, random, name=self.name)
        if answer is not None:
            self.bad_in_a_row = 0
            return answer
        self.bad += 1
        self.bad_in_a_row += 1
        if self.bad_in_a_row >= self._most:
            raise SimulationError(
                f"guidance {self.name}: {self.bad_in_a_row} gradients in a row were not finite ({self.bad} of "
                f"{self.calls} in total), last at timestep {timestep} of {seen.subject!r}; the state before is kept. "
                "Use 32-bit precision, a lower guidance scale, or another guidance"
            )
        if len(self.notes) < MAX_NOTES:
            self.notes.append(
                f"guidance {self.name}: its gradient at timestep {timestep} of {seen.subject!r} was not finite and was "
                "skipped"
            )
        return np.zeros(seen.picture.shape)


def checked_gradient(
    guidance: Guidance, seen: RenderedView, timestep: int, random: np.random.Generator, *, name: str
) -> Array | None:
    """Return the gradient of ``guidance`` (H, W, 3), or None where it is not finite.

    Raises InputError on another shape or type, SimulationError with the guidance's own message where it fails.
    """
    try:
        answer = np.asarray(guidance.gradient(seen, timestep, random))
    except PhysGenError:
        raise
    # Third-party code may raise anything; report it with the guidance's name.
    except Exception as error:
        raise SimulationError(f"guidance {name}: failed ({type(error).__name__}: {str(error)[:300]})") from error
    if answer.shape != seen.picture.shape or answer.dtype.kind != "f":
        raise InputError(
            f"guidance {name}: returned {answer.shape} {answer.dtype}, expected floats {seen.picture.shape}, a "
            "gradient for each value of the picture"
        )
    return answer.astype(np.float64) if np.isfinite(answer).all() else None
