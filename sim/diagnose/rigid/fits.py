# SPDX-License-Identifier: MIT
"""All candidates fitted to a capture of rigid bodies: proposals for the verdict, with predictions and places."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...effects.registry import effect
from ...errors import InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..analysis import CandidateFit, Discrepancy, Estimate
from ..capture import Capture, Trial
from .body import rigid_body
from .candidates import BELIEFS, FREEDOMS, Freedom, Scene
from .heldout import Heldout, heldout
from .misfit import misfit
from .observation import frame_pose, sights
from .prediction import Points, believed_fit, numerics, predict_points, simulate_points
from .shooting import FREEDOM_OF_GRAIN, Fit, Model, Problem, solve
from .tracking import camera_guess, track, weigh
from .where import discrepancies
from .worlds import Launcher

Array = NDArray[np.float64]

ROUNDS = 10

CONTACTS = ("friction", "restitution", "rolling_resistance", "adhesion")
"""Effects that act in contact alone."""

FLIES = 6
"""Frames without contact after a node, from which its state is known."""

LOOSE = 300.0
"""Factor on the grain while only flights count."""

PROMISING = 12.0
"""Nats below the best within which a single effect is refined, and combined with others."""

FOLLOWED_GAIN, FOLLOWED_MISFIT = 20.0, 1.2
"""Nats over the nominal model, and misfit, above which an effect is fitted with nodes of its own."""

MOVED_GUESS = 0.3
"""Standard deviations of the prior that poses alone must say a camera has moved, for that."""

MOVED_MISFIT = 3.0
"""Misfit of the nominal model above which a moved camera is followed on its own."""

PAIR_SHARE = 0.85
"""Of the nominal model's misfit that the best single effect must get below: where it explains next to nothing, a second
one explains nothing either, and the cause is another."""

PAIR_MISFIT = 1.6
"""Misfit of the best single effect above which pairs are tried."""


@dataclass(kw_only=True, eq=False)
class BodyFits:
    """All fits of one body: by effects; flown: with states that flights alone fix, by effects."""

    problem: Problem
    fits: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    flown: dict[tuple[str, ...], Fit] = field(default_factory=dict)


class CancelledError(Exception):
    """The caller no longer wants the fits."""


@dataclass(kw_only=True, eq=False)
class RigidFits:
    """Implements ``Fits`` for captures of rigid bodies that do not touch each other."""

    capture: Capture
    bodies: list[BodyFits]
    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    numerics_rms_m: float
    believed_rms_m: float

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """Points (P, K, 3) in m at the ``predict_times`` of every predict trial, by its name."""
        return self._joined(predict_points, fit, list(self.capture.predict_trials))

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
    unknown, and whatever ``cancelled`` makes of it: ``CancelledError``.
    """
    started = time.monotonic()
    wanted = _wanted(capture, names)
    bodies = []
    for index, item in enumerate(capture.objects):
        if item.belief.rigid and any((t.object_index == index).any() for t in capture.trials):
            bodies.append(BodyFits(problem=_problem(capture, index)))
    if not bodies:
        raise InputError("capture: none of its objects is rigid and tracked: fit it as deformable bodies")
    progress = StageProgress(on_event, "fit", len(bodies) * (len(wanted) + 2))
    done = 0

    def tick(what: str) -> None:
        nonlocal done
        done += 1
        progress.report(done, what)
        if cancelled():
            raise CancelledError

    for body in bodies:
        _fit_nominal(body)
        tick("nominal")
        for freedom in wanted:
            if time.monotonic() - started < budget_s:
                _fit(body, (freedom,))
                if freedom.name == "camera_pose":
                    _moved_camera(body)
            tick(freedom.name)
        _refit_beliefs(body)
        tick("refitted")
        if time.monotonic() - started < budget_s:
            _follow_best(body)
        _refine(body, started + budget_s)
        _pairs(body, wanted, started + budget_s)
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


