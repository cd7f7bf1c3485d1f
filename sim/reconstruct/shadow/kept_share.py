# SPDX-License-Identifier: MIT
"""How likely each pixel of the ground lies in a shadow: what the bodies cast, as far as the ground's colours agree.

For every pixel the share of light that it keeps is one of a few levels. Before looking, the level is what the bodies
cast there or near by; then each level is as likely as the colour that the ground would have without it (Bayes).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..light.ground_light import smooth_terms
from .ground_colour import Texture, fit_smooth, grain, relative
from .ground_pixels import GroundPixels

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

SHADOW_RATIO = 0.9
"""Ground that keeps less than this share of its light is shadow."""
PENUMBRA_RATIO = 0.95
"""The same for what must go with a shadow, or its soft border stays behind."""
LEVELS = np.array([1.0, 0.965, 0.93, 0.87, 0.80, 0.72, 0.63, 0.54, 0.45, 0.36, 0.28, 0.20, 0.12, 0.06])
IN_SHADOW, IN_PENUMBRA = LEVELS < SHADOW_RATIO, LEVELS < PENUMBRA_RATIO
LOGS = np.log(LEVELS)
ALIKE = np.exp(-0.5 * ((LOGS[:, None] - LOGS) / np.maximum(0.04, -0.12 * LOGS)[:, None]) ** 2)
ALIKE /= ALIKE.sum(axis=1, keepdims=True)
"""(levels, levels) How a shadow's depth changes from one pixel to the next."""
DEEP = LEVELS < 0.76
"""Levels that stand out from uneven light: only these go on where no body foresees them."""
GAPS = -0.4 * np.gradient(LOGS)
"""A level stands for those around it."""
ROUGH = 0.05
"""How far the edge of a cast shadow may be off, over the side of the object."""
UNFORESEEN = 0.03
"""Probability that the bodies say nothing about a pixel: then it is lit nine times in ten."""
CONTACT, CONTACT_LOSS = 0.3, 0.85
"""Probability that a soft light gives contact shadows, whatever was found; and k in it (``light_fit``)."""
WORST = 4.0
"""What one pixel may say, as a log likelihood ratio."""
ROUNDS = 3
SMOOTH, COUPLING = 0.025, 4.0
"""Reach of a pixel's neighbourhood over the side of the object, and what it says, as a log odds."""
GROWTH = (0.03,) * 8
"""Reach of what neighbours say about a pixel's level, over the side of the object, step by step."""
ALONG = 0.7
"""What they count against the bodies' cast shadow."""
TINT_SPREAD, MOST_TINT = 0.2, 0.4
"""Of a shadow's colour: change of a log chroma over that of the log luminance."""


def kept_levels(ground: GroundPixels, kept: Values, hidden: Values) -> Values:
    """Probability (N, levels) that pixels of ``ground`` keep each of ``LEVELS`` of their light.

    kept: (N,) share of light that the bodies leave them. hidden: (N,) share of the sky that they hide.
    """
    prior = (1.0 - CONTACT) * _prior(ground, kept) + CONTACT * _prior(ground, 1.0 - CONTACT_LOSS * hidden)
    posterior = prior
    reached = prior @ IN_SHADOW > 0.15
    terms = smooth_terms(ground.places)
    for _ in range(ROUNDS):
        lit = posterior @ (LEVELS > 0.95)
        depth = posterior @ LOGS
        weight = ground.weight * (0.02 + lit)
        smooth = terms @ fit_smooth(ground.colour - depth[:, None], terms, weight)
        samples = relative(ground.colour, smooth)
        tint = _tint(samples, depth, lit)
        texture = Texture(samples - np.column_stack([depth, depth[:, None] * tint]), weight, grain(ground, samples))
        likelihood = np.empty_like(prior)
        for index, log in enumerate(LOGS):
            bare = samples - log * np.array([1.0, *tint])
            likelihood[:, index] = texture.likelihood(bare, GAPS[index], TINT_SPREAD * -log)
        likelihood = np.maximum(likelihood - likelihood.max(axis=1, keepdims=True), -WORST)
        for index in range(len(LEVELS)):
            likelihood[:, index] = ground.blurred(likelihood[:, index], 1.2)
        posterior, reached = _grown(ground, prior, np.exp(likelihood), reached)
    return posterior


