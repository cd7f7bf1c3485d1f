# SPDX-License-Identifier: MIT
"""Composition: several objects brought to fit each other, one after another (PhyCAGE section 4.3, Algorithm 1).

Gradients of the loss are in 1/m, 1 per log scale, 1/rad: what makes a step of them depends on the image's size, the
number of splats and what they show. So each kind gets one factor, chosen at the first step such that its fastest
hundredth makes a step of known size; directions and all ratios stay the gradient's own. With the simulation the factor
follows how well successive steps agree."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import Cancelled, InputError, SimulationError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...mpm.colliders import Collider
from ...mpm.geometry.signed_distance import DistanceLattice
from ...mpm.solver_options import SolverOptions
from ...scene.model import Camera, Ground
from ..guidance.score_distillation import CheckedGuidance, Guidance
from ..raster.rasteriser import Rasteriser, SplatGradients
from ..splats import MAX_SCALE, MIN_SCALE, Splats, from_half_axes, half_axes
from ..views.posed_images import orbit_cameras
from .compose_options import ComposeOptions
from .composition_loss import CompositionLoss, LossGradients
from .composition_parts import (
    Composition,
    CompositionPart,
    DeformablePart,
    Reference,
    StepRecord,
    fraction_inside,
    part_distances,
    seated_parts,
)
from .physical_body import StepOptions

Array = NDArray[np.float64]

FAST_QUANTILE = 0.99
"""Quantile of gradient length, among splats with any gradient, that sets the factor."""

MAX_STEP = 4.0
"""Bound of a step, over the first step's length: single splats may have enormous gradients."""


AGREEMENT_GAIN = 0.25
"""Log of the growth of a step's length after one that pointed the same way, and of its shrinkage after the opposite.
Chosen, with 0 as the cosine that keeps the length, on three assets of the benchmark (ring, hat, sock); 0.5 does as
well."""


class StepScale:
    """Scales gradients to steps: about ``first`` long initially, decaying to the fraction ``last`` over ``steps``.

    With ``adapts`` the length also follows how well successive steps agree (delta-bar-delta, Jacobs 1988, with one
    length for all points): it is multiplied by exp(AGREEMENT_GAIN cos θ), θ between the previous step and this one, to
    at most ``MAX_STEP`` times the first. What has far to go moves faster, what swings to and fro settles.
    """

    def __init__(self, *, first: float, last: float, steps: int, adapts: bool = False) -> None:
        """first: length of the first step in the parameter's unit; 0 freezes it."""
        self._first, self._last, self._steps, self._adapts = first, last, steps, adapts
        self._factor: float | None = None
        self._growth = 1.0
        self._previous: Array | None = None

    def steps_down(self, gradients: Array, step: int) -> Array:
        """Return the step (N, D) down ``gradients`` (N, D) at ``step`` (from 0): -factor · gradient, clipped."""
        length = np.linalg.norm(gradients, axis=1)
        if self._factor is None:
            moved = length[length > 0]
            if len(moved) == 0 or self._first == 0:
                return np.zeros_like(gradients)
            self._factor = self._first / float(np.quantile(moved, FAST_QUANTILE))
        decay = self._last ** (step / max(self._steps - 1, 1))
        most = MAX_STEP * self._first * decay / np.maximum(length, 1e-300)
        found = -gradients * np.minimum(self._growth * self._factor * decay, most)[:, None]
        if not self._adapts:
            return np.asarray(found)
        if self._previous is not None:
            growth = self._growth * math.exp(AGREEMENT_GAIN * _cosine(self._previous, found))
            self._growth = min(growth, MAX_STEP)
        self._previous = found
        return np.asarray(-gradients * np.minimum(self._growth * self._factor * decay, most)[:, None])


def _cosine(a: Array, b: Array) -> float:
    """Return the cosine between two arrays of one shape as vectors; 0 where one is zero."""
    lengths = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / lengths if lengths > 0 else 0.0


DIRECT_STEP = 0.5
"""Fraction of ``first_move`` for steps without simulation: single points overshoot where the material would average.
With it (half a cell) the ablations did best of 0.5, 1 and 2 cells on two assets of the benchmark."""

