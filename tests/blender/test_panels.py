# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands behind the panels: operators, the list that follows the viewport, presets, effects, rendering."""

import dataclasses
import inspect
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from mathutils import Vector
from physgen import physgen_addon
from physgen.batch.blender_script import add_script_options
from physgen.batch.commands.render_commands import render_options
from physgen.batch.render import build_parser
from physgen.physgen_addon import bake_state, interpreter, paths, text
from physgen.physgen_addon.operators import render_ops
from physgen.physgen_addon.operators.photo_object_ops import cutouts_picture
from physgen.physgen_addon.panels.render_panel import RESULTS
from physgen.physgen_addon.panels.sidebar import is_in
from physgen.physgen_addon.props import material_props
from physgen.physgen_addon.props.body_props import bodies
from physgen.physgen_addon.props.material_props import LAW_FIELDS, get_material, is_modified
from physgen.physgen_addon.props.scene_props import EFFECT_ITEMS, effect_values
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.sim.effects.registry import effect
from physgen.sim.errors import InputError
from physgen.sim.scene.material import LAWS


@pytest.fixture(autouse=True)
def addon(fresh_blender, tmp_path, monkeypatch):
    """The user's own presets are in a folder of the test."""
    monkeypatch.setattr(material_props, "own_folder", lambda *, create=False: own_folder(tmp_path, create))
    material_props.forget_presets()
    physgen.register()
    yield
    physgen.unregister()
    material_props.forget_presets()


def own_folder(tmp_path, create=False):
    folder = tmp_path / "materials"
    if create:
        folder.mkdir(exist_ok=True)
    return folder


def a_cube(name="Cube", location=(0, 0, 0), size=2.0):
    mesh = bpy.data.meshes.new(name)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh.from_pydata(corners.tolist(), [], faces)
    item = bpy.data.objects.new(name, mesh)
    item.location = location
    bpy.context.scene.collection.objects.link(item)
    bpy.context.view_layer.update()
    return item


def select(*items):
    bpy.context.view_layer.update()
    for item in bpy.context.view_layer.objects:
        item.select_set(item in items)
    bpy.context.view_layer.objects.active = items[0] if items else None


def a_body(name="Cube", **options):
    item = a_cube(name, **options)
    select(item)
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    return item


# -- registering ------------------------------------------------------------------------------------------------------


def test_extension_registers_and_unregisters_repeatedly():
    for _ in range(2):
        physgen.unregister()
        assert not hasattr(bpy.types.Object, "physgen") and not hasattr(bpy.types, "PHYSGEN_PT_world")
        physgen.register()
    assert hasattr(bpy.types, "PHYSGEN_PT_world")


def test_panels_are_in_the_order_of_a_first_visit():
    panels = [p for p in bpy.types.Panel.__subclasses__() if p.__name__.startswith("PHYSGEN_PT") and p.is_registered]
    mine = [p for p in panels if p.bl_space_type == "VIEW_3D" and not getattr(p, "bl_parent_id", "")]
    tops = {p.bl_label: p.bl_order for p in mine}
    assert sorted(tops, key=tops.get) == [
        *("Scene", "Objects", "Motion", "Simulate", "Render", "World", "Compose Objects", "Diagnose")
    ]
    assert len(set(tops.values())) == 8


def registered_groups():
    return [
        kind
        for module in physgen_addon._modules()
        for kind in physgen_addon.registered_classes(module)
        if issubclass(kind, bpy.types.PropertyGroup)
        and kind.__module__.endswith((".body_props", ".material_props", ".render_props", ".scene_props"))
    ]


def test_every_property_has_a_description():
    for kind in registered_groups():
        for name in inspect.get_annotations(kind):
            found = kind.bl_rna.properties[name]
            # What is named is shown; what has no name is for the program.
            if found.name and found.name != name and found.type not in ("COLLECTION",):
                assert found.description or found.type == "POINTER" or name.endswith(("_index", "switch", "pin_index"))


