# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers, units, camera and folders of an exported Blender scene."""

import dataclasses
import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from mathutils import Matrix
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Camera

from .export_scenes import add, add_empty, animate, exported, prepared, refused


@pytest.fixture(autouse=True)
def settings(addon):
    bpy.context.scene.physgen.simulation.frame_end = 9


@pytest.fixture
def scene():
    return bpy.context.scene


# Numbers


def test_pushes_are_in_the_order_of_their_frames_and_later_than_the_start(scene, tmp_path):
    settings = scene.physgen.simulation
    settings.frame_start, settings.frame_end = 11, 60
    scene.render.fps, scene.render.fps_base = 25, 1.0
    scene.unit_settings.scale_length = 0.1
    body = add(place=(0.0, 0.0, 10.0)).physgen
    for frame, speed in ((41, 3.0), (31, 5.0)):
        push = body.pushes.add()
        push.frame, push.velocity = frame, (0.0, 0.0, speed)
    _, objects = exported(scene, tmp_path)
    assert [(key.time_s, key.value) for key in objects["Cube"].velocity_keys] == [
        *((0.8, (0.0, 0.0, 0.5)), (1.2, (0.0, 0.0, 0.3))),
    ]
    body.pushes[0].frame = 31
    refused(scene, tmp_path / "twice", "'Cube'", "frame 31", "already pushed")
    body.pushes[0].frame, body.start_frame = 41, 35
    refused(scene, tmp_path / "early", "'Cube'", "frame 31", "starts at frame 35")
    body.role = "collider"
    add("Other", (3.0, 0.0, 10.0))
    assert exported(scene, tmp_path, "collider")[1]["Cube"].velocity_keys == ()


