# SPDX-License-Identifier: GPL-3.0-or-later
"""The photo's camera in Blender's terms."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.scene.model import Camera

SENSOR_MM = 36.0
CLIP_NEAR_M, CLIP_FAR_M = 1e-3, 1e4


def render_size(camera: Camera, scale: float) -> tuple[int, int]:
    """Width and height in pixels of the camera's image times ``scale``."""
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def photo_uv(camera: Camera, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Texture coordinates (V, 2), the origin at the bottom left, of ``vertices`` (V, 3) that wear the photo.

    It is projected along the camera's rays.
    """
    pixels = camera.project(vertices)
    return np.nan_to_num(np.stack([pixels[:, 0] / camera.width, 1.0 - pixels[:, 1] / camera.height], axis=1))


def add_camera(scene: bpy.types.Scene, camera: Camera, size: tuple[int, int]) -> bpy.types.Object:
    """Add ``camera`` to ``scene`` and set the scene's resolution to ``size`` (width, height).

    Blender looks along -Z with +Y up, OpenCV along +Z with +Y down. Unequal focal lengths become a pixel aspect,
    an off-centre principal point a lens shift; both are exact, also when rounding made ``size`` another shape.
    """
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
    data = bpy.data.cameras.new("photo camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_MM
    data.clip_start, data.clip_end = CLIP_NEAR_M, CLIP_FAR_M
    item = bpy.data.objects.new("photo camera", data)
    scene.collection.objects.link(item)
    scene.camera = item
    aim_camera(scene, camera)
    return item


def aim_camera(scene: bpy.types.Scene, camera: Camera) -> None:
    """Put the camera of ``scene``, which ``add_camera`` has added, where ``camera`` is, with its lens."""
    render, data = scene.render, scene.camera.data
    width, height = render.resolution_x, render.resolution_y
    fx, fy = camera.fx * width / camera.width, camera.fy * height / camera.height
    cx, cy = camera.cx * width / camera.width, camera.cy * height / camera.height
    aspect = fx / fy
    # Blender takes pixel aspects from 1 up only.
    render.pixel_aspect_x, render.pixel_aspect_y = (1.0, aspect) if aspect >= 1 else (1.0 / aspect, 1.0)
    data.lens = fx / width * SENSOR_MM
    # Shifts are in units of the image's width, also the vertical one.
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) * aspect / width
    pose = np.asarray(camera.world_from_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene.camera.matrix_world = Matrix(pose.tolist())
