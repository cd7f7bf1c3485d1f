# SPDX-License-Identifier: MIT
"""Bayesian model comparison of the fitted candidates: one effect, two, none, or an unknown one.

Two questions are separate. Which known candidate explains the trials best follows from the evidence, which penalises
every extra parameter. Whether the best one explains them at all follows from its misfit:

    p(c) = w_c a(m_c),   w_c = prior_c exp((L_c - L_none - d) / T) / sum,   p(unknown) = 1 - sum p(c)

with the log evidence L_c in nats relative to the nominal model, a threshold d that only effects pay (chance gains of
the search), a temperature T > 1 because trials of one recording share model errors, the misfit m_c of the fit, and
a(m), the probability that the right candidate leaves a misfit of m (logistic in ln m). An effect that does not predict
held-out trials better has no gain, whatever its evidence, but where bounces make them chaotic, and is never sure there;
where one predicts them down to the noise, unknown yields to it, whatever its misfit. ``none`` is never said while the
nominal model's held-out error is many times noise and grain (the simulator's own uncertainty), all trials together or
each over its own, nor while what it leaves of whole trials bends as under a force that is missing, nor while friction
and restitution outside their plausible ranges explain the trials far better: what it would get goes to ``unknown``.
However large the evidence, a small share of every probability stays spread over all answers: for what no model of the
errors knows of, in the search and in the models themselves. The constants (``comparison_settings``) were set on
captures of known cause made by other simulators (docs/diagnosis.md).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.registry import effects
from .against_none import against_none, nominal_or_refitted, worsens
from .comparison_settings import VOCABULARY, ComparisonSettings
from .diagnosis import NONE, SAME, UNKNOWN, Verdict
from .fits import CandidateFit, FittedModels
from .report.effect_words import effect_label

TWINS: Mapping[str, tuple[str, ...]] = {
    "time_scale": ("buoyancy",),
    "buoyancy": ("time_scale",),
    "air_drag": ("wind",),
}
"""Effects with the same rigid motion, or containing it: if one is named, so is the other."""

CONTAINING = ("wind",)
"""Effects that are another one with more numbers: air drag is wind in still air."""

MOST_ALTERNATIVES = 4

BETTER = "an effect explains the trials far better"
"""Why it is not ``none`` where nothing speaks against it."""

TWIN_SHARE = 0.003
"""A twin is named from this fraction of the verdict's probability on."""


@dataclass(frozen=True, kw_only=True)
class ModelComparison:
    """probabilities: by name, including ``none`` and ``unknown``; they sum to 1. best: the fit behind each name.

    reasons: why each effect is not the verdict, in a few words.
    """

    verdict: Verdict
    probabilities: Mapping[str, float]
    best: Mapping[str, CandidateFit]
    reasons: Mapping[str, str]


def compare_models(fits: FittedModels, weighing: ComparisonSettings) -> ModelComparison:
    """Return verdict and probabilities. A pair of effects counts for its first effect."""
    worth = (c for c in fits.candidates if _worth_it(c, fits.candidates))
    candidates = [nominal_or_refitted(fits), *worth]
    grain = math.hypot(fits.floor_rms_m, fits.grain_rms_m)
    against = against_none(fits, weighing)
    weights = _weights(candidates, weighing, grain, far=against.left == 0.0)
    adequate = [_adequacy(c, candidates[0].misfit, weighing) * _shown(c, candidates[0], weighing) for c in candidates]
    adequate[0] *= against.left
    shares = [w * a for w, a in zip(weights, adequate, strict=True)]
    predicted = [_predicted(c, fits, weighing) for c in candidates]
    if max(predicted) > 0:
        # What predicts held-out trials down to the noise is an explanation: unknown yields to it.
        claims = np.array(predicted) * (np.array(weights) + 1e-12)
        yielded = max(predicted) * max(0.0, 1.0 - sum(shares))
        shares = [s + yielded * c for s, c in zip(shares, claims / claims.sum(), strict=True)]
    probabilities, best = _by_name(candidates, shares)
    top = max(probabilities, key=lambda n: probabilities[n])
    named, behind = _by_name(candidates, shares, causes=(top, *best[top].effects[1:]))
    if max(named, key=lambda n: named[n]) == top:
        probabilities, best = named, behind
    probabilities[UNKNOWN] = max(0.0, 1.0 - sum(probabilities.values()))
    total = sum(probabilities.values())
    barred = {NONE} if against.said else set()
    probabilities = _never_sure({name: p / total for name, p in probabilities.items()}, weighing.lapse, barred)
    verdict = _verdict(probabilities, best, weighing)
    reasons = {
        name: _reason(fit, best, fits, weighing) if fit.effects else against.said or BETTER
        for name, fit in best.items()
        if name not in (verdict.effect, *verdict.effects, *verdict.alternatives)
    }
    return ModelComparison(verdict=verdict, probabilities=probabilities, best=best, reasons=reasons)


