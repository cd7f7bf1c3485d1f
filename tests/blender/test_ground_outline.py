# SPDX-License-Identifier: GPL-3.0-or-later
"""The lines that show the ground in viewports: where it is, and only where it is to be seen."""

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.overlays import GROUND_CELLS, ground_lines

from .panel_scenes import a_body

pytestmark = pytest.mark.usefixtures("addon")


def ends():
    return np.array(ground_lines(bpy.context.scene))


def test_the_lines_lie_on_the_plane_below_the_objects():
    assert ground_lines(bpy.context.scene) == []
    item, world = a_body(), bpy.context.scene.physgen.world
    item.location = (3.0, 0.0, 5.0)
    bpy.context.view_layer.update()
    world.ground_point, world.ground_normal = (0.0, 0.0, -2.0), (0.0, 0.0, 1.0)
    found = ends()
    assert (
        len(found) == 4 * (GROUND_CELLS + 1) and np.allclose(found[:, 2], -2.0, atol=0.03) and found[:, 2].min() > -2.0
    )
    assert np.allclose(found[:, :2].mean(axis=0), (3.0, 0.0), atol=1e-5)
    assert np.ptp(found[:, 0]) > 2 * item.dimensions.x
    world.ground_normal = (1.0, 0.0, 1.0)
    tilted = ends()
    assert np.allclose((tilted - (0.0, 0.0, -2.0)) @ (1.0, 0.0, 1.0), 0.0, atol=0.05)


def test_no_lines_where_the_ground_is_seen_otherwise_or_there_is_none():
    a_body()
    scene = bpy.context.scene
    assert ground_lines(scene)
    scene.physgen.world.use_ground = False
    assert ground_lines(scene) == []
    scene.physgen.world.use_ground, scene.physgen.folder = True, "//photo"
    assert ground_lines(scene) == []
    scene.physgen.folder = ""
    bpy.ops.mesh.primitive_plane_add()
    scene.physgen.world.ground_object = bpy.context.object
    assert ground_lines(scene) == []
