# SPDX-License-Identifier: MIT
"""A scene whose objects pass through each other → one whose objects do not; all else is as it was."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from physgen.sim.app.compose_inputs import photo_reference
from physgen.sim.app.compose_scene import compose
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.gaussians.compose.compose_options import ComposeOptions, ComposeRequest
from physgen.sim.gaussians.mesh_to_splats import splats_on_mesh
from physgen.sim.gaussians.splat_ply import read_splats, write_splats
from physgen.sim.gaussians.splats import transform_splats
from physgen.sim.mpm.colliders import Surface
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Camera, Ground, SceneModel, SceneObject
from physgen.sim.scene.textured_mesh import read_textured_mesh
from PIL import Image

RADIUS = 0.05
OVERLAP = 0.02
LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.04), (0.0, 0.0, 1.0, -0.5), (0.0, -1.0, 0.0, 0.06), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=96, height=64, fx=170.0, fy=170.0, cx=48.0, cy=32.0, world_from_camera=LOOKING_AWAY)
TURNED = ((0.0, -2.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0))
"""From a mesh file of half the size, turned about z."""
PHYSICS = ComposeOptions(method="ppps", steps=40, cells=16)


def a_ball(path, centre, colour):
    """A ball with a seam, a texture of one colour, in its own coordinates."""
    mesh = trimesh.creation.uv_sphere(radius=RADIUS, count=(16, 16))
    inverse = np.linalg.inv(np.asarray(TURNED))
    vertices = (np.asarray(mesh.vertices) + centre) @ inverse[:3, :3].T
    vertices = np.concatenate([vertices, vertices[:1]])
    faces = mesh.faces.copy()
    faces[0][faces[0] == 0] = len(vertices) - 1
    picture = Image.new("RGB", (4, 4), colour)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    visual = trimesh.visual.TextureVisuals(uv=np.full((len(vertices), 2), 0.5), material=material)
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(path)


@pytest.fixture
def scene(tmp_path):
    """Two balls on the ground, 2 cm in each other; the right one has splats of its own."""
    root = tmp_path / "scene"
    shift = (2 * RADIUS - OVERLAP, 0.0, RADIUS)
    a_ball(root / "meshes/left.glb", (0.0, 0.0, RADIUS), (200, 40, 40))
    a_ball(root / "meshes/right.glb", shift, (40, 40, 200))
    for folder in ("albedo", "stages", "splats"):
        (root / folder).mkdir()
    Image.new("RGB", (4, 4)).save(root / "albedo/right.png")
    (root / "stages/kept.npz").write_bytes(b"")
    (root / "reconstruct.json").write_text("{}")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    surface = Surface(vertices=np.asarray(ball.vertices) + shift, faces=np.asarray(ball.faces))
    splats = splats_on_mesh(surface.vertices, surface.faces, np.full((len(ball.vertices), 3), 0.3), 300, seed=1)
    write_splats(root / "splats/right.ply", transform_splats(splats, np.linalg.inv(np.asarray(TURNED))))
    items = tuple(
        SceneObject(
            name=name, mesh=f"meshes/{name}.glb", size_m=0.1, world_from_mesh=TURNED, occlusion_order=order, splats=file
        )
        for name, order, file in (("right", 1, "splats/right.ply"), ("left", 0, None))
    )
    return save_scene(root, SceneModel(camera=CAMERA, objects=items, ground=Ground(), photo=None, background=None))


def world(folder, name):
    item = next(item for item in folder.model.objects if item.name == name)
    return load_object_mesh(folder, item).vertices


@pytest.mark.long
def test_penetration_is_resolved_and_other_objects_are_unchanged(scene, tmp_path):
    out, said = tmp_path / "out", []
    request = ComposeRequest(options=PHYSICS, picture=False, splats=1000)
    folder = compose(load_scene(scene.root), out=out, request=request, on_event=said.append)
    assert folder.root == out and load_scene(out).model == folder.model
    # The frontmost stays, byte for byte, and so does everything that is no matter of places.
    assert (out / "meshes/left.glb").read_bytes() == (scene.root / "meshes/left.glb").read_bytes()
    assert sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()) == [
        *("albedo/right.png", "checksums.json", "compose.json", "meshes/left.glb", "meshes/right.glb", "scene.json"),
        "splats/right.ply",
    ]
    before, after = (read_textured_mesh(root / "meshes/right.glb") for root in (scene.root, out))
    assert np.array_equal(before.faces, after.faces) and np.array_equal(before.uv, after.uv)
    assert before.picture == after.picture and len(before.vertices) == len(after.vertices)
    assert np.array_equal(after.vertices[0], after.vertices[-1])
    moved = world(folder, "right")
    record = json.loads((out / "compose.json").read_text())
    pair = record["pairs"][0]
    assert pair["objects"] == ["left", "right"] and record["method"] == "ppps" and record["picture"] is None
    # Two balls of radius r whose centres are d apart share a lens of π (2r - d)² (d² + 4 d r) / (12 d).
    d = 2 * RADIUS - OVERLAP
    lens = np.pi * OVERLAP**2 * (d * d + 4 * d * RADIUS) / (12 * d)
    assert pair["before"]["volume_m3"] == pytest.approx(lens, rel=0.1)
    assert pair["before"]["deepest_m"] == pytest.approx(OVERLAP, rel=0.15)
    assert pair["after"]["volume_m3"] < 0.1 * lens
    inside = RADIUS - np.linalg.norm(moved - (0.0, 0.0, RADIUS), axis=1)
    assert inside.max() < 0.2 * OVERLAP
    # It went to the right, did not leave the ground downward, and took its splats along.
    assert moved[:, 0].mean() > world(scene, "right")[:, 0].mean() and moved[:, 2].min() > -0.001
    old, new = (
        transform_splats(read_splats(root / "splats/right.ply"), np.asarray(TURNED)) for root in (scene.root, out)
    )
    way = (moved - world(scene, "right")).mean(axis=0)
    assert (new.centres - old.centres).mean(axis=0) == pytest.approx(way, abs=0.3 * np.linalg.norm(way))
    assert np.array_equal(new.colours, old.colours)
    assert {event["stage"] for event in said} == {"composing"}
    # The same again, over the first, comes out the same.
    compose(load_scene(scene.root), out=out, request=request)
    assert json.loads((out / "compose.json").read_text()) == record


def test_the_picture_is_the_photo_but_for_the_objects(scene):
    root = scene.root
    photo, background = np.full((64, 96, 3), 200, np.uint8), np.full((64, 96, 3), 90, np.uint8)
    mask = np.zeros((64, 96), np.uint8)
    mask[20:40, 30:50] = 255
    for name, picture in (("photo", photo), ("background", background), ("left", mask), ("right", mask)):
        Image.fromarray(picture).save(root / f"{name}.png")
    items = tuple(dataclasses.replace(item, mask=f"{item.name}.png") for item in scene.model.objects)
    folder = save_scene(
        root, dataclasses.replace(scene.model, objects=items, photo="photo.png", background="background.png")
    )
    reference = photo_reference(folder, items, size=48)
    assert (reference.camera.width, reference.camera.height, reference.camera.fx) == (48, 32, 85.0)
    assert np.allclose(reference.pixels, 200 / 255) and reference.backdrop[15, 20] == pytest.approx(90 / 255)
    assert reference.backdrop[5, 5] == pytest.approx(200 / 255)
    bare = photo_reference(folder, scene.model.objects, size=500)
    assert bare.camera == CAMERA and np.allclose(bare.backdrop, 90 / 255)
    Image.fromarray(photo[:10]).save(root / "background.png")
    with pytest.raises(InputError, match=r"background.png: has 96x10 pixels, the scene's camera 96x64"):
        photo_reference(folder, items, size=48)


def test_refused_compositions_leave_no_files(scene, tmp_path):
    physics = ComposeRequest(options=PHYSICS, picture=False)
    root = scene.root
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "scene.json").write_text("{}")
    for out, words in (
        (root, "is the scene, inside it or a parent of it"),
        (root / "out", "inside it or a parent of it"),
        (tmp_path, "inside it or a parent of it"),
        (mine, "holds something other than a composition"),
        (root / "scene.json", "inside it or a parent of it"),
    ):
        with pytest.raises(InputError, match=words):
            compose(load_scene(root), out=out, request=physics)
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"has no photo.*--no-picture"):
        compose(load_scene(root), out=out)
    with pytest.raises(InputError, match="there is no 'cup'"):
        compose(load_scene(root), out=out, request=dataclasses.replace(physics, objects=("left", "cup")))
    with pytest.raises(Cancelled):
        compose(load_scene(root), out=out, request=physics, cancelled=lambda: True)
    for guidance, words in (("model", "write exact:FOLDER"), ("exact:/nowhere", "no such folder")):
        with pytest.raises(InputError, match=words):
            compose(load_scene(root), out=out, request=dataclasses.replace(physics, guidance=guidance))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "scene"] and (mine / "scene.json").read_text() == "{}"
    for changes, words in (
        ({"splats": 1}, "splats is 1: give 100"),
        ({"options": ComposeOptions()}, "method pse-sds needs the picture"),
        ({"prompt": "a frog"}, "only a guidance diffusers"),
    ):
        with pytest.raises(InputError, match=words):
            dataclasses.replace(physics, **changes)
