# SPDX-License-Identifier: MIT
"""What speaks against ``none``: that nothing is missing beside what is believed of a capture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammainccinv

from .comparison_settings import VOCABULARY, ComparisonSettings
from .fits import CandidateFit, FittedModels


@dataclass(frozen=True, kw_only=True)
class AgainstNone:
    """What the models behind ``none`` leave that speaks against it.

    said: in a few words; "" if nothing does. left: factor on what ``none`` may claim.
    """

    said: str
    left: float


def against_none(fits: FittedModels, weighing: ComparisonSettings) -> AgainstNone:
    """Return what the models behind ``none`` leave that speaks against it."""
    far = _far_off(fits, weighing)
    if far:
        return AgainstNone(said=far, left=0.0)
    straight, held = _straight(fits, weighing), _contacts_held(fits, weighing)
    said = ""
    if held < 0.5:
        said = "friction and restitution outside their plausible ranges explain the trials far better"
    elif straight < 0.5:
        said = "what it leaves of whole trials bends as under a missing force"
    return AgainstNone(said=said, left=straight * held)


def _far_off(fits: FittedModels, weighing: ComparisonSettings) -> str:
    """Return, in a few words, that held-out trials are many times as far off as noise and grain make; "" if not."""
    models = fits.nominal, nominal_or_refitted(fits)
    if min(m.heldout_rms_m for m in models) > weighing.many * math.hypot(fits.floor_rms_m, fits.grain_rms_m):
        return f"its error is more than {weighing.many:g} times noise and the simulator's own uncertainty"
    if min(map(_surprise, models)) > _expected_surprise(models[0].heldout_trials, weighing):
        chi = min(m.heldout_chi for m in models)
        return f"held-out trials are {chi:.1f} times as far off as noise and the simulator's own uncertainty make each"
    return ""


MOST_ELSEWHERE = 3.0
"""A trial in which the body comes to lie on another face counts at most as this many times the median one: its distance
says that it fell the other way, not by how much the model is wrong."""


def _surprise(fit: CandidateFit) -> float:
    """Return the sum of squares of held-out trials, each over what noise and grain make of it."""
    trials = np.array(fit.heldout_trials)
    known = np.isfinite(trials)
    away = np.array(fit.heldout_elsewhere, dtype=bool) & known if fit.heldout_elsewhere else np.zeros_like(known)
    if known.sum() > 2:
        trials[away] = np.minimum(trials[away], MOST_ELSEWHERE * float(np.median(trials[known])))
    return float(np.sum(trials[known] ** 2))


def _expected_surprise(trials: Sequence[float], weighing: ComparisonSettings) -> float:
    """Return what ``_surprise`` exceeds with the probability ``chance``: the error of each trial is one number."""
    known = sum(math.isfinite(t) for t in trials)
    return 2.0 * float(gammainccinv(0.5 * known, weighing.chance)) if known else math.inf


def _straight(fits: FittedModels, weighing: ComparisonSettings) -> float:
    """Return the probability that what the models behind ``none`` leave is noise and tracking, by its ``bending``."""
    least = min(fits.nominal.bending, nominal_or_refitted(fits).bending)
    return 1.0 / (1.0 + math.expm1(min(least, 60.0)) * math.exp(-weighing.bends))


def _contacts_held(fits: FittedModels, weighing: ComparisonSettings) -> float:
    """Return the probability that contacts are as believed, and not as any other friction and restitution make them.

    Those are a cause as improbable as an effect, and pay its fee. Held-out trials need not be predicted better: what is
    missing need not be these two.
    """
    refitted = fits.refitted
    gain = refitted.log_evidence - fits.nominal.log_evidence
    if not refitted.effects or not math.isfinite(gain) or worsens(refitted, fits.nominal, weighing):
        return 1.0
    odds = math.exp(min((gain - weighing.fee) / weighing.temperature, 60.0))
    return 1.0 / (1.0 + odds * (1 - weighing.prior_none) / VOCABULARY / weighing.prior_none)


def worsens(fit: CandidateFit, nominal: CandidateFit, weighing: ComparisonSettings) -> bool:
    """Return whether ``fit`` leaves far more of the trials than the nominal model, which it contains."""
    return fit.misfit > weighing.worsens * max(1.0, nominal.misfit)


def nominal_or_refitted(fits: FittedModels) -> CandidateFit:
    """Return the model behind ``none``: nominal, or re-fitted within its plausible ranges if that has more evidence."""
    within = not fits.refitted.effects and fits.refitted.log_evidence > fits.nominal.log_evidence
    return fits.refitted if within else fits.nominal
