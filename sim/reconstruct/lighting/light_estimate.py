# SPDX-License-Identifier: MIT
"""Estimate the light of a photo: an environment map, and at most one sun from ground shadows.

For a given direction the shadow of the reconstructed objects is known. The sun's direction, angular size and strength
are those whose shadows explain the ground's brightness best (``ground_lighting``), over all objects at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...composite.srgb import bytes_to_linear
from ...scene.environment import SPOT_SHARE, ground_light, sun_in
from ...scene.equirectangular import LUMINANCE, Radiance, directions
from ...scene.model import Camera, Ground, Light, Vector
from .ground_lighting import (
    GroundLight,
    ShadowCaster,
    fit_ground_light,
    overcast_sky,
    smooth_terms,
    sun_disc,
    surface_points,
)

SIZE = (64, 32)
BLUR = 0.04
"""Blur of the surroundings over the photo's longer side."""
EDGE = 0.12
"""Share of the photo's sides over which it fades into the guessed surroundings."""


def photo_environment(pixels: NDArray[np.uint8], background: NDArray[np.uint8], camera: Camera) -> NDArray[np.float32]:
    """Return an equirectangular environment (32, 64, 3) in linear light with mean luminance 1
    (``sim/scene/equirectangular``).

    A soft sky, the visible surroundings and the ground. Only tint, gradient and direction matter, because the photo's
    colours already contain the real light. pixels, background: (H, W, 3) sRGB, with and without objects. camera: above
    the ground z = 0, without roll.
    """
    behind = bytes_to_linear(background)
    light = bytes_to_linear(pixels[::4, ::4]).reshape(-1, 3).astype(np.float64)
    luminance = light @ LUMINANCE
    bright = light[luminance >= np.percentile(luminance, 85)].mean(axis=0)
    white = max(float(bright @ LUMINANCE), 1e-4)
    # A lamp is seldom as coloured as the objects it lights: pull its tint halfway to white.
    sky = 0.5 * bright / white + 0.5
    horizon = camera.cy + camera.fy * float(np.tan(np.arcsin(np.clip(camera.world_from_camera[2][2], -1.0, 1.0))))
    ground = behind[int(np.clip(horizon, 0, behind.shape[0])) :: 4, ::4].reshape(-1, 3)
    bounce = (ground.mean(axis=0) if len(ground) else light.mean(axis=0)) / white
    width, height = SIZE
    towards, solid = directions(height, width)
    up = towards[..., 2:]
    # Brighter towards the zenith, as rooms and overcast skies are (CIE overcast: zenith three times the horizon).
    radiance = np.where(up > 0, sky * (1.0 + 2.0 * np.maximum(up, 0.0)) / 3.0, bounce)
    seen, share = _seen(behind, camera, towards)
    share = share * (up > 0)
    radiance = radiance * (1.0 - share) + seen / white * share
    mean = float(((radiance @ LUMINANCE) * solid).sum() / solid.sum())
    return (radiance / mean if mean > 1e-6 else np.ones_like(radiance)).astype(np.float32)


