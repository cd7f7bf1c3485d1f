# SPDX-License-Identifier: MIT
"""Search for each candidate's parameters: from the nominal fit, or from another effect (``pair_search``).

``misfit`` measures whether a fit leaves more than noise and contact uncertainty would: smooth remainders in flight,
defects at contacts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..work import Work
from .contact_uncertainty import weight_contacts
from .multiple_shooting import Fit, solve
from .observed_poses import TOUCHED, frame_pose, observe_body, turns_on_a_face
from .rigid_candidates import BELIEFS, CANDIDATE_EFFECTS, CandidateEffect, tether_numbers
from .rigid_misfit import misfit
from .rigid_simulator import RigidWorlds, on_its_rim, rigid_body
from .segment_paths import Model
from .segmented_trial import Evaluation
from .shooting_problem import CONTACT_DEGREES_OF_FREEDOM, Problem
from .start_numbers import missing_forces, tether_start
from .state_tracking import initial_camera, track_states
from .world_settings import BodyScene

Array = NDArray[np.float64]


ROUNDS = 10

CONTACTS = ("friction", "restitution", "rolling_resistance", "adhesion", "inertia")
"""Effects that act in contact only: a free body turns alike whatever the factor on its moments of inertia."""

FLIES = 6
"""Contact-free frames after a node that determine its state."""

LOOSE = 300.0
"""Factor on the contact uncertainty while only flights count."""

FOLLOWED_GAIN, FOLLOWED_MISFIT = 20.0, 1.2
"""Nats over the nominal model, and misfit, above which an effect is re-tracked with its own nodes."""

RECONSIDERED, RESTARTED = 3, 5
"""Best effects from whose states the nominal model is restarted, and which are restarted from its states."""

LEVELLED, LEVEL = 2, 1.0
"""Most rounds of both, and nats that the nominal model has to gain for another one."""

CONTAINED = (("air_drag", "wind"),)
"""Effects whose numbers are the first of another one's: drag is wind in still air."""

MOVED_GUESS = 0.3
"""Camera displacement from poses alone, in prior standard deviations, above which ``camera_pose`` is re-tracked."""

MOVED_MISFIT = 3.0
"""Misfit of the nominal model above which ``camera_pose`` is re-tracked."""

MINIMA, APART = 3, 0.75
"""Starts of a contact effect from its grid, and their least distance in prior standard deviations."""

BEHIND, BEHIND_SHARE = 60.0, 0.5
"""Nats, and fraction of the best gain, behind which an effect is not fitted to convergence."""


@dataclass(kw_only=True, eq=False)
class BodyFits:
    """All fits of one body, by effects; flown: the problem searched, and a fit whose states flights alone determine.

    begun: unfinished fits to resume, by effects.
    """

    problem: Problem
    work: Work
    fits: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    flown: dict[tuple[str, ...], tuple[Problem, Fit]] = field(default_factory=dict)
    begun: dict[tuple[str, ...], list[Fit]] = field(default_factory=dict)


