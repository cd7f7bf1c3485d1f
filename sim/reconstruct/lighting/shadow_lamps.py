# SPDX-License-Identifier: MIT
"""The lamps that explain the colours of the ground around rough bodies: a sky and up to three directional lamps.

As in ``ground_lighting`` the ground keeps the share  (1 − Σ q) (1 − k (1 − V)) + Σ q v  of its light. The bodies are
rough proxies and the ground has any texture, so lamps are scored by the likelihood of the ground's colours without
their shadows. What a shadow takes from the chromas is measured with every trial: a warm lamp leaves a cool shadow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .ground_lighting import ShadowCaster, overcast_sky, smooth_terms, sun_disc
from .ground_pixels import GroundPixels, GroundTexture, ProxyBody, fit_smooth, pixel_noise, relative_colour

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]

SEARCHED = 4000
"""Ground pixels used while lamps are searched, more of them near the objects."""
HEIGHTS_DEG = (19.0, 25.0, 32.0, 41.0, 52.0, 66.0)
TURNS = 24
LOWEST, HIGHEST = math.radians(15.0), math.radians(87.0)
ANGLES = (0.05, 0.15, 0.4, 0.9)
"""rad; trial diameters of a lamp: from the real sun, blurred like the rough bodies, to a window nearby."""
SHARES = (0.12, 0.22, 0.34, 0.45, 0.55, 0.64, 0.72, 0.79, 0.85)
"""Trial shares of the light, finer where the shadow's depth depends on it more."""
CHANGES = (0.6, 0.8, 1.0, 1.2)
"""Trial factors of the shares of lamps that are known when another is added."""
USUAL_CHANGE = 0.8
LOSSES = (0.45, 0.7, 0.9)
USUAL_LOSS = 0.7
MOST_SHARE = 0.88
MOST_LAMPS = 3
SKY = 90
VISIBLE = 0.95
"""Share of light above which a pixel counts as lit."""
MOST = 3.0
"""Limit of one pixel's log likelihood ratio: neighbours share their texture, and rough bodies have wrong edges."""
UNCERTAIN, TINT = 0.13, 0.08
"""Uncertainty of a modelled shadow's log luminance and of its colour."""
MOST_TINT = 0.4
"""Largest change of a log chroma over that of the log luminance."""
DEEP, FEWEST_DEEP = -0.2, 30
"""Log light below which a shadow's tint shows, and the pixels that it takes."""
SUN_GAIN, LAMP_GAIN = 25.0, 60.0
"""Log likelihood gain required for a sun, and for every further lamp."""


@dataclass(frozen=True)
class ShadowLamp:
    """slide: (2,) shadow length for a height of 1; angle: rad; share: q."""

    slide: Values
    angle: float
    share: float


@dataclass(frozen=True)
class ShadowLight:
    """lamps: () for a soft light. loss: k. gain: of log likelihood over no shadow at all."""

    lamps: tuple[ShadowLamp, ...]
    loss: float
    gain: float

    @property
    def share(self) -> float:
        """Of all lamps in the light on open ground."""
        return sum(lamp.share for lamp in self.lamps)


def fit_light(ground: GroundPixels, bodies: Sequence[ProxyBody]) -> ShadowLight:
    """Return the light under which ``bodies`` explain the colours of ``ground`` best."""
    search = _Search(ground, bodies, _all_over())
    best = search.greedy()
    # Again, with the texture that the ground has without these shadows.
    search.learn(search.kept(best))
    if len(best.lamps) < 2:
        best = search.greedy()
        # Ground that no shadow at all explains better says nothing about a lamp.
        return search.soft() if best.lamps and best.gain <= 0.0 else best
    best = replace(best, gain=search.gain(search.kept(best)))
    for _ in best.lamps:
        # The first goes to the end, as it is or as it is found beside the others.
        turned = replace(best, lamps=(*best.lamps[1:], best.lamps[0]))
        best = max((turned, search.with_another(best.lamps[1:])), key=_gain)
    return best


def fit_wall_light(wall: GroundPixels, bodies: Sequence[ProxyBody], lamps: Sequence[ShadowLamp] | None) -> ShadowLight:
    """Return the light under which ``bodies`` explain the colours of ``wall`` best, all in its frame, whose second axis
    points up.

    lamps: those of the ground's that shine on the wall, too; None if none was found on the ground: then any that does
    not shine from below.
    """
    search = _Search(wall, bodies, [slide for slide in _all_over() if slide[1] >= 0.0])
    near = None if lamps is None else [lamp.slide for lamp in lamps]
    best = search.greedy(near)
    search.learn(search.kept(best))
    best = search.greedy(near)
    return search.soft() if best.lamps and best.gain <= 0.0 else best


