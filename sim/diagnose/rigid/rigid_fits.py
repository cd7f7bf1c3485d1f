# SPDX-License-Identifier: MIT
"""``Fits`` of a capture of rigid bodies: all candidates, with predictions and localisation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...effects.registry import effect
from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..capture import Capture, Trial
from ..comparison_settings import SHARED
from ..fits import CandidateFit, Discrepancy, Estimate
from ..work import Work
from .bending import bending
from .held_out_score import HeldOutScore, noise_floor, score_held_out
from .multiple_shooting import Fit
from .pair_search import BASE_GAIN, search_pairs
from .rigid_candidates import BELIEFS, CANDIDATE_EFFECTS, FRICTION_SPREAD, RESTITUTION_SPREAD, CandidateEffect
from .rigid_localisation import localise_discrepancies
from .rigid_misfit import misfit
from .rigid_prediction import (
    Points,
    believed_fit,
    contact_spread,
    hidden_spins,
    marginal_points,
    marginal_rms,
    pooled_rms,
    predict_points,
    prediction_spread,
    simulate_points,
    step_size_error,
)
from .rigid_refits import refine_promising, refit_beliefs, refit_best, settle_on_a_face, sharpen
from .rigid_search import (
    BodyFits,
    begin_search,
    body_problem,
    finish_best,
    fit_camera_pose,
    fit_nominal,
    reconsider_nominal,
)
from .shared_spins import share_spins
from .world_settings import BodyScene

Array = NDArray[np.float64]

REFITS = ("friction", "restitution")
"""Contact parameters that are re-fitted as a candidate of their own."""
UNEXPLAINED = 1.5
"""Misfit of the best candidate above which the capture counts as unexplained."""

SHARPENINGS = 3
"""Repetitions in which the noise of single points follows the closest fit."""

LIFT_SPREAD = 0.7
"""Standard deviation of the logarithm of a lift where no point shows the spin: a path tells their product alone, and
the surface of thrown and struck balls moves at some 0.1 to 1.5 of their speed."""

WORSE = 1.2
"""Factor on the nominal error of complete trials up to which the mean over plausible contacts is preferred."""


@dataclass(kw_only=True, eq=False)
class RigidFits:
    """``Fits`` for captures of rigid bodies that do not touch each other.

    expects: nothing explains the capture, so ``refitted`` predicts the mean over its parameters' plausible ranges.
    """

    capture: Capture
    bodies: list[BodyFits]
    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    grain_rms_m: float
    expects: bool = False

    def numerics_rms_m(self, fit: CandidateFit) -> float:
        """See ``Fits``."""
        return float(np.sqrt(np.mean([step_size_error(f) ** 2 for f in self._own(fit)])))

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``."""
        trials = list(self.capture.predict_trials)
        if fit is self.refitted and self.expects:
            return self._joined(marginal_points, self.nominal, trials)
        return self._joined(predict_points, fit, trials)

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``."""
        return self._joined(simulate_points, fit, list(self.capture.trials))

    def hidden_spins(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``."""
        return {name: spin for found in self._own(fit) for name, spin in hidden_spins(found).items()}

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """See ``Fits``."""
        key = None if fit is None else fit.effects
        return localise_discrepancies(
            self.capture, [(b.fits[()], None if key is None else b.fits[key]) for b in self.bodies]
        )

    def _own(self, fit: CandidateFit) -> list[Fit]:
        """Return the fit of each body behind ``fit``."""
        if fit is self.nominal:
            return [believed_fit(body.fits[()]) for body in self.bodies]
        return [body.fits[fit.effects] for body in self.bodies]

    def _joined(self, how: Callable[[Fit], Points], fit: CandidateFit, trials: list[Trial]) -> dict[str, Array]:
        joined: dict[str, Array] = {}
        for found in self._own(fit):
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
    work: Work | None = None,
) -> RigidFits:
    """Return the effects ``names`` (None: all that apply to rigid bodies) fitted to ``capture``.

    work: budget, of which every body gets an equal part; None for no limit. Raises InputError where no body is rigid or
    a name is unknown, Cancelled when ``cancelled()`` becomes True.
    """
    work = Work() if work is None else work
    wanted = _wanted(capture, names)
    bodies = []
    for index, item in enumerate(capture.objects):
        if item.belief.rigid and any((t.object_index == index).any() for t in capture.trials):
            bodies.append(BodyFits(problem=body_problem(capture, index, work), work=work))
    if not bodies:
        raise InputError("capture: no object is rigid and tracked; fit it as deformable")
    progress = StageProgress(on_event, "fit", len(bodies) * (len(wanted) + 4) + 1)
    done = 0

    def tick(what: str) -> None:
        nonlocal done
        done += 1
        progress.report(done, what)
        if cancelled():
            raise Cancelled("cancelled while fitting; nothing was written")

    whole = work.limit
    for number, body in enumerate(bodies):
        work.limit = whole * (number + 1) / len(bodies)
        _fit_body(body, wanted, work, tick)
    fits = _assemble(capture, bodies)
    tick("judged")
    return fits


