# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender scenes for the tests of the panels: cubes that are selected and take part, and presets of the test's own."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")


def own_folder(tmp_path, create=False):
    folder = tmp_path / "materials"
    if create:
        folder.mkdir(exist_ok=True)
    return folder


def a_cube(name="Cube", location=(0, 0, 0), size=2.0):
    mesh = bpy.data.meshes.new(name)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh.from_pydata(corners.tolist(), [], faces)
    item = bpy.data.objects.new(name, mesh)
    item.location = location
    bpy.context.scene.collection.objects.link(item)
    bpy.context.view_layer.update()
    return item


def select(*items):
    bpy.context.view_layer.update()
    for item in bpy.context.view_layer.objects:
        item.select_set(item in items)
    bpy.context.view_layer.objects.active = items[0] if items else None


def a_body(name="Cube", **options):
    item = a_cube(name, **options)
    select(item)
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    return item
