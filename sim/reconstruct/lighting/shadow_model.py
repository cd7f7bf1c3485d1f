# SPDX-License-Identifier: MIT
"""Fit the light that explains the ground's shadows, and the shadow probability of each pixel.

As in ``ground_lighting`` the ground keeps the share  (1 − q) (1 − k (1 − V)) + q v  of its light. Here bodies are
rough proxies and the ground has any texture, so a light is scored by the likelihood of the ground's colours without
its shadow. For every pixel the share of light that it keeps is one of a few levels; its prior is the cast shadow, its
likelihood the frequency of the unshadowed colour on lit ground (Bayes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ground_lighting import ShadowCaster, overcast_sky, smooth_terms, sun_disc
from .ground_pixels import GroundPixels, GroundTexture, ProxyBody, fit_smooth, pixel_noise, relative_colour

Values = NDArray[np.float64]

SEARCHED = 4000
"""Ground pixels used while lights are searched."""
HEIGHTS_DEG = (19.0, 25.0, 32.0, 41.0, 52.0, 66.0)
TURNS = 24
LOWEST, HIGHEST = math.radians(15.0), math.radians(87.0)
ANGLES = (0.05, 0.15, 0.4, 0.9)
"""rad; trial diameters of the sun: from the real one, blurred like the rough bodies, to a window nearby."""
SHARES = (0.15, 0.25, 0.4, 0.55, 0.7, 0.85)
LOSSES = (0.45, 0.7, 0.9)
SKY = 90
VISIBLE = 0.95
"""Share of light above which a pixel counts as lit."""
MOST = 3.0
"""Limit of one pixel's log likelihood ratio: neighbours share their texture, and rough bodies have wrong edges."""
UNCERTAIN, TINT = 0.13, 0.08
"""Uncertainty of a modelled shadow's log luminance and of its colour."""
SUN_GAIN = 25.0
"""Log likelihood gain required for a sun."""


@dataclass(frozen=True)
class ShadowLight:
    """slide: (2,) shadow length for a height of 1; angle: rad; share, loss: q and k. share 0: no sun."""

    slide: Values
    angle: float
    share: float
    loss: float
    gain: float


def fit_light(ground: GroundPixels, bodies: Sequence[ProxyBody]) -> ShadowLight:
    """Return the light under which ``bodies`` explain the colours of ``ground`` best."""
    count = len(ground.rows)
    chosen = np.arange(count)
    if count > SEARCHED:
        chosen = np.random.default_rng(0).choice(count, SEARCHED, replace=False)
    terms, colour = smooth_terms(ground.places)[chosen], ground.colour[chosen]
    fineness = pixel_noise(
        ground, relative_colour(ground.colour, np.broadcast_to(np.median(colour, axis=0), ground.colour.shape))
    )
    caster = ShadowCaster([body.points[::2] for body in bodies], ground.places[chosen])
    hidden = 1.0 - caster.reaching(*overcast_sky(SKY))
    best = ShadowLight(np.array([1.0, 0.0]), ANGLES[0], 0.0, 0.0, 0.0)
    weight, known = ground.weight[chosen], np.zeros(len(chosen))
    for turn in range(2):
        smooth = fit_smooth(colour - known[:, None], terms, weight)
        samples = relative_colour(colour, terms @ smooth)
        bare = samples.copy()
        bare[:, 0] -= known
        texture = GroundTexture(bare, weight, fineness)
        lit = texture.likelihood(samples)

        def gain(kept: Values, samples: Values = samples, texture: GroundTexture = texture, lit: Values = lit) -> float:
            shaded = kept < VISIBLE
            bare = samples[shaded]
            bare[:, 0] -= np.log(np.maximum(kept[shaded], 0.02))
            return float(np.clip(texture.likelihood(bare, UNCERTAIN, TINT) - lit[shaded], -MOST, MOST).sum())

        def tried(slide: Values, angle: float, count: int) -> ShadowLight:
            sun = caster.reaching(*sun_disc(direction_of(slide), angle, count))
            return max(
                (
                    ShadowLight(slide, angle, q, k, gain((1.0 - q) * (1.0 - k * hidden) + q * sun))
                    for q in SHARES
                    for k in LOSSES
                ),
                key=_gain,
            )

        none = max(
            (ShadowLight(best.slide, best.angle, 0.0, k, gain(1.0 - k * hidden)) for k in LOSSES),
            key=_gain,
        )
        if turn == 0:
            rough = sorted((tried(slide, 0.15, 4) for slide in _all_over()), key=_gain, reverse=True)
            finer = [tried(light.slide, angle, 10) for light in rough[:6] for angle in ANGLES]
            best = max(finer, key=_gain)
        step = 0.12 + 0.06 * float(np.linalg.norm(best.slide))
        for scale in (2.0, 1.0, 0.5):
            best = max(
                (tried(best.slide + scale * step * way, best.angle, 10) for way in _WAYS),
                key=_gain,
            )
        best = max((tried(best.slide, angle, 16) for angle in ANGLES), key=_gain)
        found = best if best.gain > none.gain + SUN_GAIN else none
        sun = caster.reaching(*sun_disc(direction_of(found.slide), found.angle, 16))
        kept = (1.0 - found.share) * (1.0 - found.loss * hidden) + found.share * sun
        weight = ground.weight[chosen] * np.where(kept > VISIBLE, 1.0, 0.02)
        known = np.log(np.maximum(kept, 0.02))
    return found


