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
from ...srgb import bytes_to_linear
from .ground_lighting import (
    GroundLight,
    ShadowCaster,
    fit_ground_light,
    overcast_sky,
    smooth_terms,
    sun_disc,
    surface_points,
)
from .standing_surface import ground_before, standing_surface

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Mesh = tuple[Points, NDArray[np.integer]]

OBJECT_SIDE, LONGEST_SIDE = 110, 1600
"""Size in pixels of the largest object in the picture in which shadows are compared, and the picture's longest side."""
MAX_POINTS = 7000
MIN_POINTS = 300
REACH = 2.8
"""Range of ground around an object, over its height: the shadow of a sun 20° high."""
WHITE_GROUND = 0.5
"""Share of clipped pixels beside the objects above which they are the lit ground, white paper, and not highlights on
it: without them only its shadows are left to be compared with each other."""
WHITE_SHARE = 2
"""Most clipped points that are kept, over the others."""
LEAST_SHADED = 30
"""Fewest points of white ground that are darker, as in a shadow: a cut-out has a few along its outline."""
LUMINANCE_F32 = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True)
class GroundObservation:
    """Visible ground points.

    caster: shadows at them. brightness: (N,) natural logarithm of the luminance. terms: (N, 6), ``smooth_terms``. sky:
    (N,) share of the environment's light that reaches them past the objects. rows, columns: (N,) their pixels in a
    picture of ``size`` (width, height). white: (N,) where the photo is clipped, on ground that mostly is.
    """

    caster: ShadowCaster
    brightness: Points
    terms: Points
    sky: Points
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    size: tuple[int, int]
    white: Mask


def ground_axes(ground: Ground) -> Points:
    """Return rows (3, 3): two unit vectors along the ground, and its normal."""
    normal = ground.unit_normal
    helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal])


def observe_ground(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[tuple[Points, NDArray[np.integer]]],
    sky: tuple[Points, Points] | None,
    things: Mask | None = None,
) -> GroundObservation | None:
    """Return the visible ground around the objects in ``pixels`` (H, W, 3) sRGB, or None if there is too little.

    Arguments as for ``estimate_lamps``.
    """
    axes, origin = ground_axes(ground), np.asarray(ground.point, dtype=np.float64)
    surfaces = [(surface_points(vertices, faces) - origin) @ axes.T for vertices, faces in meshes]
    height, width = pixels.shape[:2]
    shrink = min(1.0, OBJECT_SIDE / _largest_side(masks), LONGEST_SIDE / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    linear = bytes_to_linear(pixels)
    light = np.asarray(cv2.resize(linear, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    luminance = light @ LUMINANCE_F32
    objects = np.logical_or.reduce(masks if things is None else [*masks, things])
    bright, black = pixels.max(axis=2) >= 254, pixels.max(axis=2) <= 2
    beside = bright[_beside(masks) & ~objects]
    on_white = len(beside) > 0 and bool(beside.mean() > WHITE_GROUND)
    clipped = black if on_white else bright | black
    objects = objects | (cv2.erode(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    covered = cv2.resize(objects.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    # Pixels along an outline mix object and ground.
    covered = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    white = cv2.resize((bright & on_white).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    rows, columns = np.nonzero(~covered & (luminance > 1e-4))
    seen = np.column_stack([(columns + 0.5) * width / size[0], (rows + 0.5) * height / size[1]])
    rays = camera.rays(seen) @ axes.T
    eye = (camera.position - origin) @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[:, 2] < -1e-9, -eye[2] / rays[:, 2], np.nan)
        flat = eye[:2] + depth[:, None] * rays[:, :2]
    near = np.zeros(len(flat), dtype=bool)
    for surface in surfaces:
        low, high = surface[:, :2].min(axis=0), surface[:, :2].max(axis=0)
        tall = max(float(surface[:, 2].max()), 1e-9)
        with np.errstate(invalid="ignore"):
            outside = np.linalg.norm(np.maximum(np.maximum(low - flat, flat - high), 0.0), axis=1)
            near |= outside < REACH * tall
    if near.sum() < MIN_POINTS:
        return None
    near &= _standing(light, rows, columns, near, ground_before(flat, eye[:2], surfaces))
    blank = near & white[rows, columns]
    most = max(MIN_POINTS, WHITE_SHARE * int((near & ~blank).sum()))
    if blank.sum() > most:
        # Robust fits would take the few points that show a shadow for outliers.
        drawn = np.random.default_rng(0).choice(np.flatnonzero(blank), most, replace=False)
        near = near & ~blank
        near[drawn] = True
    index = np.flatnonzero(near)
    if len(index) > MAX_POINTS:
        index = np.random.default_rng(0).choice(index, MAX_POINTS, replace=False)
    points = flat[index]
    caster = ShadowCaster(surfaces, points)
    brightness = np.log(luminance[rows[index], columns[index]].astype(np.float64))
    above = caster.reaching(*(sky or overcast_sky()))
    return GroundObservation(
        caster=caster,
        brightness=brightness,
        terms=smooth_terms(points),
        sky=above,
        rows=rows[index],
        columns=columns[index],
        size=size,
        white=white[rows[index], columns[index]],
    )


def _standing(
    light: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64], near: Mask, before: Mask
) -> Mask:
    """Which (N,) of the pixels ``rows``, ``columns`` show the surface on which the objects stand.

    light: (h, w, 3) linear. near: (N,) those that count as ground; before: (N,) those close before the objects.
    """
    pictures = [np.zeros(light.shape[:2], dtype=bool) for _ in range(2)]
    for picture, values in zip(pictures, (near, before & near), strict=True):
        picture[rows, columns] = values
    surface = standing_surface(np.log(np.maximum(light, 1e-3).astype(np.float64)), *pictures)
    return surface[rows, columns] if surface.sum() >= MIN_POINTS else near


def _beside(masks: Sequence[Mask]) -> Mask:
    """Pixels (H, W) no farther from one of ``masks`` than its own size, by boxes."""
    found = np.zeros(masks[0].shape, dtype=bool)
    for mask in masks:
        if mask.any():
            window = []
            for axis in (1, 0):
                lines = np.flatnonzero(mask.any(axis=axis))
                extent = int(lines[-1] - lines[0]) + 1
                window.append(slice(max(0, int(lines[0]) - extent), int(lines[-1]) + 1 + extent))
            found[tuple(window)] = True
    return found


def _largest_side(masks: Sequence[Mask]) -> int:
    """Pixels along the longer side of the largest mask's box."""
    return max(max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) if mask.any() else 1 for mask in masks)


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
