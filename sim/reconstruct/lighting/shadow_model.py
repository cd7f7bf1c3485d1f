# SPDX-License-Identifier: MIT
"""The shadow probability of each pixel of the ground, from its colours and the light past the objects.

For every pixel the share of light that it keeps is one of a few levels; its prior is the cast shadow
(``shadow_lamps``), its likelihood the frequency of the unshadowed colour on lit ground (Bayes).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.equirectangular import LUMINANCE
from .ground_lighting import smooth_terms
from .ground_pixels import GroundPixels, GroundTexture, fit_smooth, pixel_noise, relative_colour
from .shadow_lamps import shadow_tint

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]

SHADOW_RATIO = 0.9
"""Ground that keeps less than this share of its light is shadow."""
PENUMBRA_RATIO = 0.95
"""The same for the penumbra, which must be removed with the shadow."""
SHARPNESS = 1.2
"""Pixels over which a photo blurs the edge of a hard shadow: its rim is darkened too."""
LEVELS = np.array([1.0, 0.965, 0.93, 0.87, 0.80, 0.72, 0.63, 0.54, 0.45, 0.36, 0.28, 0.20, 0.12, 0.06])
IN_SHADOW, LIT = LEVELS < SHADOW_RATIO, LEVELS > 0.95
LOGS = np.log(LEVELS)
ALIKE = np.exp(-0.5 * ((LOGS[:, None] - LOGS) / np.maximum(0.04, -0.12 * LOGS)[:, None]) ** 2)
ALIKE /= ALIKE.sum(axis=1, keepdims=True)
"""(levels, levels) Transition probability of the level from one pixel to the next."""
DEEP = LEVELS < 0.76
"""Levels that stand out from uneven light: only these propagate where no body predicts them."""
GAPS = -0.4 * np.gradient(LOGS)
"""Half width of each level."""
ROUGH = 0.05
"""Error of a cast shadow's edge over the object's size."""
UNFORESEEN = 0.03
"""Probability that the bodies do not predict a pixel: then it is lit nine times in ten."""
CONTACT, CONTACT_LOSS = 0.3, 0.85
"""Probability of contact shadows by a soft light, whatever the fit; and k in it."""
WORST = 4.0
"""Limit of one pixel's log likelihood ratio."""
ROUNDS = 3
SMOOTH, COUPLING = 0.025, 4.0
"""Radius of a pixel's neighbourhood over the object's size, and its weight in log odds."""
GROWTH = (0.03,) * 8
"""Radius of propagation of levels over the object's size, step by step."""
ALONG = 0.7
"""Weight of the neighbours against the cast shadow."""
TINT_SPREAD = 0.2
"""Uncertainty of a shadow's tint: change of a log chroma over that of the log luminance."""
RIM_DEPTH, RIM_SPREADS = 0.5, 2.5
"""Lost light, as a logarithm, from which ground that touches an object is dark beside it; and the same over the spread
of the ground."""
RIM_GAP, RIM_REACH, RIM_INSIDE = 0.03, 0.25, 0.8
"""Distances over the object's size: of dark ground that touches it, and within which that must end; and the share of
its area that must lie within. What goes on is another surface."""
RIM_TINT = 0.4
"""Log chroma of all channels, over the depth, above which such ground is of another colour, not in shadow."""
RIM_SKY = 0.05
"""Share of the sky that the objects hide there at least: ground seen beside an object, but far from where it stands, is
dark for another reason."""
RIM_SHADOW = 0.5
"""Probability that such ground is in shadow, whatever the bodies predict: what stands close to the ground, a saucer or
the sill of a car, shades a strip that a rough proxy body does not."""


STEP, LEAST_STEP = 0.1, 0.005
"""Distance over the object's size within which a shadow's border is looked at; step of the logarithm that is noise."""