def _seen(
    behind: NDArray[np.float32], camera: Camera, towards: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Light (h, w, 3) in the directions ``towards`` (h, w, 3) from the photo, and a weight (h, w, 1) of where it is
    visible."""
    height, width = behind.shape[:2]
    pixels = camera.project(camera.position + towards)
    x, y = pixels[..., 0], pixels[..., 1]
    # In a small picture, where a wide blur is cheap.
    small = cv2.resize(behind, (max(8, min(width, 128)), max(8, min(height, 128))), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), BLUR * max(small.shape[:2]))
    column = np.clip(np.nan_to_num(x * small.shape[1] / width - 0.5), -1e3, 1e3).astype(np.float32)
    row = np.clip(np.nan_to_num(y * small.shape[0] / height - 0.5), -1e3, 1e3).astype(np.float32)
    light = np.asarray(cv2.remap(blurred, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    with np.errstate(invalid="ignore"):
        margin = np.minimum.reduce([x / width, 1 - x / width, y / height, 1 - y / height])
        inside = np.where(pixels[..., 2] > 0, np.clip(margin / EDGE, 0.0, 1.0), 0.0)
    return light.astype(np.float64), np.nan_to_num(inside)[..., None]


Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Mesh = tuple[Points, NDArray[np.integer]]

OBJECT_SIDE, LONGEST_SIDE = 110, 1600
"""Size in pixels of the largest object in the picture in which shadows are compared, and the picture's longest side."""
MAX_POINTS = 7000
MIN_POINTS = 300
REACH = 2.8
"""Range of ground around an object, over its height: the shadow of a sun 20° high."""
LUMINANCE_F32 = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True)
class GroundObservation:
    """Visible ground points.

    caster: shadows at them. brightness: (N,) natural logarithm of the luminance. terms: (N, 6), ``smooth_terms``. sky:
    (N,) share of the environment's light that reaches them past the objects. rows, columns: (N,) their pixels in a
    picture of ``size`` (width, height).
    """

    caster: ShadowCaster
    brightness: Points
    terms: Points
    sky: Points
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    size: tuple[int, int]


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
) -> GroundObservation | None:
    """Return the visible ground around the objects in ``pixels`` (H, W, 3) sRGB, or None if there is too little.

    Arguments as for ``estimate_sun``.
    """
    axes, origin = ground_axes(ground), np.asarray(ground.point, dtype=np.float64)
    surfaces = [(surface_points(vertices, faces) - origin) @ axes.T for vertices, faces in meshes]
    height, width = pixels.shape[:2]
    shrink = min(1.0, OBJECT_SIDE / _largest_side(masks), LONGEST_SIDE / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    linear = bytes_to_linear(pixels)
    clipped = (pixels.max(axis=2) >= 254) | (pixels.max(axis=2) <= 2)
    luminance = cv2.resize(linear @ LUMINANCE_F32, size, interpolation=cv2.INTER_AREA)
    objects = np.logical_or.reduce(masks) | (cv2.erode(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    covered = cv2.resize(objects.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    # Pixels along an outline mix object and ground.
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
    )


def _largest_side(masks: Sequence[Mask]) -> int:
    """Pixels along the longer side of the largest mask's box."""
    return max(max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) if mask.any() else 1 for mask in masks)


LOWEST_DEG, HIGHEST_DEG = 16.0, 86.0
MIN_ANGLE, MAX_ANGLE = 0.009, 1.2
"""rad: the real sun, and a large window nearby."""
USUAL_ANGLE = 0.15
"""rad; initial angular size, also used if the shadow's edge does not determine it."""
STARTS = 2
MIN_STRENGTH = 0.12
MIN_CLEARNESS = 7.0
"""Without a sun, the best direction on a patchy ground reaches about 3; photos with other objects, whose shadows are
unknown, reach 6."""


@dataclass(frozen=True)
class SunEstimate:
    """The sun by the ground's shadows.

    direction: unit vector towards it, or None for no sun. strength: its irradiance over the environment's on open
    ground. angle: apparent diameter in rad. clearness: darkness of its shadow over that of the ground's texture alone
    in patches of the same shape. sky_loss: share of the occluded sky's light that is really lost.
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
    """Return the sun of the photo ``pixels`` (H, W, 3) sRGB, or None if too little ground is visible.

    masks: (H, W) of all objects; meshes: vertices (V, 3) and faces (T, 3) of the same, in the units of ``camera``. sky:
    unit vectors (D, 3) in the ground's frame and weights (D,) of the environment; None for an overcast sky.
    """
    view = observe_ground(camera, ground, pixels, masks, meshes, sky)
    if view is None:
        return None
    none = fit_ground_light(view.brightness, view.terms, view.sky, None, 0.25)
    scale = float(np.clip(1.48 * np.median(np.abs(none.residual)), 0.03, 0.25))

    def light(parameters: Points, count: int, rounds: int = 5) -> GroundLight:
        disc = sun_disc(_direction(parameters[:2]), _angle(parameters[2]), count)
        return fit_ground_light(view.brightness, view.terms, view.sky, view.caster.reaching(*disc), scale, rounds)

    starts = sorted(_all_over(), key=lambda p: light(p, 5, 3).cost)
    refined = [_refined(lambda p: light(p, 12).cost, start) for start in _distinct(starts, STARTS)]
    best = min(refined, key=lambda p: light(p, 48).cost)
    best[2] = _angle_or_usual(lambda p: light(p, 48).cost, best)
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


def _angle_or_usual(cost: Callable[[Points], float], best: Points) -> float:
    """The logarithm of the sun's angular size: the fitted one, or the usual one if that explains the ground as well."""
    usual = np.array([*best[:2], math.log(USUAL_ANGLE)])
    return float(usual[2] if cost(usual) <= cost(best) * 1.002 else best[2])


def _clearness(view: GroundObservation, sun: Points, light: GroundLight) -> float:
    """Darkness of the sun's shadow over that of the ground's texture alone in patches of the same shape.

    sun: (N,) share of the sun that reaches the points.
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


ENVIRONMENT_FILE = "light/environment.exr"
DEFAULT_SUN = (-0.45, -0.35, 0.82)
"""Above, left and from behind the camera, a common position of windows."""
DEFAULT_STRENGTH, DEFAULT_ANGLE = 0.6, 0.3


@dataclass(frozen=True, eq=False)
class LitScene:
    """Inputs of the light estimate, lengths in the camera's unit.

    pixels, background: (H, W, 3) sRGB, with and without objects; masks: (H, W) of all objects; meshes: vertices (V, 3)
    and faces (T, 3) of the same.
    """

    camera: Camera
    ground: Ground
    pixels: NDArray[np.uint8]
    background: NDArray[np.uint8]
    masks: Sequence[Mask]
    meshes: Sequence[Mesh]


def estimate_light(
    scene: LitScene, given: Radiance | None, notice: Callable[[str], None], *, with_sun: bool = True
) -> tuple[Radiance, Light]:
    """Return the environment map and the light of ``scene``; the caller writes the map.

    given: an environment that replaces the photo's, in the scene's axes. A small bright spot in it is its own sun, and
    none is estimated from the shadows. with_sun: False never adds one. ``notice`` receives the estimates.
    """
    if given is None:
        radiance, sky = photo_environment(scene.pixels, scene.background, scene.camera), None
    else:
        radiance, sky = given, ground_light(given, ground_axes(scene.ground))
        spot = sun_in(given, scene.ground.unit_normal)
        if with_sun and spot >= SPOT_SHARE:
            notice(f"the environment has a sun of its own ({spot:.0%} of the ground's light): none is added")
            with_sun = False
    none = Light(environment=ENVIRONMENT_FILE)
    if not with_sun:
        return radiance, none
    found = estimate_sun(scene.camera, scene.ground, scene.pixels, scene.masks, scene.meshes, sky)
    if found is None:
        notice("too little ground is visible to estimate the sun; it is set above, left and behind")
        return radiance, light_with_sun(none, DEFAULT_SUN, DEFAULT_STRENGTH, DEFAULT_ANGLE)
    if found.direction is None:
        notice("no object casts a clear shadow: the light is soft, without a sun (physgen light sets one)")
        return radiance, none
    light = light_with_sun(none, found.direction, found.strength, found.angle)
    notice(f"{describe_sun(light)}; its shadows stand out {found.clearness:.0f} times from the ground's texture")
    return radiance, light


def light_with_sun(light: Light, direction: Vector, strength: float, angle: float) -> Light:
    """Return ``light`` with a sun. direction: of any length; angle: rad."""
    length = math.hypot(*direction)
    x, y, z = (v / length for v in direction)
    return Light(
        environment=light.environment, sun_direction=(x, y, z), sun_strength=min(strength, 20.0), sun_angle=angle
    )


def describe_sun(light: Light) -> str:
    """Return the sun of ``light`` in words."""
    if light.sun_direction is None or light.sun_strength == 0:
        return "no sun"
    x, y, z = light.sun_direction
    height = math.degrees(math.asin(max(-1.0, min(1.0, z))))
    aside = f"{math.degrees(math.atan2(abs(x), y)):.0f}° to the {'right' if x > 0 else 'left'} of straight ahead"
    return (
        f"sun {height:.0f}° high, {aside}, {light.sun_strength:.2g} times the rest of the light, "
        f"{math.degrees(light.sun_angle):.2g}° across"
    )
