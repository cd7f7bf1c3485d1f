# SPDX-License-Identifier: GPL-3.0-or-later
"""The move of a Blender scene's camera against the photo's, as a path that rendering into the photo follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import bpy
import numpy as np

from ...sim.errors import InputError
from ...sim.scene.camera_move import ZOOM_RANGE, is_still, posed
from ...sim.scene.camera_path import CameraPath, PoseKey
from ...sim.scene.model import Camera


def camera_path(scene: bpy.types.Scene, photo: Camera, frames: Sequence[int], *, first_frame: int) -> CameraPath | None:
    """What the camera of ``scene`` does over its ``frames``, numbered from ``first_frame`` on; None: it stands still.

    photo: the photo's camera, which the scene's is compared with. Still is what shows the photo's own view; a scene
    without a camera has it too. The current frame comes back at the end. Raises InputError for a lens that has nothing
    in common with the photo's.
    """
    if scene.camera is None:
        return None
    now, part = scene.frame_current, scene.frame_subframe
    seen = []
    try:
        for frame in frames if _may_move(scene) else (now,):
            scene.frame_set(frame)
            seen.append(_seen(scene, photo))
    finally:
        scene.frame_set(now, subframe=part)
    ahead = photo.position + np.asarray(photo.world_from_camera)[:3, 2]
    if all(is_still(photo, camera, ahead) for camera in seen):
        return None
    keys = [
        PoseKey(
            frame=float(first_frame + index),
            world_from_camera=camera.world_from_camera,
            zoom=camera.fx / photo.fx,
        )
        for index, camera in enumerate(seen)
    ]
    return CameraPath(interpolation="linear", poses=tuple(keys))


def _may_move(scene: bpy.types.Scene) -> bool:
    """Whether the scene's camera may be elsewhere at another frame."""
    item = scene.camera
    animated = any(owner.animation_data is not None for owner in (item, item.data))
    cut = any(marker.camera is not None for marker in scene.timeline_markers)
    return animated or cut or item.parent is not None or len(item.constraints) > 0


def _seen(scene: bpy.types.Scene, photo: Camera) -> Camera:
    """``photo`` where the scene's camera is at the current frame, with its focal length."""
    graph = scene.view_layers[0].depsgraph
    item = scene.camera.evaluated_get(graph)
    if item.data.type != "PERSP":
        raise InputError(f"camera {scene.camera.name!r} is no perspective camera: the photo was taken by one")
    pose = np.array(item.matrix_world, dtype=np.float64)
    turn = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
    there = posed(photo, turn @ np.diag([1.0, -1.0, -1.0]), pose[:3, 3])
    render = scene.render
    lens = item.calc_matrix_camera(
        graph, x=photo.width, y=photo.height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    zoom = float(lens[0][0]) * photo.width / 2.0 / photo.fx
    # Blender keeps lenses in 32 bits.
    zoom = 1.0 if abs(zoom - 1.0) < 1e-5 else zoom
    if not ZOOM_RANGE[0] <= zoom <= ZOOM_RANGE[1]:
        raise InputError(
            f"camera {scene.camera.name!r} has {zoom:.2g} times the photo's focal length: give it the lens of the "
            f"photo's camera, or {ZOOM_RANGE[0]:g} to {ZOOM_RANGE[1]:g} times that"
        )
    return replace(there, fx=photo.fx * zoom, fy=photo.fy * zoom)
