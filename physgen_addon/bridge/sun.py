# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene's sun as a lamp of Blender."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
from mathutils import Quaternion, Vector
from numpy.typing import NDArray

from ...sim.scene.folder import SceneFolder
from ...sim.scene.model import Light

MIN_SUN_COSINE = 0.05
"""A sun lower than 3° over the ground would need an unbounded strength to light it as much as the scene says."""


def new_sun(
    light: Light, normal: NDArray[np.float64], irradiance: float, colour: NDArray[np.floating]
) -> tuple[bpy.types.Light, Quaternion]:
    """The lamp of ``light``, whose ``sun_direction`` is given, and how an object that holds it is turned.

    normal: unit vector (3,) of the ground; irradiance: of the ground by the sun; colour: RGB (3,) of luminance 1.
    """
    direction = np.asarray(light.sun_direction)
    data = bpy.data.lights.new("sun", "SUN")
    # Blender's strength is the irradiance of a surface that faces the sun.
    data.energy = irradiance / max(float(direction @ normal), MIN_SUN_COSINE)
    # The photo's white balance has made the whole light white; a sun of another colour than the sky's light would
    # tint the shadows.
    data.color = colour.tolist()
    data.angle = light.sun_angle
    return data, turn_to(direction)


def turn_to(direction: NDArray[np.floating]) -> Quaternion:
    """How a lamp is turned whose light comes from ``direction`` (3,)."""
    return Vector(direction.tolist()).to_track_quat("Z", "Y")


def with_sun_angle(folder: SceneFolder, angle: float | None) -> SceneFolder:
    """``folder`` with a sun of this apparent diameter in radians; None leaves the scene's."""
    if angle is None:
        return folder
    light = dataclasses.replace(folder.scene.light, sun_angle=angle)
    return dataclasses.replace(folder, scene=dataclasses.replace(folder.scene, light=light))
