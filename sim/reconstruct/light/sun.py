# SPDX-License-Identifier: MIT
"""The sun of a photo, from the shadows that its objects cast on the ground.

For a direction the shadow of the reconstructed objects is known, whole, as far as the photo shows it; what an object
hides does not count. The direction, apparent size and strength are those whose shadows explain the ground's brightness
best (``ground_light``). All objects are asked at once.
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
from .cast import sun_disc
from .ground_light import GroundLight, fit_ground
from .ground_view import GroundView, Mask, Mesh, Points, ground_axes, look_at_ground

LOWEST_DEG, HIGHEST_DEG = 16.0, 86.0
MIN_ANGLE, MAX_ANGLE = 0.009, 1.2
"""rad: the real sun, and a large window near by."""
USUAL_ANGLE = 0.15
"""rad; where the search begins, and what is taken where the shadow's edge does not tell."""
STARTS = 2
MIN_STRENGTH = 0.12
MIN_CLEARNESS = 7.0
"""Without any sun, the direction under which a patchy ground looks most like a shadow reaches about 3; photos in which
other things stand, whose shadows are not known, reach 6."""


@dataclass(frozen=True)
class SunEstimate:
    """What the ground says about the sun.

    direction: unit vector towards it, or None for no sun. strength: its irradiance over the environment's on open
    ground. angle: apparent diameter in rad. clearness: how dark its shadow is over how dark the ground's texture alone
    comes out in patches of that shape. sky_loss: how much of the light of the sky that objects hide is really lost.
    """

    direction: Vector | None
    strength: float
    angle: float
    clearness: float
    sky_loss: float


def estimate_sun(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[Mesh],
    sky: tuple[Points, Points] | None = None,
) -> SunEstimate | None:
    """The sun of the photo ``pixels`` (H, W, 3) sRGB, or None when it shows too little ground to tell.

    masks: (H, W) of all objects; meshes: vertices (V, 3) and faces (T, 3) of the same, in the units of ``camera``.
    sky: unit vectors (D, 3) in the ground's frame and weights (D,) of the environment; None for an overcast sky.
    """
    view = look_at_ground(camera, ground, pixels, masks, meshes, sky)
    if view is None:
        return None
    none = fit_ground(view.brightness, view.terms, view.sky, None, 0.25)
    scale = float(np.clip(1.48 * np.median(np.abs(none.residual)), 0.03, 0.25))

    def light(parameters: Points, count: int, rounds: int = 5) -> GroundLight:
        disc = sun_disc(_direction(parameters[:2]), _angle(parameters[2]), count)
        return fit_ground(view.brightness, view.terms, view.sky, view.caster.reaching(*disc), scale, rounds)

    starts = sorted(_all_over(), key=lambda p: light(p, 5, 3).cost)
    refined = [_refined(lambda p: light(p, 12).cost, start) for start in _distinct(starts, STARTS)]
    best = min(refined, key=lambda p: light(p, 48).cost)
    best[2] = _told_angle(lambda p: light(p, 48).cost, best)
    final = light(best, 48, 12)
    direction, angle = _direction(best[:2]), _angle(best[2])
    clearness = _clearness(view, view.caster.reaching(*sun_disc(direction, angle, 48)), final)
    strength = final.share / (1.0 - final.share)
    x, y, z = (float(v) for v in ground_axes(ground).T @ direction)
    return SunEstimate(
        direction=(x, y, z) if strength >= MIN_STRENGTH and clearness >= MIN_CLEARNESS else None,
        strength=strength,
        angle=angle,
        clearness=clearness,
        sky_loss=final.sky_loss,
    )


def _refined(cost: Callable[[Points], float], start: Points) -> Points:
    """The parameters (3,) of least ``cost`` near ``start``, by Nelder and Mead's method."""
    simplex = start + np.vstack([np.zeros(3), np.diag([0.25, 0.25, 0.75])])
    options = {"maxfev": 60, "xatol": 0.01, "fatol": 1e-5, "initial_simplex": simplex}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)


def _told_angle(cost: Callable[[Points], float], best: Points) -> float:
    """The logarithm of the sun's size: what was found, or the usual one where that explains the ground as well."""
    usual = np.array([*best[:2], math.log(USUAL_ANGLE)])
    return float(usual[2] if cost(usual) <= cost(best) * 1.002 else best[2])


def _clearness(view: GroundView, sun: Points, light: GroundLight) -> float:
    """How dark the sun's shadow is over how dark a patch of that shape comes out elsewhere on this ground, by its
    texture alone. sun: (N,) share of the sun that reaches the points.
    """
    shade = 1.0 - sun
    if shade.sum() < 1.0:
        return 0.0
    ambient = (1.0 - light.share) * (1.0 - light.sky_loss * (1.0 - view.sky))
    drop = np.log((ambient + light.share) / (ambient + light.share * sun))
    dark = float((drop * shade).sum() / shade.sum())
    known, shaded, rest = (np.zeros(view.size[::-1], dtype=np.float32) for _ in range(3))
    for picture, values in ((known, 1.0), (shaded, shade), (rest, light.residual)):
        picture[view.rows, view.columns] = values
    # Only some of the pixels were looked at; between them the shadow goes on.
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
    """Parameters (3,) to begin with: every 15° around, in seven heights."""
    slides = [1.0 / math.tan(math.radians(h)) for h in (20, 26, 33, 42, 52, 63, 75)]
    turns = np.radians(np.arange(0, 360, 15))
    return [np.array([s * math.cos(a), s * math.sin(a), math.log(USUAL_ANGLE)]) for s in slides for a in turns]


def _distinct(starts: Sequence[Points], count: int) -> list[Points]:
    """The first ``count`` of ``starts`` that lie apart from those before."""
    chosen: list[Points] = []
    for start in starts:
        slide = start[:2]
        if all(np.linalg.norm(slide - other[:2]) > 0.3 + 0.2 * np.linalg.norm(other[:2]) for other in chosen):
            chosen.append(start)
        if len(chosen) == count:
            break
    return chosen


def _direction(slide: Points) -> Points:
    """Unit vector (3,) towards a sun whose shadows are ``slide`` (2,) long for a height of 1, kept within bounds."""
    length = float(np.linalg.norm(slide))
    bounded = np.clip(length, 1.0 / math.tan(math.radians(HIGHEST_DEG)), 1.0 / math.tan(math.radians(LOWEST_DEG)))
    flat = slide * (bounded / max(length, 1e-12))
    return np.array([*flat, 1.0]) / math.hypot(bounded, 1.0)


def _angle(logarithm: float) -> float:
    return float(np.clip(math.exp(min(logarithm, 5.0)), MIN_ANGLE, MAX_ANGLE))
