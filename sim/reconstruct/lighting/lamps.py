# SPDX-License-Identifier: MIT
"""The sun and the lamps of a photo, from the shadows of its objects on the ground.

For a given direction the shadow of the reconstructed objects is known. A lamp's direction, angular size and strength
are those whose shadows explain the ground's brightness best (``ground_lighting``), over all objects at once; a further
lamp is accepted where its own shadow stands out as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...scene.model import Camera, Ground, Vector
from .ground_lighting import GroundLight, fit_ground_light, sun_disc
from .ground_observation import MIN_POINTS, GroundObservation, Mask, Mesh, Points, ground_axes, observe_ground

LEAST_SHADED = 30
"""Fewest points of white ground that are darker, as in a shadow: a cut-out has a few along its outline."""
LOWEST_DEG, HIGHEST_DEG = 16.0, 86.0
MIN_ANGLE, MAX_ANGLE = 0.009, 1.2
"""rad: the real sun, and a large window nearby."""
USUAL_ANGLE = 0.15
"""rad; initial angular size, also used if the shadow's edge does not determine it."""
STARTS = 2
SEARCHED, THINNED = 2200, 3
"""Ground points with which lamps are searched for; every so many surface points cast their shadows then."""
MIN_STRENGTH = 0.12
MIN_CLEARNESS = 7.0
"""Without a sun, the best direction on a patchy ground reaches about 3; photos with other objects, whose shadows are
unknown, reach 6."""
OUTLYING = 3.0
"""Residual over the texture's beyond which a point counts as that far off: the fit is robust, and a strip of the
object that its mask lacks must not decide either."""
MOST_LAMPS = 3
LEAST_GAIN = 0.04
"""Least share of the misfit that a further lamp explains."""


@dataclass(frozen=True)
class LampEstimate:
    """A sun or lamp by the ground's shadows.

    direction: unit vector towards it. share: of the light on open ground, 0 to 1. angle: apparent diameter in rad.
    clearness: darkness of its shadow over that of the ground's texture alone in patches of the same shape.
    """

    direction: Vector
    share: float
    angle: float
    clearness: float


def estimate_lamps(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[Mesh],
    sky: tuple[Points, Points] | None = None,
    *,
    most: int = MOST_LAMPS,
    things: Mask | None = None,
) -> tuple[LampEstimate, ...] | None:
    """Return the lamps of the photo ``pixels`` (H, W, 3) sRGB, strongest first, () for a soft light, or None if too
    little ground is visible, or it is white throughout and says nothing.

    masks: (H, W) of all objects; meshes: vertices (V, 3) and faces (T, 3) of the same, in the units of ``camera``. sky:
    unit vectors (D, 3) in the ground's frame and weights (D,) of the environment; None for an overcast sky. most: how
    many lamps at most. things: (H, W) what stands on the ground besides the objects, or None.
    """
    view = observe_ground(camera, ground, pixels, masks, meshes, sky, things)
    if view is None or (~view.white).sum() < LEAST_SHADED:
        # On white throughout any lamp explains the ground that stands in none of its shadow.
        return None
    search = _Search(view)
    lamps = search.first()
    kept = search.judged(lamps)
    while 0 < len(kept) == len(lamps) < most:
        alone = search.final(lamps)[1].cost
        lamps = search.with_another(lamps)
        more = search.judged(lamps)
        if len(more) < len(lamps) or search.final(lamps)[1].cost > (1.0 - LEAST_GAIN) * alone:
            break
        kept = more
    if not kept and (~view.white).sum() < MIN_POINTS:
        return None
    axes = ground_axes(ground)
    found = []
    for lamp, share, clearness in kept:
        x, y, z = (float(v) for v in axes.T @ _direction(lamp[:2]))
        found.append(LampEstimate((x, y, z), share, _angle(lamp[2]), clearness))
    return tuple(sorted(found, key=lambda lamp: -lamp.share))


Lamp = Points
"""Parameters (3,) of a lamp: the slide (2,) of its shadows for a height of 1, and the logarithm of its angle."""