def _fit_body(body: BodyFits, wanted: list[CandidateEffect], work: Work, tick: Callable[[str], None]) -> None:
    """Fit the nominal model, the effects ``wanted`` and pairs of them to ``body``; tick: called after each step."""
    fit_nominal(body)
    tick("nominal")
    for candidate in wanted:
        if work.left():
            begin_search(body, (candidate,))
            if candidate.name == "camera_pose":
                fit_camera_pose(body)
        else:
            work.skip((candidate.name,), "tried")
        tick(candidate.name)
    finish_best(body)
    refit_beliefs(body)
    tick("refitted")
    refit_best(body)
    settle_on_a_face(body)
    refine_promising(body)
    reconsider_nominal(body)
    tick("best again")
    search_pairs(body, wanted)
    for _ in range(SHARPENINGS):
        if not sharpen(body):
            break
        # Sharper noise may leave room for a second effect.
        search_pairs(body, wanted)
    if body.problem.scene.unscaled:
        body.fits = {k: share_spins(f) if "magnus" in k else f for k, f in body.fits.items()}
    tick("pairs")


def _wanted(capture: Capture, names: Sequence[str] | None) -> list[CandidateEffect]:
    chosen = []
    for name in CANDIDATE_EFFECTS if names is None else names:
        effect(name)
        if name not in CANDIDATE_EFFECTS or (name == "camera_pose" and capture.camera is None):
            continue
        if name == "restitution" and capture.ground.restitution is None:
            continue
        chosen.append(CANDIDATE_EFFECTS[name])
    return chosen


def shown_keys(keys: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Return ``keys`` and ``REFITS``, each once, in their order: among equally likely candidates the first decides."""
    return tuple(dict.fromkeys((*keys, REFITS)))


def _assemble(capture: Capture, bodies: list[BodyFits]) -> RigidFits:
    keys = _worth(bodies, [k for k in bodies[0].fits if all(k in b.fits for b in bodies)])
    shown = shown_keys(keys)
    made = {}
    plain = [believed_fit(b.fits[()]) for b in bodies]
    spreads = [prediction_spread(f) for f in plain]
    held = {k: [score_held_out(b.fits[k], s) for b, s in zip(bodies, spreads, strict=True)] for k in shown}
    for k in shown:
        made[k] = _candidate(capture, bodies, k, held[k])
    for k in ((), REFITS):
        made[k] = dataclasses.replace(made[k], bending=sum(bending(b.fits[k]) for b in bodies))
    _level_twins(made)
    top = max(made, key=lambda k: made[k].log_evidence)
    floors = [noise_floor(b.fits[top]) for b in bodies]
    grains = [np.hypot(pooled_rms(contact_spread(f)), step_size_error(f)) for f in plain]
    expects, gap = False, min(c.misfit for c in made.values())
    if gap > UNEXPLAINED and not any(b.problem.scene.body.round for b in bodies):
        expected = float(np.sqrt(np.mean([marginal_rms(f) ** 2 for f in plain])))
        # A few tumbling trials hardly tell which re-fitted parameters predict better: the nominal ones are the
        # reference, and parameters re-fitted to an unexplained motion are not used.
        believed = [score_held_out(f).rms_m for f in plain]
        expects = expected < WORSE * float(np.sqrt(np.mean(np.square(believed))))
        if expects:
            made[REFITS] = dataclasses.replace(made[REFITS], heldout_rms_m=expected)
    singles = sorted((made[k] for k in keys if k), key=lambda c: -c.log_evidence)
    return RigidFits(
        capture=capture,
        bodies=bodies,
        expects=expects,
        nominal=made[()],
        refitted=made[REFITS],
        candidates=tuple(singles),
        floor_rms_m=float(np.sqrt(np.mean(np.square(floors)))),
        grain_rms_m=float(np.sqrt(np.mean(np.square(grains)))),
    )


PAIRS_SHOWN = 3
"""Best pairs that are judged."""


def _worth(bodies: list[BodyFits], keys: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return ``keys`` without pairs that are no better than the best single effect, and with the best few others."""

    def evidence(key: tuple[str, ...]) -> float:
        return sum(b.fits[key].evidence for b in bodies)

    best = max((evidence(k) for k in keys if len(k) == 1), default=math.inf)
    pairs = sorted((k for k in keys if len(k) > 1 and evidence(k) > best), key=lambda k: -evidence(k))
    return [k for k in keys if len(k) < 2 or k in pairs[:PAIRS_SHOWN]]


def _level_twins(made: dict[tuple[str, ...], CandidateFit]) -> None:
    """Equalise evidence and held-out error of a slow clock and a lighter body, which are the same motion."""
    clock, weight = made.get(("time_scale",)), made.get(("buoyancy",))
    if clock is None or weight is None:
        return
    rate = clock.parameters["time_scale"]["rate"].value
    fraction = weight.parameters["buoyancy"]["fraction"].value
    if abs(rate**2 - (1 - fraction)) < 0.1 * abs(fraction) + 1e-4:
        best = max(clock.log_evidence, weight.log_evidence)
        error = min(clock.heldout_rms_m, weight.heldout_rms_m)
        chi = min(clock.heldout_chi, weight.heldout_chi)
        better = min(clock, weight, key=lambda fit: fit.heldout_chi)
        for twin in (clock, weight):
            made[twin.effects] = dataclasses.replace(
                twin,
                log_evidence=best,
                heldout_rms_m=error,
                heldout_chi=chi,
                heldout_trials=better.heldout_trials,
                heldout_elsewhere=better.heldout_elsewhere,
            )


def _candidate(
    capture: Capture, bodies: list[BodyFits], key: tuple[str, ...], held: list[HeldOutScore]
) -> CandidateFit:
    first = max(bodies, key=lambda b: float(np.trace(b.fits[key].schur.sum(axis=0))))
    fit = first.fits[key]
    scene = fit.problem.scene
    cover = np.linalg.inv(np.eye(fit.model.size) + fit.schur.sum(axis=0) / SHARED)
    spread = 0.5 * (cover + cover.T)
    rng = np.random.default_rng(0)
    values, vectors = np.linalg.eigh(spread)
    draws = fit.z + (vectors * np.sqrt(np.clip(values, 0.0, 4.0)) @ rng.normal(size=(fit.model.size, 64))).T
    others = tuple(name for name in key if name != "magnus")
    if scene.unscaled and others != key and all(others in b.fits for b in bodies):
        gain = sum(b.fits[key].evidence - b.fits[others].evidence for b in bodies)
        if gain > BASE_GAIN:
            _as_a_factor(draws, fit, "magnus")
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
        candidate = CANDIDATE_EFFECTS[name]
        if candidate.positive and _amount(fit, name) < 0:
            # A negative amount: the nominal model with an extra parameter.
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
        heldout_chi=float(np.sqrt(np.mean([h.chi**2 for h in held]))),
        heldout_trials=tuple(chi for h in held for chi in h.trials),
        heldout_elsewhere=tuple(away for h in held for away in h.elsewhere),
        misfit=math.sqrt(square),
    )