# -- the list of bodies -----------------------------------------------------------------------------------------------


def test_only_meshes_that_can_be_simulated_are_added():
    cube, lamp = a_cube(), bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    empty = bpy.data.objects.new("Bare", bpy.data.meshes.new("Bare"))
    for item in (lamp, empty):
        bpy.context.scene.collection.objects.link(item)
    select(lamp, empty, cube)
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    assert bodies(bpy.context.scene) == [cube] and bpy.context.active_object == cube
    select(lamp)
    assert bpy.ops.physgen.add_bodies() == {"CANCELLED"}
    select()
    assert not bpy.ops.physgen.add_bodies.poll()


def test_list_and_viewport_are_one():
    scene = bpy.context.scene
    lamp = bpy.data.objects.new("A lamp", None)
    scene.collection.objects.link(lamp)
    one, two = a_body("b"), a_body("a")
    state = scene.physgen
    assert scene.objects[state.body_index] == two
    select(one)
    assert scene.objects[state.body_index] == one
    state.body_index = scene.objects.find("a")
    assert bpy.context.active_object == two and two.select_get() and not one.select_get()
    select(lamp)
    assert state.body_index == -1
    for nowhere in (-1, 99):
        state.body_index = nowhere
        assert bpy.context.active_object == lamp
    two.name = "z"
    state.body_index = scene.objects.find("z")
    assert bpy.context.active_object == two


def test_the_list_does_not_reach_into_hidden_collections_or_edit_mode():
    scene, one, two = bpy.context.scene, a_body("a"), a_body("b")
    hidden = bpy.data.collections.new("hidden")
    scene.collection.children.link(hidden)
    hidden.objects.link(one)
    scene.collection.objects.unlink(one)
    bpy.context.view_layer.layer_collection.children["hidden"].exclude = True
    scene.physgen.body_index = scene.objects.find("a")
    assert bpy.context.active_object == two
    assert bpy.ops.physgen.select_bodies() == {"FINISHED"} and bpy.context.selected_objects == [two]
    three = a_body("c")
    bpy.ops.object.mode_set(mode="EDIT")
    scene.physgen.body_index = scene.objects.find("b")
    assert bpy.context.active_object == three and bpy.context.mode == "EDIT_MESH"
    assert not bpy.ops.physgen.add_bodies.poll()
    bpy.ops.object.mode_set(mode="OBJECT")


def test_two_scenes_keep_their_own_lists():
    one = a_body("here")
    other = bpy.data.scenes.new("Other")
    assert other.physgen.body_index == -1 and bodies(other) == []
    other.physgen.body_index = 0
    assert bpy.context.active_object == one


def test_deleted_renamed_duplicated():
    scene, item = bpy.context.scene, a_body("ball")
    item.physgen.material.preset = "rubber"
    item.physgen.velocity = (1, 2, 3)
    twin = item.copy()
    scene.collection.objects.link(twin)
    twin.physgen.velocity = (0, 0, 0)
    assert [o.name for o in bodies(scene)] == ["ball", "ball.001"] and twin.physgen.material.preset == "rubber"
    assert tuple(item.physgen.velocity) == (1, 2, 3)
    select(item)
    bpy.ops.object.delete()
    assert bodies(scene) == [twin] and scene.physgen.body_index == -1
    assert bpy.ops.physgen.remove_body(name="gone") == {"CANCELLED"}
    assert bpy.ops.physgen.remove_body(name="ball.001") == {"FINISHED"} and bodies(scene) == []
    assert twin.physgen.material.preset == "rubber"


