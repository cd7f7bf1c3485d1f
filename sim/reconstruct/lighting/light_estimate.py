# SPDX-License-Identifier: MIT
"""Estimate the light of a photo: an environment map and at most one sun.

The lamps come from the shadows on the ground (``lamps``). The strongest is the scene's sun; the others shine from the
environment map, as spots of their size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.environment import SPOT_SHARE, ground_light, sun_in
from ...scene.equirectangular import LUMINANCE, Radiance, directions
from ...scene.model import Camera, Ground, Light, Vector
from ...srgb import bytes_to_linear
from .ground_observation import Mask, Mesh, ground_axes
from .lamps import MOST_LAMPS, LampEstimate, estimate_lamps

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


ENVIRONMENT_FILE = "light/environment.exr"
DEFAULT_SUN = (-0.45, -0.35, 0.82)
"""Above, left and from behind the camera, a common position of windows."""
DEFAULT_STRENGTH, DEFAULT_ANGLE = 0.6, 0.3


@dataclass(frozen=True, eq=False)
class LitScene:
    """Inputs of the light estimate, lengths in the camera's unit.

    pixels, background: (H, W, 3) sRGB, with and without objects; masks: (H, W) of all objects; meshes: vertices (V, 3)
    and faces (T, 3) of the same. things: (H, W) what stands on the ground besides the objects, or None.
    """

    camera: Camera
    ground: Ground
    pixels: NDArray[np.uint8]
    background: NDArray[np.uint8]
    masks: Sequence[Mask]
    meshes: Sequence[Mesh]
    things: Mask | None = None


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
    # A map of the user's stays as it is: only a sun is added to it.
    most = MOST_LAMPS if given is None else 1
    found = estimate_lamps(
        scene.camera, scene.ground, scene.pixels, scene.masks, scene.meshes, sky, most=most, things=scene.things
    )
    if found is None:
        notice("too little ground is visible, or all is white, to estimate the sun; it is set above, left and behind")
        return radiance, light_with_sun(none, DEFAULT_SUN, DEFAULT_STRENGTH, DEFAULT_ANGLE)
    if not found:
        notice("no object casts a clear shadow: the light is soft, from above, without a sun (physgen light sets one)")
        return radiance if given is not None else with_soft_key(radiance, scene.ground), none
    sun, others = found[0], found[1:]
    rest = 1.0 - sum(lamp.share for lamp in found)
    radiance = with_spots(radiance, scene.ground, [(lamp, lamp.share / rest) for lamp in others])
    light = light_with_sun(none, sun.direction, sun.share / (1.0 - sun.share), sun.angle)
    notice(f"{describe_sun(light)}; its shadows stand out {sun.clearness:.0f} times from the ground's texture")
    for lamp in others:
        notice(
            f"a second shadow: {describe_sun(light_with_sun(none, lamp.direction, lamp.share / rest, lamp.angle))}"
            "; this lamp is a spot in the environment map"
        )
    return radiance, light


KEY_SHARE, KEY_SPREAD = 0.45, 0.3
"""Share of the ground's light that comes from around the zenith where no lamp is found, and its standard deviation in
rad. Rooms have lamps and windows, and clouds are thinner somewhere: under an even sky a thing that is up by a third of
its size leaves hardly a shadow. Judged by eye on one photo."""


def with_soft_key(radiance: Radiance, ground: Ground) -> Radiance:
    """Return ``radiance`` with a soft light around the zenith of ``ground``, again of mean luminance 1.

    It has the colour of the map's light on the ground, of which it then is ``KEY_SHARE``.
    """
    towards, solid = directions(*radiance.shape[:2])
    height = np.clip(towards @ ground.unit_normal, -1.0, 1.0)
    cosine = np.maximum(height, 0.0) * solid
    lobe = np.exp(-0.5 * np.square(np.arccos(height) / KEY_SPREAD))
    colour = np.tensordot(cosine, radiance, axes=2)
    found = radiance + lobe[..., None] * (colour * (KEY_SHARE / (1.0 - KEY_SHARE) / float((lobe * cosine).sum())))
    return np.asarray(found / float(((found @ LUMINANCE) * solid).sum() / solid.sum()), dtype=np.float32)


SPOT_SIZE = (512, 256)
"""Size of a map with spots: a pixel is 0.7°."""
SMALLEST_SPOT = 0.03
"""Radians; a narrower spot would be a few pixels only."""


def with_spots(radiance: Radiance, ground: Ground, lamps: Sequence[tuple[LampEstimate, float]]) -> Radiance:
    """Return ``radiance`` with ``lamps`` as discs in it, at least ``SPOT_SIZE`` large, again of mean luminance 1.

    lamps: each with its irradiance on open ground over that of the map. The discs have the colour of the map's light
    on the ground.
    """
    if not lamps:
        return radiance
    if radiance.shape[1] < SPOT_SIZE[0]:
        radiance = np.asarray(cv2.resize(radiance, SPOT_SIZE, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    towards, solid = directions(*radiance.shape[:2])
    cosine = np.maximum(towards @ ground.unit_normal, 0.0) * solid
    colour = np.tensordot(cosine, radiance, axes=2)
    # A soft border of a pixel: a small disc would else be of a size that depends on where it lies.
    pixel = math.pi / radiance.shape[0]
    found = radiance
    for lamp, strength in lamps:
        off = np.arccos(np.clip(towards @ np.asarray(lamp.direction), -1.0, 1.0))
        disc = np.clip((max(lamp.angle, SMALLEST_SPOT) / 2.0 - off) / pixel + 0.5, 0.0, 1.0)
        lit = float((disc * cosine).sum())
        if lit > 0.0:
            found = found + disc[..., None] * (colour * (strength / lit))
    return np.asarray(found / float(((found @ LUMINANCE) * solid).sum() / solid.sum()), dtype=np.float32)


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
