# SPDX-License-Identifier: MIT
"""A bake of what stands in Blender, as a bake of the photo's scene."""

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.app.bake_transfer import transfer_bake
from physgen.sim.cache.bake_check import require_intact
from physgen.sim.cache.bake_folder import BakedObject, load_bake, load_manifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Reader, Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Camera, SceneModel, SceneObject

from ..conftest import complete_manifest

LOOK = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -2.0), (0.0, -1.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, world_from_camera=LOOK)
UPRIGHT = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))


def shifted(x, y, z):
    return ((1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, y), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0))


def a_scene(root, *objects, photo):
    root.mkdir()
    for name, mesh, _ in objects:
        mesh.export(root / f"{name}.ply")
    items = tuple(SceneObject(name=n, mesh=f"{n}.ply", size_m=0.1, world_from_mesh=m) for n, _, m in objects)
    if photo:
        for name in ("photo.png", "background.png"):
            (root / name).write_bytes(b"-")
        return save_scene(root, SceneModel(camera=CAMERA, objects=items))
    return save_scene(root, SceneModel(camera=CAMERA, objects=items, photo=None, background=None))


@pytest.fixture
def made(tmp_path):
    """The photo's scene has a cup (+Y up in its file) and a spoon; Blender baked the cup, called Mug."""
    cup, spoon = trimesh.creation.box((0.1, 0.06, 0.04)), trimesh.creation.box((0.02, 0.02, 0.02))
    photo = a_scene(tmp_path / "photo", ("cup", cup, UPRIGHT), ("spoon", spoon, shifted(1.0, 0.0, 0.0)), photo=True)
    world = load_object_mesh(photo, photo.model.objects[0]).vertices
    centre = world.mean(axis=0)
    own = trimesh.Trimesh(world - centre, cup.faces, process=False)
    scene = a_scene(tmp_path / "scene", ("Mug", own, shifted(*centre)), photo=False)
    bake = tmp_path / "bakes" / "abc"
    bake.mkdir(parents=True)
    with Pc2Writer(bake / "Mug.pc2", vertex_count=8) as writer:
        for index in range(3):
            writer.append(own.vertices + np.array([0, 0, 0.1 * index]))
        # As every bake has them.
        sums = writer.checksum("Mug.pc2", ended=True)
    mug = BakedObject(name="Mug", file="Mug.pc2", vertices=8, space="mesh")
    given = {"geometry_hash": scene.geometry_hash(), "checksums": (sums,)}
    save_manifest(bake, complete_manifest(mug, fps=30.0, **given))
    return photo, scene, bake


def test_transferred_bake_is_in_world_metres_under_scene_names(made, tmp_path):
    photo, scene, bake = made
    events = []
    transfer_bake(photo, scene, load_bake(bake), out=tmp_path / "out", names={"cup": "Mug"}, on_event=events.append)
    manifest = load_manifest(tmp_path / "out")
    # What a render checks first.
    require_intact(load_bake(bake))
    require_intact(load_bake(tmp_path / "out"))
    assert manifest.geometry_hash == photo.geometry_hash() and manifest.fps == 30 and manifest.frames_done == 3
    assert [(item.name, item.space) for item in manifest.objects] == [("cup", "world"), ("spoon", "world")]
    rest = [load_object_mesh(photo, item).vertices for item in photo.model.objects]
    cup, spoon = (Pc2Reader(tmp_path / "out" / item.file) for item in manifest.objects)
    np.testing.assert_allclose(cup.sample(2), rest[0] + [0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(spoon.sample(2), rest[1], atol=1e-6)
    assert not events


def test_objects_moved_in_blender_are_named(made, tmp_path):
    photo, scene, bake = made
    item = scene.model.objects[0]
    matrix = np.asarray(item.world_from_mesh) + np.pad([[0.5]], ((0, 3), (3, 0)))
    moved = SceneObject(name="Mug", mesh="Mug.ply", size_m=0.1, world_from_mesh=tuple(map(tuple, matrix.tolist())))
    changed = save_scene(scene.root, SceneModel(camera=CAMERA, objects=(moved,), photo=None, background=None))
    with pytest.raises(InputError, match="bake the scene again"):
        transfer_bake(photo, changed, load_bake(bake), out=tmp_path / "out", names={"cup": "Mug"})
    save_manifest(bake, dataclasses.replace(load_manifest(bake), geometry_hash=changed.geometry_hash()))
    events = []
    transfer_bake(photo, changed, load_bake(bake), out=tmp_path / "out", names={"cup": "Mug"}, on_event=events.append)
    assert [event["message"][:3] for event in events] == ["cup"]


def test_another_mesh_or_name_is_refused(made, tmp_path):
    photo, scene, bake = made
    with pytest.raises(InputError, match="no cache of object 'Pot'"):
        transfer_bake(photo, scene, load_bake(bake), out=tmp_path / "a", names={"cup": "Pot"})
    fine = trimesh.creation.icosphere(subdivisions=1)
    fine.export(photo.root / "cup.ply")
    with pytest.raises(InputError, match="8 vertices and had 42"):
        transfer_bake(photo, scene, load_bake(bake), out=tmp_path / "b", names={"cup": "Mug"})


def test_particles_come_along(made, tmp_path):
    photo, scene, bake = made
    rng = np.random.default_rng(3)
    points = rng.normal(size=(5, 3)) * 0.02
    with Pc2Writer(bake / "Mug.points.pc2", vertex_count=5) as writer:
        for index in range(3):
            writer.append(points + np.array([0, 0, 0.1 * index]))
    manifest = load_manifest(bake)
    flowing = dataclasses.replace(manifest.objects[0], points_file="Mug.points.pc2", points=5, points_as="surface")
    save_manifest(bake, dataclasses.replace(manifest, objects=(flowing,)))
    transfer_bake(photo, scene, load_bake(bake), out=tmp_path / "out", names={"cup": "Mug"})
    cup = load_manifest(tmp_path / "out").objects[0]
    assert (cup.points_file, cup.points, cup.points_as) == ("cup.points.pc2", 5, "surface")
    centre = np.asarray(scene.model.objects[0].world_from_mesh)[:3, 3]
    expected = points + centre + np.array([0, 0, 0.2])
    np.testing.assert_allclose(Pc2Reader(tmp_path / "out" / cup.points_file).sample(2), expected, atol=1e-6)


def test_a_damaged_bake_is_not_transferred(made, tmp_path):
    photo, scene, bake = made
    content = bytearray((bake / "Mug.pc2").read_bytes())
    content[-1] ^= 1
    (bake / "Mug.pc2").write_bytes(content)
    with pytest.raises(InputError, match=r"Mug\.pc2: frames 3 are not what was baked"):
        transfer_bake(photo, scene, load_bake(bake), out=tmp_path / "out", names={"cup": "Mug"})
