# SPDX-License-Identifier: GPL-3.0-or-later
"""EEVEE for the same image formation as Cycles: exact coverage, direct light, shadow maps drawn anew each sample."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from . import compat, passes
from .options import RenderOptions
from .regions import Box
from .sky_lamps import SkyLamp
from .sun import turn_to

MAX_SUBPIXELS = 8
MAX_DRAWN = 2**24
"""Pixels that are drawn at once, subpixels among them; each takes some 60 bytes of the graphics card's memory."""
MAX_ANGLE = 1.2
"""A lamp whose directions are spread wider than this would shine through the ground beside it."""


def set_up(scene: bpy.types.Scene, options: RenderOptions) -> None:
    """Let EEVEE render ``scene``, whose light is soft."""
    render, eevee = scene.render, scene.eevee
    render.engine = compat.eevee()
    # Every sample sees all pixels at another place within themselves, and every lamp from another of its directions.
    eevee.taa_render_samples = options.samples
    render.filter_size = 1.0
    render.use_high_quality_normals = True
    eevee.use_raytracing = eevee.use_fast_gi = False
    eevee.clamp_surface_direct = eevee.clamp_surface_indirect = 0.0
    eevee.use_shadows = True
    eevee.shadow_pool_size = "1024"
    # Unlit: the lamps are the sky too. A scene without a world would be given one.
    scene.world = bpy.data.worlds.new("no light")
    tree = compat.node_tree(scene.world)
    shader, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    shader.inputs["Strength"].default_value = 0.0
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])


def set_up_colours(scene: bpy.types.Scene, options: RenderOptions) -> None:
    """Let EEVEE render the colours of ``scene``, whose size is ``subpixels`` times the picture's."""
    set_up(scene, options)
    # All its samples would be alike: with this filter they lie in the middle of the pixel.
    scene.eevee.taa_render_samples, scene.render.filter_size = 1, 0.0


def subpixels(options: RenderOptions) -> int:
    """Samples along a pixel's side. EEVEE has no filter that is a box, and any other takes in neighbouring pixels."""
    return int(np.clip(round(options.samples**0.5), 1, MAX_SUBPIXELS))


def colours(
    scene: bpy.types.Scene, layer: str, frame: int, box: Box, side: int, folder: Path
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The pass ``layer`` (h, w, 3) and coverage (h, w) in ``box``, means over ``side`` times ``side`` subpixels.

    ``folder`` takes temporary files. Raises RenderError when Blender fails.
    """
    rows = max(MAX_DRAWN // (box.width * side * side), 1)
    parts = []
    for top in range(box.y0, box.y1, rows):
        strip = Box(box.x0 * side, top * side, box.x1 * side, min(top + rows, box.y1) * side)
        channels = passes.render(scene, frame, strip, folder)
        whole = np.concatenate([passes.stack(channels, layer), channels["Combined.A"][..., None]], axis=-1)
        height, width = whole.shape[0] // side, whole.shape[1] // side
        parts.append(whole.reshape(height, side, width, side, 4).mean(axis=(1, 3)))
    pixels = np.concatenate(parts)
    return pixels[..., :3], pixels[..., 3]


def add_lamp(scenes: list[bpy.types.Scene], lamp: SkyLamp, *, finest: float) -> None:
    """Add ``lamp`` to ``scenes``; ``finest`` (metres) is what its shadows need to resolve."""
    data = bpy.data.lights.new("sky", "SUN")
    irradiance = float(lamp.irradiance.max())
    data.energy, data.color = irradiance, (lamp.irradiance / max(irradiance, 1e-30)).tolist()
    data.angle = min(lamp.angle, MAX_ANGLE)
    sharpen(data, finest=finest)
    item = bpy.data.objects.new("sky", data)
    item.rotation_euler = turn_to(lamp.direction).to_euler()
    for scene in scenes:
        scene.collection.objects.link(item)


def sharpen(data: bpy.types.Light, *, finest: float) -> None:
    """Shadows of the sun lamp ``data`` from hard ones, one for each sample's direction.

    EEVEE's own soft shadows follow rays through one shadow map and leak where things touch the ground. ``finest``:
    size of a pixel of the map, metres; finer maps cost memory and time.
    """
    data.use_shadow, data.use_shadow_jitter, data.shadow_jitter_overblur = True, True, 0.0
    data.shadow_filter_radius = 1.0
    data.shadow_maximum_resolution = float(np.clip(finest, 1e-5, 1e3))


@contextlib.contextmanager
def unseen(collection: bpy.types.Collection) -> Iterator[None]:
    """What is in ``collection`` throws shadows, but the camera does not see it.

    Cycles has ``indirect_only`` for it, which EEVEE knows not.
    """
    items = [item for item in collection.all_objects if item.visible_camera]
    for item in items:
        item.visible_camera = False
    try:
        yield
    finally:
        for item in items:
            item.visible_camera = True