def test_undo_takes_back_one_step():
    a_body("ball")
    bpy.ops.ed.undo_push(message="added")
    assert bpy.ops.physgen.add_stack_effect(effect="wind") == {"FINISHED"}
    bpy.ops.ed.undo_push(message="effect")
    bpy.data.objects["ball"].physgen.material.preset = "snow"
    bpy.ops.ed.undo_push(message="snow")
    bpy.ops.ed.undo()
    scene = bpy.context.scene
    assert bpy.data.objects["ball"].physgen.material.preset == "medium" and len(scene.physgen.world.effects) == 1
    bpy.ops.ed.undo()
    scene = bpy.context.scene
    assert len(scene.physgen.world.effects) == 0 and bodies(scene)[0].name == "ball"
    bpy.ops.ed.redo()
    assert bpy.context.scene.physgen.world.effects[0].effect == "wind"
    assert bpy.context.scene.physgen.body_index >= 0


def test_colliders():
    wall = a_cube("wall")
    select(wall)
    assert bpy.ops.physgen.add_colliders() == {"FINISHED"}
    assert wall.physgen.enabled and wall.physgen.role == "collider"
    # Taken out and added again it is what it was.
    bpy.ops.physgen.remove_body()
    bpy.ops.physgen.add_bodies()
    assert wall.physgen.role == "collider"


# -- material ---------------------------------------------------------------------------------------------------------


def test_a_changed_number_is_seen_and_taken_back():
    material = a_body().physgen.material
    for name in material_props._SHIPPED.good:
        material.preset = name
        assert material.preset == name and not is_modified(material), name
    material.preset = "rubber"
    material.youngs_modulus *= 1.01
    assert is_modified(material) and material.preset == "rubber"
    assert bpy.ops.physgen.reset_preset() == {"FINISHED"} and not is_modified(material)
    material.preset = "custom"
    material.density = 5
    assert not is_modified(material) and material.preset == "custom" and material.density == 5
    assert bpy.ops.physgen.reset_preset() == {"CANCELLED"}
    material.preset = "wood"
    assert material.law == "rigid" and material.density == 550


def test_a_preset_of_ones_own(tmp_path):
    item = a_body()
    material = item.physgen.material
    material.preset = "clay"
    material.density, material.fibre_axis = 1234.5, (0.6, 0.0, 0.8)
    assert bpy.ops.physgen.save_preset(name=" My clay ") == {"FINISHED"}
    assert material.preset == "My clay" and not is_modified(material)
    other = a_body("other").physgen.material
    other.preset = "My clay"
    assert get_material(other) == get_material(material) and other.density == 1234.5
    with pytest.raises(RuntimeError, match="is a shipped preset"):
        bpy.ops.physgen.save_preset(name="CLAY")
    with pytest.raises(RuntimeError, match="preset name"):
        bpy.ops.physgen.save_preset(name="a/b")
    assert bpy.ops.physgen.delete_preset(name="My clay") == {"FINISHED"}
    assert material.preset == "custom" and material.density == 1234.5
    with pytest.raises(RuntimeError, match="already be deleted"):
        bpy.ops.physgen.delete_preset(name="My clay")
    assert not list(own_folder(tmp_path).iterdir())


def test_a_preset_is_kept_by_name_where_it_is_missing(tmp_path):
    material = a_body("ball").physgen.material
    material.law, material.density = "rigid", 777
    bpy.ops.physgen.save_preset(name="é oak")
    bpy.ops.physgen.save_preset(name="a first")
    material.preset = "é oak"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    for path in own_folder(tmp_path).iterdir():
        path.unlink()
    material_props.forget_presets()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    material = bpy.data.objects["ball"].physgen.material
    assert (material.preset, material.law, material.density) == ("é oak", "rigid", 777)
    assert not is_modified(material) and get_material(material).preset == "é oak"
    assert ("é oak", "é oak (missing)") in [item[:2] for item in material_props.preset_items(material.preset_name)]
    material.preset = "é oak"
    assert material.density == 777
    material.preset = "rubber"
    assert material.density == 1100 and "é oak" not in [
        item[0] for item in material_props.preset_items(material.preset_name)
    ]


