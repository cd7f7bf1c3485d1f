# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's light in Blender: the environment map and the sun, as a world with a lamp or as lamps alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.equirectangular import LUMINANCE, irradiance
from ...sim.scene.folder import SceneFolder
from . import compat, eevee
from .exr import read_layers
from .sky_lamps import SkyLamp, sky_lamps
from .sun import new_sun

LAMPS_ABOVE, LAMPS_BELOW = 16, 8
OPEN_RADIANCE = 2.0
"""EEVEE's lamps are scaled until open white ground has this radiance: it stores a surface's colour, which is one over
light at rest, in few bits and up to 8. Only ratios of light reach the picture."""


@dataclass(frozen=True)
class _Sky:
    """The environment. path: its file, None for an even white. radiance: (H, W, 3). colour: RGB (3,) irradiance of
    the open ground."""

    path: Path | None
    radiance: NDArray[np.float32]
    colour: NDArray[np.float64]

    @property
    def irradiance(self) -> float:
        return float(self.colour @ LUMINANCE)


def add_environment(scenes: list[bpy.types.Scene], folder: SceneFolder) -> float:
    """Give all ``scenes`` the light of ``folder``; the luminance of the irradiance on the open ground.

    Raises InputError when the environment map is not readable or black.
    """
    sky = _sky(folder)
    world = bpy.data.worlds.new("environment")
    tree = compat.node_tree(world)
    shader = tree.nodes.new("ShaderNodeBackground")
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    if sky.path is None:
        shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    else:
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        texture.image = bpy.data.images.load(str(sky.path))
        texture.image.colorspace_settings.name = "Linear Rec.709"
        tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
        # Sampled at the map's own resolution; the automatic choice is larger and costs time in every frame.
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = int(np.clip(sky.radiance.shape[1], 4, 1024))
    for scene in scenes:
        scene.world = world
    sun = _add_sun(scenes, folder, sky, 1.0)
    return sky.irradiance * (1.0 if sun is None else 1.0 + folder.scene.light.sun_strength)


def add_lamps(light_scene: bpy.types.Scene, shadow_scene: bpy.types.Scene, folder: SceneFolder) -> float:
    """The same for EEVEE, whose world throws no shadows: the sky as lamps, all scaled alike (``OPEN_RADIANCE``).

    The luminance of the irradiance on the open ground, as scaled. Raises InputError as ``add_environment`` does.
    """
    sky, normal = _sky(folder), folder.scene.ground.unit_normal
    both = [light_scene, shadow_scene]
    strength = folder.scene.light.sun_strength if folder.scene.light.sun_direction is not None else 0.0
    scale = OPEN_RADIANCE * math.pi / (sky.irradiance * (1.0 + strength))
    # A quarter of what a pixel of light spans on the ground: light comes in low there, and a coarser map would darken
    # what lies around a contact.
    camera, width = folder.scene.camera, shadow_scene.render.resolution_x
    height = abs(float((camera.position - np.asarray(folder.scene.ground.point)) @ normal))
    finest = 0.25 * height / (camera.fx * width / camera.width)
    above, below = sky_lamps(sky.radiance, normal, above=LAMPS_ABOVE, below=LAMPS_BELOW)
    for lamps, scenes in ((above, both), (below, [light_scene])):
        for lamp in lamps:
            eevee.add_lamp(scenes, SkyLamp(lamp.direction, lamp.irradiance * scale, lamp.angle), finest=finest)
    sun = _add_sun(both, folder, sky, scale)
    if sun is not None:
        eevee.sharpen(sun, finest=finest)
    return OPEN_RADIANCE * math.pi


def _add_sun(scenes: list[bpy.types.Scene], folder: SceneFolder, sky: _Sky, scale: float) -> bpy.types.Light | None:
    light = folder.scene.light
    if light.sun_direction is None or light.sun_strength <= 0:
        return None
    normal = folder.scene.ground.unit_normal
    data, turn = new_sun(light, normal, light.sun_strength * sky.irradiance * scale, sky.colour / sky.irradiance)
    item = bpy.data.objects.new("sun", data)
    item.rotation_euler = turn.to_euler()
    for scene in scenes:
        scene.collection.objects.link(item)
    return data


def _sky(folder: SceneFolder) -> _Sky:
    name = folder.scene.light.environment
    if name is None:
        return _Sky(None, np.ones((32, 64, 3), np.float32), np.full(3, math.pi))
    path = folder.file(name)
    radiance = _read_environment(path)
    sky = _Sky(path, radiance, irradiance(radiance, folder.scene.ground.unit_normal))
    if not (math.isfinite(sky.irradiance) and sky.irradiance > 0):
        raise InputError(f"{path}: lights the ground with {sky.irradiance}; give an environment with finite light")
    return sky


def _read_environment(path: Path) -> NDArray[np.float32]:
    channels = read_layers(path)
    try:
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    except KeyError:
        raise InputError(f"{path}: has channels {sorted(channels)}; an environment needs R, G and B") from None
