# SPDX-License-Identifier: GPL-3.0-or-later
"""A baked scene as Alembic from the command line and from Python, opened again by Blender."""

import dataclasses
import shutil

import numpy as np
import physgen
import pytest
from physgen.batch.cli import main
from physgen.sim.cache.bake_folder import load_bake, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.material import load_preset

bpy = pytest.importorskip("bpy")

SHIFTS = [(0.02 * i, 0.0, 0.01 * i) for i in range(5)]


def opened(file):
    """Import ``file`` into an empty Blender; the mesh of most vertices: one that grains replace has none."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.alembic_import(filepath=str(file), as_background_job=False)
    meshes = [item for item in bpy.data.objects if item.type == "MESH"]
    return max(meshes, key=lambda item: len(item.data.vertices))


def middle(item, frame):
    """Middle of the bounding box in the world at ``frame``."""
    bpy.context.scene.frame_set(frame)
    shown = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([shown.matrix_world @ vertex.co for vertex in shown.data.vertices])
    return (points.min(axis=0) + points.max(axis=0)) / 2


@pytest.mark.parametrize("fps", [24.0, 29.97])
def test_bodies_move_as_baked(world, bake, tmp_path, fps):
    folder = bake(SHIFTS)
    made = load_bake(folder)
    made = dataclasses.replace(made, manifest=dataclasses.replace(made.manifest, fps=fps))
    save_manifest(folder, made.manifest)
    out = tmp_path / "für andere" / "moving.abc"
    assert main(["export", str(world.folder.root), "--bake", str(folder), "--alembic", str(out)]) == 0
    item = opened(out)
    bpy.context.scene.render.fps, bpy.context.scene.render.fps_base = 30, 30 / fps
    first = middle(item, 1)
    for index, shift in enumerate(SHIFTS):
        assert middle(item, 1 + index) - first == pytest.approx(np.array(shift), abs=1e-5)
    assert [path.name for path in out.parent.iterdir()] == ["moving.abc"]


def test_grains_are_vertices(world, bake, tmp_path):
    item = world.folder.objects[0]
    model = dataclasses.replace(world.folder.model, objects=(dataclasses.replace(item, material=load_preset("sand")),))
    root = shutil.copytree(world.folder.root, tmp_path / "scene")
    scene = save_scene(root, model)
    folder = bake(SHIFTS)
    made = load_bake(folder)
    grains = np.random.default_rng(1).uniform(-0.02, 0.02, (300, 3))
    with Pc2Writer(folder / "grains.pc2", vertex_count=300) as writer:
        for shift in SHIFTS:
            writer.append(grains + shift)
    baked = dataclasses.replace(made.manifest.objects[0], points_file="grains.pc2", points=300)
    manifest = dataclasses.replace(made.manifest, objects=(baked,), geometry_hash="")
    save_manifest(folder, manifest)
    physgen.export_alembic(scene, load_bake(folder), tmp_path / "sand.abc")
    assert len(opened(tmp_path / "sand.abc").data.vertices) == 300


def test_what_cannot_be_written_is_one_line(world, bake, tmp_path, capsys):
    scene, folder = world.folder, bake(SHIFTS)
    arguments = ["export", str(scene.root), "--alembic", str(tmp_path / "x.abc")]
    with pytest.raises(SystemExit) as usage:
        main(arguments)
    assert usage.value.code == 2 and "--alembic needs --bake" in capsys.readouterr().err
    (tmp_path / "x.abc").write_bytes(b"mine")
    assert main([*arguments, "--bake", str(folder)]) == 3
    assert "is there already" in capsys.readouterr().err and (tmp_path / "x.abc").read_bytes() == b"mine"
    made = load_bake(folder)
    other = dataclasses.replace(made, manifest=dataclasses.replace(made.manifest, geometry_hash="0" * 64))
    with pytest.raises(InputError, match="another scene"):
        physgen.export_alembic(scene, other, tmp_path / "y.abc")
    with pytest.raises(InputError, match=r"ends in \.abc"):
        physgen.export_alembic(scene, made, tmp_path / "y.obj")
