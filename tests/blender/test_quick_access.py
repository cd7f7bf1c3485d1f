# SPDX-License-Identifier: GPL-3.0-or-later
"""Where artists look first: samples, quick effects, menus, the pie menu's key, and the ground below a default cube."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon import context, paths
from physgen.physgen_addon.operators import asset_ops, photo_ops, quick_ops, reconstruct_ops
from physgen.physgen_addon.photo.photo_request import arguments, scene_folder
from physgen.physgen_addon.props.body_props import bodies
from physgen.physgen_addon.scene_io.export_scene import export_scene

from . import checked_layout

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture(autouse=True)
def own_folders(tmp_path, monkeypatch):
    def folder(name, *, create=False):
        (tmp_path / name).mkdir(exist_ok=True)
        return tmp_path / name

    monkeypatch.setattr(paths, "user_folder", folder)


def a_cube(**where):
    bpy.ops.mesh.primitive_cube_add(**where)
    return bpy.context.object


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_the_mesh_sample_can_be_baked_as_it_is(tmp_path, unit):
    scene, cube = bpy.context.scene, a_cube()
    scene.unit_settings.scale_length = unit
    assert bpy.ops.physgen.open_sample(sample="MESHES") == {"FINISHED"}
    assert cube.hide_viewport and scene.camera is not None
    roles = {item.name: (item.physgen.role, item.physgen.material.preset) for item in bodies(scene)}
    assert {name: preset for name, (role, preset) in roles.items() if role == "dynamic"} == {
        "Jelly": "jelly",
        "Sand": "sand",
        "Wood": "wood",
    }
    assert roles["Ramp"][0] == "collider"
    found = export_scene(scene, tmp_path / "scene").model
    sizes = {item.name: item.size_m for item in found.objects}
    # Of a hand's size to a foot's, in any unit; none in the ground.
    assert all(0.1 < size < 0.4 for size in sizes.values()), sizes
    speed = np.linalg.norm(next(item for item in found.objects if item.name == "Wood").velocity)
    assert math.isclose(speed, math.hypot(1.4, 0.6), rel_tol=1e-5)


def test_the_mesh_sample_can_be_opened_twice():
    for _ in range(2):
        assert bpy.ops.physgen.open_sample(sample="MESHES") == {"FINISHED"}
    assert len(bodies(bpy.context.scene)) == 8


def test_the_photo_sample_needs_nothing_but_reconstruct(tmp_path):
    for _ in range(2):
        assert bpy.ops.physgen.open_sample(sample="PHOTO") == {"FINISHED"}
    state = bpy.context.scene.physgen_photo
    assert (state.width, state.height) == (600, 400) and [box.name for box in state.boxes] == ["cup"]
    words = arguments(state)
    assert words[words.index("--box") + 1] == "70,12,488,392" and "--pitch=50" in words
    assert scene_folder(state).parent == tmp_path / "samples"
    assert bpy.ops.physgen.reconstruct.poll()
    assert [box.preset for box in state.boxes] == ["jelly"]
    # A copy that the user has changed is the user's.
    assert (tmp_path / "samples" / "coffee.jpg").read_bytes() == (asset_ops.DEMO / "coffee.jpg").read_bytes()


@pytest.mark.parametrize(
    ("operator", "law"), [("jelly", "neo_hookean"), ("sand", "sand"), ("liquid", "fluid"), ("rigid", "rigid")]
)
def test_a_quick_effect_on_the_default_cube_can_be_baked(tmp_path, operator, law):
    cube = a_cube(size=2)
    assert getattr(bpy.ops.physgen, f"quick_{operator}")() == {"FINISHED"}
    assert bodies(bpy.context.scene) == [cube] and cube.physgen.material.law == law
    model = export_scene(bpy.context.scene, tmp_path / "scene").model
    assert model.ground.point[2] == -2.0, "half the cube's height below it"


def test_a_ground_that_someone_placed_or_stands_on_stays():
    scene = bpy.context.scene
    scene.physgen.world.ground_point = (0.0, 0.0, 0.0)
    a_cube()
    assert bpy.ops.physgen.quick_jelly() == {"FINISHED"}
    assert tuple(scene.physgen.world.ground_point) == (0.0, 0.0, 0.0)
    scene.physgen.world.property_unset("ground_point")
    a_cube(location=(5, 0, 0))
    assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    assert tuple(scene.physgen.world.ground_point) == (0.0, 0.0, 0.0)


def test_menus_and_key_come_and_go():
    def drawn(menu):
        return {function.__name__ for function in getattr(bpy.types, menu)._dyn_ui_initialize()}

    for menu, draw in quick_ops.MENUS:
        assert draw.__name__ in drawn(menu)
    keymap = bpy.context.window_manager.keyconfigs.addon.keymaps["Object Mode"]

    def keys():
        return [item for item in keymap.keymap_items if item.idname == "wm.call_menu_pie"]

    (item,) = keys()
    assert item.properties.name == "PHYSGEN_MT_pie" and item.type == "P" and item.shift
    physgen.unregister()
    assert not keys()
    for menu, draw in quick_ops.MENUS:
        assert draw.__name__ not in drawn(menu)
    physgen.register()


def test_every_operator_that_one_would_type_has_its_name():
    titles = {kind.bl_label for kind, _ in quick_ops.QUICK}
    assert titles == {"Quick Jelly", "Quick Sand", "Quick Liquid", "Quick Rigid"}


def test_blenders_own_quick_liquid_is_told_from_ours():
    layout = checked_layout.CheckedLayout()
    quick_ops._draw_quick_effects(SimpleNamespace(layout=layout), checked_layout.Context())
    assert "Quick Liquid (PhysGen)" in layout.words and "Quick Liquid" not in layout.words


@pytest.mark.parametrize("menu", [quick_ops.PHYSGEN_MT_object, quick_ops.PHYSGEN_MT_pie])
def test_menus_bake_and_remove_only_what_there_is(menu):
    def grey():
        layout = checked_layout.CheckedLayout()
        menu.draw(checked_layout.Drawn(menu, layout), checked_layout.Context())
        return layout.grey

    assert grey() == ["physgen.bake"] and not bpy.ops.physgen.remove_body.poll()
    assert bpy.ops.physgen.open_sample(sample="MESHES") == {"FINISHED"}
    assert grey() == [] and bpy.ops.physgen.remove_body.poll()


def test_a_material_chosen_for_a_box_is_that_of_its_object():
    assert bpy.ops.physgen.open_sample(sample="PHOTO") == {"FINISHED"}
    photo_ops.add_box(bpy.context.scene, (10, 10, 50, 50), "spoon")
    for name in ("cup", "spoon"):
        a_cube().physgen.enabled = True
        bpy.context.object.physgen.source = name
    reconstruct_ops.set_materials(bpy.context.scene, reconstruct_ops.chosen_materials(bpy.context.scene))
    found = {item.physgen.source: item.physgen.material.preset for item in bodies(bpy.context.scene)}
    assert found == {"cup": "jelly", "spoon": "medium"}, "a box of its own choice, and one that is left to what it is"


def test_opening_a_photo_in_the_background_leaves_the_areas_alone():
    """They have no size there: Blender did not come back from closing the one that was split off."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    screen = bpy.context.window.screen
    before = [area.type for area in screen.areas]
    assert bpy.ops.physgen.open_sample(sample="PHOTO") == {"FINISHED"}
    assert [area.type for area in screen.areas] == before and "IMAGE_EDITOR" not in before


def test_the_cameras_frame_leaves_sidebar_and_toolbar_free():
    def framed(**widths):
        view = SimpleNamespace(view_camera_zoom=0.0, view_camera_offset=[0.0, 0.0])
        regions = [SimpleNamespace(type=kind, width=width) for kind, width in widths.items()]
        context._leave_sidebar_free(view, 1000, SimpleNamespace(regions=regions))
        return view.view_camera_zoom, view.view_camera_offset[0]

    zoom, offset = framed(UI=250)
    assert zoom < 0 < offset
    smaller, less = framed(UI=250, TOOLS=50)
    assert smaller < zoom and 0 < less < offset
    # Between two of the same width it stays in the middle; closed ones have a width of 1.
    assert framed(UI=200, TOOLS=200)[1] == 0.0 and framed(UI=1, TOOLS=1) == (0.0, 0.0)
