# SPDX-License-Identifier: MIT
"""Bayesian model comparison of the fitted candidates: one effect, two, none, or an unknown one.

Two questions are separate. Which known candidate explains the trials best follows from the evidence, which penalises
every extra parameter. Whether the best one explains them at all follows from its misfit:

    p(c) = w_c a(m_c),   w_c = prior_c exp((L_c - L_none - d) / T) / sum,   p(unknown) = 1 - sum p(c)

with the log evidence L_c in nats relative to the nominal model, a threshold d that only effects pay (chance gains of
the search), a temperature T > 1 because trials of one recording share model errors, the misfit m_c of the fit, and
a(m), the probability that the right candidate leaves a misfit of m (logistic in ln m). An effect that does not predict
held-out trials better has no gain, whatever its evidence. The constants were set on captures of known cause made by
other simulators (docs/diagnosis.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.registry import effects
from .diagnosis import NONE, UNKNOWN, CandidateFit, Fits, Verdict


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """Constants of the decision.

    temperature: T above, at least 1. fee: d above, nats.
    predicts: fraction of the nominal model's held-out error that an effect must stay below.
    enough: misfit at which a(m) is one half for a candidate that hardly lowers the nominal misfit; enough_explained:
        the same for one that removes most of it.
    sharpness: slope of a(m) in ln m.
    prior_none: prior probability that nothing is missing; the effects share the rest.
    second_gain, second_misfit: a pair of effects counts only if it gains more than this many nats over each single
        one, and each single one leaves more than this many times its misfit.
    alternative: effects with at least this fraction of the verdict's probability are named as alternatives.
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
"""Number of effects that share the prior, whichever were tested."""

TWINS: Mapping[str, tuple[str, ...]] = {
    "time_scale": ("buoyancy",),
    "buoyancy": ("time_scale",),
    "air_drag": ("wind",),
}
"""Effects with the same rigid motion, or containing it: if one is named, so is the other."""

MOST_ALTERNATIVES = 4

TWIN_SHARE = 0.003
"""A twin is named from this fraction of the verdict's probability on."""


@dataclass(frozen=True, kw_only=True)
class ModelComparison:
    """probabilities: by name, including ``none`` and ``unknown``; they sum to 1. best: the fit behind each name."""

    verdict: Verdict
    probabilities: Mapping[str, float]
    best: Mapping[str, CandidateFit]


def compare_models(fits: Fits, weighing: ComparisonSettings) -> ModelComparison:
    """Return verdict and probabilities. A pair of effects counts for its first effect."""
    candidates = [nominal_or_refitted(fits), *(c for c in fits.candidates if _worth_it(c, fits.candidates, weighing))]
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
    return ModelComparison(verdict=_verdict(probabilities, found, weighing), probabilities=probabilities, best=found)


def nominal_or_refitted(fits: Fits) -> CandidateFit:
    """Return the model behind ``none``: nominal, or re-fitted within its plausible ranges if that has more evidence."""
    within = not fits.refitted.effects and fits.refitted.log_evidence > fits.nominal.log_evidence
    return fits.refitted if within else fits.nominal


def _worth_it(fit: CandidateFit, candidates: Sequence[CandidateFit], weighing: ComparisonSettings) -> bool:
    """Return whether a second effect explains what the first leaves; always True for single effects."""
    if len(fit.effects) < 2:
        return True
    singles = [c for c in candidates if len(c.effects) == 1 and c.effects[0] in fit.effects]
    if len(singles) < len(fit.effects):
        return False
    gained = min((fit.log_evidence - c.log_evidence for c in singles), default=math.inf)
    better = min((c.misfit for c in singles), default=math.inf) > weighing.second_misfit * fit.misfit
    return bool(gained > weighing.second_gain and better)


def _weights(candidates: Sequence[CandidateFit], weighing: ComparisonSettings) -> list[float]:
    nominal = candidates[0]
    logs = []
    for fit in candidates:
        # A second cause is as improbable as the first one.
        each = (1 - weighing.prior_none) / VOCABULARY
        prior = each ** len(fit.effects) if fit.effects else weighing.prior_none
        logs.append(math.log(prior) + _gain(fit, nominal, weighing) / weighing.temperature)
    highest = max(logs)
    raw = np.exp(np.array(logs) - highest)
    return [float(w) for w in raw / raw.sum()]


def _gain(fit: CandidateFit, nominal: CandidateFit, weighing: ComparisonSettings) -> float:
    """Return the nats over the nominal model that count for ``fit``."""
    if fit is nominal:
        return 0.0
    gain = fit.log_evidence - nominal.log_evidence
    if math.isnan(gain) or not math.isfinite(fit.log_evidence):
        return -math.inf
    if fit.heldout_rms_m >= weighing.predicts * nominal.heldout_rms_m:
        gain = min(gain, 0.0)
    return gain - weighing.fee


def _adequacy(misfit: float, nominal: float, weighing: ComparisonSettings) -> float:
    """Return the probability that the right candidate leaves ``misfit`` where the nominal model leaves ``nominal``."""
    if not math.isfinite(misfit) or misfit <= 0:
        return 0.0
    # A candidate that removes nine tenths of a large misfit may leave more than one that removes little.
    left = misfit / nominal if math.isfinite(nominal) and nominal > 0 else 1.0
    explained = min(max((0.6 - left) / 0.3, 0.0), 1.0)
    enough = weighing.enough + explained * (weighing.enough_explained - weighing.enough)
    exponent = weighing.sharpness * math.log(misfit / enough)
    return 1.0 / (1.0 + math.exp(min(max(exponent, -60.0), 60.0)))


def _verdict(
    probabilities: Mapping[str, float], best: Mapping[str, CandidateFit], weighing: ComparisonSettings
) -> Verdict:
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
    """Return the kind of the effect ``name``; "none" and "unknown" are their own kinds."""
    return name if name in (NONE, UNKNOWN) else effects()[name].kind
