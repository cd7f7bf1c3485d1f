# SPDX-License-Identifier: MIT
"""Pairs of effects: fitted jointly, from the nodes and numbers of the best single effects.

A pair is tried wherever the best single effect leaves structure, in flight or at contacts, whether or not that effect
predicts held-out trials. What a pair is worth is decided later, in nats (``sim.diagnose.model_comparison``)."""

from __future__ import annotations

import numpy as np

from .multiple_shooting import Fit, solve
from .rigid_candidates import BELIEFS, CANDIDATE_EFFECTS, CandidateEffect
from .rigid_misfit import misfit
from .rigid_search import (
    BEHIND,
    BEHIND_SHARE,
    CONTACTS,
    FOLLOWED_GAIN,
    FOLLOWED_MISFIT,
    BodyFits,
    begin_search,
    finish,
    followed,
    keep,
)
from .segment_paths import Model

BASES = 3
"""Single effects from which pairs start."""

BASE_GAIN = 8.0
"""Nats over the nominal model below which a single effect is no base: the entry fee of an effect."""

PAIRS_FINISHED, PAIRS_REFINED = 4, 2
"""Pairs that are fitted to convergence, and refined with their own Jacobians."""

FLIGHT_STRUCTURE, CONTACT_STRUCTURE = 1.15, 0.9
"""Misfits, of flights and of contacts, above which the best single effect leaves structure. Fitted states absorb a part
of every contact's defect, so that what explains contacts leaves less than 1 there."""

ONE_TRACE = (
    {"air_drag", "wind"},
    {"buoyancy", "time_scale"},
    {"restitution", "adhesion"},
)
"""Pairs that no recording of one body can tell from one of the two alone."""


def leaves_structure(fit: Fit) -> bool:
    """Return whether flights or contacts of ``fit`` leave more than noise and contact uncertainty would."""
    left = misfit(fit)
    flight = (left.flight / max(left.flight_count, 1)) ** 0.5
    contact = (left.contact / max(left.contact_count, 1)) ** 0.5
    return flight > FLIGHT_STRUCTURE or contact > CONTACT_STRUCTURE


def _bases(body: BodyFits) -> list[tuple[str, Fit]]:
    """Return the best single effects, best first, one of each ``ONE_TRACE``."""
    least = body.fits[()].evidence + BASE_GAIN
    singles = [(k[0], f) for k, f in body.fits.items() if len(k) == 1 and f.evidence > least]
    found: list[tuple[str, Fit]] = []
    for name, fit in sorted(singles, key=lambda item: -item[1].evidence):
        if not any({name, other} in ONE_TRACE for other, _ in found):
            found.append((name, fit))
    return found[:BASES]


def _elsewhere(body: BodyFits, base: str, wanted: list[CandidateEffect]) -> list[CandidateEffect]:
    """Return the effects that gain by themselves where ``base`` does not act: at contacts, or beside them in flight.

    States between contacts absorb a part of what another contact effect would explain, so that little structure is
    left; but what each gains alone adds up.
    """
    least = body.fits[()].evidence + FOLLOWED_GAIN
    found = [c for c in wanted if (c.name in CONTACTS) != (base in CONTACTS) and (c.name,) in body.fits]
    return [c for c in found if body.fits[(c.name,)].evidence > least]


