# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands behind the panels of world and rendering: effects, the ground, stills and videos."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.batch.blender_script import add_script_options
from physgen.batch.commands.render_commands import render_options
from physgen.batch.render import build_parser
from physgen.physgen_addon import interpreter, paths
from physgen.physgen_addon.operators import render_ops
from physgen.physgen_addon.panels.render_panel import draws_in_software
from physgen.physgen_addon.panels.sidebar import RESULTS
from physgen.physgen_addon.props.scene_props import EFFECT_ITEMS, effect_values
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.sim.effects.registry import effect

from .panel_scenes import a_body, a_cube, select

pytestmark = pytest.mark.usefixtures("own_presets", "addon")


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
def test_layers_of_a_still_are_shown_and_another_format_gets_another_folder(world, bake, tmp_path):
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
    assert bpy.ops.physgen.render_still() == {"FINISHED"}
    assert Path(state.rendering.result) == tmp_path / "out é_png" / "0001.png"


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


def test_another_format_goes_to_a_folder_of_its_own(tmp_path):
    """A folder keeps one format: the second still of an artist who changes it was refused."""
    rendering = bpy.context.scene.physgen.rendering
    rendering.output = str(tmp_path / "frames")
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "0009.png").write_bytes(b"")
    assert render_ops._output_folder(bpy.context.scene) == tmp_path / "frames"
    rendering.format = "exr_layers"
    assert render_ops._output_folder(bpy.context.scene) == tmp_path / "frames_exr"


@pytest.mark.parametrize(
    ("renderer", "is_software"),
    [
        ("llvmpipe (LLVM 19.1.7, 256 bits)", True),
        ("Microsoft Basic Render Driver", True),
        ("NVIDIA GeForce RTX 4070/PCIe/SSE2", False),
        ("Apple M2", False),
        ("", False),
    ],
)
def test_a_machine_without_a_graphics_card_is_told(renderer, is_software):
    """A frame by EEVEE then takes minutes."""
    assert draws_in_software(renderer) == is_software
