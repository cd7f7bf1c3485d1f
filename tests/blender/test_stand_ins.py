# SPDX-License-Identifier: GPL-3.0-or-later
"""Anything goes in: what is no mesh, or shows another shape than its mesh, is simulated by a stand-in."""

import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.panels.objects_panel import PHYSGEN_PT_objects
from physgen.physgen_addon.props.body_props import bodies
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint

from . import checked_layout


@pytest.fixture(autouse=True)
def settings(addon):
    bpy.context.scene.physgen.world.use_ground = False


def a_text():
    bpy.ops.object.text_add(location=(0, 0, 2))
    item = bpy.context.object
    item.data.body, item.data.extrude = "ab", 0.1
    return item


def a_curve():
    bpy.ops.curve.primitive_bezier_circle_add(location=(0, 0, 2))
    bpy.context.object.data.bevel_depth = 0.2
    return bpy.context.object


def a_metaball():
    bpy.ops.object.metaball_add(type="BALL", location=(0, 0, 2))
    return bpy.context.object


def a_cube(**where):
    bpy.ops.mesh.primitive_cube_add(size=1, **where)
    return bpy.context.object


def mirrored():
    item = a_cube(location=(0.6, 0, 2))
    item.data.transform(((1, 0, 0, 2), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)))
    item.modifiers.new("Mirror", "MIRROR")
    return item


def arrayed():
    item = a_cube(location=(0, 0, 2))
    item.modifiers.new("Array", "ARRAY").relative_offset_displace = (1.5, 0, 0)
    return item


def keyed():
    item = a_cube(location=(0, 0, 2))
    item.shape_key_add(name="Basis")
    tall = item.shape_key_add(name="Tall")
    for point in tall.data:
        point.co.z *= 2
    tall.value = 0.5
    return item


def shown_bounds(item):
    """Corners of what the object shows, in the world."""
    graph = bpy.context.evaluated_depsgraph_get()
    evaluated = item.evaluated_get(graph)
    mesh = evaluated.to_mesh()
    points = np.array([evaluated.matrix_world @ vertex.co for vertex in mesh.vertices])
    evaluated.to_mesh_clear()
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize("make", [a_text, a_curve, a_metaball, mirrored, arrayed, keyed])
def test_the_evaluated_mesh_is_simulated_and_the_original_is_kept(tmp_path, make):
    scene, item = bpy.context.scene, make()
    bounds = shown_bounds(item)
    assert bpy.ops.physgen.quick_jelly() == {"FINISHED"}
    (body,) = bodies(scene)
    assert body != item and body.physgen.original == item and item.hide_viewport and item.hide_render
    assert np.allclose(shown_bounds(body), bounds, atol=1e-5)
    model = export_scene(scene, tmp_path / "scene").model
    assert math.isclose(model.objects[0].size_m, max(bounds[1] - bounds[0]), rel_tol=1e-5)
    bpy.context.view_layer.objects.active = body
    assert bpy.ops.physgen.remove_body() == {"FINISHED"}
    assert not bodies(scene) and not item.hide_viewport and not item.hide_render


def test_every_mesh_of_a_collection_instance_takes_part(tmp_path):
    scene = bpy.context.scene
    group = bpy.data.collections.new("pair")
    for index in range(2):
        mesh = a_cube(location=(3 * index, 0, 0))
        scene.collection.objects.unlink(mesh)
        group.objects.link(mesh)
    empty = bpy.data.objects.new("instance", None)
    scene.collection.objects.link(empty)
    empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", group, (0, 0, 5)
    bpy.context.view_layer.update()
    for item in bpy.context.view_layer.objects:
        item.select_set(item == empty)
    bpy.context.view_layer.objects.active = empty
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    places = sorted(tuple(item.matrix_world.translation) for item in bodies(scene))
    assert places == [(0, 0, 5), (3, 0, 5)] and empty.hide_viewport
    assert len(export_scene(scene, tmp_path / "scene").model.objects) == 2