def test_broken_presets_are_listed_and_change_nothing(tmp_path):
    folder = own_folder(tmp_path, create=True)
    (folder / "bad.toml").write_bytes(b"\xff[[")
    (folder / "rubber.toml").write_text("density = 1.0")
    (folder / "good.toml").write_text("density = 2.0")
    material_props.forget_presets()
    material = a_body().physgen.material
    assert (
        set(material_props.own_presets().broken) == {"bad", "rubber"}
        and material_props.find_preset("rubber").density == 1100
    )
    material.preset = "broken:bad"
    assert material.preset == "medium" and material.density == 1000
    material.preset = "good"
    assert material.density == 2
    with pytest.raises(TypeError):
        material.preset = "nothing like it"
    assert bpy.ops.physgen.delete_preset(name="bad") == {"FINISHED"} and not (folder / "bad.toml").exists()


def test_copying_a_material():
    one, two, wall = a_body("a"), a_body("b"), a_cube("c")
    one.physgen.material.preset = "jelly"
    one.physgen.material.density = 900
    select(one, two, wall)
    assert bpy.ops.physgen.copy_material() == {"FINISHED"}
    assert two.physgen.material.preset == "jelly" and two.physgen.material.density == 900
    assert is_modified(two.physgen.material) and wall.physgen.material.preset == "medium"
    select(one)
    assert not bpy.ops.physgen.copy_material.poll()


def test_every_law_shows_fields_that_exist():
    material = a_body().physgen.material
    assert set(LAW_FIELDS) == set(LAWS)
    for fields in LAW_FIELDS.values():
        assert all(hasattr(material, name) for name in fields)


@pytest.mark.parametrize(
    ("pascals", "words"), [(100, "100 Pa"), (999.9, "1 kPa"), (5e5, "500 kPa"), (1.25e6, "1.25 MPa"), (7e10, "70 GPa")]
)
def test_pressures_are_readable(pascals, words):
    assert text.pressure(pascals) == words


def test_a_crash_does_not_flood_a_panel():
    assert text.brief("Nothing is baked yet") == "Nothing is baked yet"
    crash = "\n".join(["ended with code 1: Traceback", *["  line"] * 40, "KeyError: 'x'"])
    assert text.brief(crash) == "ended with code 1: Traceback … KeyError: 'x'"
    assert len(text.brief("word " * 500)) < 310 and text.brief("") == ""


# -- motion -----------------------------------------------------------------------------------------------------------


def test_speed_is_the_length_of_the_velocity():
    body = a_body().physgen
    body.velocity = (0, 3, 4)
    assert body.speed == pytest.approx(5)
    body.speed = 10
    assert tuple(body.velocity) == pytest.approx((0, 6, 8))
    body.speed = 0
    body.speed = 2
    assert tuple(body.velocity) == pytest.approx((2, 0, 0))
    body.spin, body.start_frame = (1, 1, 1), 7
    assert bpy.ops.physgen.clear_motion() == {"FINISHED"}
    assert body.speed == 0 and tuple(body.spin) == (0, 0, 0) and body.start_frame == 0


