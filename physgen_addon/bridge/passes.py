# SPDX-License-Identifier: GPL-3.0-or-later
"""One still of one Blender scene as linear arrays."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError, RenderError
from . import compat
from .exr import read_layers
from .regions import Box

EEVEE_STEPS = 8
"""Moments of a stroke that EEVEE draws."""

Channels = dict[str, NDArray[np.float32]]


def set_up(scene: bpy.types.Scene) -> None:
    """What every engine needs: transparent where nothing is, only the border, linear numbers as they are."""
    render = scene.render
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    render.use_border = render.use_crop_to_border = True
    scene.view_settings.view_transform = "Standard"
    compat.set_exr(render.image_settings)


def open_shutter(scene: bpy.types.Scene, share: float, samples: int) -> None:
    """Blur what moves in the ``share`` of a frame interval before the frame, 0 for none, with so many samples.

    EEVEE's samples stay; they are spread over at least ``EEVEE_STEPS`` moments.
    """
    settings = scene.render
    settings.use_motion_blur = share > 0
    if settings.engine == "CYCLES":
        scene.cycles.samples = samples
    else:
        # Without its blur along the picture's own motion, which smears outlines over the ground.
        scene.eevee.motion_blur_steps, scene.eevee.motion_blur_max = EEVEE_STEPS, 0
    if share > 0:
        settings.motion_blur_shutter, settings.motion_blur_position = share, "END"


def render(scene: bpy.types.Scene, frame: int, box: Box, folder: Path) -> Channels:
    """Render ``box`` of ``scene`` at ``frame``; channels (h, w) of the box such as ``Combined.R``.

    ``folder`` holds the temporary file. Raises RenderError when Blender fails.
    """
    settings = scene.render
    width, height = settings.resolution_x, settings.resolution_y
    # Blender cuts borders down to whole pixels; a quarter pixel keeps rounding on the right side.
    settings.border_min_x, settings.border_max_x = (box.x0 + 0.25) / width, min((box.x1 + 0.25) / width, 1.0)
    settings.border_min_y = (height - box.y1 + 0.25) / height
    settings.border_max_y = min((height - box.y0 + 0.25) / height, 1.0)
    path = folder / "layers.exr"
    path.unlink(missing_ok=True)
    settings.filepath = str(path)
    scene.frame_set(frame)
    try:
        # The operator renders its scene at the frame of the context's scene.
        with compat.active_scene(scene):
            bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        raise RenderError(f"frame {frame}: Blender could not render it: {error}") from error
    try:
        channels = read_layers(path)
    except InputError as error:
        # Blender says nothing when a write fails, and a full disk is the usual reason.
        raise RenderError(
            f"frame {frame}: Blender wrote no usable image; free space for temporary files, then run again ({error})"
        ) from error
    if next(iter(channels.values())).shape != (box.height, box.width):
        found = next(iter(channels.values())).shape
        raise RenderError(f"frame {frame}: Blender rendered {found} pixels instead of {(box.height, box.width)}")
    return channels


def stack(channels: Channels, name: str) -> NDArray[np.float32]:
    """The pass ``name`` as (h, w, 3); RenderError when it is missing."""
    try:
        return np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1)
    except KeyError:
        raise RenderError(f"Blender wrote no pass {name!r}, only {sorted(channels)}") from None
