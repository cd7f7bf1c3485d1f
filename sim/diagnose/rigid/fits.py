# SPDX-License-Identifier: MIT
"""All candidates fitted to a capture of rigid bodies: proposals for the verdict, with predictions and places."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...effects.registry import effect
from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..analysis import CandidateFit, Discrepancy, Estimate
from ..capture import Capture, Trial
from .candidates import BELIEFS, FREEDOMS, Freedom, Scene
from .heldout import Heldout, heldout, noise_floor
from .misfit import misfit
from .prediction import Points, believed_fit, numerics, predict_points, simulate_points
from .search import (
    BodyFits,
    begin,
    body_problem,
    finish_best,
    fit_nominal,
    follow_best,
    moved_camera,
    pairs,
    reconsider_nominal,
    refine,
    refit_beliefs,
)
from .shooting import Fit
from .spread import expected_points, expected_rms
from .where import discrepancies

Array = NDArray[np.float64]

UNEXPLAINED = 1.5
"""Misfit of the best candidate above which none is an explanation."""

WORSE = 1.2
"""Times the believed model's error on the complete takes up to which the mean over plausible contacts is preferred."""

PAIR_GAIN, PAIR_CLEARS = 15.0, 0.85
"""Nats by which two effects must beat the best one, and share of its misfit below which they must get."""


@dataclass(kw_only=True, eq=False)
class RigidFits:
    """Implements ``Fits`` for captures of rigid bodies that do not touch each other.

    expects: nothing explains the capture, and ``refitted`` predicts the mean over its numbers' plausible ranges.
    """

    capture: Capture
    bodies: list[BodyFits]
    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    numerics_rms_m: float
    expects: bool = False

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """Points (P, K, 3) in m at the ``predict_times`` of every predict trial, by its name."""
        trials = list(self.capture.predict_trials)
        if fit is self.refitted and self.expects:
            return self._joined(expected_points, self.nominal, trials)
        return self._joined(predict_points, fit, trials)

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """Points (T, K, 3) in m at the frames of every trial, by its name, started from its first frames."""
        return self._joined(simulate_points, fit, list(self.capture.trials))

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """By trial; see ``Fits``."""
        key = None if fit is None else fit.effects
        return discrepancies(self.capture, [(b.fits[()], None if key is None else b.fits[key]) for b in self.bodies])

    def _joined(self, how: Callable[[Fit], Points], fit: CandidateFit, trials: list[Trial]) -> dict[str, Array]:
        joined: dict[str, Array] = {}
        for body in self.bodies:
            found = believed_fit(body.fits[()]) if fit is self.nominal else body.fits[fit.effects]
            for name, (columns, points) in how(found).items():
                trial = next(t for t in trials if t.name == name)
                if name not in joined:
                    joined[name] = np.zeros((len(points), trial.rest_points.shape[0], 3))
                joined[name][:, columns] = points
        return joined


def fit_rigid(
    capture: Capture,
    names: Sequence[str] | None = None,
    *,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    budget_s: float = 120.0,
) -> RigidFits:
    """Every effect of ``names`` (None: all that mean something for a rigid body) fitted to ``capture``.

    budget_s: seconds after which no further candidate is begun. Raises InputError where no body is rigid or a name is
    unknown, Cancelled when ``cancelled()`` became true.
    """
    started = time.monotonic()
    wanted = _wanted(capture, names)
    bodies = []
    for index, item in enumerate(capture.objects):
        if item.belief.rigid and any((t.object_index == index).any() for t in capture.trials):
            bodies.append(BodyFits(problem=body_problem(capture, index)))
    if not bodies:
        raise InputError("capture: none of its objects is rigid and tracked: fit it as deformable bodies")
    progress = StageProgress(on_event, "fit", len(bodies) * (len(wanted) + 2))
    done = 0

    def tick(what: str) -> None:
        nonlocal done
        done += 1
        progress.report(done, what)
        if cancelled():
            raise Cancelled("cancelled while fitting; nothing was written")

    for body in bodies:
        fit_nominal(body)
        tick("nominal")
        for freedom in wanted:
            if time.monotonic() - started < budget_s:
                begin(body, (freedom,))
                if freedom.name == "camera_pose":
                    moved_camera(body)
            tick(freedom.name)
        finish_best(body, started + budget_s)
        refit_beliefs(body)
        tick("refitted")
        follow_best(body, started + budget_s)
        refine(body, started + budget_s)
        reconsider_nominal(body, started + budget_s)
        pairs(body, wanted, started + budget_s)
    return _assemble(capture, bodies)


