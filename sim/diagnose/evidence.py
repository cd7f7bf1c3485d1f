# SPDX-License-Identifier: MIT
"""From fitted candidates to probabilities: which effect, or none, or one that nobody here knows.

Two questions are kept apart. Which of the known candidates explains the takes best is answered by their evidence, in
which every extra parameter is paid for. Whether the best one explains them at all is answered by what it leaves over:

    p(c) = w_c a(m_c),   w_c = prior_c exp((L_c - L_none - d) / T) / sum,   p(unknown) = 1 - sum p(c)

with the log evidence L_c in nats over that of the nominal model, an entry fee d that only effects pay (what search and
grain leave to chance), a temperature T > 1 because takes of one recording share what the model gets wrong, the misfit
m_c of the fit and a(m), how probable the right candidate would leave a misfit of m (a logistic curve in ln m). An
effect that does not predict takes better that it was not fitted to has no gain, whatever its evidence. The constants
were set on captures of known cause made by other simulators (docs/diagnosis.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.registry import effects
from .analysis import CandidateFit, Fits
from .diagnosis import NONE, UNKNOWN, Verdict


@dataclass(frozen=True, kw_only=True)
class Weighing:
    """Constants of the decision.

    temperature: T above, at least 1. fee: d above, nats.
    predicts: share of the nominal model's held-out error below which an effect has to come.
    enough: misfit at which the chance that the right candidate leaves that much is one half, where it hardly lowers the
        nominal model's; enough_explained: the same where it takes most of that away.
    sharpness: slope of that curve in ln m.
    prior_none: prior probability that nothing is missing; the effects share the rest.
    second_gain, second_misfit: a candidate of two effects counts only where it gains more nats than this over each of
        them alone, and each alone leaves more than so many times its misfit.
    alternative: an effect is named beside the verdict from this share of the verdict's probability on.
    """

    temperature: float = 4.0
    fee: float = 8.0
    predicts: float = 0.97
    enough: float = 1.7
    enough_explained: float = 3.0
    sharpness: float = 8.0
    prior_none: float = 0.3
    second_gain: float = 15.0
    second_misfit: float = 1.15
    alternative: float = 0.1


VOCABULARY = 18
"""Effects that share the prior: all of them, whichever were tried."""

TWINS: Mapping[str, tuple[str, ...]] = {
    "time_scale": ("buoyancy",),
    "buoyancy": ("time_scale",),
    "air_drag": ("wind",),
}
"""Effects that are the same motion for a rigid body, or contain it: whoever is named, so is the other."""

MOST_ALTERNATIVES = 4

TWIN_SHARE = 0.003
"""A twin is named from this share of the verdict's probability on."""


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """probabilities: by single name, ``none`` and ``unknown`` among them, together 1. best: fit behind each name."""

    verdict: Verdict
    probabilities: Mapping[str, float]
    best: Mapping[str, CandidateFit]


def weigh(fits: Fits, weighing: Weighing) -> Weighed:
    """Verdict and probabilities. A candidate of two effects counts for the first of its effects."""
    candidates = [unchanged(fits), *(c for c in fits.candidates if _worth_it(c, fits.candidates, weighing))]
    weights = _weights(candidates, weighing)
    adequate = [_adequacy(c.misfit, candidates[0].misfit, weighing) for c in candidates]
    probabilities: dict[str, float] = {}
    best: dict[str, tuple[float, CandidateFit]] = {}
    for fit, weight, chance in zip(candidates, weights, adequate, strict=True):
        name = fit.effects[0] if fit.effects else NONE
        probability = float(weight * chance)
        probabilities[name] = probabilities.get(name, 0.0) + probability
        if name not in best or probability > best[name][0]:
            best[name] = (probability, fit)
    probabilities[UNKNOWN] = max(0.0, 1.0 - sum(probabilities.values()))
    total = sum(probabilities.values())
    probabilities = {name: p / total for name, p in probabilities.items()}
    found = {name: fit for name, (_, fit) in best.items()}
    return Weighed(verdict=_verdict(probabilities, found, weighing), probabilities=probabilities, best=found)