def _gain_of_first(light: ShadowLight) -> float:
    return light.gain - (SUN_GAIN if light.lamps else 0.0)


def _gain(light: ShadowLight) -> float:
    return light.gain


class _Search:
    """Trials of lamps on a sample of the ground."""

    def __init__(self, ground: GroundPixels, bodies: Sequence[ProxyBody], starts: Sequence[Values]) -> None:
        count = len(ground.rows)
        chosen = np.arange(count)
        if count > SEARCHED:
            near = ground.weight / ground.weight.sum()
            chosen = np.random.default_rng(0).choice(count, SEARCHED, replace=False, p=near)
        self._terms, self._colour = smooth_terms(ground.places, ground.extent)[chosen], ground.colour[chosen]
        middle = np.broadcast_to(np.median(self._colour, axis=0), ground.colour.shape)
        self._fineness = pixel_noise(ground, relative_colour(ground.colour, middle))
        self._caster = ShadowCaster([body.points[::2] for body in bodies], ground.places[chosen])
        self._hidden = 1.0 - self._caster.reaching(*overcast_sky(SKY))
        self._starts = starts
        # The search comes by the same lamps again, once more for every texture that it learns.
        self._skies: dict[float, Values] = {}
        self._reached: dict[tuple[bytes, float, int], Values] = {}
        self._rough = [self._reaching(slide, 0.15, 4) for slide in self._starts]
        self.learn(np.ones(len(chosen)))

    def _reaching(self, slide: Values, angle: float, count: int = 10) -> Values:
        key = (slide.tobytes(), angle, count)
        if key not in self._reached:
            self._reached[key] = self._caster.reaching(*sun_disc(direction_of(slide), angle, count))
        return self._reached[key]

    def _ambient(self, loss: float) -> Values:
        """Share (N,) that is left of the sky's light."""
        if loss not in self._skies:
            self._skies[loss] = 1.0 - loss * self._hidden
        return self._skies[loss]

    def learn(self, kept: Values) -> None:
        """Take the ground's texture from pixels that keep the share ``kept`` (N,) of their light."""
        known = np.log(np.maximum(kept, 0.02))
        weight = np.where(kept > VISIBLE, 1.0, 0.02)
        smooth = fit_smooth(self._colour - known[:, None], self._terms, weight)
        self._samples = relative_colour(self._colour, self._terms @ smooth)
        bare = self._samples.copy()
        bare[:, 0] -= known
        lit = kept > VISIBLE
        self._usual = np.median(self._samples[lit if lit.any() else slice(None), 1:], axis=0)
        self._texture = GroundTexture(bare, weight, self._fineness)
        self._lit = self._texture.likelihood(self._samples)
        # One row a channel, for the many trials.
        self._channels = np.ascontiguousarray(self._samples.T)

    def gain(self, kept: Values) -> float:
        """Log likelihood over that of no shadow, if pixels keep the share ``kept`` (N,)."""
        shaded = np.flatnonzero(kept < VISIBLE)
        depth = np.log(np.maximum(kept[shaded], 0.02))
        bare = self._channels[:, shaded]
        tint = shadow_tint(bare.T, depth, self._usual)
        bare[0] -= depth
        bare[1] -= depth * tint[0]
        bare[2] -= depth * tint[1]
        gained = self._texture.likelihood(bare.T, UNCERTAIN, TINT) - self._lit[shaded]
        return float(gained.clip(-MOST, MOST, out=gained).sum())

    def kept(self, light: ShadowLight) -> Values:
        """Share (N,) of the light that the sample keeps under ``light``."""
        ambient = (1.0 - light.share) * (1.0 - light.loss * self._hidden)
        return ambient + sum((lamp.share * self._reaching(lamp.slide, lamp.angle, 16) for lamp in light.lamps), 0.0)

    def soft(self) -> ShadowLight:
        """The best light without a lamp."""
        return max((ShadowLight((), k, self.gain(1.0 - k * self._hidden)) for k in LOSSES), key=_gain)

    def greedy(self, near: Sequence[Values] | None = None) -> ShadowLight:
        """The best light, lamp by lamp; lamps only ``near`` these slides (2,) if they are given."""
        if near is not None and not len(near):
            return self.soft()
        first = self.with_another((), near)
        best = max((self.soft(), first), key=_gain_of_first if near is None else _gain)
        while 0 < len(best.lamps) < MOST_LAMPS:
            more = self.with_another(best.lamps, near)
            if more.gain < best.gain + LAMP_GAIN:
                break
            best = more
        return best

    def with_another(self, lamps: tuple[ShadowLamp, ...], near: Sequence[Values] | None = None) -> ShadowLight:
        """``lamps`` with new shares, and the lamp that explains most beside them, ``near`` one of these slides (2,)."""
        known = [self._reaching(lamp.slide, lamp.angle) for lamp in lamps]

        def tried(
            slide: Values,
            angle: float,
            reaching: Values,
            losses: Iterable[float] = (USUAL_LOSS,),
            shares: Sequence[float] = SHARES,
            changes: Sequence[float] = CHANGES,
        ) -> ShadowLight:
            new = ShadowLamp(slide, angle, 0.0)
            trials = self._shared((*lamps, new), [*known, reaching], losses, shares, changes if lamps else (1.0,))
            # Known lamps may leave no light for another.
            return max(trials, key=_gain, default=ShadowLight((*lamps, new), USUAL_LOSS, -math.inf))

        few, usual = SHARES[1::2], (USUAL_CHANGE,)
        slides = near
        if slides is None:
            starts = zip(self._starts, self._rough, strict=True)
            rough = [tried(slide, 0.15, reaching, shares=few, changes=usual) for slide, reaching in starts]
            rough = sorted(rough, key=_gain, reverse=True)[:6]
            slides = [light.lamps[-1].slide for light in rough]
        best = max((tried(s, a, self._reaching(s, a), changes=usual) for s in slides for a in ANGLES), key=_gain)
        step = 0.12 + 0.06 * float(np.linalg.norm(best.lamps[-1].slide))
        for scale in (2.0, 1.0, 0.5):
            slide, angle = best.lamps[-1].slide, best.lamps[-1].angle
            ways = [slide + scale * step * way for way in _WAYS]
            best = max((tried(s, angle, self._reaching(s, angle)) for s in ways), key=_gain)
        slide = best.lamps[-1].slide
        return max((tried(slide, a, self._reaching(slide, a, 16), LOSSES) for a in ANGLES), key=_gain)

    def _shared(
        self,
        lamps: tuple[ShadowLamp, ...],
        reaching: Sequence[Values],
        losses: Iterable[float],
        of: Sequence[float],
        changes: Sequence[float],
    ) -> Iterable[ShadowLight]:
        """Trials of the shares of ``lamps``, of which ``reaching`` (N,) each reaches the ground.

        of: shares of the last lamp; changes: factors of the others'.
        """
        for share in of:
            for change in changes:
                shares = [*(change * lamp.share for lamp in lamps[:-1]), share]
                if sum(shares) > MOST_SHARE:
                    continue
                direct = shares[0] * reaching[0]
                for q, v in zip(shares[1:], reaching[1:], strict=True):
                    direct += q * v
                mixed = tuple(replace(lamp, share=q) for lamp, q in zip(lamps, shares, strict=True))
                for k in losses:
                    kept = (1.0 - sum(shares)) * self._ambient(k)
                    kept += direct
                    yield ShadowLight(mixed, k, self.gain(kept))


