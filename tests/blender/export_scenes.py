# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender scenes for the tests of the export: cubes, empties and animations, and the folders made of them."""

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.scene_to_world import prepare_world
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh

CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def add(name="Cube", place=(0.0, 0.0, 1.0), *, role="dynamic", vertices=CUBE, faces=QUADS):
    data = bpy.data.meshes.new(name)
    data.from_pydata(vertices, [], faces)
    item = bpy.data.objects.new(name, data)
    item.location = place
    item.physgen.enabled, item.physgen.role = True, role
    bpy.context.scene.collection.objects.link(item)
    return item


def add_empty(name, place=(0.0, 0.0, 1.0), size=1.0):
    item = bpy.data.objects.new(name, None)
    item.empty_display_type, item.empty_display_size, item.location = "CUBE", size, place
    bpy.context.scene.collection.objects.link(item)
    return item


def animate(item, path, first, last, frames=(1, 9)):
    for frame, value in zip(frames, (first, last), strict=True):
        setattr(item, path, value)
        item.keyframe_insert(path, frame=frame)


def exported(scene, tmp_path, name="scene"):
    """The folder as the worker reads it, objects by name."""
    written = export_scene(scene, tmp_path / name)
    folder = load_scene(tmp_path / name)
    assert folder.model == written.model
    return folder, {item.name: item for item in folder.model.objects}


def world_vertices(item):
    bpy.context.view_layer.update()
    matrix = np.array(item.matrix_world, dtype=np.float64)
    points = np.array([vertex.co for vertex in item.data.vertices], dtype=np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def prepared(folder):
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    return prepare_world(folder, meshes, BakeOptions(quality="preview"))


def refused(scene, tmp_path, *words):
    with pytest.raises(InputError) as caught:
        export_scene(scene, tmp_path / "scene")
    for word in words:
        assert word in str(caught.value)
    assert not (tmp_path / "scene" / "scene.json").exists()
