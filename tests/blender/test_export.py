# SPDX-License-Identifier: GPL-3.0-or-later
"""Any Blender scene as a scene folder: exact where it can be, refused with a way out where it cannot."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.scene_io.export_animation import export_names
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.scene_to_world_checks import vertices_at
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import InputError
from physgen.sim.scene.meshes import load_object_mesh, read_mesh

from .export_scenes import CUBE, QUADS, add, add_empty, animate, exported, prepared, refused, world_vertices


@pytest.fixture(autouse=True)
def settings(addon):
    bpy.context.scene.physgen.simulation.frame_end = 9


@pytest.fixture
def scene():
    return bpy.context.scene


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
        (_keys, "animated (location; Object > Animation > Clear Keyframes)"),
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
