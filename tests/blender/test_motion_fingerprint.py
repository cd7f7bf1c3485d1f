# SPDX-License-Identifier: GPL-3.0-or-later
"""A fingerprint of a Blender scene changes with what its motion depends on, and with nothing else."""

import pytest

bpy = pytest.importorskip("bpy")
from mathutils import Matrix
from physgen.physgen_addon import compat
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.scene.model import Camera

from .export_scenes import add, add_empty, animate, exported


@pytest.fixture(autouse=True)
def settings(addon):
    bpy.context.scene.physgen.simulation.frame_end = 9


@pytest.fixture
def scene():
    return bpy.context.scene


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
    "push": lambda o: setattr(o.physgen.pushes.add(), "frame", 5),
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