def unchanged(fits: Fits) -> CandidateFit:
    """The model with nothing added, its own numbers within their plausible range: what ``none`` stands for."""
    within = not fits.refitted.effects and fits.refitted.log_evidence > fits.nominal.log_evidence
    return fits.refitted if within else fits.nominal


def _worth_it(fit: CandidateFit, candidates: Sequence[CandidateFit], weighing: Weighing) -> bool:
    """Whether a second effect explains what the first alone leaves; always true of a single one."""
    if len(fit.effects) < 2:
        return True
    singles = [c for c in candidates if len(c.effects) == 1 and c.effects[0] in fit.effects]
    if len(singles) < len(fit.effects):
        return False
    gained = min((fit.log_evidence - c.log_evidence for c in singles), default=math.inf)
    better = min((c.misfit for c in singles), default=math.inf) > weighing.second_misfit * fit.misfit
    return bool(gained > weighing.second_gain and better)


def _weights(candidates: Sequence[CandidateFit], weighing: Weighing) -> list[float]:
    nominal = candidates[0]
    logs = []
    for fit in candidates:
        # A second cause is as improbable beside the first as the first is by itself.
        each = (1 - weighing.prior_none) / VOCABULARY
        prior = each ** len(fit.effects) if fit.effects else weighing.prior_none
        logs.append(math.log(prior) + _gain(fit, nominal, weighing) / weighing.temperature)
    highest = max(logs)
    raw = np.exp(np.array(logs) - highest)
    return [float(w) for w in raw / raw.sum()]


def _gain(fit: CandidateFit, nominal: CandidateFit, weighing: Weighing) -> float:
    """Nats over the nominal model that count for ``fit``."""
    if fit is nominal:
        return 0.0
    gain = fit.log_evidence - nominal.log_evidence
    if math.isnan(gain) or not math.isfinite(fit.log_evidence):
        return -math.inf
    if fit.heldout_rms_m >= weighing.predicts * nominal.heldout_rms_m:
        gain = min(gain, 0.0)
    return gain - weighing.fee


def _adequacy(misfit: float, nominal: float, weighing: Weighing) -> float:
    """Chance that the right candidate would leave ``misfit`` where the nominal model leaves ``nominal``."""
    if not math.isfinite(misfit) or misfit <= 0:
        return 0.0
    # What explains nine tenths of a large misfit may leave more than what merely shaves a little off.
    left = misfit / nominal if math.isfinite(nominal) and nominal > 0 else 1.0
    explained = min(max((0.6 - left) / 0.3, 0.0), 1.0)
    enough = weighing.enough + explained * (weighing.enough_explained - weighing.enough)
    exponent = weighing.sharpness * math.log(misfit / enough)
    return 1.0 / (1.0 + math.exp(min(max(exponent, -60.0), 60.0)))


def _verdict(probabilities: Mapping[str, float], best: Mapping[str, CandidateFit], weighing: Weighing) -> Verdict:
    name = max(probabilities, key=lambda n: probabilities[n])
    top = probabilities[name]
    share = weighing.alternative if name not in (NONE, UNKNOWN) else 2 * weighing.alternative
    others = [
        n
        for n in sorted(probabilities, key=lambda n: -probabilities[n])
        if n not in (name, UNKNOWN, NONE)
        and probabilities[n] >= top * (TWIN_SHARE if n in TWINS.get(name, ()) else share)
    ][:MOST_ALTERNATIVES]
    if name in (NONE, UNKNOWN):
        return Verdict(effect=name, probability=top, alternatives=tuple(others))
    return Verdict(effect=name, probability=top, alternatives=tuple(others), effects=best[name].effects)


def kind_of(name: str) -> str:
    """Kind of the effect ``name``; "none" and "unknown" are kinds of their own."""
    return name if name in (NONE, UNKNOWN) else effects()[name].kind