def test_a_pin_is_a_box_around_the_upper_part():
    item = a_body(location=(1, 0, 5))
    item.rotation_euler, item.scale = (0, 0, 0.3), (1, 1, 2)
    bpy.context.view_layer.update()
    assert bpy.ops.physgen.add_pin() == {"FINISHED"}
    box = item.physgen.pins[0].box
    bpy.context.view_layer.update()
    corners = [box.matrix_world @ Vector((x, y, z)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    held = np.array([(item.matrix_world @ v.co)[:] for v in item.data.vertices])
    inside = ((held >= low) & (held <= high)).all(axis=1)
    assert inside.sum() == 4 and (held[inside, 2] > 6.9).all()
    assert low[2] == pytest.approx(6.0, abs=0.01) and box.empty_display_type == "CUBE"
    item.location.x += 3
    bpy.context.view_layer.update()
    assert box.matrix_world.translation.x == pytest.approx(4.0, abs=0.01)


def test_pins_that_lost_their_box():
    item = a_body()
    for _ in range(3):
        bpy.ops.physgen.add_pin()
    body = item.physgen
    boxes = [pin.box for pin in body.pins]
    assert body.pin_index == 2
    twin = item.copy()
    bpy.context.scene.collection.objects.link(twin)
    assert bpy.ops.physgen.remove_pin() == {"FINISHED"} and len(body.pins) == 2 and body.pin_index == 1
    # The duplicate still uses it.
    assert is_in(boxes[2], bpy.context.scene)
    select(boxes[0])
    bpy.ops.object.delete()
    select(item)
    lost = body.pins[0].box
    assert lost is None or not is_in(lost, bpy.context.scene)
    body.pin_index = 0
    bpy.ops.physgen.remove_pin()
    bpy.data.objects.remove(twin)
    name = boxes[1].name
    bpy.ops.physgen.remove_pin()
    assert len(body.pins) == 0 and name not in bpy.data.objects
    assert bpy.ops.physgen.remove_pin() == {"CANCELLED"}


# -- world ------------------------------------------------------------------------------------------------------------


def test_every_effect_can_be_added_and_means_what_the_registry_says():
    world = bpy.context.scene.physgen.world
    for name, *_ in EFFECT_ITEMS:
        assert bpy.ops.physgen.add_stack_effect(effect=name) == {"FINISHED"}
        entry = world.effects[world.effect_index]
        assert effect_values(entry) == effect(name).defaults
        for low in (True, False):
            for number, parameter in zip(entry.parameters, effect(name).parameters, strict=True):
                number.value = -1e30 if low else 1e30
                bound = parameter.low if low else parameter.high
                assert number.value == pytest.approx(bound, rel=1e-6)
            # To the last digit, or the simulation would refuse it.
            values = effect_values(entry)
            assert effect(name).checked(values) == values
    assert "time_scale" not in [entry.effect for entry in world.effects]


def test_whole_numbers_and_angles():
    world = bpy.context.scene.physgen.world
    bpy.ops.physgen.add_stack_effect(effect="tether")
    string = world.effects[0].parameters["string"]
    string.value = 0.4
    assert string.value == 0 and not string.switch
    string.switch = True
    assert string.value == 1
    bpy.ops.physgen.add_stack_effect(effect="gravity_tilt")
    angle = world.effects[1].parameters["angle"]
    angle.angle = 9.0
    assert angle.value == pytest.approx(np.pi)


def test_numbers_of_another_version_are_left_out():
    world = bpy.context.scene.physgen.world
    bpy.ops.physgen.add_stack_effect(effect="wind")
    entry = world.effects[0]
    entry.parameters["wind_x"].name = "wind_of_old"
    entry.parameters["wind_of_old"].value = 1e9
    assert effect_values(entry) == effect("wind").defaults


def test_the_stack_is_ordered():
    world = bpy.context.scene.physgen.world
    assert not bpy.ops.physgen.remove_stack_effect.poll()
    for name in ("wind", "magnus", "friction"):
        bpy.ops.physgen.add_stack_effect(effect=name)
    assert bpy.ops.physgen.move_stack_effect(direction="DOWN") == {"CANCELLED"}
    bpy.ops.physgen.move_stack_effect(direction="UP")
    assert [e.effect for e in world.effects] == ["wind", "friction", "magnus"] and world.effect_index == 1
    bpy.ops.physgen.remove_stack_effect()
    assert [e.effect for e in world.effects] == ["wind", "magnus"] and world.effect_index == 1
    bpy.ops.physgen.remove_stack_effect()
    bpy.ops.physgen.remove_stack_effect()
    assert len(world.effects) == 0 and world.effect_index == 0


def test_targets_are_what_moves():
    ball, wall, idle = a_body("ball"), a_body("wall"), a_cube("idle")
    wall.physgen.role = "collider"
    bpy.ops.physgen.add_stack_effect(effect="wind")
    entry = bpy.context.scene.physgen.world.effects[0]
    select(wall, idle)
    assert not bpy.ops.physgen.add_effect_targets.poll()
    select(ball, wall, idle)
    for _ in range(2):
        assert bpy.ops.physgen.add_effect_targets() == {"FINISHED"}
    assert [target.item for target in entry.targets] == [ball]
    assert bpy.ops.physgen.remove_effect_target(index=5) == {"CANCELLED"}
    assert bpy.ops.physgen.remove_effect_target(index=0) == {"FINISHED"} and not entry.targets


def test_static_friction_is_never_left_below_in_any_order():
    for group in (bpy.context.scene.physgen.world, a_body().physgen):
        group.friction = 0.9
        assert group.static_friction == pytest.approx(0.9)
        group.static_friction, group.friction = 0.1, 0.1
        assert (group.friction, group.static_friction) == pytest.approx((0.1, 0.1))
        group.friction, group.static_friction = 0.2, 0.5
        assert (group.friction, group.static_friction) == pytest.approx((0.2, 0.5))


def test_ground_below_and_frames_from_scene():
    scene = bpy.context.scene
    assert not bpy.ops.physgen.ground_below.poll()
    a_body(location=(0, 0, 3))
    assert bpy.ops.physgen.ground_below() == {"FINISHED"}
    assert scene.physgen.world.ground_point[2] == pytest.approx(2.0)
    scene.frame_start, scene.frame_end = 10, 34
    bpy.ops.physgen.frames_from_scene()
    assert (scene.physgen.simulation.frame_start, scene.physgen.simulation.frame_end) == (10, 34)


# -- render -----------------------------------------------------------------------------------------------------------


def a_photo_scene(world, bake, tmp_path):
    state = bpy.context.scene.physgen
    state.folder, state.simulation.bake = str(world.folder.root), str(bake)
    state.rendering.output, state.rendering.samples = str(tmp_path / "out é"), 1
    state.rendering.scale, state.simulation.frame_start = 0.5, 11
    return state


def test_a_still_and_a_video_are_rendered_in_a_process_of_their_own(world, bake, tmp_path):
    state = a_photo_scene(world, bake([(0, 0, 0), (-0.02, 0, 0)]), tmp_path)
    scene = bpy.context.scene
    scene.frame_set(12)
    assert bpy.ops.physgen.render_still() == {"FINISHED"}
    assert Path(state.rendering.result) == tmp_path / "out é" / "0002.png"
    assert bpy.data.images["0002.png"].size[0] == 80
    with pytest.raises(RuntimeError, match="go to one from 11 to 12"):
        scene.frame_set(13)
        bpy.ops.physgen.render_still()
    assert bpy.ops.physgen.render_video() == {"FINISHED"}
    assert Path(state.rendering.result).stat().st_size > 1000


def flags_of(scene, monkeypatch):
    """What Render Still hands to the script, which is not started."""
    given = []

    def stage(command, *_, **__):
        given.extend(command)
        return {"event": "done"}

    monkeypatch.setattr(render_ops, "run_stage", stage)
    with pytest.raises(RuntimeError, match="is not there"):
        bpy.ops.physgen.render_still()
    parser = build_parser()
    add_script_options(parser)
    return parser.parse_args(given[given.index(scene.physgen.folder) :])


def test_every_choice_of_the_panel_reaches_the_command(world, bake, tmp_path, monkeypatch):
    state = a_photo_scene(world, bake([(0, 0, 0)]), tmp_path)
    scene, rendering = bpy.context.scene, state.rendering
    scene.frame_set(11)
    rendering.samples, rendering.scale = 0, 1.0
    # Untouched, the panel renders what the command line renders.
    assert render_options(flags_of(scene, monkeypatch)) == RenderOptions()
    rendering.engine, rendering.device, rendering.samples, rendering.scale = "cycles", "cuda", 5, 0.3
    rendering.motion_blur, rendering.grain, rendering.match_sharpness, rendering.reflections = 0.2, False, False, False
    rendering.f_number, rendering.focus_distance, rendering.format = 2.8, 0.4, "png16"
    chosen = RenderOptions(
        device="cuda", samples=5, scale=0.3, motion_blur=0.2, grain=False, match_sharpness=False, reflections=False,
        f_number=2.8, focus_distance=0.4, bits=16,
    )  # fmt: skip
    assert render_options(flags_of(scene, monkeypatch)) == chosen
    rendering.engine, rendering.motion_blur, rendering.f_number, rendering.format = "eevee", 0.0, 0.1, "exr_layers"
    changed = {"engine": "eevee", "device": "cpu", "motion_blur": 0.0, "f_number": 0.5, "bits": None}
    chosen = dataclasses.replace(chosen, **changed, format="exr-layers")
    assert render_options(flags_of(scene, monkeypatch)) == chosen


@pytest.mark.long
def test_layers_of_a_still_are_shown_and_another_format_wants_another_folder(world, bake, tmp_path):
    state = a_photo_scene(world, bake([(0, 0, 0), (-0.02, 0, 0)]), tmp_path)
    state.rendering.format, state.rendering.video = "exr_layers", "webm"
    bpy.context.scene.frame_set(11)
    assert bpy.ops.physgen.render_still() == {"FINISHED"}
    assert Path(state.rendering.result) == tmp_path / "out é" / "0001.exr"
    shown = bpy.data.images["0001.exr"]
    # Asking for its size reads it; of layers there is none.
    assert (tuple(shown.size), shown.type) == ((0, 0), "MULTILAYER")
    assert bpy.ops.physgen.render_video() == {"FINISHED"}
    assert Path(state.rendering.result).name == "video.webm" and Path(state.rendering.result).suffix in RESULTS
    state.rendering.format = "png"
    with pytest.raises(RuntimeError, match=r"holds frames as 000\d.exr; choose another folder"):
        bpy.ops.physgen.render_still()


def test_rendering_reports_why_it_is_impossible(world, bake, tmp_path, monkeypatch):
    assert not bpy.ops.physgen.render_still.poll()
    folder = bake([(0, 0, 0)])
    state = a_photo_scene(world, folder, tmp_path)
    state.simulation.bake = ""
    assert not bpy.ops.physgen.render_video.poll()
    state.simulation.bake = str(tmp_path)
    with pytest.raises(RuntimeError, match="holds no bake"):
        bpy.ops.physgen.render_video()
    state.simulation.bake = str(folder)
    state.rendering.output = str(tmp_path / "out")
    # With the light zip the Python that simulates renders.
    monkeypatch.setitem(interpreter.RENDERING, "no_such_module", "Something")
    monkeypatch.setenv(interpreter.VARIABLE, str(tmp_path / "nothing"))
    with pytest.raises(RuntimeError, match="nothing, named in PHYSGEN_PYTHON, is no Python"):
        bpy.ops.physgen.render_video()


def test_the_command_is_of_this_blender():
    command = render_ops.render_command()
    assert command[1:] == [str(render_ops.SCRIPT)] and Path(command[0]).is_file()
    assert render_ops.SCRIPT.is_file()


def test_frames_of_a_file_that_is_not_saved_go_where_its_bakes_wait(tmp_path):
    rendering = bpy.context.scene.physgen.rendering
    assert rendering.output.startswith("//") and not bpy.data.filepath
    waiting = render_ops._output_folder(bpy.context.scene)
    assert waiting.is_relative_to(paths.unsaved_root()) and paths.unsaved_root().is_dir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert render_ops._output_folder(bpy.context.scene) == tmp_path / "physgen_render"


def test_a_switch_stands_for_a_number_that_is_not_zero():
    rendering = bpy.context.scene.physgen.rendering
    assert not rendering.blurs_depth and rendering.f_number == 0
    rendering.blurs_depth = True
    assert rendering.f_number == pytest.approx(2.8)
    rendering.f_number = 4.0
    rendering.blurs_depth = True
    assert rendering.f_number == 4.0, "switching on what is on has changed the number"
    rendering.blurs_depth = False
    assert rendering.f_number == 0
    body = a_body().physgen
    assert body.surface == "GROUND"
    body.surface = "OWN"
    assert body.own_surface


def test_popups_are_broken_into_lines_where_there_is_a_window(monkeypatch):
    message = "a word and another " * 20 + "\n" + "x" * 200
    assert text.popup(message) == message
    monkeypatch.setattr(text, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    lines = text.popup(message).splitlines()
    assert max(map(len, lines)) <= text.POPUP and "".join(lines).replace(" ", "") == "".join(message.split())


def test_a_photo_that_blender_made_an_empty_of_is_a_start(tmp_path):
    image = bpy.data.images.new("dropped", 32, 24)
    image.filepath_raw, image.file_format = str(tmp_path / "dropped.png"), "PNG"
    image.save()
    assert not bpy.ops.physgen.use_image.poll()
    empty = bpy.data.objects.new("Empty", None)
    empty.empty_display_type, empty.data = "IMAGE", bpy.data.images.load(str(tmp_path / "dropped.png"))
    bpy.context.scene.collection.objects.link(empty)
    select(empty)
    assert bpy.ops.physgen.use_image() == {"FINISHED"}
    assert bpy.context.scene.physgen_photo.path == str(tmp_path / "dropped.png") and empty.hide_get()


def a_picture(path, values):
    image = bpy.data.images.new(path.stem, values.shape[1], values.shape[0])
    image.pixels.foreach_set(np.ascontiguousarray(values, dtype=np.float32).ravel())
    image.filepath_raw, image.file_format = str(path), "PNG"
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save()
    bpy.data.images.remove(image)


def test_the_picture_of_the_cut_outs_darkens_what_stays_in_the_background(tmp_path):
    photo, mask = np.full((24, 32, 4), 0.8), np.zeros((24, 32, 4))
    photo[..., 3] = mask[..., 3] = mask[8:16, 10:20] = 1.0
    with pytest.raises(InputError, match="no photo with masks"):
        cutouts_picture(tmp_path)
    a_picture(tmp_path / "photo.png", photo)
    a_picture(tmp_path / "masks" / "book.png", mask)
    image = cutouts_picture(tmp_path)
    shown = np.array(image.pixels[:]).reshape(24, 32, 4)[..., :3]
    assert shown[12, 15] == pytest.approx(0.8, abs=0.01) and shown[2, 2] == pytest.approx(0.16, abs=0.01)
    assert shown[8, 15] == pytest.approx((1.0, 0.55, 0.1), abs=0.01)
    a_picture(tmp_path / "masks" / "cup.png", mask[:12])
    with pytest.raises(InputError, match=r"cup\.png: is of another size"):
        cutouts_picture(tmp_path)


def test_what_cannot_be_baked_is_marked_in_the_list_until_it_is_mended():
    cube = a_body("Cube")
    plane = a_cube("Plane")
    plane.data.transform(((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 0), (0, 0, 0, 1)))
    select(plane)
    bpy.ops.physgen.add_bodies()
    assert bake_state.observe(bpy.context.scene).unfit == {"Plane"}
    plane.physgen.role = "collider"
    assert bake_state.observe(bpy.context.scene).unfit == set()
    plane.physgen.role = "dynamic"
    plane.data = cube.data
    assert bake_state.observe(bpy.context.scene).unfit == set()
