# SPDX-License-Identifier: MIT
"""Scenes from mesh files, the files that meshes refer to, and a scene's hash."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import trimesh
from physgen.sim.app.reconstruct import Physics
from physgen.sim.app.scene_variant import make_variant
from physgen.sim.errors import InputError
from physgen.sim.importers.mesh_scene import scene_from_meshes
from physgen.sim.scene.folder import side_files
from physgen.sim.scene.meshes import load_object_mesh
from PIL import Image

CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
FACES = ("1/1 3/3 2/2", "1/1 2/2 4/4", "1/1 4/4 3/3", "2/2 3/3 4/4")


def textured_obj(folder, colour):
    """An OBJ with a material library and a texture in a folder below."""
    (folder / "maps").mkdir(parents=True)
    lines = ["mtllib body.mtl", *(f"v {x} {y} {z}" for x, y, z in CORNERS), *(f"vt {x} {y}" for x, y, _ in CORNERS)]
    (folder / "body.obj").write_text("\n".join([*lines, "usemtl skin", *(f"f {face}" for face in FACES)]))
    (folder / "body.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd maps/my skin.png\nmap_Bump ../secret.png\n")
    Image.new("RGB", (4, 4), colour).save(folder / "maps" / "my skin.png")
    Image.new("RGB", (4, 4)).save(folder.parent / "secret.png")
    return folder / "body.obj"


def test_materials_and_textures_are_copied_and_kept_apart(tmp_path):
    meshes = {name: textured_obj(tmp_path / name, name) for name in ("red", "blue")}
    assert side_files(meshes["red"]) == ["body.mtl", "maps/my skin.png"]
    scene = scene_from_meshes(meshes, out=tmp_path / "scene")
    for item in scene.objects:
        texture = scene.file(item.mesh).parent / "maps" / "my skin.png"
        assert texture.read_bytes() == (tmp_path / item.name / "maps" / "my skin.png").read_bytes()
        found, source = load_object_mesh(scene, item), trimesh.load(meshes[item.name], process=False, force="mesh")
        np.testing.assert_array_equal(found.vertices, source.vertices)
        np.testing.assert_array_equal(found.faces, source.faces)
    assert not list((tmp_path / "scene").rglob("secret.png"))
    assert len(scene.files()) == 6 and all(scene.file(name).is_file() for name in scene.files())
    variant = make_variant(scene, out=tmp_path / "variant", physics=Physics(presets=("hard",)))
    assert variant.files() == scene.files()


def test_a_gltf_brings_its_buffer(tmp_path):
    exported = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
    for name, content in exported.items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "model.gltf"
    assert side_files(path) == [name for name in exported if name != "model.gltf"] != []
    scene = scene_from_meshes({"box": path}, out=tmp_path / "scene")
    assert len(load_object_mesh(scene, scene.objects[0]).faces) == 12
    assert len(scene.files()) == len(exported)


@pytest.mark.parametrize(
    "text", ["", "[1]", '{"buffers": 3, "images": [{"uri": 4}, 5]}', '{"buffers": [{"uri": "../x"}]}', "{"]
)
def test_damaged_references_are_ignored(tmp_path, text):
    (tmp_path / "x.gltf").write_text(text)
    (tmp_path / "x.obj").write_text(f"mtllib /etc/hosts\nmtllib \nmtllib {text}\n")
    assert side_files(tmp_path / "x.gltf") == side_files(tmp_path / "x.obj") == []


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "box.obj")
    before = sorted(tmp_path.iterdir())

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(InputError, match="No space left on device"):
        scene_from_meshes({"box": tmp_path / "box.obj"}, out=tmp_path / "scene")
    assert sorted(tmp_path.iterdir()) == before


def test_an_empty_folder_is_filled_and_a_full_one_refused(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.obj")
    (tmp_path / "scene").mkdir()
    scene_from_meshes({"box": tmp_path / "box.obj"}, out=tmp_path / "scene")
    with pytest.raises(InputError, match="not empty"):
        scene_from_meshes({"box": tmp_path / "box.obj"}, out=tmp_path / "scene")


def test_the_hash_is_over_what_moves_the_scene(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    scene = scene_from_meshes({"box": tmp_path / "box.ply"}, out=tmp_path / "scene")
    known = scene.hash()
    assert len(known) == 64 and scene.hash() == known
    assert scene.with_model(dataclasses.replace(scene.model, gravity=(0.0, 0.0, -1.62))).hash() != known
    camera = dataclasses.replace(scene.model.camera, fx=600.0)
    assert scene.with_model(dataclasses.replace(scene.model, camera=camera)).hash() == known
    trimesh.creation.box((1, 1, 2)).export(scene.file("meshes/box.ply"))
    assert scene.hash() != known
    json.dumps(scene.motion_inputs(), allow_nan=False)