LossFunction = Callable[[Splats, int], LossGradients]
"""Splats, step (from 0) → loss and gradients."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PartStep:
    """The part after a step, and the gradients before it, None in a step without images."""

    number: int
    splats: Splats
    loss: LossGradients | None


class PartOptimiser:
    """Optimises one deformable part: Algorithm 1 of PhyCAGE, and its ablations under the same budget of steps.

    Δμ comes from the simulator or directly from the gradient, scales and rotations from descent. ∇μ L points uphill, so
    the initial velocity is -P ∇μ L with P > 0 (Algorithm 1, line 4 leaves the sign open).
    """

    def __init__(self, *, splats: Splats, body: DeformablePart, options: ComposeOptions) -> None:
        """body: its points are ``splats.centres``."""
        self.splats = splats
        self._body = body
        # Cached from the last physical step, because they are expensive; None after points were placed.
        self._gradients: Array | None = None
        self._options = options
        last, steps = options.last_rate, options.steps
        # A simulation averages the points of a cell, so successive steps agree until one is too long. Single points
        # mostly disagree, so that straight descent only loses by it.
        simulated = options.method == "pse-sds"
        share = 1.0 if simulated else DIRECT_STEP
        self._move = StepScale(first=share * options.first_move * body.cell, last=last, steps=steps, adapts=simulated)
        self._stretch = StepScale(first=options.first_stretch, last=last, steps=steps, adapts=simulated)
        self._turn = StepScale(first=options.first_turn, last=last, steps=steps, adapts=simulated)

    def steps(self, evaluate: LossFunction) -> Iterator[PartStep]:
        """Yield the steps of the options' method; ``evaluate`` is called once in each step that uses images.

        Raises SimulationError when gradients or positions are no longer finite; ``splats`` are then those of the last
        valid step.
        """
        for number in range(self._options.steps):
            loss = evaluate(self.splats, number) if self._step_uses_images(number) else None
            if loss is not None:
                _check_finite(loss.gradients, number)
            splats = self._moved(loss, number)
            if loss is not None:
                splats = self._reshaped(splats, loss.gradients, number)
            self.splats = splats
            yield PartStep(number=number, splats=splats, loss=loss)

    def _step_uses_images(self, number: int) -> bool:
        """Return whether a step uses images: PPPS + SDS alternates, the simulator first."""
        return self._options.uses_images and not (self._options.method == "ppps+sds" and number % 2 == 0)

    def _straight(self, number: int) -> bool:
        """Return whether a step follows the gradient directly, without the simulator."""
        return self._options.method == "sds" or (self._options.method == "ppps+sds" and self._step_uses_images(number))

    def _moved(self, loss: LossGradients | None, number: int) -> Splats:
        still = np.zeros((len(self.splats), 3))
        down = still if loss is None else self._move.steps_down(loss.gradients.centres, number)
        if self._straight(number):
            self._body.place(self.splats.centres + down)
            self._gradients = None
            return self.splats.changed(centres=self.splats.centres + down)
        before = self._body.gradients if self._gradients is None else self._gradients
        self._body.step(down)
        self._gradients = self._body.gradients
        part = _valid_gradients(self._gradients @ np.linalg.inv(before))
        return from_half_axes(self.splats, self._body.points, part @ half_axes(self.splats))

    def _reshaped(self, splats: Splats, gradients: SplatGradients, number: int) -> Splats:
        """Return ``splats`` after a step of θ: log scales, and rotations on the sphere of unit quaternions."""
        stretch = self._stretch.steps_down(gradients.scales * splats.scales, number)
        along = gradients.rotations
        along = along - (along * splats.rotations).sum(axis=1, keepdims=True) * splats.rotations
        turn = 0.5 * self._turn.steps_down(0.5 * along, number)
        return splats.changed(
            scales=np.clip(splats.scales * np.exp(stretch), MIN_SCALE, MAX_SCALE),
            rotations=splats.rotations + turn,
        )


def _valid_gradients(gradients: Array) -> Array:
    """Return deformation gradients (N, 3, 3), the identity replacing non-finite and inverted ones."""
    finite = np.isfinite(gradients).all(axis=(1, 2))
    safe = np.where(finite[:, None, None], gradients, np.eye(3))
    good = finite & (np.linalg.det(safe) > 0)
    return np.where(good[:, None, None], safe, np.eye(3))


def _check_finite(gradients: SplatGradients, number: int) -> None:
    for name in ("centres", "scales", "rotations"):
        if not np.isfinite(getattr(gradients, name)).all():
            raise SimulationError(
                f"composition: the gradient of {name} is not finite in step {number + 1}: lower first_move, or omit "
                "the guidance"
            )


NO_GUIDANCE: Mapping[str, Guidance] = MappingProxyType({})


def compose(
    parts: Sequence[CompositionPart],
    *,
    reference: Reference | None,
    guidance: Mapping[str, Guidance] = NO_GUIDANCE,
    cameras: Sequence[Camera] = (),
    options: ComposeOptions | None = None,
    ground: Ground | None = None,
    solver: SolverOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Composition:
    """Return ``parts`` deformed until they fit each other and ``reference``; the arguments are not modified.

    parts: the fixed one first, then the deformable ones; each is fixed once it fits all before it (what the authors
        propose for more than two objects, §6).
    guidance: score distillation of deformable parts, by their names; each is rendered alone, from one of ``cameras`` a
        step; by default 16 around it, as in SyncDreamer.
    ground: on which deformable parts are seated that come near it; it is no obstacle before.
    solver: where to compute; its grid is ignored.

    Raises InputError for fewer than two parts, for a method that uses images without reference and guidance, and for
    open surfaces; SimulationError when the run fails; Cancelled.
    """
    options, solver = options or ComposeOptions(), solver or SolverOptions()
    _check_given(parts, reference, guidance, options)
    if reference is not None:
        reference = scaled_reference(reference, options.size)
    rasteriser = Rasteriser(solver=solver)
    watched = {name: CheckedGuidance(given) for name, given in guidance.items()}
    fixed: list[CompositionPart] = [parts[0]]
    lattices: list[DistanceLattice] = []
    history: list[StepRecord] = []
    progress = StageProgress(on_event, "composing", options.steps * (len(parts) - 1))
    for index, part in enumerate(parts[1:]):
        later = parts[index + 2 :]
        objective = CompositionLoss(
            rasteriser=rasteriser,
            fixed=[other.splats for other in (*fixed, *later)],
            subject=part.name,
            reference=reference,
            guidance=watched.get(part.name),
            cameras=cameras or orbit_cameras(part.splats.centres, options.size),
            options=options,
        )
        lattices.append(part_distances(fixed[-1]))
        body = _deformable(part, fixed, options, solver)
        optimiser = PartOptimiser(splats=part.splats, body=body, options=options)
        for step in optimiser.steps(objective.evaluate):
            if cancelled():
                raise Cancelled("composition cancelled")
            found = step.loss
            history.append(
                StepRecord(
                    part=part.name,
                    step=step.number,
                    loss=math.nan if found is None else found.loss,
                    psnr=math.nan if found is None else found.psnr,
                    inside=fraction_inside(step.splats, lattices),
                )
            )
            progress.report(index * options.steps + step.number + 1)
        surface = body.resolved_surface() if options.simulates else body.surface()
        fixed.append(dataclasses.replace(part, splats=optimiser.splats, surface=surface))
    notes = tuple(note for one in watched.values() for note in one.notes)
    seats = options.simulates and options.seat > 0
    placed = seated_parts(fixed, options.seat, ground) if seats else tuple(fixed)
    return Composition(parts=placed, history=tuple(history), notes=notes)


def _check_given(
    parts: Sequence[CompositionPart],
    reference: Reference | None,
    guidance: Mapping[str, Guidance],
    options: ComposeOptions,
) -> None:
    """Raise InputError where ``compose`` says so, apart from surfaces."""
    if len(parts) < 2:
        raise InputError(f"composition: {len(parts)} object given: choose at least two")
    if options.uses_images and reference is None and not guidance:
        raise InputError(
            f"compose option method is {options.method!r} without a picture: give a reference, or use 'ppps'"
        )
    strange = sorted(set(guidance) - {part.name for part in parts[1:]})
    if strange:
        raise InputError(f"guidance is given for {strange[0]!r}: no deformable object has that name")


def _deformable(
    part: CompositionPart, fixed: Sequence[CompositionPart], options: ComposeOptions, solver: SolverOptions
) -> DeformablePart:
    """Return ``part`` as a body that deforms among those ``fixed``."""
    boundaries = [Collider(name=f"{other.name} (fixed)", surface=other.surface) for other in fixed]
    steps = StepOptions(
        substeps=options.substeps, cells_across=options.cells, keep_strain=options.keep_strain, solver=solver
    )
    return DeformablePart(part, boundaries, steps, seed=options.seed)


def scaled_reference(reference: Reference, size: int) -> Reference:
    """Return ``reference`` scaled down to ``size`` pixels on its longer side; smaller ones are unchanged."""
    camera = reference.camera
    share = size / max(camera.width, camera.height)
    if share >= 1:
        return reference
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    x, y = width / camera.width, height / camera.height
    small = dataclasses.replace(
        camera, width=width, height=height, fx=camera.fx * x, cx=camera.cx * x, fy=camera.fy * y, cy=camera.cy * y
    )

    def resized(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float64)

    return Reference(camera=small, pixels=resized(reference.pixels), backdrop=resized(reference.backdrop))
