# SPDX-License-Identifier: MIT
"""The light of a reconstructed scene: an environment, from the photo or a file, and at most one sun."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.environment import SPOT_SHARE, ground_light, sun_in
from ...scene.equirectangular import Radiance
from ...scene.model import Camera, Ground, Light, Vector
from .ground_view import Mask, Mesh, ground_axes
from .photo_environment import photo_environment
from .sun import estimate_sun

ENVIRONMENT_FILE = "light/environment.exr"
DEFAULT_SUN = (-0.45, -0.35, 0.82)
"""Above, left and from behind the camera: where painters and windows put it."""
DEFAULT_STRENGTH, DEFAULT_ANGLE = 0.6, 0.3


@dataclass(frozen=True, eq=False)
class LitScene:
    """What light is estimated from, lengths in the camera's unit.

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
    """The environment and the light of ``scene``, whose map is yet to be written; ``notice`` is told what was found.

    given: an environment that replaces the photo's, in the scene's axes. It keeps its own sun: a bright small spot in
    it means that none is looked for in the shadows. with_sun: False leaves it out in any case.
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
        notice("too little ground is seen to tell where the light comes from; the sun is set to above, left, behind")
        return radiance, sunny(none, DEFAULT_SUN, DEFAULT_STRENGTH, DEFAULT_ANGLE)
    if found.direction is None:
        notice("no object throws a clear shadow: the light is soft, without a sun (physgen light sets one)")
        return radiance, none
    light = sunny(none, found.direction, found.strength, found.angle)
    notice(f"{described(light)}; its shadows stand out {found.clearness:.0f} times from the ground's texture")
    return radiance, light


def sunny(light: Light, direction: Vector, strength: float, angle: float) -> Light:
    """``light`` with a sun. direction: of any length; angle: rad."""
    length = math.hypot(*direction)
    x, y, z = (v / length for v in direction)
    return Light(
        environment=light.environment, sun_direction=(x, y, z), sun_strength=min(strength, 20.0), sun_angle=angle
    )


def described(light: Light) -> str:
    """The sun of ``light`` in words."""
    if light.sun_direction is None or light.sun_strength == 0:
        return "no sun"
    x, y, z = light.sun_direction
    height = math.degrees(math.asin(max(-1.0, min(1.0, z))))
    aside = f"{math.degrees(math.atan2(abs(x), y)):.0f}° to the {'right' if x > 0 else 'left'} of straight ahead"
    return (
        f"sun {height:.0f}° high, {aside}, {light.sun_strength:.2g} times the rest of the light, "
        f"{math.degrees(light.sun_angle):.2g}° across"
    )