def test_a_collection_that_was_set_up_takes_part_as_it_was():
    scene = bpy.context.scene
    group = bpy.data.collections.new("set up")
    moving, ramp, box = (a_cube(location=(3 * index, 0, 0)) for index in range(3))
    bpy.ops.mesh.primitive_plane_add(location=(0, 0, -1))
    floor = bpy.context.object
    for item in (moving, ramp, floor, box):
        scene.collection.objects.unlink(item)
        group.objects.link(item)
    for item in (moving, ramp):
        item.physgen.enabled = True
    moving.physgen.material.preset, moving.physgen.velocity, moving.physgen.spin = "sand", (1, 0, 0), (0, 2, 0)
    moving.physgen.pins.add().box = box
    moving.physgen.pushes.add().velocity = (0, 1, 0)
    ramp.physgen.role, ramp.parent = "collider", moving
    empty = bpy.data.objects.new("instance", None)
    scene.collection.objects.link(empty)
    empty.instance_type, empty.instance_collection = "COLLECTION", group
    empty.location, empty.rotation_euler = (0, 0, 5), (0, 0, math.pi / 2)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = empty
    empty.select_set(True)
    # The plane has no inside: as a body of its own it would be refused, and the whole collection with it.
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert "instance" not in scene.objects and len(scene.objects) == 4
    found = {item.physgen.role: item for item in bodies(scene)}
    assert set(found) == {"dynamic", "collider"} and moving not in found.values()
    body = found["dynamic"]
    assert body.physgen.material.preset == "sand" and body.data != moving.data
    assert tuple(body.physgen.velocity) == pytest.approx((0, 1, 0), abs=1e-6)
    assert tuple(body.physgen.pushes[0].velocity) == pytest.approx((-1, 0, 0), abs=1e-6)
    assert tuple(body.physgen.spin) == pytest.approx((-2, 0, 0), abs=1e-6)
    assert tuple(body.matrix_world.translation) == pytest.approx((0, 0, 5), abs=1e-6)
    assert found["collider"].parent == body and body.physgen.pins[0].box in tuple(scene.objects)
    # The ramp stood 3 to the right; turned a quarter it stands 3 to the back.
    assert tuple(found["collider"].matrix_world.translation) == pytest.approx((0, 3, 5), abs=1e-5)


def test_what_is_linked_or_overridden_takes_part_when_it_is_local(tmp_path):
    """An override would lose its physics when the file is opened again, and its settings would be grey before."""
    a_cube().name = "theirs"
    bpy.data.libraries.write(str(tmp_path / "theirs.blend"), {bpy.context.object})
    bpy.data.objects.remove(bpy.context.object)
    with bpy.data.libraries.load(str(tmp_path / "theirs.blend"), link=True) as (_, wanted):
        wanted.objects = ["theirs"]
    item = wanted.objects[0]
    bpy.context.scene.collection.objects.link(item)

    def add():
        bpy.context.view_layer.objects.active = item
        item.select_set(True)
        bpy.ops.physgen.add_bodies()
        return [body.name for body in bodies(bpy.context.scene)]

    assert add() == []
    item = item.override_create(remap_local_usages=True)
    assert add() == []
    item.physgen.enabled = True  # as in a file of ours that somebody has overridden an object of
    assert any("Make Local" in words for words in objects_panel().words)
    item = item.make_local()
    assert add() == ["theirs"] and not any("Make Local" in words for words in objects_panel().words)


def objects_panel():
    return checked_layout.draw(PHYSGEN_PT_objects)


def test_an_animation_hands_over_at_the_current_frame(tmp_path):
    scene, item = bpy.context.scene, a_cube(location=(0, 0, 2))
    item.keyframe_insert("location", frame=1)
    item.location = (2.4, 0, 2)
    item.keyframe_insert("location", frame=25)
    for layer in item.animation_data.action.layers:
        for curve in layer.strips[0].channelbag(item.animation_data.action_slot).fcurves:
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"
    scene.frame_set(11)
    assert bpy.ops.physgen.quick_rigid() == {"FINISHED"}
    (body,) = bodies(scene)
    assert math.isclose(body.location.x, 1.0, abs_tol=1e-5) and body.physgen.start_frame == 11
    # 0.1 m a frame at 24 frames a second.
    assert np.allclose(body.physgen.velocity, (2.4, 0, 0), atol=1e-4)
    marks = {}
    for frame in (5, 10, 11, 20):
        scene.frame_set(frame)
        assert (item.hide_render, body.hide_render) == (frame >= 11, frame < 11)
        marks[frame] = fingerprint(scene)
        # While it is hidden, too.
        model = export_scene(scene, tmp_path / "scene").model
        assert math.isclose(model.objects[0].start_time, 10 / 24)
        assert math.isclose(model.objects[0].world_from_mesh[0][3], 1.0, abs_tol=1e-5)
    assert len(set(marks.values())) == 1
    assert bpy.ops.physgen.remove_body(name=body.name) == {"FINISHED"}
    scene.frame_set(20)
    assert not item.hide_render and not item.hide_viewport


def test_what_cannot_be_done_is_said_when_it_is_added():
    item = a_text()
    item.data.extrude = 0.0
    assert bpy.ops.physgen.quick_jelly() == {"CANCELLED"}
    assert not item.hide_viewport and not bodies(bpy.context.scene) and len(bpy.data.meshes) == 0