def _gain(light: ShadowLight) -> float:
    return light.gain


_WAYS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [-0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]])


def light_shares(
    ground: GroundPixels, bodies: Sequence[ProxyBody], light: ShadowLight
) -> tuple[Values, Values, Values]:
    """Return the share (N,) of its light that the ground keeps, (objects, N) the ratio with to without each object, and
    the share (objects, N) of the sky that each of them occludes."""
    disc = sun_disc(direction_of(light.slide), light.angle, 24)
    casters = [ShadowCaster([body.points], ground.places) for body in bodies]
    hidden = np.stack([1.0 - caster.reaching(*overcast_sky(SKY)) for caster in casters])
    suns = np.stack([caster.reaching(*disc) for caster in casters])

    def kept(use: list[int]) -> Values:
        sky = 1.0 - light.loss * np.minimum(hidden[use].sum(axis=0), 1.0)
        return np.maximum((1.0 - light.share) * sky + light.share * suns[use].prod(axis=0), 0.01)

    everyone = list(range(len(bodies)))
    total = kept(everyone)
    alone = [total / kept([other for other in everyone if other != index]) for index in everyone]
    return total, np.minimum(np.stack(alone), 1.0), hidden


def direction_of(slide: Values) -> Values:
    """Return the unit vector (3,) towards a light whose shadows are ``slide`` (2,) long for a height of 1, clamped to
    bounds."""
    length = float(np.linalg.norm(slide))
    bounded = float(np.clip(length, 1.0 / math.tan(HIGHEST), 1.0 / math.tan(LOWEST)))
    flat = slide * (bounded / length) if length > 1e-9 else np.array([bounded, 0.0])
    return np.array([*flat, 1.0]) / math.hypot(bounded, 1.0)


def _all_over() -> list[Values]:
    slides = [1.0 / math.tan(math.radians(height)) for height in HEIGHTS_DEG]
    turns = np.arange(TURNS) * (2.0 * math.pi / TURNS)
    return [np.array([s * math.cos(a), s * math.sin(a)]) for s in slides for a in turns]


Mask = NDArray[np.bool_]


SHADOW_RATIO = 0.9
"""Ground that keeps less than this share of its light is shadow."""
PENUMBRA_RATIO = 0.95
"""The same for the penumbra, which must be removed with the shadow."""
LEVELS = np.array([1.0, 0.965, 0.93, 0.87, 0.80, 0.72, 0.63, 0.54, 0.45, 0.36, 0.28, 0.20, 0.12, 0.06])
IN_SHADOW, IN_PENUMBRA = LEVELS < SHADOW_RATIO, LEVELS < PENUMBRA_RATIO
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
TINT_SPREAD, MOST_TINT = 0.2, 0.4
"""Tint of a shadow: change of a log chroma over that of the log luminance."""


def light_level_posterior(ground: GroundPixels, kept: Values, hidden: Values) -> Values:
    """Return the probability (N, levels) that pixels of ``ground`` keep each of ``LEVELS`` of their light.

    kept: (N,) share of light past the bodies. hidden: (N,) share of the sky that they occlude.
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
        samples = relative_colour(ground.colour, smooth)
        tint = _tint(samples, depth, lit)
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


def shadow_probability(ground: GroundPixels, posterior: Values, part: Values) -> tuple[Values, Values]:
    """Return the probability (N,) that pixels of ``ground`` are in shadow, and (N,) in shadow or penumbra.

    posterior: (N, levels) of ``light_level_posterior``. part: (N,) share of the lost light, as a logarithm, that one
    object blocks alone: only what it darkens itself is its shadow.
    """
    shadow = (posterior * (part[:, None] * LOGS < math.log(SHADOW_RATIO))).sum(axis=1)
    penumbra = posterior @ IN_PENUMBRA
    return _coherent(ground, shadow), _coherent(ground, penumbra)


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
    lit = LEVELS > 0.95
    unforeseen = np.where(lit, 0.9 / lit.sum(), 0.1 / (~lit).sum())
    prior = (1.0 - UNFORESEEN) * prior + UNFORESEEN * unforeseen
    return np.asarray(prior / prior.sum(axis=1, keepdims=True))


def _tint(samples: Values, depth: Values, lit: Values) -> Values:
    """Change (2,) of the chromas in the shadow over that of the log luminance: shadows under a sky are bluish."""
    usual = np.median(samples[lit > 0.8][:, 1:], axis=0) if (lit > 0.8).any() else np.zeros(2)
    deep = depth < -0.2
    if deep.sum() < 30:
        return np.zeros(2)
    slope = np.median((samples[deep][:, 1:] - usual) / depth[deep, None], axis=0)
    return np.asarray(np.clip(slope, -MOST_TINT, MOST_TINT))
