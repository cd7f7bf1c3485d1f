# SPDX-License-Identifier: MIT
"""Splats fitted to views of an object (PhyCAGE equations 1 to 3; Kerbl et al. 2023, section 5).

Descent moves unconstrained parameters, named after the fields of ``Splats``: centres as they are, log scales,
quaternions of any length, logits of opacities, colours as they are (Kerbl et al. 2023, section 5.1: logarithm and
sigmoid keep scales and opacities in range). The optimiser is Adam (Kingma and Ba 2015) with a rate for each group."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..composite.image_metrics import psnr
from ..errors import Cancelled, InputError, SimulationError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..mpm.solver_options import SolverOptions
from .image_loss import ALPHA_WEIGHT, RGB, SSIM_SHARE, WHITE, Target, fit_loss, image_loss, view_target
from .raster.rasteriser import Rasteriser, SplatGradients
from .splats import MAX_SCALE, MIN_SCALE, Splats, joined
from .views.posed_images import View

Array = NDArray[np.float64]
ParameterGroups = Mapping[str, Array]
"""One array for each of ``GROUPS``, N splats long."""

GROUPS = ("centres", "scales", "rotations", "opacities", "colours")

MIN_OPACITY = 1e-5
"""Distance that opacities keep from 0 and 1, where the logit would be infinite."""


def to_parameters(splats: Splats) -> dict[str, Array]:
    """Return the unconstrained parameters of N ``splats`` by group: (N, 3), (N, 3), (N, 4), (N,), (N, 3)."""
    opacities = np.clip(splats.opacities, MIN_OPACITY, 1 - MIN_OPACITY)
    return {
        "centres": splats.centres,
        "scales": np.log(splats.scales),
        "rotations": splats.rotations,
        "opacities": np.log(opacities / (1 - opacities)),
        "colours": splats.colours,
    }


def from_parameters(values: ParameterGroups) -> Splats:
    """Return the splats with the parameters ``values``; scales are clamped to what ``Splats`` accepts."""
    return Splats(
        centres=values["centres"],
        scales=np.exp(np.clip(values["scales"], np.log(MIN_SCALE * 1.001), np.log(MAX_SCALE * 0.999))),
        rotations=values["rotations"],
        opacities=_sigmoid(values["opacities"]),
        colours=values["colours"],
    )


def parameter_gradients(values: ParameterGroups, gradients: SplatGradients) -> dict[str, Array]:
    """Return derivatives by the parameters ``values``, given those by the splats (chain rule).

    d/d log s = s d/ds; d/d logit α = α (1 - α) d/dα. Only the direction of a quaternion matters, so the component along
    it is removed (the rasteriser's is 0 there) and the rest is divided by its length.
    """
    raw = values["rotations"]
    lengths = np.linalg.norm(raw, axis=1, keepdims=True)
    unit = raw / lengths
    turning = np.asarray(gradients.rotations, dtype=np.float64)
    opacities = _sigmoid(values["opacities"])
    return {
        "centres": np.asarray(gradients.centres, dtype=np.float64),
        "scales": np.exp(values["scales"]) * gradients.scales,
        "rotations": (turning - unit * np.sum(unit * turning, axis=1, keepdims=True)) / lengths,
        "opacities": opacities * (1 - opacities) * gradients.opacities,
        "colours": np.asarray(gradients.colours, dtype=np.float64),
    }


def _sigmoid(logits: Array) -> Array:
    return np.asarray(0.5 * (1 + np.tanh(0.5 * logits)))


BETA_1, BETA_2 = 0.9, 0.999
EPSILON = 1e-15
"""Added to the denominator. As small as in 3D Gaussian Splatting: a splat's contribution to an image's mean loss, and
so its gradient, is far below the usual 1e-8."""


@dataclass(frozen=True)
class AdamState:
    """State of Adam. values, means, squares: by group, the parameters and the running means of their gradients and
    squared gradients; a group without means has not moved yet. steps: taken so far."""

    values: ParameterGroups
    means: ParameterGroups = field(default_factory=dict)
    squares: ParameterGroups = field(default_factory=dict)
    steps: int = 0

    def stepped(self, gradients: ParameterGroups, rates: Mapping[str, float]) -> AdamState:
        """Return the state after one step down ``gradients``. Groups without an entry in ``rates`` are frozen."""
        values, means, squares = dict(self.values), dict(self.means), dict(self.squares)
        steps = self.steps + 1
        for name, rate in rates.items():
            gradient = gradients[name]
            means[name] = BETA_1 * means.get(name, 0.0) + (1 - BETA_1) * gradient
            squares[name] = BETA_2 * squares.get(name, 0.0) + (1 - BETA_2) * gradient * gradient
            mean = means[name] / (1 - BETA_1**steps)
            size = np.sqrt(squares[name] / (1 - BETA_2**steps)) + EPSILON
            values[name] = values[name] - rate * mean / size
        return AdamState(values, means, squares, steps)


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of ``fit_splats``. Raises InputError on a value out of range.

    A rate is the change that Adam makes in a step while all gradients agree. Those of centres, scales and rotations are
    about four times those of 3D Gaussian Splatting, which takes 30 000 steps for a photographed room; one object takes
    a few hundred.
    """

    steps: int = 600
    """Optimisation steps, each on one view; at least 1. The paper takes 3000 for the background object and 30 000 for
    the foreground one."""

    centre_rate: float = 2e-3
    """Rate of centres, in radii of the object (half the diagonal of the initial centres' bounding box); 0 to 1. Decays
    exponentially to a hundredth at the last step."""

    scale_rate: float = 2e-2
    """Rate of log scales; 0 to 1."""

    rotation_rate: float = 5e-3
    """Rate of quaternions; 0 to 1."""

    opacity_rate: float = 2.5e-2
    """Rate of logits of opacities; 0 to 1."""

    colour_rate: float = 2.5e-3
    """Rate of colours; 0 to 1."""

    ssim_share: float = SSIM_SHARE
    """λ₁, weight of SSIM against L1; 0 to 1."""

    alpha_weight: float = ALPHA_WEIGHT
    """λ₂, penalty for covering a pixel outside the object; at least 0."""

    frozen: frozenset[str] = frozenset()
    """Fields of ``Splats`` that are not optimised: "centres" keeps a foreground on its surface (equation 16)."""

    label: int | None = None
    """Object of the views' labels that is fitted; None fits all that the views' masks cover."""

    seed: int = 0
    """Seed of the order of views and of the random background colours."""

    def __post_init__(self) -> None:
        _require(isinstance(self.steps, int) and self.steps >= 1, "steps", self.steps, "give a whole number from 1")
        for name in ("centre_rate", "scale_rate", "rotation_rate", "opacity_rate", "colour_rate", "ssim_share"):
            value = getattr(self, name)
            _require(math.isfinite(value) and 0 <= value <= 1, name, value, "give a number from 0 to 1")
        _require(
            math.isfinite(self.alpha_weight) and self.alpha_weight >= 0,
            "alpha_weight",
            self.alpha_weight,
            "give at least 0; the paper uses 1",
        )
        strange = sorted(self.frozen - set(GROUPS))
        _require(not strange, "frozen", strange, f"choose among {', '.join(GROUPS)}")
        _require(len(self.frozen) < len(GROUPS), "frozen", sorted(self.frozen), "leave at least one free")


def _require(condition: bool, field: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(f"fit option {field} is {value!r}: {remedy}")


REPORT_EVERY = 25
"""Steps between two reports of progress."""
FINAL_RATE = 0.01
"""Factor on the centres' rate at the last step, as in 3D Gaussian Splatting."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatFit:
    """Result of ``fit_splats``."""

    splats: Splats

    losses: NDArray[np.float64]
    """(steps,) loss (equations 1 + 2) of each step's view, before the step."""

    psnr: Mapping[int, float]
    """dB of each view by its index, over the pixels that count, over white."""


def fit_splats(
    views: Sequence[View],
    start: Splats,
    options: FitOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    fixed: Splats | None = None,
    solver: SolverOptions | None = None,
) -> SplatFit:
    """Return ``start`` optimised to look like ``views``: Adam, each step on one view, in shuffled order.

    At each step the view and the splats get the same random background colour: transparency where the object is opaque
    then has a cost, which the alpha term of the loss does not give.

    fixed: the splats of the other objects, not optimised. With them, and a label, each step also renders everything and
    compares the pixels that show another object: the fitted splats may be behind it, but not in front of it. solver:
    where Taichi computes. Raises InputError on unusable views or splats, Cancelled, and SimulationError when the
    optimisation diverges.
    """
    options = options or FitOptions()
    targets = _view_targets(views, options)
    if not len(start):
        raise InputError("fit: the start has no splats: give at least one")
    rasteriser = Rasteriser(solver=solver)
    progress = StageProgress(on_event, "fit", options.steps)
    random = np.random.default_rng(options.seed)
    order = _shuffled_views(len(targets), random)
    descent = AdamState(to_parameters(start))
    radius = _radius(start)
    losses = np.zeros(options.steps)
    for step in range(options.steps):
        if cancelled():
            raise Cancelled(f"cancelled at step {step} of {options.steps} of the fit")
        colour = _random_colour(random)
        rates = _rates(options, radius, step / options.steps)
        try:
            target = targets[next(order)]
            if fixed is not None and target.others is not None:
                descent = _clearance_step(descent, target.others, fixed, colour, rates, rasteriser, options)
            losses[step], descent = _fit_step(descent, target, colour, rates, rasteriser, options)
        except FloatingPointError as error:
            raise SimulationError(
                f"fit: {error} at step {step}: lower centre_rate, scale_rate and colour_rate, or check the scales and "
                "colours of the initial splats"
            ) from None
        if step % REPORT_EVERY == 0 or step == options.steps - 1:
            progress.report(step + 1, f"loss {losses[step]:.4f}")
    splats = from_parameters(descent.values)
    reached = {index: _psnr(splats, target, rasteriser) for index, target in enumerate(targets)}
    return SplatFit(splats=splats, losses=losses, psnr=reached)


def _view_targets(views: Sequence[View], options: FitOptions) -> list[Target]:
    if not views:
        raise InputError("fit: there are no views: give at least one image with its camera")
    targets = [view_target(view, label=options.label) for view in views]
    if not any((target.alpha > 0).any() for target in targets):
        raise InputError("fit: no view shows the object: check the masks and the label")
    return targets


def _shuffled_views(count: int, random: np.random.Generator) -> Iterator[int]:
    """Yield indices of views without end: all of them in random order, then in another."""
    while True:
        yield from (int(place) for place in random.permutation(count))


def _random_colour(random: np.random.Generator) -> RGB:
    red, green, blue = random.uniform(size=3)
    return float(red), float(green), float(blue)


def _radius(splats: Splats) -> float:
    """Return half the diagonal of the centres' bounding box in metres; for a single splat its scale."""
    return float(np.linalg.norm(np.ptp(splats.centres, axis=0)) / 2) or float(splats.scales.max())


def _rates(options: FitOptions, radius: float, passed: float) -> dict[str, float]:
    """Return the rates of the groups that are not frozen, after the fraction ``passed`` of all steps."""
    rates = {
        "centres": options.centre_rate * radius * FINAL_RATE**passed,
        "scales": options.scale_rate,
        "rotations": options.rotation_rate,
        "opacities": options.opacity_rate,
        "colours": options.colour_rate,
    }
    return {name: rate for name, rate in rates.items() if name not in options.frozen}


def _fit_step(
    descent: AdamState,
    target: Target,
    colour: RGB,
    rates: Mapping[str, float],
    rasteriser: Rasteriser,
    options: FitOptions,
) -> tuple[float, AdamState]:
    """Return the loss before a step on one view, and the state after it. Raises FloatingPointError on divergence."""
    seen = rasteriser.render(from_parameters(descent.values), target.camera, background=colour)
    loss, d_colour, d_alpha = fit_loss(
        seen.colour,
        seen.alpha,
        target.over(colour),
        target.alpha,
        ssim_share=options.ssim_share,
        alpha_weight=options.alpha_weight,
        counted=target.counted,
    )
    if not np.isfinite(loss):
        raise FloatingPointError(f"the loss is {loss}")
    return loss, _adam_step(descent, rasteriser.gradients(d_colour, d_alpha), rates)


def _clearance_step(
    descent: AdamState,
    others: Target,
    fixed: Splats,
    colour: RGB,
    rates: Mapping[str, float],
    rasteriser: Rasteriser,
    options: FitOptions,
) -> AdamState:
    """Return the state after a step on the pixels that show the other objects, whose splats ``fixed`` stay."""
    together = joined([fixed, from_parameters(descent.values)])
    seen = rasteriser.render(together, others.camera, background=colour)
    _, d_colour = image_loss(seen.colour, others.over(colour), ssim_share=options.ssim_share, counted=others.counted)
    gradients = rasteriser.gradients(d_colour)
    own = SplatGradients(**{name: getattr(gradients, name)[len(fixed) :] for name in GROUPS})
    return _adam_step(descent, own, rates)


def _adam_step(descent: AdamState, gradients: SplatGradients, rates: Mapping[str, float]) -> AdamState:
    after = descent.stepped(parameter_gradients(descent.values, gradients), rates)
    for name in rates:
        if not np.isfinite(after.values[name]).all():
            raise FloatingPointError(f"the {name} are no longer finite")
    return after


def _psnr(splats: Splats, target: Target, rasteriser: Rasteriser) -> float:
    seen = rasteriser.render(splats, target.camera, background=WHITE)
    return psnr(seen.colour, target.pixels, target.counted, peak=1.0)