class _Search:
    """The lamps that explain one observation best."""

    def __init__(self, view: GroundObservation) -> None:
        self._whole = view
        none = fit_ground_light(view.brightness, view.terms, view.sky, (), 0.25)
        self._scale = float(np.clip(1.48 * np.median(np.abs(none.residual)), 0.03, 0.25))
        # Lamps are searched for on a part of the points.
        index = np.arange(0, len(view.brightness), max(1, len(view.brightness) // SEARCHED))
        self._view = GroundObservation(
            caster=view.caster.thinned(index, THINNED),
            brightness=view.brightness[index],
            terms=view.terms[index],
            sky=view.sky[index],
            rows=view.rows[index],
            columns=view.columns[index],
            size=view.size,
            white=view.white[index],
        )
        self._starts = _all_over()
        self._rough = [self._reaching(start, 5) for start in self._starts]

    def _reaching(self, lamp: Lamp, count: int) -> Points:
        return self._view.caster.reaching(*sun_disc(_direction(lamp[:2]), _angle(lamp[2]), count))

    def _fitted(self, reaching: Sequence[Points], rounds: int) -> GroundLight:
        view = self._view
        return fit_ground_light(view.brightness, view.terms, view.sky, reaching, self._scale, rounds)

    def final(self, lamps: Sequence[Lamp]) -> tuple[list[Points], GroundLight]:
        """The share (N,) of each lamp that reaches the whole observation's points, and the light."""
        view = self._whole
        reaching = [view.caster.reaching(*sun_disc(_direction(p[:2]), _angle(p[2]), 48)) for p in lamps]
        return reaching, fit_ground_light(view.brightness, view.terms, view.sky, reaching, self._scale, 12)

    def first(self) -> list[Lamp]:
        """The single lamp that explains the ground best."""
        costs = [self._fitted([rough], 3).cost for rough in self._rough]
        starts = [self._starts[index] for index in np.argsort(costs, kind="stable")]
        refined = [_refined(self._alone([], 12), start) for start in _distinct(starts, STARTS)]
        best = min(refined, key=self._alone([], 48))
        best[2] = _angle_or_usual(self._alone([], 48), best)
        return [best]

    def with_another(self, lamps: Sequence[Lamp]) -> list[Lamp]:
        """``lamps`` and one more, all refined in turn: alone, one lamp may have stood between two."""
        found = [lamp.copy() for lamp in lamps]
        others = [self._reaching(lamp, 12) for lamp in found]
        for _ in range(2):
            costs = [self._fitted([*others, rough], 3).cost for rough in self._rough]
            added = self._starts[int(np.argmin(costs))]
            for index in range(len(found)):
                rest = [self._reaching(lamp, 5) for i, lamp in enumerate(found) if i != index]
                rest.append(self._reaching(added, 5))
                costs = [self._fitted([*rest, rough], 3).cost for rough in self._rough]
                if min(costs) < self._fitted([*rest, self._reaching(found[index], 5)], 3).cost:
                    found[index] = self._starts[int(np.argmin(costs))]
            others = [self._reaching(lamp, 12) for lamp in found]
        found.append(added)
        for _ in range(2):
            for index in range(len(found)):
                rest = [self._reaching(lamp, 12) for i, lamp in enumerate(found) if i != index]
                found[index] = _refined(self._alone(rest, 12), found[index], 36)
        for index in range(len(found)):
            rest = [self._reaching(lamp, 48) for i, lamp in enumerate(found) if i != index]
            found[index][2] = _angle_or_usual(self._alone(rest, 48), found[index])
        return found

    def _alone(self, rest: Sequence[Points], count: int) -> Callable[[Lamp], float]:
        return lambda lamp: self._fitted([*rest, self._reaching(lamp, count)], 5).cost

    def judged(self, lamps: Sequence[Lamp]) -> list[tuple[Lamp, float, float]]:
        """Those of ``lamps`` that are strong and clear enough, each with share and clearness."""
        reaching, light = self.final(lamps)
        found = []
        for index, lamp in enumerate(lamps):
            clear = _clearness(self._whole, reaching, index, light, OUTLYING * self._scale)
            rest = 1.0 - sum(light.shares)
            if light.shares[index] >= MIN_STRENGTH * max(rest, 1e-6) and clear >= MIN_CLEARNESS:
                found.append((lamp, light.shares[index], clear))
        return found


def _refined(cost: Callable[[Points], float], start: Points, most: int = 60) -> Points:
    """The parameters (3,) of least ``cost`` near ``start``, by Nelder and Mead's method."""
    simplex = start + np.vstack([np.zeros(3), np.diag([0.25, 0.25, 0.75])])
    options = {"maxfev": most, "xatol": 0.01, "fatol": 1e-5, "initial_simplex": simplex}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)


def _angle_or_usual(cost: Callable[[Points], float], best: Points) -> float:
    """The logarithm of the sun's angular size: the fitted one, or the usual one if that explains the ground as well."""
    usual = np.array([*best[:2], math.log(USUAL_ANGLE)])
    return float(usual[2] if cost(usual) <= cost(best) * 1.002 else best[2])


def _clearness(view: GroundObservation, lamps: Sequence[Points], index: int, light: GroundLight, most: float) -> float:
    """Darkness of a lamp's shadow over that of the ground's texture alone in patches of the same shape.

    lamps: for each lamp, the share (N,) of its light that reaches the points; index: which one. most: residual of log
    brightness beyond which a point counts as that far off.
    """
    shade = 1.0 - lamps[index]
    if shade.sum() < 1.0:
        return 0.0
    ambient = (1.0 - sum(light.shares)) * (1.0 - light.sky_loss * (1.0 - view.sky))
    others = ambient + sum(
        (share * lamp for i, (share, lamp) in enumerate(zip(light.shares, lamps, strict=True)) if i != index),
        np.zeros_like(ambient),
    )
    drop = np.log((others + light.shares[index]) / (others + light.shares[index] * lamps[index]))
    dark = float((drop * shade).sum() / shade.sum())
    residual = np.clip(light.residual, -most, most)
    known, shaded, rest = (np.zeros(view.size[::-1], dtype=np.float32) for _ in range(3))
    for picture, values in ((known, 1.0), (shaded, shade), (rest, residual)):
        picture[view.rows, view.columns] = values
    # Only some of the pixels were sampled; interpolate the shadow between them.
    near = [cv2.GaussianBlur(picture, (0, 0), 2.0) for picture in (shaded, known)]
    pattern = near[0] / np.maximum(near[1], 1e-4)
    rows, columns = np.nonzero(pattern > 0.1)
    if not len(rows):
        return 0.0
    patch = pattern[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    weight = cv2.filter2D(known, -1, patch, borderType=cv2.BORDER_CONSTANT)
    total = cv2.filter2D(rest, -1, patch, borderType=cv2.BORDER_CONSTANT)
    full = weight > 0.6 * float(weight.max())
    return dark / max(float(np.sqrt(np.mean((total[full] / weight[full]) ** 2))), 1e-3)


def _all_over() -> list[Points]:
    """Initial parameters (3,): every 15° around, at seven heights."""
    slides = [1.0 / math.tan(math.radians(h)) for h in (20, 26, 33, 42, 52, 63, 75)]
    turns = np.radians(np.arange(0, 360, 15))
    return [np.array([s * math.cos(a), s * math.sin(a), math.log(USUAL_ANGLE)]) for s in slides for a in turns]


def _distinct(starts: Sequence[Points], count: int) -> list[Points]:
    """The first ``count`` of ``starts`` that differ enough from those before."""
    chosen: list[Points] = []
    for start in starts:
        slide = start[:2]
        if all(np.linalg.norm(slide - other[:2]) > 0.3 + 0.2 * np.linalg.norm(other[:2]) for other in chosen):
            chosen.append(start)
        if len(chosen) == count:
            break
    return chosen


def _direction(slide: Points) -> Points:
    """Unit vector (3,) towards a sun whose shadows are ``slide`` (2,) long for a height of 1, clamped to bounds."""
    length = float(np.linalg.norm(slide))
    bounded = np.clip(length, 1.0 / math.tan(math.radians(HIGHEST_DEG)), 1.0 / math.tan(math.radians(LOWEST_DEG)))
    flat = slide * (bounded / max(length, 1e-12))
    return np.array([*flat, 1.0]) / math.hypot(bounded, 1.0)


def _angle(logarithm: float) -> float:
    return float(np.clip(math.exp(min(logarithm, 5.0)), MIN_ANGLE, MAX_ANGLE))
