# SPDX-License-Identifier: MIT
"""Constants of the model comparison, set on captures of known cause made by other simulators."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """Constants of the decision.

    temperature: T above, at least 1. fee: d above, nats; where held-out trials exclude ``none``, it falls like
        second_fee with the error that the likeliest effect leaves them.
    predicts: fraction of the nominal model's held-out error that an effect must stay below.
    worsens: factor on the nominal misfit, if that is above 1, from which an effect has no gain. It contains the nominal
        model: what leaves so much more, as where its contacts are surer and wrong, explains nothing.
    enough: misfit at which a(m) is one half for a candidate that hardly lowers the nominal misfit; enough_explained:
        the same for one that removes most of it.
    sharpness: slope of a(m) in ln m.
    prior_none: prior probability that nothing is missing; the effects share the rest.
    containing: prior of an effect that contains another one (``CONTAINING``), relative to it: numbers that the trials
        leave open cost no evidence.
    unseen_fee: nats that an effect pays more where it predicts held-out trials no better, and the nominal model's error
        there is within noise and grain, so that they cannot judge; else it has no gain at all.
    unshown: largest probability of an effect that predicts held-out trials no better; where their error grows, it is
        divided by the same factor, and ``unknown`` gets the rest.
    second_fee: nats that a second effect pays, beside its prior; with unseen_fee where the pair predicts held-out
        trials no better than its better single effect.
    clearly: fraction of the better single effect's held-out error at which a pair pays no second_fee, and of the
        nominal model's at which effects pay no fee where ``none`` is excluded; both fall from ``predicts`` on: states
        between contacts absorb what an effect explains there, so that the evidence hardly shows it; held-out trials,
        predicted through their contacts, do.
    predicted: closed fractions of the gap from which an effect begins to count, and fully counts, as an explanation.
    many: factor on noise floor and grain together above which the nominal model's held-out error excludes ``none``.
    chance: probability, if noise and grain are all there is, of held-out trials so far off that they exclude ``none``.
    bends: nats of ``CandidateFit.bending`` from which ``unknown`` is likelier than ``none``: odds of 100 to 1, because
        a slow error of another memory bends a little, too.
    lapse: share that is spread evenly over the vocabulary, ``none`` and ``unknown``; what falls to effects that were
        not tested goes to ``unknown``. From Laplace's rule of succession on sure verdicts (docs/measurements.md).
    alternative: effects with at least this fraction of the verdict's probability are named as alternatives.
    """

    temperature: float = 4.0
    fee: float = 8.0
    predicts: float = 0.97
    worsens: float = 2.0
    enough: float = 1.7
    enough_explained: float = 3.0
    sharpness: float = 8.0
    prior_none: float = 0.3
    containing: float = 0.2
    unseen_fee: float = 100.0
    unshown: float = 0.9
    second_fee: float = 20.0
    clearly: float = 0.5
    predicted: tuple[float, float] = (0.9, 0.98)
    many: float = 3.0
    chance: float = 0.001
    bends: float = math.log(100.0)
    lapse: float = 0.02
    alternative: float = 0.1


VOCABULARY = 19
"""Number of effects that share the prior, whichever were tested."""

SHARED = 4.0
"""Factor on the variance of parameters: trials of one recording share model errors. The same as ``temperature``, and
what the truth's distance from the fits shows (docs/measurements.md)."""