def light_level_posterior(ground: GroundPixels, kept: Values, hidden: Values, distance: Values) -> Values:
    """Return the probability (N, levels) that pixels of ``ground`` keep each of ``LEVELS`` of their light.

    kept: (N,) share of light past the bodies. hidden: (N,) share of the sky that they occlude. distance: (N,) from the
    nearest object, over the objects' size.
    """
    prior = (1.0 - CONTACT) * _prior(ground, kept) + CONTACT * _prior(ground, 1.0 - CONTACT_LOSS * hidden)
    rim = dark_rim(ground, prior, hidden, distance)
    prior[rim] = (1.0 - RIM_SHADOW) * prior[rim] + RIM_SHADOW * IN_SHADOW / IN_SHADOW.sum()
    posterior = prior
    reached = prior @ IN_SHADOW > 0.15
    terms = smooth_terms(ground.places, ground.extent)
    for _ in range(ROUNDS):
        lit, depth, weight, smooth = _unshaded(ground, terms, posterior)
        samples = relative_colour(ground.colour, smooth)
        usual = np.median(samples[lit > 0.8][:, 1:], axis=0) if (lit > 0.8).any() else np.zeros(2)
        tint = shadow_tint(samples, depth, usual)
        texture = GroundTexture(
            samples - np.column_stack([depth, depth[:, None] * tint]), weight, pixel_noise(ground, samples)
        )
        likelihood = np.empty_like(prior)
        for index, log in enumerate(LOGS):
            bare = samples - log * np.array([1.0, *tint])
            likelihood[:, index] = texture.likelihood(bare, GAPS[index], TINT_SPREAD * -log)
        likelihood = np.maximum(likelihood - likelihood.max(axis=1, keepdims=True), -WORST)
        for index in range(len(LEVELS)):
            likelihood[:, index] = ground.blurred(likelihood[:, index], 1.2)
        posterior, reached = _grown(ground, prior, np.exp(likelihood), reached)
    return posterior


def _unshaded(ground: GroundPixels, terms: Values, posterior: Values) -> tuple[Values, Values, Values, Values]:
    """The probability (N,) that pixels are lit, the logarithm (N,) of the light that they keep, and weight (N,) and
    smooth part (N, 3) in ``terms`` of the ground's colour without shadows."""
    lit, depth = posterior @ LIT, posterior @ LOGS
    weight = ground.weight * (0.02 + lit)
    return lit, depth, weight, terms @ fit_smooth(ground.colour - depth[:, None], terms, weight)


def dark_rim(ground: GroundPixels, prior: Values, hidden: Values, distance: Values) -> Mask:
    """Return (N,) whether pixels of ``ground`` belong to dark ground that touches an object and ends near it.

    prior: (N, levels) of the light that they keep; hidden, distance: as of ``light_level_posterior``.
    """
    lit, _, _, smooth = _unshaded(ground, smooth_terms(ground.places, ground.extent), prior)
    off = ground.colour - smooth
    luminance = off @ LUMINANCE
    chroma = np.linalg.norm(off - luminance[:, None], axis=1)
    spread = 1.48 * float(np.median(np.abs(luminance[lit >= np.median(lit)])))
    dark = luminance < -max(RIM_DEPTH, RIM_SPREADS * spread)
    # The darker, the less its tint is known; 0.5 as the least light is not zero.
    dark &= (chroma < RIM_TINT * (0.5 - luminance)) & (hidden > RIM_SKY)
    number, labels = cv2.connectedComponents((ground.picture(dark) > 0).astype(np.uint8), connectivity=8)
    own = labels.astype(np.int64)[ground.rows, ground.columns]
    area = np.bincount(own, minlength=number)
    keep = np.bincount(own[distance < RIM_GAP], minlength=number) > 0
    keep &= np.bincount(own[distance < RIM_REACH], minlength=number) > RIM_INSIDE * area
    keep[0] = False
    return np.asarray(keep[own])


