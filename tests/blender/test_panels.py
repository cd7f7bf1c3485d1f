# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands behind the panels: registering, the list that follows the viewport, motion, words and pictures."""

import inspect
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from mathutils import Vector
from physgen import physgen_addon
from physgen.physgen_addon import bake_state, context, text
from physgen.physgen_addon.operators.photo_object_ops import cutouts_picture
from physgen.physgen_addon.panels.sidebar import is_in
from physgen.physgen_addon.props.body_props import bodies
from physgen.sim.errors import InputError

from .panel_scenes import a_body, a_cube, select

pytestmark = pytest.mark.usefixtures("own_presets", "addon")


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


def test_tooltips_are_one_paragraph_without_a_full_stop():
    """Blender adds the full stop, below a break where a docstring ends with one."""
    told = [item for item in dir(bpy.ops.physgen) if not item.startswith("_")]
    assert len(told) > 40
    for name in told:
        words = getattr(bpy.ops.physgen, name).get_rna_type().description
        assert words and "\n" not in words and not words.endswith((".", " ")), name


@pytest.mark.parametrize(
    ("fit", "picture", "narrow", "wide"),
    [
        ("HORIZONTAL", (600, 450), 28.908371, 29.099030),
        ("HORIZONTAL", (450, 800), 26.349110, -2.136254),
        ("AUTO", (600, 450), 6.220251, 29.099030),
        ("AUTO", (450, 800), 29.062307, 20.645809),
    ],
)
def test_a_whole_photo_has_the_zoom_that_blender_gives_it(fit, picture, narrow, wide):
    """As Frame Camera Bounds of Blender 5.2.2 left it in viewports of these sizes."""
    assert context.zoom_of_whole(522, 878, picture, fit=fit) == pytest.approx(narrow, abs=1e-4)
    assert context.zoom_of_whole(1048, 878, picture, fit=fit) == pytest.approx(wide, abs=1e-4)


def test_photos_are_chosen_by_thumbnail():
    """Blender's file browser takes the number, whatever it is called."""
    (shown,) = bpy.ops.physgen.open_photo.get_rna_type().properties["display_type"].enum_items
    params = bpy.types.FileSelectParams.bl_rna.properties["display_type"].enum_items
    assert shown.value == params["THUMBNAIL"].value


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
    body.pushes.add()
    assert bpy.ops.physgen.clear_motion() == {"FINISHED"}
    assert body.speed == 0 and tuple(body.spin) == (0, 0, 0) and body.start_frame == 0 and not body.pushes


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


# -- words and pictures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (
            "none was given, so book hops 9 cm high; 2.5 times slower than real, 4.2 s. Change it with --velocity, "
            "--slow; --still leaves everything at rest",
            "none was given, so book hops 9 cm high; 2.5 times slower than real, 4.2 s",
        ),
        (
            "photo.jpg: no object stands out in it; draw a box around each one (--box x0,y0,x1,y1)",
            "photo.jpg: no object stands out in it; draw a box around each one",
        ),
        ("cut-outs: by isnet; --segmenter none cuts out by colour", "cut-outs: by isnet"),
        ("--pick 3: give numbers from 1 to 2", "--pick 3: give numbers from 1 to 2"),
        ("/home/a--b/photo.jpg: is no photo (of 3 bytes)", "/home/a--b/photo.jpg: is no photo (of 3 bytes)"),
    ],
)
def test_options_of_the_command_line_are_not_said_in_blender(said, shown):
    assert text.without_options(said) == shown


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
    unfit = bake_state.observe(bpy.context.scene).unfit
    assert set(unfit) == {"Plane"} and "is flat" in unfit["Plane"]
    plane.physgen.role = "collider"
    assert bake_state.observe(bpy.context.scene).unfit == {}
    plane.physgen.role = "dynamic"
    plane.data = cube.data
    assert bake_state.observe(bpy.context.scene).unfit == {}
