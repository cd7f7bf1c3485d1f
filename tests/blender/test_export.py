# SPDX-License-Identifier: GPL-3.0-or-later
"""Any Blender scene as a scene folder: exact where it can be, refused with a way out where it cannot."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from mathutils import Matrix
from physgen.physgen_addon import compat
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.physgen_addon.scene_io.export_animation import export_names
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.world_setup import prepare_world
from physgen.sim.app.world_setup_checks import vertices_at
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.meshes import load_object_mesh, read_mesh
from physgen.sim.scene.model import Camera

CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@pytest.fixture(autouse=True)
def addon(fresh_blender):
    physgen.register()
    bpy.context.scene.physgen.simulation.frame_end = 9
    yield
    physgen.unregister()


@pytest.fixture
def scene():
    return bpy.context.scene


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


# Meshes


@pytest.mark.parametrize("scale", [(1, 1, 1), (0.5, 2, 1), (-1, 1, 1)])
def test_the_mesh_file_has_the_vertices_of_the_mesh_in_their_order(scene, tmp_path, scale):
    item = add(vertices=[*CUBE, (0.1, 0.2, 0.3), (0.3, 0.1, 0.123456789)])  # two loose vertices
    item.scale, item.rotation_euler = scale, (0.3, 0.4, 0.5)
    world = world_vertices(item)
    folder, objects = exported(scene, tmp_path)
    raw = read_mesh(folder.file(objects["Cube"].mesh))
    assert np.array_equal(raw.vertices, np.array([v.co for v in item.data.vertices]))
    loaded = load_object_mesh(folder, objects["Cube"])
    assert np.abs(loaded.vertices - world).max() < 1e-6
    corners = loaded.vertices[loaded.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(abs(math.prod(scale)), rel=1e-5)
    assert objects["Cube"].size_m == pytest.approx(np.ptp(world, axis=0).max())


def test_polygons_of_many_corners_become_triangles(scene, tmp_path):
    ring = [(math.cos(a), math.sin(a)) for a in np.arange(8) * math.pi / 4]
    prism = [(x, y, z) for z in (0.0, 1.0) for x, y in ring]
    sides = [(i, (i + 1) % 8, 8 + (i + 1) % 8, 8 + i) for i in range(8)]
    add(vertices=prism, faces=[tuple(range(7, -1, -1)), tuple(range(8, 16)), *sides])
    folder, objects = exported(scene, tmp_path)
    assert len(load_object_mesh(folder, objects["Cube"]).faces) == 2 * 6 + 8 * 2
    prepared(folder)


def test_objects_may_share_a_mesh_and_seams_may_be_open(scene, tmp_path):
    first = add("a", (-2, 0, 1), vertices=[CUBE[i] for quad in QUADS for i in quad], faces=np.arange(24).reshape(6, 4))
    second = add("b", (2, 0, 1))
    second.data = first.data
    folder, objects = exported(scene, tmp_path)
    assert objects["a"].mesh == objects["b"].mesh
    prepared(folder)


def test_edits_change_the_fingerprint(scene, tmp_path):
    item = add()
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.transform.resize(value=(2, 2, 2))
    item.location.z = 2
    _, objects = exported(scene, tmp_path)
    assert objects["Cube"].size_m == pytest.approx(2)
    assert item.mode == "EDIT"


FLAT = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (CUBE, [], ["no faces"]),
        (FLAT, [(0, 1, 2, 3)], ["flat", "Solidify"]),
        (CUBE, QUADS[1:], ["not closed", "Fill Holes"]),
        ([*CUBE[:7], (math.nan, 0, 0)], QUADS, ["vertex 7"]),
        (CUBE, [*QUADS, *(quad[::-1] for quad in QUADS)], ["no volume"]),
    ],
)
@pytest.mark.parametrize("role", ["dynamic", "collider"])
def test_meshes_without_an_inside_are_refused(scene, tmp_path, vertices, faces, words, role):
    add("sound", (5, 0, 1))
    add("Odd.001", vertices=vertices, faces=faces, role=role)
    refused(scene, tmp_path, "'Odd.001'", *words)


def test_the_simulation_refuses_what_the_export_refuses_and_takes_what_it_takes(scene, tmp_path):
    # A face twice more, a face without area, a loose edge: no harm. Seen by the worker's own checks.
    item = add(faces=[*QUADS, QUADS[0], QUADS[0][::-1], (0, 1, 1 + 7)], vertices=[*CUBE, (-0.5, -0.5, 0.0)])
    with pytest.raises(InputError, match="not closed"):
        exported(scene, tmp_path)
    item.data.clear_geometry()
    item.data.from_pydata([*CUBE, (9, 9, 9)], [(7, 8)], [*QUADS, QUADS[0], QUADS[0][::-1]])
    prepared(exported(scene, tmp_path)[0])


def test_small_holes_are_closed_for_the_simulation_alone(scene, tmp_path):
    bpy.ops.mesh.primitive_monkey_add(location=(0, 0, 2))
    head = bpy.context.object
    head.physgen.enabled = True
    count = len(head.data.vertices), len(head.data.polygons)
    folder, objects = exported(scene, tmp_path)
    mesh = load_object_mesh(folder, objects[head.name])
    assert len(mesh.vertices) == count[0]
    assert (len(head.data.vertices), len(head.data.polygons)) == count
    sides = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()
    prepared(folder)


@pytest.mark.parametrize("scale", [(0, 0, 0), (1, 1, 0)])
def test_no_scale_may_vanish(scene, tmp_path, scale):
    add().scale = scale
    refused(scene, tmp_path, "'Cube'", "scale")


# Names


def test_names_are_made_fit_and_unique(scene, tmp_path):
    long = "n" * 70
    names = ["Cube", "Cube.001", "Cube_001", "cube", "Würfel é", "ground", "CON", " ", "ab/c", long, long[:63] + "m"]
    found = [add(name, (3 * i, 0, 1)).name for i, name in enumerate(names)]
    given = export_names(scene)
    assert sorted(given) == sorted(found)
    assert given["Cube"] == "Cube"
    assert given["Cube_001"] == "Cube_001"
    assert given["Cube.001"] == "Cube_001_2"
    assert given["Würfel é"] == "Würfel é"
    assert len({name.casefold() for name in given.values()}) == len(names)
    _, objects = exported(scene, tmp_path)
    assert set(objects) == set(given.values())
    assert not {"ground", "con"} & {name.casefold() for name in objects}


def test_a_scene_without_bodies_is_refused(scene, tmp_path):
    refused(scene, tmp_path, "no object")
    add(role="collider")
    refused(scene, tmp_path, "no object is simulated")


# What the artist sees


@pytest.mark.parametrize("kind", ["MIRROR", "ARRAY", "SOLIDIFY", "SKIN", "DISPLACE", "ARMATURE", "CLOTH", "NODES"])
def test_modifiers_that_change_the_shape_are_refused(scene, tmp_path, kind):
    item = add()
    modifier = item.modifiers.new("mine", kind)
    if kind == "NODES":
        modifier.node_group = bpy.data.node_groups.new("own", "GeometryNodeTree")
    refused(scene, tmp_path, "'mine'", "apply it or hide it in the viewport")
    modifier.show_viewport = False
    exported(scene, tmp_path)


def test_modifiers_that_smooth_are_fine_and_simulate_the_mesh_before_them(scene, tmp_path):
    item = add()
    for kind in ("SUBSURF", "BEVEL", "WEIGHTED_NORMAL", "EDGE_SPLIT", "TRIANGULATE", "UV_PROJECT"):
        item.modifiers.new(kind, kind)
    item.modifiers.new("Smooth by Angle", "NODES").node_group = bpy.data.node_groups.new(
        "Smooth by Angle.001", "GeometryNodeTree"
    )
    item.modifiers.new("PhysGen cache", "MESH_CACHE")
    folder, objects = exported(scene, tmp_path)
    assert len(load_object_mesh(folder, objects["Cube"]).vertices) == 8


def test_shape_keys_are_refused(scene, tmp_path):
    item = add()
    item.shape_key_add(name="Basis")
    exported(scene, tmp_path, "one")
    fat = item.shape_key_add(name="fat")
    fat.value = 0.0
    exported(scene, tmp_path, "two")
    fat.value = 0.5
    refused(scene, tmp_path, "'Cube'", "shape keys")
    fat.mute = True
    exported(scene, tmp_path, "three")
    animate(item.data.shape_keys.key_blocks["fat"], "value", 0.0, 1.0)
    refused(scene, tmp_path, "'Cube'", "shape keys")


def _keys(item):
    animate(item, "location", (0, 0, 1), (1, 0, 1))


def _driver(item):
    item.driver_add("location", 0).driver.expression = "frame"


def _constraint(item):
    item.constraints.new("COPY_LOCATION").target = add_empty("target")


def _parent(item):
    item.parent = add_empty("mother")
    _keys(item.parent)


def _nla(item):
    _keys(item)
    data = item.animation_data
    data.nla_tracks.new().strips.new("strip", 1, data.action)
    data.action = None


@pytest.mark.parametrize(
    ("how", "word"),
    [
        (_keys, "animated (location)"),
        (_driver, "driven"),
        (_constraint, "constraint"),
        (_parent, "'mother', which is animated"),
        (_nla, "animated"),
    ],
)
def test_simulated_objects_may_not_be_animated_otherwise(scene, tmp_path, how, word):
    item = add()
    how(item)
    refused(scene, tmp_path, "'Cube'", word, "collider")
    item.physgen.role = "collider"
    add("other", (5, 0, 1))
    exported(scene, tmp_path)


def test_a_still_parent_is_fine(scene, tmp_path):
    item = add(place=(1, 0, 0))
    item.parent = add_empty("mother", (0, 0, 3))
    item.parent.rotation_euler.z = 1.0
    world = world_vertices(item)
    folder, objects = exported(scene, tmp_path)
    assert np.abs(load_object_mesh(folder, objects["Cube"]).vertices - world).max() < 1e-6


def test_an_object_that_is_switched_off_is_refused(scene, tmp_path):
    item = add()
    item.hide_set(True)
    exported(scene, tmp_path, "eye")
    item.hide_viewport = True
    refused(scene, tmp_path, "'Cube'", "disabled")


def test_animated_settings_are_refused(scene, tmp_path):
    item = add()
    item.physgen.keyframe_insert("friction", frame=1)
    refused(scene, tmp_path, "'Cube'", "physgen.friction", "animated")


# What moves


def test_a_collider_is_what_is_seen(scene, tmp_path):
    add("falls", (20, 0, 1))
    item = add("hollow", role="collider", vertices=FLAT, faces=[(0, 1, 2, 3)])
    item.modifiers.new("thick", "SOLIDIFY").thickness = 0.5
    item.modifiers.new("PhysGen cache", "MESH_CACHE").filepath = str(tmp_path / "none.pc2")
    folder, objects = exported(scene, tmp_path)
    assert objects["hollow"].motion is None
    assert np.ptp(load_object_mesh(folder, objects["hollow"]).vertices[:, 2]) == pytest.approx(0.5)
    assert item.modifiers["PhysGen cache"].show_viewport


def test_a_collider_goes_where_its_animation_takes_it(scene, tmp_path):
    add("falls", (20, 0, 1))
    item = add("turns", role="collider")
    item.scale = (1, 3, 0.5)
    mother = add_empty("mother", (2, 0, 0))
    item.parent = mother
    animate(item, "location", (0, 0, 1), (1, 2, 1))
    animate(mother, "rotation_euler", (0, 0, 0.2), (0.5, 3.0, 4.0))
    scene.frame_set(5)
    folder, objects = exported(scene, tmp_path)
    assert scene.frame_current == 5
    motion = objects["turns"].motion
    assert motion.vertices_file is None
    assert len(motion.rotations) == 9
    collider = prepared(folder).setup.colliders[0]
    for frame in (1, 4, 9):
        scene.frame_set(frame)
        assert np.abs(vertices_at(collider, (frame - 1) / scene.render.fps) - world_vertices(item)).max() < 1e-5


def test_a_collider_that_deforms_takes_its_vertices_along(scene, tmp_path):
    add("falls", (20, 0, 1))
    grows, keyed = add("grows", (0, 0, 1), role="collider"), add("keyed", (5, 0, 1), role="collider")
    animate(grows, "scale", (1, 1, 1), (2, 1, 1))
    keyed.shape_key_add(name="Basis")
    for point in keyed.shape_key_add(name="fat").data:
        point.co *= 2
    animate(keyed.data.shape_keys.key_blocks["fat"], "value", 0.0, 1.0)
    folder, objects = exported(scene, tmp_path)
    for index, name, axis in ((0, "grows", 0), (1, "keyed", 2)):
        assert objects[name].motion.vertices_file == f"meshes/{name}.npz"
        collider = prepared(folder).setup.colliders[index]
        assert collider.name == name
        sides = [np.ptp(vertices_at(collider, t / scene.render.fps)[:, axis]) for t in (0, 8)]
        assert sides == pytest.approx([1, 2])


def test_a_collider_whose_faces_change_is_refused(scene, tmp_path):
    add("falls", (20, 0, 1))
    modifier = add("changes", role="collider").modifiers.new("many", "ARRAY")
    modifier.count = 1
    modifier.keyframe_insert("count", frame=1)
    modifier.count = 4
    modifier.keyframe_insert("count", frame=9)
    refused(scene, tmp_path, "'changes'", "other vertices")


def test_a_collider_that_could_move_and_does_not_stands_still(scene, tmp_path):
    add("falls", (20, 0, 1))
    item = add("still", role="collider")
    animate(item, "location", (0, 0, 1), (0, 0, 1))
    _, objects = exported(scene, tmp_path)
    assert objects["still"].motion is None


def test_pins_are_the_boxes_of_empties_and_lead_along(scene, tmp_path):
    item = add()
    box = add_empty("box", (0, 0, 1.5), size=0.25)
    box.scale = (4, 4, 1)
    item.physgen.pins.add().box = box
    _, objects = exported(scene, tmp_path, "still")
    (pin,) = objects["Cube"].pins
    assert pin.low == pytest.approx((-1, -1, 1.25))
    assert pin.high == pytest.approx((1, 1, 1.75))
    assert objects["Cube"].pin_motion == ()
    animate(box, "location", (0, 0, 1.5), (0, 0, 2.5))
    folder, objects = exported(scene, tmp_path)
    assert objects["Cube"].pin_motion[-1].value == pytest.approx((0, 0, 1))
    assert objects["Cube"].pin_motion[-1].time_s == pytest.approx(8 / 24)
    assert prepared(folder).setup.bodies[0].pins.any()
    animate(box, "rotation_euler", (0, 0, 0), (0, 0, 1))
    refused(scene, tmp_path / "turned", "'Cube'", "turn")
    item.physgen.pins.add()
    refused(scene, tmp_path / "none", "pin 2")


# Numbers


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


# Fingerprint


def _mesh(item):
    item.data.vertices[0].co.x += 0.01
    item.data.update()


def _key(item):
    curve = bpy.data.objects["moves"].animation_data.action.layers[0].strips[0].channelbags[0].fcurves[0]
    curve.keyframe_points[-1].co.y += 1


CHANGES = {
    "mesh": _mesh,
    "location": lambda o: setattr(o, "location", (0, 0, 2)),
    "rotation": lambda o: setattr(o, "rotation_euler", (0, 0, 2)),
    "density": lambda o: setattr(o.physgen.material, "density", 77),
    "law": lambda o: setattr(o.physgen.material, "law", "snow"),
    "velocity": lambda o: setattr(o.physgen, "velocity", (0, 0, 2)),
    "start": lambda o: setattr(o.physgen, "start_frame", 5),
    "sandy": lambda o: setattr(o.physgen, "sandy", True),
    "role": lambda o: setattr(o.physgen, "role", "collider"),
    "part": lambda o: setattr(o.physgen, "enabled", False),
    "name": lambda o: setattr(o, "name", "other"),
    "gravity": lambda o: setattr(bpy.context.scene, "gravity", (0, 0, -1)),
    "weightless": lambda o: setattr(bpy.context.scene, "use_gravity", False),
    "fps": lambda o: setattr(bpy.context.scene.render, "fps", 30),
    "end": lambda o: setattr(bpy.context.scene.physgen.simulation, "frame_end", 12),
    "quality": lambda o: setattr(bpy.context.scene.physgen.simulation, "quality", "fine"),
    "seed": lambda o: setattr(bpy.context.scene.physgen.simulation, "seed", 3),
    "units": lambda o: setattr(bpy.context.scene.unit_settings, "scale_length", 0.1),
    "friction": lambda o: setattr(bpy.context.scene.physgen.world, "friction", 0.1),
    "ground": lambda o: setattr(bpy.data.objects["plane"], "location", (0, 0, -1)),
    "no ground": lambda o: setattr(bpy.context.scene.physgen.world, "use_ground", False),
    "effect": lambda o: setattr(bpy.context.scene.physgen.world.effects[0].parameters[0], "value", 1.5),
    "effect off": lambda o: setattr(bpy.context.scene.physgen.world.effects[0], "enabled", False),
    "target": lambda o: setattr(bpy.context.scene.physgen.world.effects[0].targets.add(), "item", o),
    "pin": lambda o: setattr(bpy.data.objects["box"], "scale", (2, 1, 1)),
    "collider": lambda o: setattr(bpy.data.objects["moves"], "scale", (2, 1, 1)),
    "keyframe": _key,
    "modifier": lambda o: setattr(bpy.data.objects["moves"].modifiers[0], "levels", 2),
    "mother": lambda o: setattr(bpy.data.objects["mother"], "location", (2, 0, 0)),
}


def full_scene(scene):
    item = add()
    item.physgen.pins.add().box = add_empty("box")
    scene.physgen.world.ground_object = add_empty("plane", (0, 0, 0))
    scene.physgen.world.effects.add().effect = "wind"
    scene.physgen.simulation.frame_start = 1
    moves = add("moves", (4, 0, 1), role="collider")
    moves.modifiers.new("smooth", "SUBSURF").levels = 1
    moves.parent = add_empty("mother")
    animate(moves, "location", (4, 0, 1), (5, 0, 1))
    return item


@pytest.mark.parametrize("name", CHANGES)
def test_the_fingerprint_changes_with_what_the_motion_depends_on(scene, name):
    item = full_scene(scene)
    before = fingerprint(scene)
    assert fingerprint(scene) == before
    CHANGES[name](item)
    assert fingerprint(scene) != before


def test_the_fingerprint_does_not_change_with_anything_else(scene, tmp_path):
    item = full_scene(scene)
    before = fingerprint(scene)
    scene.frame_set(6)
    item.select_set(True)
    bpy.context.view_layer.objects.active = item
    item.data.materials.append(bpy.data.materials.new("red"))
    item.data.materials[0].name = "blue"
    item.physgen.material.preset = item.physgen.material.preset
    scene.physgen.simulation.device = "cuda"
    scene.physgen.simulation.bake = "//somewhere"
    item.modifiers.new("PhysGen cache", "MESH_CACHE")
    pinhole = Camera(width=9, height=9, fx=9, fy=9, cx=4, cy=4, world_from_camera=tuple(map(tuple, Matrix())))
    bridge_camera.add_camera(scene, pinhole, (9, 9))
    scene.camera.location.x += 1
    add("bystander").physgen.enabled = False
    export_scene(scene, tmp_path / "scene")
    assert fingerprint(scene) == before


def lattice(item):
    """Let a lattice bend ``item`` whose point is driven by a property, after nodes with an animated input."""
    data = bpy.data.lattices.new("cage")
    cage = bpy.data.objects.new("cage", data)
    bpy.context.scene.collection.objects.link(cage)
    item.modifiers.new("cage", "LATTICE").object = cage
    cage["amount"] = 1.0
    driver = cage.driver_add("scale", 0).driver
    variable = driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = cage, '["amount"]'
    driver.expression = "var + frame / 10"
    return cage


def nodes(item):
    """Geometry nodes that shift ``item`` by their input; the modifier."""
    tree = bpy.data.node_groups.new("shift", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Shift", in_out="INPUT", socket_type="NodeSocketVector")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    shift = tree.nodes.new("GeometryNodeTransform")
    tree.links.new(start.outputs[0], shift.inputs[0])
    tree.links.new(start.outputs[1], shift.inputs["Translation"])
    tree.links.new(shift.outputs[0], end.inputs[0])
    modifier = item.modifiers.new("shift", "NODES")
    modifier.node_group = tree
    return modifier, tree.interface.items_tree["Shift"].identifier


def test_colliders_with_rigs_are_told_by_their_settings(scene, tmp_path):
    add("falls", (20, 0, 1))
    item = add("rigged", role="collider")
    cage = lattice(item)
    modifier, identifier = nodes(item)
    wave = item.modifiers.new("wave", "WAVE")
    animate(wave, "height", 0.0, 1.0)
    item.constraints.new("COPY_ROTATION").target = add_empty("guide")
    bpy.context.view_layer.update()
    seen = {fingerprint(scene)}
    for frame in (3, 7):
        scene.frame_set(frame)
        seen.add(fingerprint(scene))
    assert len(seen) == 1
    _, objects = exported(scene, tmp_path)
    assert objects["rigged"].motion.vertices_file
    assert fingerprint(scene) in seen
    changes = [
        lambda: cage.__setitem__("amount", 2.0),
        lambda: setattr(cage.data.points[0], "co_deform", (-1, -1, -1)),
        lambda: compat.set_modifier_input(modifier, identifier, (0.0, 0.0, 0.5)),
        lambda: setattr(modifier.node_group.nodes["Transform Geometry"].inputs["Scale"], "default_value", (1, 1, 2)),
        lambda: setattr(wave, "speed", 0.1),
        lambda: setattr(bpy.data.objects["guide"], "rotation_euler", (1, 0, 0)),
        lambda: setattr(item.constraints[0], "use_x", False),
    ]
    for number, change in enumerate(changes):
        change()
        assert fingerprint(scene) not in seen, number
        seen.add(fingerprint(scene))


def test_the_fingerprint_never_raises(scene):
    empty = fingerprint(scene)
    item = add(faces=[])
    item.physgen.material.fibre_axis = (0, 0, 0)
    scene.physgen.simulation.frame_end = 0
    item.physgen.pins.add()
    scene.physgen.world.effects.add().effect = "wind"
    scene.physgen.world.effects[0].targets.add()
    assert fingerprint(scene) != empty


# The whole way


@pytest.mark.long
def test_an_export_bakes(scene, tmp_path):
    item = add("Würfel.001", (0, 0, 0.7))
    item.scale = (0.4, 0.4, -0.4)
    lift = add("lift", (0, 0, 0.2), role="collider")
    lift.scale = (2, 2, 0.2)
    animate(lift, "location", (0, 0, 0.2), (0, 0, 0.6))
    scene.physgen.simulation.frame_end = 9
    folder, _ = exported(scene, tmp_path)
    out = tmp_path / "bake"
    options = ["--frames", "9", "--fps", "24", "--quality", "preview", "--json"]
    command = [sys.executable, "-m", "physgen.batch.cli", "bake", str(folder.root), "--out", str(out), *options]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr + result.stdout[-800:]
    assert json.loads(result.stdout.splitlines()[-1])["event"] == "done"
    cube, plate = (Pc2Reader(out / f"{name}.pc2") for name in ("Würfel_001", "lift"))
    assert cube.vertex_count == 8
    assert np.abs(cube.sample(0) - world_vertices(item)).max() < 1e-6
    plate_top = plate.sample(8)[:, 2].max()
    assert plate_top == pytest.approx(0.7, abs=1e-4)
    # It would have fallen below where the plate is now.
    assert cube.sample(8)[:, 2].min() > plate_top - 0.03
    assert inputs_hash(folder, BakeOptions()) == inputs_hash(exported(scene, tmp_path, "again")[0], BakeOptions())