def body_problem(capture: Capture, index: int, work: Work) -> Problem:
    """Return the trials of object ``index`` of ``capture``, with nodes and initial states."""
    body = rigid_body(capture.objects[index])
    seen = [observe_body(capture, t, index, body.center) for t in capture.trials if (t.object_index == index).any()]
    seen = [s for s in seen if np.isfinite(s.seen).all(axis=2).any()]
    unscaled, normal = all(s.hides_spin for s in seen), np.asarray(capture.ground.unit_normal)
    if unscaled:
        # Its turn is not seen: it is that of its mesh, until it rolls.
        body = on_its_rim(capture.objects[index], normal) or body
    simulator = RigidWorlds(body=body, work=work)
    places = []
    for observations in seen:
        for frame in range(0, len(observations.times), max(1, len(observations.times) // 8)):
            pose = frame_pose(observations, frame)
            if pose is not None:
                places.append(pose[0])
    middle = np.median(places, axis=0) if places else np.zeros(3)
    scene = BodyScene(
        capture=capture,
        body=body,
        middle=middle,
        unscaled=unscaled,
        turns_on_a_face=len(body.corners) > 1 and turns_on_a_face(seen, normal, body.bound),
    )
    return Problem(scene=scene, simulator=simulator, trials=track_states(scene, simulator, seen))


def fit_nominal(body: BodyFits) -> None:
    """Fit the nominal model and set the contact uncertainty."""
    problem, model = body.problem, Model(candidates=())
    z = np.zeros(BELIEFS.size)
    for _ in range(2):
        weight_contacts(problem, model, z)
        fit = solve(problem, model, z, [t.states for t in problem.trials], rounds=6)
        z = fit.z
        for trial, states in zip(problem.trials, fit.states, strict=True):
            trial.states = states
    body.fits[()] = fit


def reconsider_nominal(body: BodyFits) -> None:
    """Restart the nominal model from the states of the best effects, and the effects from its states where it gained.

    Every effect contains the nominal model. One that gains with zero amount has only found better states, which the
    nominal model must get too; and with these an effect explains at least as much.
    """
    for _ in range(LEVELLED):
        before = body.fits[()].evidence
        singles = [f for k, f in body.fits.items() if len(k) == 1 and f.problem is body.problem]
        for fit in sorted(singles, key=lambda f: -f.evidence)[:RECONSIDERED]:
            if not body.work.left():
                body.work.skip(("none",), "restarted from the best effects' states")
                return
            keep(body, (), solve(body.problem, Model(candidates=()), fit.z[: BELIEFS.size], fit.states, rounds=5))
        if body.fits[()].evidence < before + LEVEL:
            break
        _reconsider_effects(body)
    _reconsider_contained(body)


def _reconsider_contained(body: BodyFits) -> None:
    """Restart an effect that another one contains from the other's states and first numbers, where that fits better."""
    for part, whole in CONTAINED:
        if (part,) not in body.fits or (whole,) not in body.fits:
            continue
        small, large = body.fits[(part,)], body.fits[(whole,)]
        if large.evidence < small.evidence + LEVEL or large.evidence < body.fits[()].evidence + LEVEL:
            continue
        if not body.work.left():
            body.work.skip((part,), f"restarted from the states of {whole}")
            continue
        z = large.z[: small.model.size]
        keep(body, (part,), solve(large.problem, small.model, z, large.states, rounds=ROUNDS))


def _reconsider_effects(body: BodyFits) -> None:
    """Restart the best effects from the states of the nominal model."""
    nominal = body.fits[()]
    singles = sorted((k for k in body.fits if len(k) == 1), key=lambda k: -body.fits[k].evidence)
    likely = [k for k in singles if body.fits[k].evidence > body.fits[singles[0]].evidence - BEHIND]
    for key in likely[:RESTARTED]:
        if not body.work.left():
            body.work.skip(key, "restarted from the nominal model's states")
            continue
        fit = body.fits[key]
        z = np.concatenate([nominal.z[: BELIEFS.size], fit.z[BELIEFS.size :]])
        keep(body, key, solve(body.problem, fit.model, z, nominal.states, rounds=5))


def begin_search(body: BodyFits, candidates: tuple[CandidateEffect, ...], base: Fit | None = None) -> Fit:
    """Return the first steps with ``freedoms`` from ``base`` (default: nominal), reusing its Jacobians."""
    problem, nominal = body.problem, body.fits[()]
    first = nominal if base is None else base
    model = Model(candidates=candidates)
    new = candidates[len(first.model.candidates) :]
    slopes: Evaluation | None = nominal.evaluation if first.problem is problem else first.evaluation
    problem = first.problem
    starts: list[Array] = [first.z]
    for candidate in new:
        starts = [np.concatenate([z, s]) for z in starts for s in starts_of(body, candidate, first)]
    slopes = reusable(body, candidates, slopes)
    if new[0].name not in CONTACTS:
        # Flight is nearly linear: contacts are added once the forces are about right.
        loose = loosened(problem)
        flown = [solve(loose, model, z, first.states, rounds=3, held=slopes) for z in starts]
        flown = sorted(flown, key=lambda f: -f.evidence)[:2]
        fits = [(f.z, f.states) for f in flown]
    else:
        found, free = scanned(body, first, model, new[-1])
        fits = [*((z, free) for z in found), *((z, first.states) for z in (found[0], *starts[1:]))]
    begun = [solve(problem, model, z, s, rounds=2, held=slopes) for z, s in fits]
    begun.sort(key=lambda f: -f.evidence)
    key = tuple(f.name for f in candidates)
    body.begun[key] = [f for f in begun if f.evidence > begun[0].evidence - BEHIND]
    keep(body, key, begun[0])
    return begun[0]


def starts_of(body: BodyFits, candidate: CandidateEffect, base: Fit) -> tuple[tuple[float, ...], ...]:
    """Return the starting values of ``candidate``. Without lift no path depends on a hidden spin, and without spin none
    on lift: Magnus starts from a plausible lift there. A tether starts where the missing forces point to, too."""
    known: tuple[tuple[float, ...], ...] = ()
    if base.model.candidates and (candidate.name,) in body.fits:
        # What it needs alone, where something else is already explained.
        known = (tuple(map(float, body.fits[(candidate.name,)].z[BELIEFS.size :])),)
    if candidate.name == "magnus" and body.problem.scene.unscaled:
        return ((1.0,), *known)
    if candidate.name == "tether":
        found = tether_start(missing_forces(base), body.problem.scene.middle)
        if found is not None:
            return (tether_numbers(body.problem.scene, *found), *candidate.starts, *known)
    return (*candidate.starts, *known)


def reusable(body: BodyFits, candidates: tuple[CandidateEffect, ...], slopes: Evaluation | None) -> Evaluation | None:
    """Return ``slopes``, the nominal Jacobians, or None where paths depend on what the nominal model ignores."""
    lifted = body.problem.scene.unscaled and any(c.name == "magnus" for c in candidates)
    return None if lifted else slopes


def finish(body: BodyFits, key: tuple[str, ...]) -> Fit:
    """Return the fit begun for ``key``, iterated to convergence."""
    nominal = body.fits[()]
    for fit in body.begun.pop(key, []):
        known = nominal.evaluation if fit.problem is body.problem else fit.evaluation
        slopes = reusable(body, fit.model.candidates, known)
        keep(body, key, solve(fit.problem, fit.model, fit.z, fit.states, rounds=ROUNDS, held=slopes))
    return body.fits[key]


def finish_best(body: BodyFits) -> None:
    """Finish every single effect that may still become the best."""
    nominal = body.fits[()].evidence
    for key in sorted(body.begun, key=lambda k: -body.fits[k].evidence):
        best = max(f.evidence for f in body.fits.values())
        near = best - max(BEHIND, BEHIND_SHARE * (best - nominal))
        if body.fits[key].evidence < near:
            continue
        if body.work.left():
            finish(body, key)
        else:
            body.work.skip(key, "fitted to convergence")


def keep(body: BodyFits, key: tuple[str, ...], fit: Fit) -> None:
    """Take ``fit`` as the fit of ``key`` where it is the best one so far."""
    if key not in body.fits or body.fits[key].evidence < fit.evidence:
        body.fits[key] = fit


def scanned(body: BodyFits, begin: Fit, model: Model, candidate: CandidateEffect) -> tuple[list[Array], list[Array]]:
    """Return start numbers, best first, and states of a contact effect: states from flights, numbers from a grid.

    States of the nominal fit are biased by its wrong contacts. Up to ``MINIMA`` numbers, apart by ``APART``.
    """
    problem = begin.problem
    key = tuple(f.name for f in begin.model.candidates)
    # Where a fit followed its own nodes, flights of the earlier nodes say nothing about these.
    if key not in body.flown or body.flown[key][0] is not problem:
        loose = solve(loosened(problem), begin.model, begin.z, begin.states, rounds=4, held=begin.evaluation)
        body.flown[key] = (problem, loose)
    flown = body.flown[key][1]
    spreads = _arrival_spreads(problem, flown)
    base = begin.z.copy()
    base[: BELIEFS.size] = 0.0
    tried = [np.concatenate([base, s]) for s in candidate.grid]
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
        costs.append(
            own + float(np.sum((CONTACT_DEGREES_OF_FREEDOM + 12) * np.log1p(squares / CONTACT_DEGREES_OF_FREEDOM)))
        )
    # A state without a following flight is only known from its contacts and stays.
    states = [s.copy() for s in begin.states]
    for segment in flown.evaluation.segments:
        if int((segment.record[:, TOUCHED] <= 0).sum()) >= FLIES:
            states[segment.trial][segment.index] = flown.states[segment.trial][segment.index]
    order = np.argsort(costs)
    best = [tried[int(order[0])]]
    for k in order[1:]:
        if len(best) == MINIMA or costs[k] > costs[order[0]] + 2 * BEHIND:
            break
        if all(float(np.abs(tried[k] - z).max()) >= APART for z in best):
            best.append(tried[k])
    return best, states


def _arrival_spreads(problem: Problem, flown: Fit) -> list[Array | None]:
    """Return covariances (12, 12) of the defects with states from flights alone, including the contact uncertainty."""
    found: list[Array | None] = []
    for segment in flown.evaluation.segments:
        if segment.defect is None or segment.come is None:
            found.append(None)
            continue
        hessian = flown.evaluation.linear[segment.trial].hessian
        first, second = 12 * segment.index, 12 * segment.index + 12
        here = np.linalg.pinv(hessian[first:second, first:second] + 1e-6 * np.eye(12))
        there = np.linalg.pinv(hessian[second : second + 12, second : second + 12] + 1e-6 * np.eye(12))
        come = segment.come[:, :12]
        found.append(problem.trials[segment.trial].covers[segment.index] + come @ here @ come.T + there)
    return found


def fit_camera_pose(body: BodyFits) -> None:
    """Fit ``camera_pose`` with its own nodes: from another viewpoint contacts happen at other times."""
    problem, nominal = body.problem, body.fits[()]
    if misfit(nominal).ratio < MOVED_MISFIT:
        return
    candidate = CANDIDATE_EFFECTS["camera_pose"]
    model = Model(candidates=(candidate,))
    guess = initial_camera(problem)
    if float(np.abs(guess).max()) > MOVED_GUESS:
        followed(body, model, np.concatenate([np.zeros(BELIEFS.size), guess]))


def followed(body: BodyFits, model: Model, z: Array) -> Fit:
    """Return ``model`` fitted from ``z`` with nodes at its own contacts, if that is better."""
    problem = body.problem
    trials = track_states(problem.scene, problem.simulator, [t.observations for t in problem.trials], model=model, z=z)
    other = dataclasses.replace(problem, trials=trials)
    weight_contacts(other, model, z)
    flown = solve(loosened(other), model, z, [t.states for t in trials], rounds=3)
    begin = flown.z if model.candidates[-1].name not in CONTACTS else z
    fit = solve(other, model, begin, flown.states, rounds=2)
    fit = solve(other, model, fit.z, fit.states, rounds=ROUNDS, held=fit.evaluation)
    keep(body, tuple(f.name for f in model.candidates), fit)
    return fit


def loosened(problem: Problem) -> Problem:
    """Return ``problem`` with contacts so uncertain that flights alone determine the states."""
    trials = [dataclasses.replace(t, covers=[c * LOOSE**2 for c in t.covers]) for t in problem.trials]
    return dataclasses.replace(problem, trials=trials)
