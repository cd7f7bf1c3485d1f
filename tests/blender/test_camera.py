# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own projection against ``Camera.project``."""

import numpy as np
import pytest
from physgen.sim.scene.model import Camera

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon import compat
from physgen.physgen_addon.scene_io.photo_view import add_camera, render_size

POSE = ((0.8, -0.36, 0.48, 0.1), (0.0, -0.8, -0.6, 0.4), (0.6, 0.48, -0.64, 0.9), (0, 0, 0, 1))


@pytest.mark.parametrize(
    ("fx", "fy", "cx", "cy", "scale"),
    [
        (600, 600, 320, 240, 1.0),
        (600, 540, 320, 240, 1.0),
        (540, 610, 320, 240, 1.0),
        (600, 560, 290.25, 275.5, 1.0),
        (560, 600, 360.5, 201.0, 0.37),
    ],
)
def test_projection_matches(fx, fy, cx, cy, scale):
    camera = Camera(width=640, height=480, fx=fx, fy=fy, cx=cx, cy=cy, world_from_camera=POSE)
    compat.enable_cycles()
    scene = bpy.data.scenes.new("camera")
    size = render_size(camera, scale)
    item = add_camera(scene, camera, size)
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        scene.view_layers[0].update()
        render = scene.render
        matrix = item.calc_matrix_camera(
            scene.view_layers[0].depsgraph,
            x=size[0],
            y=size[1],
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [640, 480], (50, 2))
    points = camera.position + camera.rays(pixels) * rng.uniform(0.3, 3.0, (50, 1))
    full = np.asarray(matrix) @ np.asarray(item.matrix_world.inverted())
    clip = np.c_[points, np.ones(50)] @ full.T
    device = clip[:, :2] / clip[:, 3:]
    found = np.c_[(device[:, 0] + 1) / 2 * size[0], (1 - device[:, 1]) / 2 * size[1]]
    expected = camera.project(points)[:, :2] * np.array(size) / [640, 480]
    assert np.abs(found - expected).max() < 0.02