def search_pairs(body: BodyFits, wanted: list[CandidateEffect]) -> None:
    """Fit pairs of the best single effects with every other one; those that still gain are fitted to convergence."""
    bases = _bases(body)
    hidden = [c for c in wanted if c.name == "magnus" and body.problem.scene.unscaled]
    if not bases:
        # Hidden spins differ between trials, so that no single effect takes their place.
        singles = [(k[0], f) for k, f in body.fits.items() if len(k) == 1] if hidden else []
        bases = sorted(singles, key=lambda item: -item[1].evidence)[:1]
    if not bases:
        return
    others = wanted if leaves_structure(bases[0][1]) else [*hidden, *_elsewhere(body, bases[0][0], wanted)]
    tried: list[tuple[str, str]] = []
    for name, fit in bases:
        begun = _begin(body, [(name, other.name) for other in others], fit)
        tried += begun
        likeliest = max(begun, key=lambda key: body.fits[key].evidence, default=None)
        if likeliest is not None and _explains(body, likeliest):
            # Another base has nothing to explain better; but what no recording tells apart has to be weighed.
            known = {candidate.name for candidate in wanted}
            for twin in _twins(likeliest):
                if twin[1] in known and (twin[0],) in body.fits:
                    tried += _begin(body, [twin], body.fits[(twin[0],)])
            break
    ranked = sorted(tried, key=lambda key: -body.fits[key].evidence)[:PAIRS_FINISHED]
    for key in ranked:
        best = max(body.fits[k].evidence for k in tried)
        if _far_behind(body.fits[key].evidence, best, bases[0][1].evidence):
            continue
        if body.work.left():
            finish(body, key)
        else:
            body.work.skip(key, "fitted to convergence")
    _refine(body, sorted(ranked, key=lambda key: -body.fits[key].evidence)[:PAIRS_REFINED], bases[0][1].evidence)


def _begin(body: BodyFits, keys: list[tuple[str, str]], fit: Fit) -> list[tuple[str, str]]:
    """Begin the search of those pairs ``keys`` that are new, from ``fit`` of their first effect, and return them."""
    begun = []
    for name, other in keys:
        same = name == other or {name, other} in ONE_TRACE
        if same or (name, other) in body.fits or (other, name) in body.fits:
            continue
        if not body.work.left():
            body.work.skip((name, other), "tried")
            continue
        begin_search(body, (CANDIDATE_EFFECTS[name], CANDIDATE_EFFECTS[other]), fit)
        begun.append((name, other))
    return begun


def _twins(key: tuple[str, str]) -> list[tuple[str, str]]:
    """Return the pairs that have, in place of one effect of ``key``, its twin in ``ONE_TRACE``; the other one first."""
    return [
        (stays, twin)
        for stays, leaves in (key, key[::-1])
        for alike in ONE_TRACE
        if leaves in alike
        for twin in alike - {leaves, stays}
    ]


def _far_behind(evidence: float, best: float, single: float) -> bool:
    """Return whether a pair of ``evidence`` cannot become the ``best`` one, which gains on the best ``single``."""
    return evidence < best - max(BEHIND, BEHIND_SHARE * (best - single))


def _explains(body: BodyFits, key: tuple[str, str]) -> bool:
    """Return whether the pair ``key``, fitted to convergence, leaves no structure."""
    return body.work.left() and not leaves_structure(finish(body, key))


def _refine(body: BodyFits, keys: list[tuple[str, str]], single: float) -> None:
    """Refine the pairs ``keys``, best first, with their own Jacobians; follow the best through its own contacts."""
    for number, key in enumerate(keys):
        fit = body.fits[key]
        if fit.evidence < single + BASE_GAIN or _far_behind(fit.evidence, body.fits[keys[0]].evidence, single):
            continue
        if not body.work.left():
            body.work.skip(key, "refined")
            continue
        keep(body, key, solve(fit.problem, fit.model, fit.z, fit.states, rounds=4))
        fit = body.fits[key]
        if number == 0 and fit.evidence > single + FOLLOWED_GAIN and misfit(fit).ratio > FOLLOWED_MISFIT:
            followed(body, fit.model, fit.z)
        _reconsider_singles(body, body.fits[key])


def _reconsider_singles(body: BodyFits, pair: Fit) -> None:
    """Restart both single effects of ``pair`` from its nodes and states; keep them where they are better.

    A pair contains both. What gains because it has found better states is no second cause.
    """
    at = BELIEFS.size
    for candidate in pair.model.candidates:
        own = pair.z[at : at + candidate.size]
        at += candidate.size
        if (candidate.name,) in body.fits and body.work.left():
            z = np.concatenate([pair.z[: BELIEFS.size], own])
            keep(body, (candidate.name,), solve(pair.problem, Model(candidates=(candidate,)), z, pair.states))