def _by_name(
    candidates: Sequence[CandidateFit], shares: Sequence[float], causes: Sequence[str] = ()
) -> tuple[dict[str, float], dict[str, CandidateFit]]:
    """Return the sum of ``shares`` by the effect that each candidate counts for, and the likeliest candidate of each.

    That is its first effect. causes: effects of the likeliest pair, the first one first: another pair that has one of
    the others counts for the effect that it has beside that, in place of the first.
    """
    probabilities: dict[str, float] = {}
    best: dict[str, tuple[float, CandidateFit]] = {}
    for fit, share in zip(candidates, shares, strict=True):
        name = fit.effects[0] if fit.effects else NONE
        if len(fit.effects) > 1 and name in causes[1:] and causes[0] not in fit.effects:
            name = fit.effects[1]
        probabilities[name] = probabilities.get(name, 0.0) + float(share)
        if name not in best or share > best[name][0]:
            best[name] = (float(share), fit)
    return probabilities, {name: fit for name, (_, fit) in best.items()}


def _never_sure(probabilities: Mapping[str, float], lapse: float, barred: Collection[str]) -> dict[str, float]:
    """Return ``probabilities``, the share ``lapse`` of them spread over all answers, tested or not, but ``barred``."""
    each = lapse / (VOCABULARY + 2)
    found = {name: (1.0 - lapse) * p + each * (name not in barred) for name, p in probabilities.items()}
    found[UNKNOWN] += max(0.0, 1.0 - sum(found.values()))
    return found


RESOLVABLE = 1.5
"""Gap over noise floor below which gap closure is not resolvable."""


def closed_fraction(before: float, after: float, floor: float) -> float:
    """Return (before - after) / (before - floor), from -1 to 1; NaN where the gap is not resolvable.

    A model that is better than the floor closes all of the gap; one that doubles it, or worse, counts as -1.
    """
    if not before > RESOLVABLE * floor or not math.isfinite(after):
        return math.nan
    return min(max((before - after) / (before - floor), -1.0), 1.0)


def _predicted(fit: CandidateFit, fits: FittedModels, weighing: ComparisonSettings) -> float:
    """Return how far ``fit`` counts as an explanation because it predicts held-out trials: 0 to 1."""
    closed = closed_fraction(fits.nominal.heldout_rms_m, fit.heldout_rms_m, fits.floor_rms_m)
    low, high = weighing.predicted
    return min(max((closed - low) / (high - low), 0.0), 1.0) if fit.effects and math.isfinite(closed) else 0.0


def _reason(
    fit: CandidateFit, best: Mapping[str, CandidateFit], fits: FittedModels, weighing: ComparisonSettings
) -> str:
    """Return why the effects of ``fit`` are not the verdict, in a few words."""
    nominal = nominal_or_refitted(fits)
    if not math.isfinite(fit.log_evidence) or not math.isfinite(fit.heldout_rms_m):
        return "its simulation failed"
    if abs(fit.heldout_rms_m - nominal.heldout_rms_m) <= 1e-6 * nominal.heldout_rms_m:
        return SAME
    if _left(fit, nominal) >= weighing.predicts:
        which = "" if fit.heldout_rms_m >= weighing.predicts * nominal.heldout_rms_m else "most "
        return f"predicts {which}held-out trials no better than the nominal model"
    gain = fit.log_evidence - nominal.log_evidence
    if gain < weighing.fee:
        return "gains too little for its parameters"
    top = max((f for f in best.values() if f.effects), key=lambda f: f.log_evidence)
    better, verb = " and ".join(effect_label(n) for n in top.effects), "fits" if len(top.effects) == 1 else "fit"
    if top.log_evidence - fit.log_evidence > weighing.fee:
        return f"{better} {verb} the trials far better"
    if fit.misfit <= 1 and top is not fit:
        return f"{better} {verb} the trials better"
    return f"leaves {fit.misfit:.1f} times the noise unexplained"