def shadow_probability(ground: GroundPixels, posterior: Values, part: Values) -> tuple[Values, Values]:
    """Probability (N,) that pixels of ``ground`` lie in shadow, and (N,) that they lie in it or in its soft border.

    posterior: (N, levels) of ``kept_levels``. part: (N,) how much of the lost light, as a logarithm, one object takes
    alone: shadow is only what it makes darker itself.
    """
    shadow = (posterior * (part[:, None] * LOGS < math.log(SHADOW_RATIO))).sum(axis=1)
    penumbra = posterior @ IN_PENUMBRA
    return _coherent(ground, shadow), _coherent(ground, penumbra)


def _grown(ground: GroundPixels, prior: Values, likelihood: Values, reached: Mask) -> tuple[Values, Mask]:
    """Posterior (N, levels) where a shadow goes on as deep as it is beside, as far as the colours agree.

    So it also finds what rough bodies, a wrong light, or a second lamp did not foresee. A mean field: what a pixel's
    neighbours are is part of its prior, first far around, then near by. reached: (N,) pixels from which a shadow may
    go on; also returned with those that it has gone on to.
    """
    posterior = _normalised(prior * likelihood)
    for reach in GROWTH:
        sigma = max(1.5, reach * ground.object_side)
        deep = np.column_stack([ground.blurred(column, sigma) for column in (posterior * reached[:, None])[:, DEEP].T])
        goes_on = ALONG * deep @ ALIKE[DEEP]
        reached = reached | (goes_on.sum(axis=1) > 0.1)
        posterior = _normalised(((1.0 - goes_on.sum(axis=1, keepdims=True)) * prior + goes_on) * likelihood)
    return posterior, reached


def _normalised(values: Values) -> Values:
    return np.asarray(values / values.sum(axis=1, keepdims=True))


def _coherent(ground: GroundPixels, probability: Values) -> Values:
    """``probability`` (N,) where neighbours lie in the same shadow as a rule (mean field of an Ising model)."""
    sigma = max(1.5, SMOOTH * ground.object_side)
    alone = np.log(np.maximum(probability, 1e-6) / np.maximum(1.0 - probability, 1e-6))
    for _ in range(6):
        around = ground.blurred(probability, sigma)
        probability = 1.0 / (1.0 + np.exp(-alone - COUPLING * (2.0 * around - 1.0)))
    return probability


def _prior(ground: GroundPixels, kept: Values) -> Values:
    """Probability (N, levels) before the colours are looked at: the cast shadow, as blurred as the bodies are rough."""
    level = np.abs(np.log(kept)[:, None] - LOGS).argmin(axis=1)
    sigma = max(1.5, ROUGH * ground.object_side)
    prior = np.zeros((len(kept), len(LEVELS)))
    for index in np.unique(level):
        here = level == index
        prior[:, index] = 0.75 * ground.blurred(here, sigma) + 0.25 * ground.blurred(here, 3.0 * sigma)
    # Depths are modelled roughly too.
    spread = np.exp(-0.5 * ((LOGS[:, None] - LOGS) / np.maximum(0.06, -0.35 * LOGS)[:, None]) ** 2)
    prior = prior @ (spread / spread.sum(axis=1, keepdims=True))
    lit = LEVELS > 0.95
    unforeseen = np.where(lit, 0.9 / lit.sum(), 0.1 / (~lit).sum())
    prior = (1.0 - UNFORESEEN) * prior + UNFORESEEN * unforeseen
    return np.asarray(prior / prior.sum(axis=1, keepdims=True))


def _tint(samples: Values, depth: Values, lit: Values) -> Values:
    """Change (2,) of the chromas in the shadow over that of the log luminance: a sky's shadows are bluish."""
    usual = np.median(samples[lit > 0.8][:, 1:], axis=0) if (lit > 0.8).any() else np.zeros(2)
    deep = depth < -0.2
    if deep.sum() < 30:
        return np.zeros(2)
    slope = np.median((samples[deep][:, 1:] - usual) / depth[deep, None], axis=0)
    return np.asarray(np.clip(slope, -MOST_TINT, MOST_TINT))