def _wanted(capture: Capture, names: Sequence[str] | None) -> list[Freedom]:
    chosen = []
    for name in FREEDOMS if names is None else names:
        effect(name)
        if name not in FREEDOMS or (name == "camera_pose" and capture.camera is None):
            continue
        if name == "restitution" and capture.ground.restitution is None:
            continue
        chosen.append(FREEDOMS[name])
    return chosen


def _assemble(capture: Capture, bodies: list[BodyFits]) -> RigidFits:
    refits = ("friction", "restitution")
    keys = _worth(bodies, [k for k in bodies[0].fits if all(k in b.fits for b in bodies)])
    shown = {*keys, refits}
    made = {}
    held = {k: [heldout(b.fits[k]) for b in bodies] for k in shown}
    for k in shown:
        made[k] = _candidate(capture, bodies, k, held[k])
    _level_twins(made)
    believed = [heldout(believed_fit(b.fits[()])) for b in bodies]
    top = max(made, key=lambda k: made[k].log_evidence)
    floors = [noise_floor(b.fits[top]) for b in bodies]
    floor = min([float(np.sqrt(np.mean(np.square(floors)))), *(c.heldout_rms_m for c in made.values())])
    expects, gap = False, min(c.misfit for c in made.values())
    if gap > UNEXPLAINED and not any(b.problem.scene.body.round for b in bodies):
        expected = float(np.sqrt(np.mean([expected_rms(believed_fit(b.fits[()])) ** 2 for b in bodies])))
        # A handful of takes that tumble hardly tells which refitted numbers predict better: the believed ones are the
        # measure, and what was refitted to a motion that is not understood is not taken along.
        expects = expected < WORSE * float(np.sqrt(np.mean([b.rms_m**2 for b in believed])))
        if expects:
            made[refits] = dataclasses.replace(made[refits], heldout_rms_m=expected)
    singles = sorted((made[k] for k in keys if k), key=lambda c: -c.log_evidence)
    return RigidFits(
        capture=capture,
        bodies=bodies,
        expects=expects,
        nominal=made[()],
        refitted=made[refits],
        candidates=tuple(singles),
        floor_rms_m=floor,
        numerics_rms_m=float(np.sqrt(np.mean([numerics(believed_fit(b.fits[()])) ** 2 for b in bodies]))),
    )