def _singles(fit: CandidateFit, candidates: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Return the single effects of the pair ``fit``; [] of a single effect."""
    return [c for c in candidates if len(c.effects) == 1 < len(fit.effects) and c.effects[0] in fit.effects]


def _worth_it(fit: CandidateFit, candidates: Sequence[CandidateFit]) -> bool:
    """Return whether a pair leaves less than the better one of its effects; always True for single effects."""
    if len(fit.effects) < 2:
        return True
    singles = _singles(fit, candidates)
    if len(singles) < len(fit.effects):
        return False
    best = max(singles, key=lambda c: c.log_evidence)
    return fit.misfit < best.misfit and fit.log_evidence > best.log_evidence


def _second_fee(fit: CandidateFit, candidates: Sequence[CandidateFit], weighing: ComparisonSettings) -> float:
    """Return the nats that a pair pays for its second effect; 0 for a single effect."""
    singles = _singles(fit, candidates)
    if not singles:
        return 0.0
    left = max(_left(fit, c) for c in singles)
    if not left < weighing.predicts:
        return weighing.second_fee + weighing.unseen_fee
    return weighing.second_fee * _unsure(left, weighing)


def _unsure(left: float, weighing: ComparisonSettings) -> float:
    """Return the part of a fee that is due where held-out trials are left with ``left`` of their error: 1 to 0."""
    share = math.log(max(left, 1e-9) / weighing.clearly) / math.log(weighing.predicts / weighing.clearly)
    return min(max(share, 0.0), 1.0)


def _weights(
    candidates: Sequence[CandidateFit], weighing: ComparisonSettings, grain: float, *, far: bool
) -> list[float]:
    """Return the weights of ``candidates``, the nominal model first. far: held-out trials exclude that one."""
    nominal = candidates[0]
    logs = []
    for fit in candidates:
        # A second cause is as improbable as the first one.
        each = (1 - weighing.prior_none) / VOCABULARY
        prior = each ** len(fit.effects) if fit.effects else weighing.prior_none
        if fit.effects and any(_same_motion(fit, other) for other in candidates):
            prior /= 2
        prior *= weighing.containing ** sum(name in CONTAINING for name in fit.effects)
        gain = _gain(fit, nominal, weighing, grain) - _second_fee(fit, candidates, weighing)
        logs.append(math.log(prior) + gain / weighing.temperature)
    likeliest = max(range(1, len(logs)), key=lambda i: logs[i], default=0)
    if likeliest:
        # What held-out trials ask for, and get, is no chance gain of a search that has not seen them.
        due = _unsure(_left(candidates[likeliest], nominal), weighing) if far else 1.0
        logs[1:] = [log - due * weighing.fee / weighing.temperature for log in logs[1:]]
    highest = max(logs)
    raw = np.exp(np.array(logs) - highest)
    return [float(w) for w in raw / raw.sum()]


def _same_motion(fit: CandidateFit, other: CandidateFit) -> bool:
    """Return whether both are single effects that are two names of one motion, which share its prior."""
    names = {*fit.effects, *other.effects}
    return names == {"time_scale", "buoyancy"} and fit.log_evidence == other.log_evidence


def _left(fit: CandidateFit, other: CandidateFit) -> float:
    """Return the held-out error of ``fit`` over that of ``other``.

    Each trial counts by what noise and contacts make of it, where that is known: of a body that may come to lie on
    another face the distance says little, and the largest one would decide.
    """
    if math.isfinite(fit.heldout_chi) and math.isfinite(other.heldout_chi):
        return fit.heldout_chi / max(other.heldout_chi, 1e-12)
    if not math.isfinite(fit.heldout_rms_m):
        return math.inf
    return fit.heldout_rms_m / max(other.heldout_rms_m, 1e-12)


def _gain(fit: CandidateFit, nominal: CandidateFit, weighing: ComparisonSettings, grain: float) -> float:
    """Return the nats over the nominal model that count for ``fit``. grain: noise and grain together, m."""
    if fit is nominal:
        return 0.0
    gain = fit.log_evidence - nominal.log_evidence
    if math.isnan(gain) or not math.isfinite(fit.log_evidence):
        return -math.inf
    if worsens(fit, nominal, weighing):
        gain = min(gain, 0.0)
    if _left(fit, nominal) >= weighing.predicts:
        # Where bounces make held-out motion chaotic it shows nothing, and a large gain stands.
        gain = min(gain, max(gain - weighing.unseen_fee, 0.0) if nominal.heldout_rms_m < grain else 0.0)
    return gain


def _shown(fit: CandidateFit, nominal: CandidateFit, weighing: ComparisonSettings) -> float:
    """Return the most that ``fit`` may claim after its prediction of held-out trials: less where their error grows."""
    left = _left(fit, nominal)
    if not fit.effects or left < weighing.predicts or not math.isfinite(nominal.heldout_rms_m):
        return 1.0
    if math.isfinite(fit.limit):
        # Of a deformable body trials and held-out motion are simulated on the same lattices: what only the trials
        # gain may be the lattice's own error.
        return 0.0
    return weighing.unshown * min(1.0, 1.0 / left) if math.isfinite(left) else 0.0


def _adequacy(fit: CandidateFit, nominal: float, weighing: ComparisonSettings) -> float:
    """Return the probability that the right candidate leaves the misfit of ``fit`` where the nominal model leaves
    ``nominal``: one half at its limit, and at a misfit of 1 the same whatever the limit."""
    misfit, sharpness = fit.misfit, weighing.sharpness
    if not math.isfinite(misfit) or misfit <= 0:
        return 0.0
    # A candidate that removes nine tenths of a large misfit may leave more than one that removes little.
    left = misfit / nominal if math.isfinite(nominal) and nominal > 0 else 1.0
    explained = min(max((0.6 - left) / 0.3, 0.0), 1.0)
    enough = weighing.enough + explained * (weighing.enough_explained - weighing.enough)
    if math.isfinite(fit.limit):
        enough = fit.limit
        sharpness *= math.log(weighing.enough) / math.log(enough)
    exponent = sharpness * math.log(misfit / enough)
    return 1.0 / (1.0 + math.exp(min(max(exponent, -60.0), 60.0)))


def _verdict(
    probabilities: Mapping[str, float], best: Mapping[str, CandidateFit], weighing: ComparisonSettings
) -> Verdict:
    name = max(probabilities, key=lambda n: probabilities[n])
    top = probabilities[name]
    share = weighing.alternative if name not in (NONE, UNKNOWN) else 2 * weighing.alternative
    causes = best[name].effects if name in best else ()
    others = [
        n
        for n in sorted(probabilities, key=lambda n: -probabilities[n])
        if n not in (name, UNKNOWN, NONE)
        # One of several causes is an alternative alone, not with a third one.
        and not (n in causes and len(best[n].effects) > 1)
        and probabilities[n] >= top * (TWIN_SHARE if n in TWINS.get(name, ()) else share)
    ][:MOST_ALTERNATIVES]
    if name in (NONE, UNKNOWN):
        return Verdict(effect=name, probability=top, alternatives=tuple(others))
    if len(best[name].effects) > 1:
        # Pairs are tried with one of two that are the same motion.
        same = [t for n in best[name].effects if n not in ("air_drag", "wind") for t in TWINS.get(n, ())]
        others += [t for t in same if t in best and t not in (*others, *best[name].effects)]
    return Verdict(effect=name, probability=top, alternatives=tuple(others), effects=best[name].effects)


def kind_of(name: str) -> str:
    """Return the kind of the effect ``name``; "none" and "unknown" are their own kinds."""
    return name if name in (NONE, UNKNOWN) else effects()[name].kind
