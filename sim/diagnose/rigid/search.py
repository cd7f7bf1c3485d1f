# SPDX-License-Identifier: MIT
"""Search for the numbers of every candidate of one body: singles from the nominal fit, pairs from the best singles."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from .body import rigid_body
from .candidates import BELIEFS, FREEDOMS, Freedom, Scene
from .misfit import misfit
from .observation import frame_pose, sights
from .shooting import FREEDOM_OF_GRAIN, Fit, Model, Problem, solve
from .tracking import camera_guess, track, weigh
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

RECONSIDERED = 3
"""Best effects from whose states the nominal model is begun again."""

MOVED_GUESS = 0.3
"""Standard deviations of the prior that poses alone must say a camera has moved, for that."""

MOVED_MISFIT = 3.0
"""Misfit of the nominal model above which a moved camera is followed on its own."""

PAIR_SHARE = 0.85
"""Of the nominal model's misfit that the best single effect must get below: where it explains next to nothing, a second
one explains nothing either, and the cause is another."""

PAIR_MISFIT = 1.6
"""Misfit of the best single effect above which pairs are tried."""

PAIRS_FINISHED = 3
"""Pairs that are fitted to the end."""

BEHIND, BEHIND_SHARE = 60.0, 0.5
"""Nats, and share of the best gain, behind which an effect is not fitted to the end."""


@dataclass(kw_only=True, eq=False)
class BodyFits:
    """All fits of one body: by effects; flown: with states that flights alone fix, by effects.

    begun: where to go on with fits that are not finished, by effects.
    """

    problem: Problem
    fits: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    flown: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    begun: dict[tuple[str, ...], list[Fit]] = field(default_factory=dict)


def body_problem(capture: Capture, index: int) -> Problem:
    """Takes of object ``index`` of ``capture``, with nodes and first states."""
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


def fit_nominal(body: BodyFits) -> None:
    """Fit the model as believed, and set what contacts can be trusted with."""
    problem, model = body.problem, Model(freedoms=())
    z = np.zeros(BELIEFS.size)
    for _ in range(2):
        weigh(problem, model, z)
        fit = solve(problem, model, z, [t.states for t in problem.takes], rounds=6)
        z = fit.z
        for take, states in zip(problem.takes, fit.states, strict=True):
            take.states = states
    body.fits[()] = fit


def reconsider_nominal(body: BodyFits, until: float) -> None:
    """Begin the nominal model again where the best effects ended; kept where it is better.

    Every effect contains the nominal model. One that gains although its own share is nothing has only found better
    states, and these are the nominal model's as well.
    """
    singles = [f for k, f in body.fits.items() if len(k) == 1 and f.problem is body.problem]
    for fit in sorted(singles, key=lambda f: -f.evidence)[:RECONSIDERED]:
        if time.monotonic() > until:
            return
        again = solve(body.problem, Model(freedoms=()), fit.z[: BELIEFS.size], fit.states, rounds=5)
        if again.evidence > body.fits[()].evidence:
            body.fits[()] = again


def begin(body: BodyFits, freedoms: tuple[Freedom, ...], base: Fit | None = None) -> Fit:
    """First steps with ``freedoms`` from ``base`` (the nominal model), whose slopes serve throughout."""
    problem, nominal = body.problem, body.fits[()]
    first = nominal if base is None else base
    model = Model(freedoms=freedoms)
    new = freedoms[len(first.model.freedoms) :]
    slopes = nominal.evaluation if first.problem is problem else first.evaluation
    problem = first.problem
    starts: list[Array] = [first.z]
    for freedom in new:
        starts = [np.concatenate([z, s]) for z in starts for s in freedom.starts]
    if new[0].name not in CONTACTS:
        # In flight everything is nearly linear: contacts join in once the forces are about right.
        loose = _loosened(problem)
        flown = [solve(loose, model, z, first.states, rounds=3, held=slopes) for z in starts]
        flown = sorted(flown, key=lambda f: -f.evidence)[:2]
        fits = [(f.z, f.states) for f in flown]
    else:
        z, free = _scanned(body, first, model, new[-1])
        fits = [(z, free), (z, first.states)]
    begun = [solve(problem, model, z, s, rounds=2, held=slopes) for z, s in fits]
    begun.sort(key=lambda f: -f.evidence)
    key = tuple(f.name for f in freedoms)
    body.begun[key] = [f for f in begun if f.evidence > begun[0].evidence - BEHIND]
    _keep(body, key, begun[0])
    return begun[0]


def finish(body: BodyFits, key: tuple[str, ...]) -> Fit:
    """Go on with what was begun for ``key`` until it no longer gets better."""
    nominal = body.fits[()]
    for fit in body.begun.pop(key, []):
        slopes = nominal.evaluation if fit.problem is body.problem else fit.evaluation
        _keep(body, key, solve(fit.problem, fit.model, fit.z, fit.states, rounds=ROUNDS, held=slopes))
    return body.fits[key]


def finish_best(body: BodyFits, until: float) -> None:
    """Finish every single effect that may yet be the best."""
    nominal = body.fits[()].evidence
    for key in sorted(body.begun, key=lambda k: -body.fits[k].evidence):
        best = max(f.evidence for f in body.fits.values())
        near = best - max(BEHIND, BEHIND_SHARE * (best - nominal))
        if body.fits[key].evidence >= near and time.monotonic() < until:
            finish(body, key)


def _keep(body: BodyFits, key: tuple[str, ...], fit: Fit) -> None:
    if key not in body.fits or body.fits[key].evidence < fit.evidence:
        body.fits[key] = fit


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


def moved_camera(body: BodyFits) -> None:
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
    _keep(body, tuple(f.name for f in model.freedoms), fit)
    return fit


def _loosened(problem: Problem) -> Problem:
    takes = [dataclasses.replace(t, covers=[c * LOOSE**2 for c in t.covers]) for t in problem.takes]
    return dataclasses.replace(problem, takes=takes)


def refine(body: BodyFits, until: float) -> None:
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


def refit_beliefs(body: BodyFits) -> None:
    """The nominal model with its own coefficients free: both contact effects, without a new one."""
    asked = ("friction",) in body.fits
    first = body.fits["friction",] if asked else begin(body, (FREEDOMS["friction"],))
    begin(body, (FREEDOMS["friction"], FREEDOMS["restitution"]), first)
    finish(body, ("friction", "restitution"))
    if not asked:
        del body.fits["friction",]


def follow_best(body: BodyFits, until: float) -> None:
    """The best effects once more with nodes of their own, where the nominal model's may stand in the way."""
    nominal = body.fits[()]
    singles = sorted((f for k, f in body.fits.items() if len(k) == 1), key=lambda f: -f.evidence)[:2]
    for fit in singles:
        if time.monotonic() > until or fit.evidence < singles[0].evidence - BEHIND:
            return
        gained = fit.evidence - nominal.evidence
        if fit.problem is body.problem and gained > FOLLOWED_GAIN and misfit(fit).ratio > FOLLOWED_MISFIT:
            _followed(body, fit.model, fit.z)


def pairs(body: BodyFits, wanted: list[Freedom], until: float) -> None:
    """Two causes at once: the best one or two with each of the others, where one alone leaves too much."""
    singles = [(k[0], f) for k, f in body.fits.items() if len(k) == 1]
    if not singles:
        return
    singles.sort(key=lambda item: -item[1].evidence)
    left = misfit(singles[0][1]).ratio
    if left < PAIR_MISFIT or left > PAIR_SHARE * misfit(body.fits[()]).ratio:
        return
    tried = []
    for name, fit in singles[:2]:
        for freedom in wanted:
            if time.monotonic() > until:
                break
            if freedom.name == name or tuple(sorted((name, freedom.name))) in {tuple(sorted(k)) for k in body.fits}:
                continue
            if {name, freedom.name} == {"air_drag", "wind"}:
                continue
            begin(body, (FREEDOMS[name], freedom), fit)
            tried.append((name, freedom.name))
    for key in sorted(tried, key=lambda k: -body.fits[k].evidence)[:PAIRS_FINISHED]:
        if time.monotonic() < until:
            finish(body, key)
