# SPDX-License-Identifier: MIT
"""Which light makes the objects' bodies cast the shadows that the ground shows: the sky and one sun for all of them.

As in ``light/ground_light`` the ground keeps the share  (1 − q) (1 − k (1 − V)) + q v  of its light: V and v the shares
of the sky and of the sun that reach it past the objects, q the sun's share on open ground, k how much of the lost sky
is really lost. There the ground's brightness is fitted, with finished bodies; here, with rough ones and on any texture,
it is asked how likely the ground's colours are when that shadow is taken away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..light.cast import Caster, even_sky, sun_disc
from ..light.ground_light import smooth_terms
from .ground_colour import Texture, fit_smooth, grain, relative
from .ground_pixels import GroundPixels
from .relief import Relief

Values = NDArray[np.float64]

SEARCHED = 4000
"""Pixels of ground that are asked while lights are tried."""
HEIGHTS_DEG = (19.0, 25.0, 32.0, 41.0, 52.0, 66.0)
TURNS = 24
LOWEST, HIGHEST = math.radians(15.0), math.radians(87.0)
ANGLES = (0.05, 0.15, 0.4, 0.9)
"""rad; apparent diameters of the sun that are tried: from the real one, as blurred as the bodies are rough, to a
window near by."""
SHARES = (0.15, 0.25, 0.4, 0.55, 0.7, 0.85)
LOSSES = (0.45, 0.7, 0.9)
SKY = 90
VISIBLE = 0.95
"""Light above which a pixel counts as lit."""
MOST = 3.0
"""What one pixel may say, as a log likelihood ratio: neighbours have the same texture, and rough bodies wrong edges."""
UNCERTAIN, TINT = 0.13, 0.08
"""Spread of a modelled shadow's log luminance and of its colour."""
SUN_GAIN = 25.0
"""How much likelier the ground must be with a sun than without."""


@dataclass(frozen=True)
class ShadowLight:
    """slide: (2,) how far a shadow reaches for a height of 1; angle: rad; share, loss: q and k. share 0: no sun."""

    slide: Values
    angle: float
    share: float
    loss: float
    gain: float


def fit_light(ground: GroundPixels, bodies: Sequence[Relief]) -> ShadowLight:
    """The light under which ``bodies`` explain the colours of ``ground`` best."""
    count = len(ground.rows)
    chosen = np.arange(count)
    if count > SEARCHED:
        chosen = np.random.default_rng(0).choice(count, SEARCHED, replace=False)
    terms, colour = smooth_terms(ground.places)[chosen], ground.colour[chosen]
    fineness = grain(ground, relative(ground.colour, np.broadcast_to(np.median(colour, axis=0), ground.colour.shape)))
    caster = Caster([body.points[::2] for body in bodies], ground.places[chosen])
    hidden = 1.0 - caster.reaching(*even_sky(SKY))
    best = ShadowLight(np.array([1.0, 0.0]), ANGLES[0], 0.0, 0.0, 0.0)
    weight, known = ground.weight[chosen], np.zeros(len(chosen))
    for turn in range(2):
        smooth = fit_smooth(colour - known[:, None], terms, weight)
        samples = relative(colour, terms @ smooth)
        bare = samples.copy()
        bare[:, 0] -= known
        texture = Texture(bare, weight, fineness)
        lit = texture.likelihood(samples)

        def gain(kept: Values, samples: Values = samples, texture: Texture = texture, lit: Values = lit) -> float:
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


def kept_light(ground: GroundPixels, bodies: Sequence[Relief], light: ShadowLight) -> tuple[Values, Values, Values]:
    """The share (N,) of its light that the ground keeps, (objects, N) what it keeps with one object over without it,
    and the share (N,) of the sky that all of them hide.
    """
    disc = sun_disc(direction_of(light.slide), light.angle, 24)
    casters = [Caster([body.points], ground.places) for body in bodies]
    hidden = np.stack([1.0 - caster.reaching(*even_sky(SKY)) for caster in casters])
    suns = np.stack([caster.reaching(*disc) for caster in casters])

    def kept(use: list[int]) -> Values:
        sky = 1.0 - light.loss * np.minimum(hidden[use].sum(axis=0), 1.0)
        return np.maximum((1.0 - light.share) * sky + light.share * suns[use].prod(axis=0), 0.01)

    everyone = list(range(len(bodies)))
    total = kept(everyone)
    alone = [total / kept([other for other in everyone if other != index]) for index in everyone]
    return total, np.minimum(np.stack(alone), 1.0), np.minimum(hidden.sum(axis=0), 1.0)


def direction_of(slide: Values) -> Values:
    """Unit vector (3,) towards a light whose shadows are ``slide`` (2,) long for a height of 1, kept within bounds."""
    length = float(np.linalg.norm(slide))
    bounded = float(np.clip(length, 1.0 / math.tan(HIGHEST), 1.0 / math.tan(LOWEST)))
    flat = slide * (bounded / length) if length > 1e-9 else np.array([bounded, 0.0])
    return np.array([*flat, 1.0]) / math.hypot(bounded, 1.0)


def _all_over() -> list[Values]:
    slides = [1.0 / math.tan(math.radians(height)) for height in HEIGHTS_DEG]
    turns = np.arange(TURNS) * (2.0 * math.pi / TURNS)
    return [np.array([s * math.cos(a), s * math.sin(a)]) for s in slides for a in turns]