def test_the_numbers_of_an_object(scene, tmp_path):
    settings = scene.physgen.simulation
    settings.frame_start, settings.frame_end = 11, 20
    scene.render.fps, scene.render.fps_base = 25, 1.0
    item = add()
    body = item.physgen
    body.material.preset = "clay"
    body.material.density = 1234.5
    body.velocity, body.spin = (0.1, 0.2, 0.3), (1, 2, 3)
    body.fill, body.shell_thickness = False, 0.07
    body.start_frame, body.sandy, body.sandy_frame = 16, True, 3
    body.own_surface, body.friction, body.static_friction, body.restitution = True, 0.6, 0.5, 0.2
    body.contact_mode = "sticky"
    body.goal_stiffness, body.goal_damping = 10.0, 0.3
    body.asleep = body.held = True
    folder, objects = exported(scene, tmp_path)
    cube = objects["Cube"]
    assert (cube.velocity, cube.spin) == ((0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    assert (cube.material.preset, cube.material.law, cube.material.density) == ("clay", "von_mises", 1234.5)
    assert (cube.fill, cube.shell_thickness, cube.start_time) == (False, 0.07, 0.2)
    assert (cube.friction, cube.static_friction, cube.restitution, cube.contact_mode) == (0.6, 0.6, 0.2, "sticky")
    assert (cube.goal_stiffness, cube.goal_damping, cube.asleep, cube.held) == (10.0, 0.3, True, True)
    (effect,) = folder.model.effects
    assert (effect.name, effect.objects, dict(effect.parameters)["start"]) == ("sandy", ("Cube",), 0.0)


def test_invalid_scenes_are_refused_in_the_artists_words(scene, tmp_path):
    body = add().physgen
    body.material.preset = "wood"
    body.material.law = "rigid"
    body.sandy = True
    refused(scene, tmp_path, "'Cube'", "sand")
    body.sandy, body.goal_stiffness = False, 1.0
    refused(scene, tmp_path, "'Cube'", "rigid")
    body.material.law = "fixed_corotated"
    bpy.context.scene.objects["Cube"].location.z = -2
    refused(scene, tmp_path, "'Cube'", "ground")


def test_the_world(scene, tmp_path):
    item = add()
    world = scene.physgen.world
    world.friction, world.static_friction, world.restitution = 0.7, 0.3, 0.25
    plane = add_empty("plane", (0, 0, -1))
    plane.rotation_euler.x = math.radians(30)
    world.ground_object = plane
    entry = world.effects.add()
    entry.effect = "wind"
    entry.targets.add().item = item
    world.effects.add().enabled = False
    scene.gravity = (0, 1, -3)
    folder, _ = exported(scene, tmp_path)
    ground = folder.model.ground
    assert (ground.friction, ground.static_friction, ground.restitution) == (0.7, 0.7, 0.25)
    assert ground.point == (0, 0, -1)
    assert ground.normal == pytest.approx((0, -0.5, math.sqrt(0.75)), abs=1e-6)
    assert folder.model.gravity == (0, 1, -3)
    assert [effect.name for effect in folder.model.effects] == ["wind"]
    assert folder.model.effects[0].objects == ("Cube",)
    prepared(folder)
    world.use_ground, scene.use_gravity = False, False
    folder, _ = exported(scene, tmp_path)
    assert folder.model.ground is None
    assert folder.model.gravity == (0, 0, 0)
    entry.targets.add().item = plane
    refused(scene, tmp_path / "other", "effect 1 (wind)", "'plane'")


def test_animated_gravity_becomes_a_track(scene, tmp_path):
    add()
    animate(scene, "gravity", (0, 0, -9), (0, 0, -1))
    scene.frame_set(7)
    folder, _ = exported(scene, tmp_path)
    assert folder.model.gravity == (0, 0, -9)
    track = folder.model.gravity_track
    assert track[0].value == (0, 0, -9)
    assert track[-1].value == (0, 0, -1)
    assert len(track) == 9


def test_the_unit_scale_turns_everything_into_metres_and_cancels_in_the_mesh(scene, tmp_path):
    item = add(place=(0, 0, 100))
    item.scale = (100, 100, 100)
    item.physgen.velocity = (50, 0, 0)
    item.physgen.pins.add().box = add_empty("box", (0, 0, 100), size=10)
    scene.physgen.world.ground_point = (0, 0, 20)
    scene.unit_settings.scale_length = 0.01
    scene.gravity = (0, 0, -981)
    folder, objects = exported(scene, tmp_path)
    cube = objects["Cube"]
    loaded = load_object_mesh(folder, cube)
    assert loaded.vertices.mean(axis=0) == pytest.approx((0, 0, 1))
    assert cube.size_m == pytest.approx(1)
    assert cube.velocity == (0.5, 0, 0)
    assert cube.pins[0].high == pytest.approx((0.1, 0.1, 1.1))
    assert folder.model.gravity == (0, 0, -9.81)
    assert folder.model.ground.point == (0, 0, 0.2)
    # A sample in mesh space, back through the object's own matrix, is where Blender has it.
    back = np.linalg.inv(np.array(cube.world_from_mesh))
    mesh_space = loaded.vertices @ back[:3, :3].T + back[:3, 3]
    assert np.abs(mesh_space - np.array([v.co for v in item.data.vertices])).max() < 1e-6
    scene.unit_settings.system = "NONE"
    scene.physgen.world.ground_point = (0, 0, 0)
    assert exported(scene, tmp_path)[0].model.gravity == (0, 0, -981)


def test_the_camera_comes_back_as_it_was_made(scene, tmp_path):
    add()
    pose = Matrix.Rotation(0.4, 4, "Z") @ Matrix.Translation((1, -4, 2)) @ Matrix.Rotation(-1.8, 4, "X")
    made = Camera(
        width=200, height=120, fx=190.0, fy=200.0, cx=93.0, cy=63.5, world_from_camera=tuple(map(tuple, pose))
    )
    bridge_camera.add_camera(scene, made, (200, 120))
    found = exported(scene, tmp_path)[0].model.camera
    points = np.random.default_rng(0).normal((0, 0, 0), 0.5, (20, 3)) + made.position + np.array(pose)[:3, 2] * 4
    assert np.abs(found.project(points) - made.project(points)).max() < 1e-3


# Folders


def test_a_second_export_replaces_the_first_and_nothing_else(scene, tmp_path):
    add("a")
    gone = add("b", (3, 0, 1))
    exported(scene, tmp_path)
    (tmp_path / "scene" / "meshes" / "mine.txt").write_text("")
    bpy.data.objects.remove(gone)
    exported(scene, tmp_path)
    assert sorted(p.name for p in (tmp_path / "scene" / "meshes").iterdir()) == ["a.ply", "mine.txt"]


def test_a_scene_with_a_photo_is_never_overwritten(scene, tmp_path):
    add()
    with_photo = dataclasses.replace(exported(scene, tmp_path)[0].model, photo="photo.png", background="background.png")
    save_scene(tmp_path / "scene", with_photo)
    before = (tmp_path / "scene" / "scene.json").read_bytes()
    with pytest.raises(InputError, match="photo"):
        export_scene(scene, tmp_path / "scene")
    assert (tmp_path / "scene" / "scene.json").read_bytes() == before
    scene.physgen.folder = str(tmp_path / "imported")
    with pytest.raises(InputError, match="imported from"):
        export_scene(scene, tmp_path / "imported")


def test_the_second_scene_of_a_file_is_exported_as_it_is(scene, tmp_path):
    add("here")
    other = bpy.data.scenes.new("other")
    item = add("there")
    scene.collection.objects.unlink(item)
    other.collection.objects.link(item)
    other.gravity = (0, 0, -2)
    animate(other, "gravity", (0, 0, -2), (0, 0, -1))
    item.location = (3, 0, 1)
    folder, objects = exported(other, tmp_path)
    assert set(objects) == {"there"}
    assert load_object_mesh(folder, objects["there"]).vertices.mean(axis=0) == pytest.approx((3, 0, 1))
    assert folder.model.gravity_track[-1].value == (0, 0, -1)
    assert bpy.context.scene == scene


def test_linked_objects_need_an_override(scene, tmp_path):
    library = tmp_path / "library.blend"
    bpy.data.libraries.write(str(library), {add("brick")})
    bpy.data.objects.remove(bpy.data.objects["brick"])
    with bpy.data.libraries.load(str(library), link=True) as (_, chosen):
        chosen.objects = ["brick"]
    item = bpy.data.objects["brick"]
    scene.collection.objects.link(item)
    refused(scene, tmp_path, "'brick'", "library override")
    item.override_create(remap_local_usages=True)
    exported(scene, tmp_path)


def test_painted_weights_and_animated_numbers_reach_the_engine(scene, tmp_path):
    """A vertex group above the middle weighs three times as much; stiffness falls by keyframes, and the frame that is
    shown changes neither export nor fingerprint. What cannot be is refused by name."""
    scene.physgen.simulation.frame_start, scene.physgen.simulation.frame_end = 1, 9
    item = add()
    body = item.physgen
    group = item.vertex_groups.new(name="top")
    group.add([v.index for v in item.data.vertices if v.co.z > 0], 1.0, "REPLACE")
    body.density_group, body.density_factor = "top", 3.0
    for frame, value in ((1, 4e5), (9, 1e5)):
        body.material.youngs_modulus = value
        item.keyframe_insert("physgen.material.youngs_modulus", frame=frame)
    scene.frame_set(5)
    before = fingerprint(scene)
    folder, objects = exported(scene, tmp_path)
    cube = objects["Cube"]
    assert cube.density_map.at_one == 3.0 and cube.density_map.at_zero == 1.0 and cube.stiffness_map is None
    (track,) = cube.material_tracks
    assert (track.field, track.keys[0].value, track.keys[-1].value) == ("youngs_modulus", 4e5, 1e5)
    assert cube.material.youngs_modulus == 4e5 and track.keys[-1].time_s == pytest.approx(8 / 24)
    ready = prepared(folder).setup.bodies[0]
    assert ready.center_of_mass[2] > 1.05 and ready.density_scale.max() == pytest.approx(3.0, rel=0.02)
    assert ready.material_at(1.0).youngs_modulus == 1e5
    scene.frame_set(9)
    assert fingerprint(scene) == before
    group.add([0], 0.5, "REPLACE")
    assert fingerprint(scene) != before
    body.density_group = "gone"
    refused(scene, tmp_path / "other", "'Cube'", "'gone'", "top")
    body.density_group = ""
    item.keyframe_insert("physgen.material.density", frame=1)
    refused(scene, tmp_path / "other", "'Cube'", "physgen.material.density", "animated")