def _problem(capture: Capture, index: int) -> Problem:
    body = rigid_body(capture.objects[index])
    launcher = Launcher(body=body)
    seen = [sights(capture, t, index, body.center) for t in capture.trials if (t.object_index == index).any()]
    seen = [s for s in seen if np.isfinite(s.seen).all(axis=2).any()]
    places = []
    for sight in seen:
        for frame in range(0, len(sight.times), max(1, len(sight.times) // 8)):
            pose = frame_pose(sight, frame)
            if pose is not None:
                places.append(pose[0])
    middle = np.median(places, axis=0) if places else np.zeros(3)
    scene = Scene(capture=capture, body=body, middle=middle)
    return Problem(scene=scene, launcher=launcher, takes=track(scene, launcher, seen))


def _fit_nominal(body: BodyFits) -> None:
    problem, model = body.problem, Model(freedoms=())
    z = np.zeros(BELIEFS.size)
    for _ in range(2):
        weigh(problem, model, z)
        fit = solve(problem, model, z, [t.states for t in problem.takes], rounds=6)
        z = fit.z
        for take, states in zip(problem.takes, fit.states, strict=True):
            take.states = states
    body.fits[()] = fit


def _fit(body: BodyFits, freedoms: tuple[Freedom, ...], base: Fit | None = None) -> Fit:
    """Fit ``freedoms`` from ``base`` (the nominal model), whose slopes serve throughout."""
    problem, nominal = body.problem, body.fits[()]
    begin = nominal if base is None else base
    model = Model(freedoms=freedoms)
    new = freedoms[len(begin.model.freedoms) :]
    slopes = nominal.evaluation if begin.problem is problem else begin.evaluation
    problem = begin.problem
    starts: list[Array] = [begin.z]
    for freedom in new:
        starts = [np.concatenate([z, s]) for z in starts for s in freedom.starts]
    if new[0].name not in CONTACTS:
        # In flight everything is nearly linear: contacts join in once the forces are about right.
        loose = _loosened(problem)
        flown = [solve(loose, model, z, begin.states, rounds=3, held=slopes) for z in starts]
        flown = sorted(flown, key=lambda f: -f.evidence)[:3]
        fits = [(f.z, f.states) for f in flown]
    else:
        z, free = _scanned(body, begin, model, new[-1])
        fits = [(z, free), (z, begin.states)]
    if len(fits) > 1:
        first = [solve(problem, model, z, s, rounds=2, held=slopes) for z, s in fits]
        first.sort(key=lambda f: -f.evidence)
        fits = [(f.z, f.states) for f in first[:2]]
    done = [solve(problem, model, z, s, rounds=ROUNDS, held=slopes) for z, s in fits]
    best = max(done, key=lambda f: f.evidence)
    key = tuple(f.name for f in freedoms)
    if key not in body.fits or body.fits[key].evidence < best.evidence:
        body.fits[key] = best
    return best


def _scanned(body: BodyFits, begin: Fit, model: Model, freedom: Freedom) -> tuple[Array, list[Array]]:
    """Where to begin with an effect of contact: flights fix the states whatever it is, a grid its best numbers.

    Begun from the nominal fit, states that were bent to wrong contacts would hold on to them.
    """
    problem = begin.problem
    key = tuple(f.name for f in begin.model.freedoms)
    if key not in body.flown:
        body.flown[key] = solve(_loosened(problem), begin.model, begin.z, begin.states, rounds=4, held=begin.evaluation)
    flown = body.flown[key]
    spreads = _arrival_spreads(problem, flown)
    base = begin.z.copy()
    base[: BELIEFS.size] = 0.0
    tried = [np.concatenate([base, s]) for s in freedom.grid]
    costs = []
    for z in tried:
        look = problem.evaluate(model, z, flown.states, slopes=False)
        squares = np.array(
            [
                s.defect @ np.linalg.solve(c, s.defect)
                for s, c in zip(look.segments, spreads, strict=True)
                if s.defect is not None and c is not None
            ]
        )
        own = float(z[len(base) :] @ z[len(base) :])
        costs.append(own + float(np.sum((FREEDOM_OF_GRAIN + 12) * np.log1p(squares / FREEDOM_OF_GRAIN))))
    # A state that no flight follows is known by its contacts alone: it stays.
    states = [s.copy() for s in begin.states]
    for segment in flown.evaluation.segments:
        if int((segment.record[:, 15] <= 0).sum()) >= FLIES:
            states[segment.take][segment.index] = flown.states[segment.take][segment.index]
    return tried[int(np.argmin(costs))], states


def _arrival_spreads(problem: Problem, flown: Fit) -> list[Array | None]:
    """Covariances (12, 12) of the defects where flights alone fix the states: of both states and of the grain."""
    found: list[Array | None] = []
    for segment in flown.evaluation.segments:
        if segment.defect is None or segment.come is None:
            found.append(None)
            continue
        hessian = flown.evaluation.linear[segment.take].hessian
        first, second = 12 * segment.index, 12 * segment.index + 12
        here = np.linalg.pinv(hessian[first:second, first:second] + 1e-6 * np.eye(12))
        there = np.linalg.pinv(hessian[second : second + 12, second : second + 12] + 1e-6 * np.eye(12))
        come = segment.come[:, :12]
        found.append(problem.takes[segment.take].covers[segment.index] + come @ here @ come.T + there)
    return found


def _moved_camera(body: BodyFits) -> None:
    """Fit ``camera_pose`` with nodes of its own: seen from elsewhere, the body meets the ground at other times."""
    problem, nominal = body.problem, body.fits[()]
    if misfit(nominal).ratio < MOVED_MISFIT:
        return
    freedom = FREEDOMS["camera_pose"]
    model = Model(freedoms=(freedom,))
    guess = camera_guess(problem)
    if float(np.abs(guess).max()) > MOVED_GUESS:
        _followed(body, model, np.concatenate([np.zeros(BELIEFS.size), guess]))


def _followed(body: BodyFits, model: Model, z: Array) -> Fit:
    """``model`` fitted with nodes where it meets the ground itself, from the numbers ``z``; kept where it is better."""
    problem = body.problem
    takes = track(problem.scene, problem.launcher, [t.sight for t in problem.takes], model=model, z=z)
    other = dataclasses.replace(problem, takes=takes)
    weigh(other, model, z)
    flown = solve(_loosened(other), model, z, [t.states for t in takes], rounds=3)
    begin = flown.z if model.freedoms[-1].name not in CONTACTS else z
    fit = solve(other, model, begin, flown.states, rounds=2)
    fit = solve(other, model, fit.z, fit.states, rounds=ROUNDS, held=fit.evaluation)
    key = tuple(f.name for f in model.freedoms)
    if key not in body.fits or body.fits[key].evidence < fit.evidence:
        body.fits[key] = fit
    return fit


def _loosened(problem: Problem) -> Problem:
    takes = [dataclasses.replace(t, covers=[c * LOOSE**2 for c in t.covers]) for t in problem.takes]
    return dataclasses.replace(problem, takes=takes)


def _refine(body: BodyFits, until: float) -> None:
    """Take the promising fits a few steps further, with slopes of their own."""
    best = max(f.evidence for f in body.fits.values())
    nominal = body.fits[()]
    far = [f for k, f in body.fits.items() if k and f.evidence > max(best - PROMISING, nominal.evidence - 3)]
    for fit in sorted(far, key=lambda f: -f.evidence)[:3]:
        if time.monotonic() > until:
            return
        key = tuple(f.name for f in fit.model.freedoms)
        new = solve(fit.problem, fit.model, fit.z, fit.states, rounds=4)
        if new.evidence > fit.evidence:
            body.fits[key] = new


def _refit_beliefs(body: BodyFits) -> None:
    """The nominal model with its own coefficients free: both contact effects, without a new one."""
    asked = ("friction",) in body.fits
    first = body.fits["friction",] if asked else _fit(body, (FREEDOMS["friction"],))
    _fit(body, (FREEDOMS["friction"], FREEDOMS["restitution"]), first)
    if not asked:
        del body.fits["friction",]


def _follow_best(body: BodyFits) -> None:
    """The best effects once more with nodes of their own, where the nominal model's may stand in the way."""
    nominal = body.fits[()]
    singles = sorted((f for k, f in body.fits.items() if len(k) == 1), key=lambda f: -f.evidence)[:2]
    for fit in singles:
        gained = fit.evidence - nominal.evidence
        if fit.problem is body.problem and gained > FOLLOWED_GAIN and misfit(fit).ratio > FOLLOWED_MISFIT:
            _followed(body, fit.model, fit.z)


def _pairs(body: BodyFits, wanted: list[Freedom], until: float) -> None:
    """Two causes at once: the best one or two with each of the others, where one alone leaves too much."""
    singles = [(k[0], f) for k, f in body.fits.items() if len(k) == 1]
    if not singles:
        return
    singles.sort(key=lambda item: -item[1].evidence)
    left = misfit(singles[0][1]).ratio
    if left < PAIR_MISFIT or left > PAIR_SHARE * misfit(body.fits[()]).ratio:
        return
    for name, fit in singles[:2]:
        for freedom in wanted:
            if time.monotonic() > until:
                return
            if freedom.name == name or tuple(sorted((name, freedom.name))) in {tuple(sorted(k)) for k in body.fits}:
                continue
            if {name, freedom.name} == {"air_drag", "wind"}:
                continue
            _fit(body, (FREEDOMS[name], freedom), fit)


def _assemble(capture: Capture, bodies: list[BodyFits]) -> RigidFits:
    keys = [k for k in bodies[0].fits if all(k in b.fits for b in bodies)]
    made = {}
    held = {k: [heldout(b.fits[k]) for b in bodies] for k in keys}
    for k in keys:
        made[k] = _candidate(capture, bodies, k, held[k])
    _level_twins(made)
    believed = [heldout(believed_fit(b.fits[()])) for b in bodies]
    floor = min(c.heldout_rms_m for c in made.values())
    refit = made[("friction", "restitution")]
    singles = sorted((made[k] for k in keys if k), key=lambda c: -c.log_evidence)
    return RigidFits(
        capture=capture,
        bodies=bodies,
        nominal=made[()],
        refitted=refit,
        candidates=tuple(singles),
        floor_rms_m=min(floor, believed[0].floor_rms_m),
        numerics_rms_m=float(np.sqrt(np.mean([numerics(believed_fit(b.fits[()])) ** 2 for b in bodies]))),
        believed_rms_m=float(np.sqrt(np.mean([b.rms_m**2 for b in believed]))),
    )


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
