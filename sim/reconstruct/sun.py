# SPDX-License-Identifier: MIT
"""The sun of a photo, from the shadows that its objects cast on the ground.

For a direction the shadow of the reconstructed objects is known, whole, as far as the photo shows it; what an object
hides does not count. The direction, apparent size and strength are those whose shadows explain the ground's brightness
best (``ground_light``). All objects are asked at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ..composite.transfer import bytes_to_linear
from ..scene.model import Camera, Ground, Vector
from .cast import Caster, even_sky, sun_disc, surface_points
from .ground_light import GroundLight, fit_ground, smooth_terms

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

WORKING_SIDE = 400
"""Longer side in pixels of the photo that shadows are compared in."""
MAX_POINTS = 9000
REACH = 2.8
"""How far around an object the ground is looked at, over its height: the shadow of a sun 20° high."""
MIN_POINTS = 300
LOWEST_DEG, HIGHEST_DEG = 16.0, 86.0
MIN_ANGLE, MAX_ANGLE = 0.009, 1.2
"""rad: the real sun, and a large window near by."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
MIN_STRENGTH = 0.12
MIN_GAIN = 0.08
"""Share of what the sky leaves unexplained that a sun has to explain to be believed."""


@dataclass(frozen=True)
class SunEstimate:
    """What the ground says about the sun.

    direction: unit vector towards it, or None for no sun. strength: its irradiance over the environment's on open
    ground. angle: apparent diameter in rad. gain: share of the ground's unexplained brightness that it explains, 0 to
    1. sky_loss: how much of the lost sky is really lost.
    """

    direction: Vector | None
    strength: float
    angle: float
    gain: float
    sky_loss: float = 1.0


@dataclass(frozen=True)
class _Scene:
    caster: Caster
    brightness: Points
    terms: Points
    sky: Points


def estimate_sun(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[tuple[Points, NDArray[np.integer]]],
    sky: tuple[Points, Points] | None = None,
) -> SunEstimate | None:
    """The sun of the photo ``pixels`` (H, W, 3) sRGB, or None when it shows too little ground to tell.

    masks: (H, W) of all objects; meshes: vertices (V, 3) and faces (T, 3) of the same, in the units of ``camera``.
    sky: unit vectors (D, 3) in the ground's frame and weights (D,) of the environment; None for an overcast sky.
    """
    prepared = _prepare(camera, ground, pixels, masks, meshes, sky)
    if prepared is None:
        return None
    scene, caster = prepared, prepared.caster
    scale = 0.25
    none = fit_ground(scene.brightness, scene.terms, scene.sky, None, scale)
    scale = float(np.clip(1.48 * np.median(np.abs(none.residual)), 0.03, 0.25))

    def light(direction: Points, angle: float, count: int, rounds: int = 5) -> GroundLight:
        sun = caster.reaching(*sun_disc(direction, angle, count))
        return fit_ground(scene.brightness, scene.terms, scene.sky, sun, scale, rounds=rounds)

    starts = sorted(
        ((light(d, 0.15, 5, 3).cost, tuple(d)) for d in _all_over()),
        key=lambda pair: pair[0],
    )
    best: tuple[float, Points] | None = None
    for slides in _distinct([np.array(d[:2]) / d[2] for _, d in starts], 3):
        found = minimize(
            lambda p: light(_direction(p[:2]), _angle(p[2]), 16).cost,
            np.array([*slides, math.log(0.15)]),
            method="Nelder-Mead",
            options={
                "maxfev": 70,
                "xatol": 0.01,
                "fatol": 1e-5,
                "initial_simplex": np.array([*slides, math.log(0.15)]) + np.vstack([np.zeros(3), 0.25 * np.eye(3) * [1, 1, 3]]),
            },
        )
        if best is None or found.fun < best[0]:
            best = (float(found.fun), np.asarray(found.x))
    assert best is not None
    direction, angle = _direction(best[1][:2]), _angle(best[1][2])
    final = light(direction, angle, 48, 12)
    none = fit_ground(scene.brightness, scene.terms, scene.sky, None, scale, rounds=8)
    gain = 1.0 - final.cost / max(none.cost, 1e-9)
    strength = final.share / (1.0 - final.share)
    x, y, z = (float(v) for v in _axes(ground).T @ direction)
    seen = strength >= MIN_STRENGTH and gain >= MIN_GAIN
    return SunEstimate(
        direction=(x, y, z) if seen else None, strength=strength, angle=angle, gain=gain, sky_loss=final.sky_loss
    )


def _all_over() -> Points:
    """Directions to begin with: every 15° around, in seven heights."""
    slides = [1.0 / math.tan(math.radians(h)) for h in (20, 26, 33, 42, 52, 63, 75)]
    turns = np.radians(np.arange(0, 360, 15))
    return np.array([_direction(np.array([s * math.cos(a), s * math.sin(a)])) for s in slides for a in turns])


def _distinct(slides: list[Points], count: int) -> list[Points]:
    chosen: list[Points] = []
    for slide in slides:
        if all(np.linalg.norm(slide - other) > 0.3 + 0.2 * np.linalg.norm(other) for other in chosen):
            chosen.append(slide)
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


def _axes(ground: Ground) -> Points:
    """Rows: two unit vectors along the ground, and its normal."""
    normal = ground.unit_normal
    helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal])


def _prepare(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[tuple[Points, NDArray[np.integer]]],
    sky: tuple[Points, Points] | None,
) -> _Scene | None:
    axes, origin = _axes(ground), np.asarray(ground.point, dtype=np.float64)
    surfaces = [(surface_points(vertices, faces) - origin) @ axes.T for vertices, faces in meshes]
    height, width = pixels.shape[:2]
    shrink = min(1.0, WORKING_SIDE / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    linear = bytes_to_linear(pixels)
    clipped = (pixels.max(axis=2) >= 254) | (pixels.max(axis=2) <= 2)
    luminance = cv2.resize(linear @ LUMINANCE, size, interpolation=cv2.INTER_AREA)
    objects = np.logical_or.reduce(masks) | (cv2.erode(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    covered = cv2.resize(objects.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    # Pixels along an outline are mixtures of object and ground.
    covered = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
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
    index = np.flatnonzero(near)
    if len(index) > MAX_POINTS:
        index = np.random.default_rng(0).choice(index, MAX_POINTS, replace=False)
    points = flat[index]
    caster = Caster(surfaces, points)
    brightness = np.log(luminance[rows[index], columns[index]].astype(np.float64))
    above = caster.reaching(*(sky or even_sky()))
    return _Scene(caster=caster, brightness=brightness, terms=smooth_terms(points), sky=above)