def shadow_probability(
    ground: GroundPixels, posterior: Values, part: Values, owned: Mask
) -> tuple[Values, Values, Values]:
    """Return the probability (N,) that pixels of ``ground`` are in shadow, (N,) in shadow or penumbra, and the share
    (N,) of their light that is expected to be left in a picture as sharp as a photo.

    posterior: (N, levels) of ``light_level_posterior``. part: (N,) share of the lost light, as a logarithm, that one
    object blocks alone: only what it darkens itself is its shadow. owned: (N,) where all of the penumbra is its own.
    """
    logs = part[:, None] * LOGS
    inside = logs < math.log(SHADOW_RATIO)
    dim = np.where(owned[:, None], LOGS, logs) < math.log(PENUMBRA_RATIO)
    shadow = _coherent(ground, (posterior * inside).sum(axis=1))
    penumbra = _coherent(ground, (posterior * dim).sum(axis=1))
    light = np.exp(logs)
    kept = [
        (posterior * some * light).sum(axis=1) / ((posterior * some).sum(axis=1) + 1e-12) for some in (inside, ~inside)
    ]
    lit = shadow <= 0.5
    blurred = ground.blurred(np.where(lit, kept[1], kept[0]), SHARPNESS)
    return shadow, penumbra, np.where(lit, blurred, np.minimum(blurred, kept[0]))


def darkening_sums(ground: GroundPixels, left: Values, past_others: Values) -> tuple[float, float]:
    """Return two sums whose ratio is how much darker ``ground`` is seen to be over how much darker ``left`` (N,), the
    share of light that a shadow leaves it, says: about 1 for a shadow, 0 or less for another surface.

    The sums of several planes add up. past_others: (N,) share of light that the shadows of other objects leave. Only
    what changes within ``STEP`` of the object's size counts. Over more, the ground's colour without the shadow is not
    known: where it is a smooth field beside one surface, that field can make anything of another one.
    """
    sigma = max(2.0, STEP * ground.object_side)
    logs, others = (np.log(np.maximum(values, 0.02)) for values in (left, past_others))
    told, seen = (values - ground.blurred(values, sigma) for values in (logs, ground.colour @ LUMINANCE - others))
    # A shadow that claims no darkening is not contradicted: the ratio is 1 then.
    noise = len(told) * LEAST_STEP**2
    return float((told * seen).sum() + noise), float(np.square(told).sum() + noise)


def _grown(ground: GroundPixels, prior: Values, likelihood: Values, reached: Mask) -> tuple[Values, Mask]:
    """Posterior (N, levels) with shadows propagated to neighbours as far as the colours agree.

    This also finds shadows that the proxy bodies, a wrong light or a second lamp did not predict. A mean field: a
    pixel's neighbours are part of its prior, first far, then near. reached: (N,) pixels from which a shadow may
    propagate; also returned with those that it has reached.
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
    """``probability`` (N,) smoothed, as neighbours mostly lie in the same shadow (mean field of an Ising model)."""
    sigma = max(1.5, SMOOTH * ground.object_side)
    alone = np.log(np.maximum(probability, 1e-6) / np.maximum(1.0 - probability, 1e-6))
    for _ in range(6):
        around = ground.blurred(probability, sigma)
        probability = 1.0 / (1.0 + np.exp(-alone - COUPLING * (2.0 * around - 1.0)))
    return probability


def _prior(ground: GroundPixels, kept: Values) -> Values:
    """Prior (N, levels): the cast shadow, blurred because the bodies are rough."""
    level = np.abs(np.log(kept)[:, None] - LOGS).argmin(axis=1)
    sigma = max(1.5, ROUGH * ground.object_side)
    prior = np.zeros((len(kept), len(LEVELS)))
    for index in np.unique(level):
        here = level == index
        prior[:, index] = 0.75 * ground.blurred(here, sigma) + 0.25 * ground.blurred(here, 3.0 * sigma)
    # Depths are approximate too.
    spread = np.exp(-0.5 * ((LOGS[:, None] - LOGS) / np.maximum(0.06, -0.35 * LOGS)[:, None]) ** 2)
    prior = prior @ (spread / spread.sum(axis=1, keepdims=True))
    unforeseen = np.where(LIT, 0.9 / LIT.sum(), 0.1 / (~LIT).sum())
    prior = (1.0 - UNFORESEEN) * prior + UNFORESEEN * unforeseen
    return np.asarray(prior / prior.sum(axis=1, keepdims=True))