def test_a_collider_keeps_its_modifiers_and_its_animation():
    item = arrayed()
    item.keyframe_insert("location", frame=1)
    assert bpy.ops.physgen.add_colliders() == {"FINISHED"}
    assert bodies(bpy.context.scene) == [item] and not item.hide_viewport


def grown_by_nodes(**where):
    """A cube that Geometry Nodes stretch to twice its height."""
    item = a_cube(**where)
    group = bpy.data.node_groups.new("Stretch", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    given, out = (group.nodes.new(f"NodeGroup{way}") for way in ("Input", "Output"))
    stretch = group.nodes.new("GeometryNodeTransform")
    stretch.inputs["Scale"].default_value = (1, 1, 2)
    group.links.new(given.outputs[0], stretch.inputs["Geometry"])
    group.links.new(stretch.outputs[0], out.inputs[0])
    item.modifiers.new("Nodes", "NODES").node_group = group
    return item


def posed(location=(0, 0, 0)):
    """A cube that the bone of an armature has turned by half a right angle."""
    item = a_cube(location=location)
    bpy.ops.object.armature_add(location=location)
    armature = bpy.context.object
    item.vertex_groups.new(name="Bone").add(range(8), 1.0, "REPLACE")
    item.modifiers.new("Armature", "ARMATURE").object = armature
    bone = armature.pose.bones["Bone"]
    bone.rotation_mode, bone.rotation_euler = "XYZ", (0, math.pi / 4, 0)
    return item


def thrown(location=(0, 0, 0)):
    """A cube that keyframes move sideways, 0.25 m a frame, until physics takes over at frame 5."""
    item = a_cube(location=location)
    for frame, x in ((1, 0.0), (25, 6.0)):
        item.location = (location[0] + x, *location[1:])
        item.keyframe_insert("location", frame=frame)
    for curve in item.animation_data.action.layers[0].strips[0].channelbag(item.animation_data.action_slot).fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
    return item


def test_stand_ins_are_baked_and_play(tmp_path):
    """All kinds in one bake of a real worker: rest shape in the first frame, gravity's fall, the hand-over."""
    scene = bpy.context.scene
    scene.render.fps, scene.frame_end = 24, 12
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", 1, 9
    simulation.cache = str(tmp_path / "cache")
    makers = [a_text, a_curve, arrayed, keyed, grown_by_nodes, posed]
    rest = {}
    for number, make in enumerate(makers):
        item = make()
        item.location = (0, 6.0 * number, 5)
        if make is posed:
            item.modifiers["Armature"].object.location = item.location
        bpy.context.view_layer.update()
        rest[item.name] = (item, shown_bounds(item))
    flier = thrown(location=(0, -8, 5))
    scene.frame_set(1)
    add(*(item for item, _ in rest.values()))
    scene.frame_set(5)
    add(flier)
    assert len(bodies(scene)) == len(makers) + 1 and all(body.physgen.original for body in bodies(scene))
    assert bpy.ops.physgen.bake("EXEC_DEFAULT") == {"FINISHED"}
    for body in bodies(scene):
        if body.physgen.original == flier:
            continue
        _, (low, high) = rest[body.physgen.original.name]
        scene.frame_set(1)
        assert np.allclose(shown_bounds(body), (low, high), atol=1e-4), body.name
        scene.frame_set(9)
        fallen = 0.5 * 9.81 * (8 / 24) ** 2
        assert np.allclose(shown_bounds(body)[0][2], low[2] - fallen, atol=0.05 * fallen), body.name
        assert body.physgen.original.hide_viewport
    (body,) = (body for body in bodies(scene) if body.physgen.original == flier)
    for frame, x in ((5, 1.0), (9, 2.0)):
        scene.frame_set(frame)
        low, high = shown_bounds(body)
        assert math.isclose((low[0] + high[0]) / 2, x, abs_tol=0.02), (frame, low, high)
        assert flier.hide_viewport and not body.hide_viewport
    fallen = 0.5 * 9.81 * (4 / 24) ** 2
    assert math.isclose((low[2] + high[2]) / 2, 5 - fallen, abs_tol=0.05 * fallen)
    scene.frame_set(4)
    assert body.hide_viewport and not flier.hide_viewport


def add(*items):
    """Let them take part as rigid bodies, as an artist does who has selected them."""
    for item in bpy.context.view_layer.objects:
        item.select_set(item in items)
    bpy.context.view_layer.objects.active = items[0]
    assert bpy.ops.physgen.quick_rigid() == {"FINISHED"}
