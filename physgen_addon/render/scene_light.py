# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of a scene folder in Blender: its environment map and sun, as a world for Cycles, as lamps for EEVEE."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.environment import lamps_in
from ...sim.scene.equirectangular import LUMINANCE, irradiance
from ...sim.scene.folder import Scene
from .. import compat
from ..frames.frame_files import read_layers
from ..paths import for_blender
from ..scene_io.photo_view import new_sun
from . import render_engines
from .sky_lamps import SkyLamp, sky_lamps

LAMPS_ABOVE, LAMPS_BELOW = 16, 8
OPEN_RADIANCE = 2.0
"""EEVEE's lamps are scaled so that open white ground has this radiance: it stores a surface's colour, here 1 over the
reference lighting, with few bits and up to 8. Only ratios of light affect the image.
"""


@dataclass(frozen=True)
class _Sky:
    """The environment. path: its file, None for uniform white. radiance: (H, W, 3). colour: RGB (3,) irradiance of
    the open ground.
    """

    path: Path | None
    radiance: NDArray[np.float32]
    colour: NDArray[np.float64]

    @property
    def irradiance(self) -> float:
        return float(self.colour @ LUMINANCE)


def add_environment(scenes: list[bpy.types.Scene], folder: Scene) -> float:
    """Light all ``scenes`` as ``folder`` specifies; return the luminance of the irradiance on the open ground.

    Raises InputError if the environment map is unreadable or black.
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
        texture.image = bpy.data.images.load(for_blender(sky.path))
        texture.image.colorspace_settings.name = "Linear Rec.709"
        tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
        # Sampled at the map's own resolution; the automatic choice is larger and costs time in every frame.
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = int(np.clip(sky.radiance.shape[1], 4, 1024))
    for scene in scenes:
        scene.world = world
    sun = _add_sun(scenes, folder, sky, 1.0)
    return sky.irradiance * (1.0 if sun is None else 1.0 + folder.model.light.sun_strength)


def add_lamps(light_scene: bpy.types.Scene, shadow_scene: bpy.types.Scene, folder: Scene) -> float:
    """Light both scenes as ``folder`` specifies for EEVEE, whose world casts no shadows: the sky as lamps, uniformly
    scaled (``OPEN_RADIANCE``); return the scaled luminance of the irradiance on the open ground.

    Raises InputError as ``add_environment`` does.
    """
    sky, normal = _sky(folder), folder.model.ground_plane.unit_normal
    both = [light_scene, shadow_scene]
    strength = folder.model.light.sun_strength if folder.model.light.sun_direction is not None else 0.0
    scale = OPEN_RADIANCE * math.pi / (sky.irradiance * (1.0 + strength))
    # A quarter of what a pixel of light spans on the ground: light comes in low there, and a coarser map would darken
    # the surroundings of contacts.
    camera, width = folder.model.camera, shadow_scene.render.resolution_x
    height = abs(float((camera.position - np.asarray(folder.model.ground_plane.point)) @ normal))
    finest = 0.25 * height / (camera.fx * width / camera.width)
    above, below = sky_lamps(sky.radiance, normal, above=LAMPS_ABOVE, below=LAMPS_BELOW)
    for lamps, scenes in ((above, both), (below, [light_scene])):
        for lamp in lamps:
            render_engines.add_lamp(scenes, SkyLamp(lamp.direction, lamp.irradiance * scale, lamp.angle), finest=finest)
    sun = _add_sun(both, folder, sky, scale)
    if sun is not None:
        render_engines.sharpen(sun, finest=finest)
    return OPEN_RADIANCE * math.pi


def _add_sun(scenes: list[bpy.types.Scene], folder: Scene, sky: _Sky, scale: float) -> bpy.types.Light | None:
    light = folder.model.light
    if light.sun_direction is None or light.sun_strength <= 0:
        return None
    normal = folder.model.ground_plane.unit_normal
    data, turn = new_sun(light, normal, light.sun_strength * sky.irradiance * scale, sky.colour / sky.irradiance)
    item = bpy.data.objects.new("sun", data)
    item.rotation_euler = turn.to_euler()
    for scene in scenes:
        scene.collection.objects.link(item)
    return data


def _sky(folder: Scene) -> _Sky:
    name = folder.model.light.environment
    if name is None:
        return _Sky(None, np.ones((32, 64, 3), np.float32), np.full(3, math.pi))
    path = folder.file(name)
    radiance = _read_environment(path)
    sky = _Sky(path, radiance, irradiance(radiance, folder.model.ground_plane.unit_normal))
    if not (math.isfinite(sky.irradiance) and sky.irradiance > 0):
        raise InputError(f"{path}: lights the ground with {sky.irradiance}; give an environment with finite light")
    return sky


def environment_lamps(folder: Scene) -> list[tuple[NDArray[np.float64], float]]:
    """Return the lamps in the environment of ``folder`` as ``lamps_in`` does. Raises InputError if it is unreadable."""
    return lamps_in(_sky(folder).radiance, folder.model.ground_plane.unit_normal)


def _read_environment(path: Path) -> NDArray[np.float32]:
    channels = read_layers(path)
    try:
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    except KeyError:
        raise InputError(f"{path}: has channels {sorted(channels)}; an environment needs R, G and B") from None