def _worth(bodies: list[BodyFits], keys: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """``keys`` without the pairs whose second effect explains next to nothing."""

    def evidence(key: tuple[str, ...]) -> float:
        return sum(b.fits[key].evidence for b in bodies)

    def left(key: tuple[str, ...]) -> float:
        found = [misfit(b.fits[key]) for b in bodies]
        squares = sum(m.flight + m.contact for m in found)
        return math.sqrt(squares / max(1, sum(m.flight_count + m.contact_count for m in found)))

    singles = [k for k in keys if len(k) == 1]
    if not singles:
        return keys
    best = max(singles, key=evidence)
    enough, most = evidence(best) + PAIR_GAIN, PAIR_CLEARS * min(left(best), left(()))
    return [k for k in keys if len(k) < 2 or (evidence(k) > enough and left(k) < most)]


def _level_twins(made: dict[tuple[str, ...], CandidateFit]) -> None:
    """A slow clock and a lighter body are one and the same motion: what their evidence differs by is the search's."""
    clock, weight = made.get(("time_scale",)), made.get(("buoyancy",))
    if clock is None or weight is None:
        return
    rate = clock.parameters["time_scale"]["rate"].value
    fraction = weight.parameters["buoyancy"]["fraction"].value
    if abs(rate**2 - (1 - fraction)) < 0.1 * abs(fraction) + 1e-4:
        best = max(clock.log_evidence, weight.log_evidence)
        made["time_scale",] = dataclasses.replace(clock, log_evidence=best)
        made["buoyancy",] = dataclasses.replace(weight, log_evidence=best)


def _candidate(capture: Capture, bodies: list[BodyFits], key: tuple[str, ...], held: list[Heldout]) -> CandidateFit:
    first = max(bodies, key=lambda b: float(np.trace(b.fits[key].schur.sum(axis=0))))
    fit = first.fits[key]
    scene = fit.problem.scene
    cover = np.linalg.inv(np.eye(fit.model.size) + fit.schur.sum(axis=0))
    spread = 0.5 * (cover + cover.T)
    rng = np.random.default_rng(0)
    values, vectors = np.linalg.eigh(spread)
    draws = fit.z + (vectors * np.sqrt(np.clip(values, 0.0, 4.0)) @ rng.normal(size=(fit.model.size, 64))).T
    parameters = {name: _estimates(scene, fit, name, draws) for name in key}
    beliefs = {}
    for n, unit in (("friction", "1"), ("restitution", "1")):
        if n not in key:
            some = [float(getattr(fit.model.setting(scene, d), n)) for d in draws]
            low, high = np.percentile(some, (2.5, 97.5))
            beliefs[n] = Estimate(
                value=float(getattr(fit.model.setting(scene, fit.z), n)), unit=unit, low=float(low), high=float(high)
            )
    evidence = sum(b.fits[key].evidence for b in bodies)
    for name in key:
        freedom = FREEDOMS[name]
        if freedom.positive and _amount(fit, name) < 0:
            # Less than none of it: what is left of it is the nominal model with a number too many.
            evidence = min(evidence, sum(b.fits[()].evidence for b in bodies) - 3.0)
    ratios = [misfit(b.fits[key]) for b in bodies]
    square = sum(m.flight + m.contact for m in ratios) / max(1, sum(m.flight_count + m.contact_count for m in ratios))
    return CandidateFit(
        effects=key,
        parameters=parameters,
        beliefs=beliefs,
        log_evidence=float(evidence),
        heldout_log_score=np.sum([h.log_score for h in held], axis=0),
        heldout_rms_m=float(np.sqrt(np.mean([h.rms_m**2 for h in held]))),
        misfit=math.sqrt(square),
    )


def _amount(fit: Fit, name: str) -> float:
    at = BELIEFS.size
    for freedom in fit.model.freedoms:
        if freedom.name == name:
            return float(fit.z[at])
        at += freedom.size
    return 0.0


def _estimates(scene: Scene, fit: Fit, name: str, draws: Array) -> dict[str, Estimate]:
    schema = {p.name: p for p in effect(name).parameters}

    def values(z: Array) -> dict[str, float]:
        at, setting = BELIEFS.size, None
        for freedom in fit.model.freedoms:
            if freedom.name == name:
                setting = freedom.values(scene, fit.model.setting(scene, z), z[at : at + freedom.size])
            at += freedom.size
        assert setting is not None
        return {k: float(np.clip(v, schema[k].low, schema[k].high)) for k, v in setting.items()}

    best, many = values(fit.z), [values(d) for d in draws]
    found = {}
    for k, v in best.items():
        low, high = np.percentile([m[k] for m in many], (2.5, 97.5))
        found[k] = Estimate(value=v, unit=schema[k].unit, low=float(min(low, v)), high=float(max(high, v)))
    return found