def _place(fit: Fit, name: str) -> int | None:
    """Return where the first number of the effect ``name`` lies in those of ``fit``; None without it."""
    at = BELIEFS.size
    for candidate in fit.model.candidates:
        if candidate.name == name:
            return at
        at += candidate.size
    return None


def _amount(fit: Fit, name: str) -> float:
    at = _place(fit, name)
    return 0.0 if at is None else float(fit.z[at])


def _as_a_factor(draws: Array, fit: Fit, name: str) -> None:
    """Spread the first number of ``name`` in ``draws`` (N, P), which is not zero, as a factor, in place.

    A path tells the product of lift and a spin that nothing shows: less lift is more spin, and no lift none at all.
    """
    at = _place(fit, name)
    if at is not None and abs(fit.z[at]) > 1e-3:
        draws[:, at] = fit.z[at] * np.exp(np.clip(draws[:, at] / fit.z[at] - 1.0, -3.0, 3.0))


def _other_contact(name: str, value: float, normal: Array) -> Array:
    """Return ``value`` of a contact coefficient as other contact models would have it, for draws ``normal`` (N,)."""
    if name == "friction":
        return np.asarray(value * np.exp(FRICTION_SPREAD * normal))
    return value + RESTITUTION_SPREAD * normal if name == "restitution" else np.full_like(normal, value)


def _estimates(scene: BodyScene, fit: Fit, name: str, draws: Array) -> dict[str, Estimate]:
    schema = {p.name: p for p in effect(name).parameters}

    def values(z: Array) -> dict[str, float]:
        at, setting = BELIEFS.size, None
        for candidate in fit.model.candidates:
            if candidate.name == name:
                setting = candidate.values(scene, fit.model.setting(scene, z), z[at : at + candidate.size])
            at += candidate.size
        assert setting is not None
        return {k: float(np.clip(v, schema[k].low, schema[k].high)) for k, v in setting.items()}

    best, many = values(fit.z), [values(d) for d in draws]
    found, normal = {}, np.random.default_rng(1).normal(size=len(draws))
    for k, v in best.items():
        drawn = np.array([m[k] for m in many]) + _other_contact(name, v, normal) - v
        if name == "magnus" and scene.unscaled:
            drawn *= np.exp(LIFT_SPREAD * normal)
        low, high = np.percentile(drawn, (2.5, 97.5))
        low, high = np.clip((low, high), schema[k].low, schema[k].high)
        found[k] = Estimate(value=v, unit=schema[k].unit, low=float(min(low, v)), high=float(max(high, v)))
    return found