_WAYS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [-0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]])


def shadow_tint(samples: Values, depth: Values, usual: Values) -> Values:
    """Return the change (2,) of log chromas in a shadow over that of the log luminance: a sky's shadows are bluish.

    samples: (N, 3) of ``relative_colour``; depth: (N,) logarithm of the light that they keep; usual: (2,) chromas of
    lit ground.
    """
    deep = depth < DEEP
    if deep.sum() < FEWEST_DEEP:
        return np.zeros(2)
    below = depth[deep]
    slope = [_median((samples[deep, i + 1] - usual[i]) / below) for i in range(2)]
    return np.asarray(np.clip(slope, -MOST_TINT, MOST_TINT))


def _median(values: Values) -> float:
    """As NumPy's, without its checks, which take longer than the few hundred values of a shadow."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    ordered = np.partition(values, (middle - 1, middle))
    return float((ordered[middle - 1] + ordered[middle]) / 2.0)


def light_shares(
    ground: GroundPixels, bodies: Sequence[ProxyBody], light: ShadowLight
) -> tuple[Values, Values, Values]:
    """Return the share (N,) of its light that the ground keeps, (objects, N) the ratio with to without each object, and
    the share (objects, N) of the sky that each of them occludes."""
    casters = [ShadowCaster([body.points], ground.places) for body in bodies]
    hidden = np.stack([1.0 - caster.reaching(*overcast_sky(SKY)) for caster in casters])
    discs = [sun_disc(direction_of(lamp.slide), lamp.angle, 24) for lamp in light.lamps]
    reaching = [np.stack([caster.reaching(*disc) for caster in casters]) for disc in discs]

    def kept(use: list[int]) -> Values:
        left = (1.0 - light.share) * (1.0 - light.loss * np.minimum(hidden[use].sum(axis=0), 1.0))
        for lamp, sun in zip(light.lamps, reaching, strict=True):
            left = left + lamp.share * sun[use].prod(axis=0)
        return np.maximum(left, 0.01)

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
