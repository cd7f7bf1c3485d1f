# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's light in Blender: the environment map and the sun."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder
from . import compat
from .environment import LUMINANCE, environment_irradiance
from .exr import read_layers
from .sun import new_sun


def add_light(scenes: list[bpy.types.Scene], folder: SceneFolder) -> float:
    """Give all ``scenes`` the light of ``folder``; the luminance of the irradiance on the open ground.

    Raises InputError when the environment map is not readable or black.
    """
    light, ground = folder.scene.light, folder.scene.ground
    normal = np.asarray(ground.normal, dtype=float)
    world = bpy.data.worlds.new("environment")
    colour = np.ones(3)
    tree = compat.node_tree(world)
    shader = tree.nodes.new("ShaderNodeBackground")
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    if light.environment is None:
        shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        irradiance = math.pi
    else:
        path = folder.file(light.environment)
        radiance = _read_environment(path)
        colour = environment_irradiance(radiance, normal)
        irradiance = float(colour @ LUMINANCE)
        if not (math.isfinite(irradiance) and irradiance > 0):
            raise InputError(f"{path}: lights the ground with {irradiance}; give an environment with finite light")
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        texture.image = bpy.data.images.load(str(path))
        texture.image.colorspace_settings.name = "Linear Rec.709"
        tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
        # Sampled at the map's own resolution; the automatic choice is larger and costs time in every frame.
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = int(np.clip(radiance.shape[1], 4, 1024))
    for scene in scenes:
        scene.world = world
    total = irradiance
    if light.sun_direction is not None and light.sun_strength > 0:
        total += light.sun_strength * irradiance
        data, turn = new_sun(light, normal, light.sun_strength * irradiance, colour / (colour @ LUMINANCE))
        sun = bpy.data.objects.new("sun", data)
        sun.rotation_euler = turn.to_euler()
        for scene in scenes:
            scene.collection.objects.link(sun)
    return total


def _read_environment(path: Path) -> NDArray[np.float32]:
    channels = read_layers(path)
    try:
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    except KeyError:
        raise InputError(f"{path}: has channels {sorted(channels)}; an environment needs R, G and B") from None
