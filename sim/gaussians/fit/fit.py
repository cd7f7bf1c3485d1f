# SPDX-License-Identifier: MIT
"""Splats fitted to views of an object (PhyCAGE equations 1 to 3; Kerbl et al. 2023, section 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...composite.metrics import psnr
from ...errors import Cancelled, InputError, SimulationError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...mpm.options import SolverOptions
from ..raster.rasteriser import Rasteriser, SplatGradients
from ..splats import Splats, joined
from ..views.view import View
from .adam import Descent
from .losses import fit_loss, image_loss
from .options import FitOptions
from .parameters import GROUPS, free_gradients, free_values, splats_of
from .target import RGB, WHITE, Target, target_of

REPORT_EVERY = 25
"""Steps between two reports of progress."""
LAST_SHARE = 0.01
"""What is left of the centres' rate at the last step, as in 3D Gaussian Splatting."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """What a fit came to."""

    splats: Splats

    losses: NDArray[np.float64]
    """(steps,) equation 1 + 2 of each step's view, before the step."""

    psnr: Mapping[int, float]
    """dB of each view by its place in the list, over the pixels that count, before white."""


def fit_splats(
    views: Sequence[View],
    start: Splats,
    options: FitOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    company: Splats | None = None,
    solver: SolverOptions | None = None,
) -> Fitted:
    """Move ``start`` until it looks like ``views``: Adam, each step on one view, all views in turn in random order.

    Behind each view stands another colour at each step, also behind the splats: what is let through where the object
    is solid then costs, though the alpha term of the loss is silent there.

    company: the other objects' splats, which stay as they are. With them, and a label, each step first renders all
    together and looks at the pixels that show another object: what is fitted may be behind it, but not before it.
    solver: where Taichi computes. Raises InputError on views or splats that cannot be used, Cancelled, and
    SimulationError when numbers grow beyond bounds.
    """
    options = options or FitOptions()
    targets = _targets(views, options)
    if not len(start):
        raise InputError("fit: the start has no splats: give at least one")
    rasteriser = Rasteriser(solver=solver)
    progress = StageProgress(on_event, "fit", options.steps)
    random = np.random.default_rng(options.seed)
    order = _in_turn(len(targets), random)
    descent = Descent(free_values(start))
    radius = _radius(start)
    losses = np.zeros(options.steps)
    for step in range(options.steps):
        if cancelled():
            raise Cancelled(f"cancelled at step {step} of {options.steps} of the fit")
        colour = _some_colour(random)
        rates = _rates(options, radius, step / options.steps)
        try:
            target = targets[next(order)]
            if company is not None and target.others is not None:
                descent = _made_room(descent, target.others, company, colour, rates, rasteriser, options)
            losses[step], descent = _stepped(descent, target, colour, rates, rasteriser, options)
        except FloatingPointError as error:
            raise SimulationError(
                f"fit: {error} at step {step}: lower centre_rate, scale_rate and colour_rate, or look at the start's "
                "scales and colours"
            ) from None
        if step % REPORT_EVERY == 0 or step == options.steps - 1:
            progress.report(step + 1, f"loss {losses[step]:.4f}")
    splats = splats_of(descent.values)
    reached = {index: _psnr(splats, target, rasteriser) for index, target in enumerate(targets)}
    return Fitted(splats=splats, losses=losses, psnr=reached)


def _targets(views: Sequence[View], options: FitOptions) -> list[Target]:
    if not views:
        raise InputError("fit: there are no views: give at least one picture with its camera")
    targets = [target_of(view, label=options.label) for view in views]
    if not any((target.alpha > 0).any() for target in targets):
        raise InputError("fit: no view shows any of the object: check the masks and the label")
    return targets


def _in_turn(count: int, random: np.random.Generator) -> Iterator[int]:
    """Places of views without end: all of them in random order, then all of them in another."""
    while True:
        yield from (int(place) for place in random.permutation(count))


def _some_colour(random: np.random.Generator) -> RGB:
    red, green, blue = random.uniform(size=3)
    return float(red), float(green), float(blue)


def _radius(splats: Splats) -> float:
    """Half the diagonal of the box around the centres, in metres; that of a single splat is its scale."""
    return float(np.linalg.norm(np.ptp(splats.centres, axis=0)) / 2) or float(splats.scales.max())


def _rates(options: FitOptions, radius: float, passed: float) -> dict[str, float]:
    """Rates of the groups that are free, when the share ``passed`` of all steps is behind."""
    rates = {
        "centres": options.centre_rate * radius * LAST_SHARE**passed,
        "scales": options.scale_rate,
        "rotations": options.rotation_rate,
        "opacities": options.opacity_rate,
        "colours": options.colour_rate,
    }
    return {name: rate for name, rate in rates.items() if name not in options.frozen}


def _stepped(
    descent: Descent,
    target: Target,
    colour: RGB,
    rates: Mapping[str, float],
    rasteriser: Rasteriser,
    options: FitOptions,
) -> tuple[float, Descent]:
    """The loss before a step on one view, and the descent after it; FloatingPointError when one is no number."""
    seen = rasteriser.render(splats_of(descent.values), target.camera, background=colour)
    loss, d_colour, d_alpha = fit_loss(
        seen.colour,
        seen.alpha,
        target.before(colour),
        target.alpha,
        ssim_share=options.ssim_share,
        alpha_weight=options.alpha_weight,
        counted=target.counted,
    )
    if not np.isfinite(loss):
        raise FloatingPointError(f"the loss is {loss}")
    return loss, _descended(descent, rasteriser.gradients(d_colour, d_alpha), rates)


def _made_room(
    descent: Descent,
    others: Target,
    company: Splats,
    colour: RGB,
    rates: Mapping[str, float],
    rasteriser: Rasteriser,
    options: FitOptions,
) -> Descent:
    """The descent after a step on how the view shows the others, among which ``company`` is what it is."""
    together = joined([company, splats_of(descent.values)])
    seen = rasteriser.render(together, others.camera, background=colour)
    _, d_colour = image_loss(seen.colour, others.before(colour), ssim_share=options.ssim_share, counted=others.counted)
    gradients = rasteriser.gradients(d_colour)
    own = SplatGradients(**{name: getattr(gradients, name)[len(company) :] for name in GROUPS})
    return _descended(descent, own, rates)


def _descended(descent: Descent, gradients: SplatGradients, rates: Mapping[str, float]) -> Descent:
    after = descent.stepped(free_gradients(descent.values, gradients), rates)
    for name in rates:
        if not np.isfinite(after.values[name]).all():
            raise FloatingPointError(f"the {name} are no longer finite")
    return after


def _psnr(splats: Splats, target: Target, rasteriser: Rasteriser) -> float:
    seen = rasteriser.render(splats, target.camera, background=WHITE)
    return psnr(seen.colour, target.pixels, target.counted, peak=1.0)
