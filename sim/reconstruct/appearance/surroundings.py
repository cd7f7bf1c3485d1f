# SPDX-License-Identifier: MIT
"""Where an object's light comes from: the sky, one sun, and the ground that both light.

Light is measured so that a white matt surface lying open on the ground has brightness (1, 1, 1): a photo's white
balance makes the whole light white, and its exposure makes such a surface about white.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.equirectangular import LUMINANCE, Radiance, directions
from ...scene.model import Camera, Light
from ..light.cast import sun_disc

Points = NDArray[np.float64]

SKY_SIZE = (64, 32)
LATTICE = 128
"""Directions all around in which it is asked what hides the light."""
SUN_POINTS = 8
LOWEST_SUN = 0.05
USUAL_GROUND = 0.3
BRIGHTEST_GROUND = 0.8
"""Albedo: white paper and snow are a little brighter, ordinary grounds are darker."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The light of a scene over the ground z = 0.

    sky: (32, 64, 3) radiance, black below the horizon. ground: (3,) albedo. sun: (3,) unit vector towards the sun, or
    None. sun_radiance: irradiance over π of a surface that faces the sun. sun_angle: its diameter in rad.
    white: (3,) what the photo's pixels, in linear light, are for brightness 1.
    """

    sky: NDArray[np.float64]
    ground: Points
    sun: Points | None
    sun_radiance: float
    sun_angle: float
    white: Points

    @property
    def ground_radiance(self) -> Points:
        """RGB (3,) of ground in open light."""
        return self.ground


def surroundings(
    camera: Camera, background: NDArray[np.float32], place: Points, size: float, radiance: Radiance, light: Light
) -> Surroundings:
    """The light around ``place`` (3,) on the ground, over ``size``, both in the unit of ``camera``.

    background: (H, W, 3) linear, without the objects and their shadows. radiance: the environment.
    """
    sky = cv2.resize(np.asarray(radiance, dtype=np.float32), SKY_SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
    towards, solid = directions(SKY_SIZE[1], SKY_SIZE[0])
    sky[towards[..., 2] <= 0] = 0.0
    open_light = np.einsum("hwc,hw,hw->c", sky, np.maximum(towards[..., 2], 0.0), solid) / np.pi
    level = max(float(open_light @ LUMINANCE), 1e-9)
    strength = light.sun_strength if light.sun_direction is not None else 0.0
    sky = sky / np.maximum(open_light, 0.05 * level) / (1.0 + strength)
    sun, sun_radiance = None, 0.0
    if light.sun_direction is not None and strength > 0:
        sun = np.asarray(light.sun_direction, dtype=np.float64)
        sun_radiance = strength / (1.0 + strength) / max(float(sun[2]), LOWEST_SUN)
    colour = _ground_colour(camera, background, place, size)
    exposure = 1.0 if colour is None else max(1.0, float(colour @ LUMINANCE) / BRIGHTEST_GROUND)
    ground = np.full(3, USUAL_GROUND) if colour is None else np.clip(colour / exposure, 0.02, 0.95)
    return Surroundings(sky, ground, sun, sun_radiance, light.sun_angle, np.full(3, exposure))


def _ground_colour(camera: Camera, background: NDArray[np.float32], place: Points, size: float) -> Points | None:
    """Median colour of the ground around; None where the photo shows too little of it."""
    steps = np.linspace(-2.0, 2.0, 41) * size
    x, y = np.meshgrid(steps, steps)
    spots = np.column_stack([x.ravel() + place[0], y.ravel() + place[1], np.zeros(x.size)])
    at = camera.project(spots)
    height, width = background.shape[:2]
    inside = (at[:, 2] > 0) & (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
    if inside.sum() < 60:
        return None
    columns, rows = at[inside, :2].astype(int).T
    return np.asarray(np.median(background[rows, columns], axis=0), dtype=np.float64)


def lattice(count: int = LATTICE) -> Points:
    """Unit vectors (count, 3) evenly all around, in sunflower order."""
    number = np.arange(count)
    height = 1.0 - (2.0 * number + 1.0) / count
    turn = number * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])


def sun_points(scene: Surroundings, count: int = SUN_POINTS) -> Points:
    """Unit vectors (count, 3) over the sun's disc, above the horizon. It must have a sun."""
    assert scene.sun is not None
    disc, weight = sun_disc(scene.sun, scene.sun_angle, count)
    return disc[weight > 0] if (weight > 0).any() else scene.sun[None]
