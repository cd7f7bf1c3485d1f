# SPDX-License-Identifier: MIT
"""Fits that are repeated once the search has told which effects are promising: with their own Jacobians, with nodes at
their own contacts, and with the noise that the closest fit leaves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .multiple_shooting import Fit, solve
from .observed_poses import ObservedBody
from .rigid_candidates import CANDIDATE_EFFECTS
from .rigid_misfit import misfit
from .rigid_search import (
    BEHIND,
    BEHIND_SHARE,
    FOLLOWED_GAIN,
    FOLLOWED_MISFIT,
    ROUNDS,
    BodyFits,
    begin_search,
    finish,
    followed,
    keep,
)
from .shooting_problem import Problem

PROMISING = 12.0
"""Nats below the best within which a single effect is refined and combined with others."""

FOLLOWED = 3
"""Best single effects that are followed through their own contacts."""

SETTLINGS = 4
"""Times that the best effect of a body that turns on a face is followed."""

SHARPENED = 0.8
"""Factor on the assumed noise below which all fits are repeated with what the closest one leaves."""


def refine_promising(body: BodyFits) -> None:
    """Refine the promising fits by a few steps with their own Jacobians."""
    best = max(f.evidence for f in body.fits.values())
    nominal = body.fits[()]
    far = [f for k, f in body.fits.items() if k and f.evidence > max(best - PROMISING, nominal.evidence - 3)]
    for fit in sorted(far, key=lambda f: -f.evidence)[:3]:
        key = tuple(f.name for f in fit.model.candidates)
        if not body.work.left():
            body.work.skip(key, "refined")
            continue
        new = solve(fit.problem, fit.model, fit.z, fit.states, rounds=4)
        if new.evidence > fit.evidence:
            body.fits[key] = new


def refit_beliefs(body: BodyFits) -> None:
    """Fit the nominal model with free contact coefficients, without a new effect."""
    asked = ("friction",) in body.fits
    first = body.fits["friction",] if asked else begin_search(body, (CANDIDATE_EFFECTS["friction"],))
    begin_search(body, (CANDIDATE_EFFECTS["friction"], CANDIDATE_EFFECTS["restitution"]), first)
    finish(body, ("friction", "restitution"))
    if not asked:
        del body.fits["friction",]


def refit_best(body: BodyFits) -> None:
    """Fit the best effects again with their own nodes, where those of the nominal model may be unsuitable."""
    nominal = body.fits[()]
    singles = sorted((f for k, f in body.fits.items() if len(k) == 1), key=lambda f: -f.evidence)[:FOLLOWED]
    for fit in singles:
        gain = singles[0].evidence - nominal.evidence
        if fit.evidence < singles[0].evidence - max(BEHIND, BEHIND_SHARE * gain):
            return
        gained = fit.evidence - nominal.evidence
        if fit.problem is body.problem and gained > FOLLOWED_GAIN and misfit(fit).ratio > FOLLOWED_MISFIT:
            if body.work.left():
                followed(body, fit.model, fit.z)
            else:
                body.work.skip((fit.model.candidates[0].name,), "followed through its own contacts")


def settle_on_a_face(body: BodyFits) -> None:
    """Follow the best effect of a body that slides and turns on one face until its nodes suit it, whatever it gains.

    How friction brakes the turn depends on where the face carries, which the nominal model, with another friction,
    moves to its limit: nodes and states of its fit suit no effect, and gains from there say little.
    """
    if not body.problem.scene.turns_on_a_face:
        return
    key = max((k for k in body.fits if len(k) == 1), key=lambda k: body.fits[k].evidence, default=None)
    for _ in range(SETTLINGS):
        if key is None or misfit(body.fits[key]).ratio < FOLLOWED_MISFIT:
            return
        if not body.work.left():
            body.work.skip(key, "followed through its own contacts")
            return
        fit = followed(body, body.fits[key].model, body.fits[key].z)
        keep(body, key, solve(fit.problem, fit.model, fit.z, fit.states, rounds=ROUNDS))


def _residual(fit: Fit) -> float:
    """Return the RMS residual in m of a coordinate of single points, for as many as no state fits.

    Axes along which nothing was measured, such as a video's depth, have no residual and do not count.
    """
    chi2, count = 0.0, 0
    for segment in fit.evaluation.segments:
        observations = fit.problem.trials[segment.trial].observations
        chi2 += float(segment.chi2.sum()) * observations.sigma**2
        frames = int(np.isfinite(observations.seen[segment.frames]).all(axis=2).sum())
        count += int(observations.measured.sum()) * (frames - 3)
    return float(np.sqrt(chi2 / max(count, 1)))


def _seen_as(body: BodyFits, change: Callable[[ObservedBody], ObservedBody]) -> dict[int, Problem]:
    """Return the problems behind the fits of ``body``, by their identity, with ``change`` made to every observation."""
    problems: dict[int, Problem] = {}
    for problem in (body.problem, *(f.problem for f in body.fits.values())):
        if id(problem) not in problems:
            own = [dataclasses.replace(t, observations=change(t.observations)) for t in problem.trials]
            problems[id(problem)] = dataclasses.replace(problem, trials=own)
    return problems


def sharpen(body: BodyFits) -> bool:
    """Replace the largest slow error of single points by the one that the closest fit leaves, and fit everything again.

    The residual of a candidate is that of a fit to the stated noise: within the largest slow error a missing force
    costs nothing, so that no candidate would move to where it is. Returns whether that made a difference.
    """
    if not body.problem.scene.unscaled:
        return False
    bare = _seen_as(body, lambda o: o.bare)
    close = {
        key: solve(bare[id(fit.problem)], fit.model, fit.z, fit.states, rounds=ROUNDS) for key, fit in body.fits.items()
    }
    residual = min(_residual(fit) for fit in (*body.fits.values(), *close.values()))
    sharp = _seen_as(body, lambda o: o.sharpened(residual))
    pairs = zip(sharp[id(body.problem)].trials, body.problem.trials, strict=True)
    if all(new.observations.sigma > SHARPENED * old.observations.sigma for new, old in pairs):
        return False
    fits = {}
    for key, fit in body.fits.items():
        starts = (fit, close[key])
        again = [solve(sharp[id(fit.problem)], fit.model, f.z, f.states, rounds=ROUNDS) for f in starts]
        fits[key] = max(again, key=lambda f: f.evidence)
    body.problem, body.fits, body.flown, body.begun = sharp[id(body.problem)], fits, {}, {}
    return True
