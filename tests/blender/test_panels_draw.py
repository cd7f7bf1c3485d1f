# SPDX-License-Identifier: GPL-3.0-or-later
"""Every panel, list, menu and popup draws in every state, and names nothing that Blender does not have."""

import math
import threading
from pathlib import Path
from types import SimpleNamespace

import bpy
import physgen
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen import physgen_addon
from physgen.physgen_addon import background_jobs, bake_state, compat, handlers, text
from physgen.physgen_addon.context import TAB
from physgen.physgen_addon.operators.photo_object_ops import PHYSGEN_OT_find_objects, add_found, found_words
from physgen.physgen_addon.operators.photo_ops import add_box
from physgen.physgen_addon.panels import sidebar, simulate_panel
from physgen.physgen_addon.props.scene_props import EFFECT_ITEMS
from physgen.sim.reconstruct.reconstruct_options import Proposal

from . import checked_layout

COFFEE = Path(physgen.__file__).parent / "presets" / "demo" / "coffee.jpg"


pytestmark = pytest.mark.usefixtures("addon")


def kinds(base):
    """Registered classes of the add-on that derive from ``base``."""
    modules = physgen_addon._modules()
    return [kind for module in modules for kind in physgen_addon.registered_classes(module) if issubclass(kind, base)]


def draw_all(part=""):
    """Names and words of all panels and menus now, or of those with ``part`` in their name, by class."""
    shown = {}
    for kind in kinds(bpy.types.Panel) + kinds(bpy.types.Menu):
        layout = checked_layout.draw(kind) if part in kind.__name__ else None
        if layout is not None:
            shown[kind.__name__] = layout
    return shown


def settings_of(owner):
    """Return the paths of the switches and choices in ``owner`` and in the groups within it, from its data-block.

    Not the settings themselves: a choice may replace the group that another one lies in.
    """
    found = []
    for item in owner.bl_rna.properties:
        ours = item.type in ("POINTER", "COLLECTION") and item.fixed_type.identifier.startswith("PHYSGEN_PG_")
        if ours:
            value = getattr(owner, item.identifier)
            for part in [value] if item.type == "POINTER" else value:
                found += settings_of(part)
        elif item.type in ("BOOLEAN", "ENUM") and not item.is_readonly and not getattr(item, "is_array", False):
            found.append((owner.path_from_id(), item.identifier))
    return found


def choices(owner, name):
    item = owner.bl_rna.properties[name]
    if item.type == "BOOLEAN":
        return [not getattr(owner, name)]
    every = [choice.identifier for choice in item.enum_items if choice.identifier]
    return [{choice} for choice in every] if item.is_enum_flag else every


def draw_every_choice(*owners):
    """Draw all panels with every switch and every choice of ``owners`` in turn, once a kind of group; return which."""
    varied, kinds_seen = set(), set()
    for block, path, name in [(owner.id_data, *setting) for owner in owners for setting in settings_of(owner)]:
        try:
            group = block.path_resolve(path)
        except ValueError:
            continue
        if (group.bl_rna.identifier, name) in kinds_seen:
            continue
        kinds_seen.add((group.bl_rna.identifier, name))
        before = getattr(group, name)
        for value in choices(group, name):
            setattr(block.path_resolve(path), name, value)
            draw_all()
        setattr(block.path_resolve(path), name, before)
        varied.add(name)
    return varied


def a_body():
    bpy.ops.mesh.primitive_cube_add(size=1)
    bpy.ops.physgen.add_bodies()
    return bpy.context.active_object


def test_every_choice_of_the_panels_is_drawn():
    item, scene = a_body(), bpy.context.scene
    for name in EFFECT_ITEMS:
        bpy.ops.physgen.add_stack_effect(effect=name[0])
    bpy.ops.mesh.primitive_cube_add(size=4)
    bpy.ops.physgen.add_colliders()
    bpy.context.view_layer.objects.active = item
    varied = draw_every_choice(scene.physgen, item.physgen)
    assert {"role", "quality", "device", "use_ground", "engine"} <= varied
    # Of the ground, of a collider: the active object is another one.
    bpy.context.view_layer.objects.active = bpy.data.objects["Cube.001"]
    assert draw_every_choice(bpy.context.active_object.physgen)


@pytest.mark.parametrize("ready", [True, False])
@pytest.mark.parametrize("trouble", ["", "the worker has ended. In a terminal: python -m pip install taichi"])
@pytest.mark.parametrize("status", ["none", "paused", "baked", "stale", "missing"])
def test_every_state_of_a_bake_is_drawn(status, trouble, ready):
    scene = bpy.context.scene
    scene.frame_end = 250
    found = bake_state.BakeState(
        status=status,
        frames_done=12,
        frames=48,
        disk_bytes=3_000_000,
        trouble=trouble,
        advice=bake_state.MESSAGES.get(status, ""),
        estimate_text="About 20 s and 0.4 GB",
    )
    layout = checked_layout.CheckedLayout()
    simulate_panel._draw_bake(layout, checked_layout.Context(), found, ready=ready)
    free = status in ("paused", "baked", "stale", "missing") and ready
    assert not free or "physgen.free_bake" in layout.names
    shown = " ".join(layout.words)
    assert (status == "none" and not ready) or not trouble or "the worker has ended" in shown
    assert "pip install" not in shown


def test_a_job_that_runs_locks_what_it_reads_and_can_be_cancelled():
    a_body()
    go_on = threading.Event()
    job = background_jobs.Job("Bake", lambda on_event, cancelled: go_on.wait(60) and {"event": "done"})
    job.message = "frame 3 of 12, and a line that no sidebar has room for: it goes on below itself, in full, to its end"
    background_jobs._running.append(job)
    job.start()
    try:
        shown = draw_all()
        assert any("Bake is running" in " ".join(layout.words) for layout in shown.values())
        words = shown["PHYSGEN_PT_scene"].words
        assert job.message not in words and job.message in " ".join(words)
    finally:
        go_on.set()
        job.wait()
        background_jobs._running.clear()


def test_bake_is_in_the_first_panel_until_it_is_done():
    """In Blender's own layout the panel Simulate begins below a laptop's window."""
    assert "physgen.bake" not in draw_all("PT_scene")["PHYSGEN_PT_scene"].names
    item = a_body()
    assert "physgen.bake" in draw_all("PT_scene")["PHYSGEN_PT_scene"].names
    item.physgen.role = "collider"
    assert "physgen.bake" not in draw_all("PT_scene")["PHYSGEN_PT_scene"].names
    layout = checked_layout.CheckedLayout()
    sidebar.draw_bake_button(layout, "stale")
    assert layout.words == ["Bake Again"]


def scene_panel(monkeypatch, status, advice=""):
    """What the first panel draws where the bake of the scene is in that state, in words and names."""
    found = bake_state.BakeState(status=status, frames_done=48, frames=48, advice=advice)
    monkeypatch.setattr(bake_state, "state", lambda scene: found)
    return draw_all("PT_scene")["PHYSGEN_PT_scene"]


def test_the_first_panel_says_what_comes_after_a_bake(monkeypatch, tmp_path):
    a_body()
    shown = scene_panel(monkeypatch, "baked")
    assert "screen.animation_play" in shown.names and "physgen.render_video" not in shown.names
    bpy.context.scene.physgen.folder = str(tmp_path)
    # A whole clip takes long; one frame shows whether it is worth it.
    assert {"physgen.render_video", "physgen.render_still"} <= set(scene_panel(monkeypatch, "baked").names)
    shown = scene_panel(monkeypatch, "stale", bake_state.MESSAGES["stale"])
    assert "Bake Again" in shown.words and "Out of date" in " ".join(shown.words)
    assert "screen.animation_play" not in shown.names


def test_the_first_panel_says_what_to_do_before_a_bake():
    """A motion that begins later, or not at all, is said too: played, both look as if nothing worked."""
    item = a_body()
    scene = bpy.context.scene
    assert bake_state.UNBAKED in " ".join(draw_all("PT_scene")["PHYSGEN_PT_scene"].words)
    assert bake_state.UNBAKED in handlers.why_still(scene) and TAB in handlers.why_still(scene)
    item.physgen.velocity, item.physgen.start_frame = (0.0, 0.0, 1.0), 23
    assert f"{item.name} at frame 23" in bake_state.unbaked(scene)
    item.physgen.velocity, item.physgen.asleep = (0.0, 0.0, 0.0), True
    assert "Everything is at rest" in bake_state.unbaked(scene)
    bpy.ops.physgen.add_stack_effect(effect="wind")
    assert bake_state.UNBAKED in bake_state.unbaked(scene)


def test_pushes_are_added_after_each_other_and_the_panel_shows_them():
    scene, body = bpy.context.scene, a_body().physgen
    scene.frame_set(1)
    body.velocity, body.start_frame = (0, 0, 2), 10
    assert "physgen.add_push" in draw_all("PT_pushes")["PHYSGEN_PT_pushes"].names
    for frame in (1, 1, 90):
        scene.frame_set(frame)
        assert bpy.ops.physgen.add_push() == {"FINISHED"}
    assert [(push.frame, *push.velocity) for push in body.pushes] == [(34, 0, 0, 2), (58, 0, 0, 2), (90, 0, 0, 2)]
    shown = draw_all("PT_pushes")["PHYSGEN_PT_pushes"]
    assert {"frame", "velocity", "physgen.remove_push"} <= set(shown.names)
    assert "at 34, 58, 90" in shown.words
    assert f"{bpy.context.object.name} at frames 10, 34, 58 and 90" in bake_state.unbaked(scene)
    body.push_index = 1
    assert bpy.ops.physgen.remove_push() == {"FINISHED"} and [push.frame for push in body.pushes] == [34, 90]
    # What is asleep and only pushed later does move.
    body.velocity, body.start_frame, body.asleep = (0, 0, 0), 0, True
    assert f"{bpy.context.object.name} at frames 34 and 90" in bake_state.unbaked(scene)
    body.pushes.clear()
    assert "at rest" in bake_state.unbaked(scene) and bpy.ops.physgen.remove_push() == {"CANCELLED"}
    assert bpy.ops.physgen.add_push() == {"FINISHED"} and tuple(body.pushes[0].velocity) == (0, 0, 1)


def test_nothing_is_said_of_objects_that_move_or_take_no_part(monkeypatch):
    scene = bpy.context.scene
    assert handlers.why_still(scene) == ""
    a_body()
    assert handlers.why_still(scene)
    scene_panel(monkeypatch, "baked")
    assert handlers.why_still(scene) == ""


def test_what_was_rendered_is_opened_where_render_video_was_pressed(monkeypatch, tmp_path):
    """The panel Render is closed until somebody opens it."""
    a_body()
    scene = bpy.context.scene
    scene.physgen.folder, video = str(tmp_path), tmp_path / "video.mp4"
    assert "wm.path_open" not in scene_panel(monkeypatch, "baked").names[:4]
    video.touch()
    scene.physgen.rendering.result = str(video)
    shown = scene_panel(monkeypatch, "baked")
    assert "video.mp4" in shown.words and "wm.path_open" in shown.names[:4]


@pytest.mark.parametrize(
    ("stage", "done", "words"),
    [("bake", 40, "Frame 40 of 108; Space plays them"), ("render", 0, "Frame 0 of 108"), ("fits", 3, "")],
)
def test_a_job_of_frames_says_which_it_is_at(stage, done, words):
    """Also so that the panels below it stay where they are once there is no message."""
    job = background_jobs.Job("Job", lambda on_event, cancelled: {})
    job._take({"event": "progress", "stage": stage, "done": done, "total": 108})
    layout = checked_layout.CheckedLayout()
    sidebar.draw_progress(layout, checked_layout.Context(), job)
    assert " ".join(layout.words[1:]) == words


def test_progress_says_what_is_done_in_the_words_of_the_command_line():
    def told(title, stage):
        job = background_jobs.Job(title, lambda on_event, cancelled: {})
        job._take({"event": "progress", "stage": stage, "done": 2, "total": 4})
        return background_jobs.progress_text(job).partition(",")[0]

    assert told("Finding objects", "propose") == "Finding objects 50 %"
    assert told("Reconstruction", "reconstruct") == "Reconstruction 50 %"
    assert told("Bake", "bake") == "Bake 50 %" and told("Render", "encode") == "Render: writing the video 50 %"
    assert told("Explanation", "track") == "Explanation: tracking 50 %"


def test_a_photo_that_blenders_eevee_shows_without_shadows_is_said_to_have_none(tmp_path):
    a_body()
    scene = bpy.context.scene
    said = {}
    for engine in (compat.eevee(), "CYCLES"):
        scene.render.engine = engine
        for folder in ("", str(tmp_path)):
            scene.physgen.folder = folder
            said[engine, folder] = "no shadows on the ground" in " ".join(draw_all()["PHYSGEN_PT_render"].words)
    assert [key for key, is_said in said.items() if is_said] == [(compat.eevee(), str(tmp_path))]


def test_a_bake_is_paused_and_other_jobs_are_cancelled():
    """Both would do the same to a bake."""
    a_body()
    go_on = threading.Event()
    for operator, button in ((bake_state.BAKE_OPERATOR, "pause_bake"), ("physgen.compose_objects", "cancel_job")):
        job = background_jobs.Job(
            "Bake",
            lambda on_event, cancelled: go_on.wait(60) and {"event": "done"},
            operator=operator,
            scene=bpy.context.scene.session_uid,
        )
        background_jobs._running.append(job)
        job.start()
        try:
            stops = {name for name in draw_all("PT_scene")["PHYSGEN_PT_scene"].names if name in STOPS}
        finally:
            go_on.set()
            job.wait()
            background_jobs._running.clear()
        assert stops == {f"physgen.{button}"}


STOPS = ("physgen.pause_bake", "physgen.cancel_job")


def test_what_counts_instead_of_a_number_that_is_off_is_said():
    rendering = bpy.context.scene.physgen.rendering
    for own, words in ((False, ["Automatic"]), (True, [])):
        rendering.own_samples = own
        layout = checked_layout.CheckedLayout()
        sidebar.optional(layout, rendering, "own_samples", "samples", "Samples", otherwise="Automatic")
        assert layout.words == words and ("samples" in layout.names) == own


NUMBERS = st.floats(-1, 1e6, width=32) | st.sampled_from([-1.0, 0.0, math.nan, math.inf])
"""A ``.blend`` may hold any number, whatever the report was."""


@given(st.lists(NUMBERS, min_size=8, max_size=8), st.booleans(), st.sampled_from(["none", "unknown", "air_drag"]))
def test_every_diagnosis_is_drawn(numbers, resolvable, verdict):
    state = bpy.context.scene.physgen_diagnose
    state.root = bpy.data.collections.get("root") or bpy.data.collections.new("root")
    state.before_root, state.has_report, state.resolvable, state.verdict = state.root, True, resolvable, verdict
    state.summary, state.alternatives, state.next_experiment = "Air drag is missing.", "wind, magnus", "a longer throw"
    for name, value in zip(
        ("before_m", "refitted_m", "after_m", "floor_m", "closed", "numerics_m"), numbers, strict=False
    ):
        setattr(state, name, value)
    state.effects.clear()
    state.warnings.clear()
    state.warnings.add().text = "One trial is short."
    for name in ("air_drag", "none"):
        effect = state.effects.add()
        effect.name, effect.probability, effect.closed, effect.has_closed = name, 0.5, numbers[6], resolvable
        parameter = effect.parameters.add()
        parameter.name, parameter.unit, parameter.value, parameter.low = "coefficient", "1/m", numbers[7], numbers[0]
    shown = draw_all("diagnose")
    assert {"PHYSGEN_PT_diagnose_causes", "PHYSGEN_PT_diagnose_add"} <= shown.keys()
    for kind in ("ball", "cylinder", "box", "mesh"):
        state.video.kind = kind
        draw_all("diagnose_video")


def test_a_long_name_takes_the_place_of_its_material_in_a_narrow_list():
    bpy.ops.mesh.primitive_cube_add()
    item = bpy.context.object
    item.physgen.enabled = True
    item.physgen.material.preset = "wood"
    item.name = "Cube"
    assert "Wood" in draw_all("objects")["PHYSGEN_PT_objects"].words
    item.name = "Collection Cube simulated"
    assert "Wood" not in draw_all("objects")["PHYSGEN_PT_objects"].words


def test_as_much_fits_beside_each_other_at_every_scale_of_the_interface():
    """Blender's ``system.ui_scale`` has the user's scale in it: twice that, and half of the sidebar stays empty."""
    usual = checked_layout.Context()
    preferences = SimpleNamespace(system=SimpleNamespace(ui_scale=1.5), view=SimpleNamespace(ui_scale=1.5))
    large = checked_layout.Context(preferences=preferences, region=SimpleNamespace(width=1.5 * usual.region.width))
    assert text.room(large, 70) == text.room(usual, 70)


def test_numbers_of_a_video_that_it_knows_itself_are_switches():
    """Not "0: as the file says"."""
    video = bpy.context.scene.physgen_diagnose.video
    for switched, number in (("own_fps", "fps"), ("own_end", "end")):
        assert not getattr(video, switched) and getattr(video, number) == 0
        setattr(video, switched, True)
        assert getattr(video, number) > 0
        setattr(video, switched, False)
        assert getattr(video, number) == 0
        assert "0" not in video.bl_rna.properties[number].description


@pytest.mark.parametrize(("error", "is_said"), [(7.6e-17, False), (2e-6, True)])
def test_the_simulators_own_error_is_said_where_it_counts(error, is_said):
    """Not "7.6e-11 µm of it"."""
    state = bpy.context.scene.physgen_diagnose
    state.root, state.has_report = bpy.data.collections.new("root"), True
    state.before_m = state.refitted_m = state.after_m = state.floor_m = 45e-6
    state.numerics_m = error
    words = " ".join(draw_all("diagnose_causes")["PHYSGEN_PT_diagnose_causes"].words)
    assert ("simulator" in words) == is_said


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.3496, 0.3503, "0.3496 and 0.3503"),
        (0.338, 0.364, "0.338 and 0.364"),
        (-1.0, 1e6, "-1 and 1e+06"),
        (2.0, 2.0, "2 and 2"),
        (0.0, 0.0, "0 and 0"),
    ],
)
def test_both_ends_of_a_narrow_interval_are_told_apart(low, high, words):
    """Not "0.35 and 0.35"."""
    assert text.interval(low, high) == words


@pytest.mark.parametrize(("verdict", "is_said"), [("air_drag", False), ("none", True)])
def test_alternatives_are_said_once(verdict, is_said):
    state = bpy.context.scene.physgen_diagnose
    state.root, state.has_report, state.verdict = bpy.data.collections.new("root"), True, verdict
    state.summary, state.alternatives = "The cause is air drag; the data cannot rule out wind.", "wind"
    words = " ".join(draw_all("diagnose")["PHYSGEN_PT_diagnose"].words)
    assert ("Too small for this recording to rule out: wind." in words) == is_said


def test_a_photo_is_drawn_with_its_boxes():
    bpy.ops.physgen.open_photo(filepath=str(COFFEE))
    photo = bpy.context.scene.physgen_photo
    empty = draw_all("PT_scene")["PHYSGEN_PT_scene"].names
    assert "physgen.draw_box" in empty and "PHYSGEN_UL_boxes" not in empty
    for name in ("ball", "cup"):
        photo.boxes.add().name = name
    names = draw_all("PT_scene")["PHYSGEN_PT_scene"].names
    # What comes next is above what few need.
    assert names.index("PHYSGEN_UL_boxes") < names.index("physgen.reconstruct") < names.index("output")
    assert len(draw_every_choice(photo)) > 5


def test_a_box_that_has_no_name_yet_is_to_get_one():
    bpy.ops.physgen.open_photo(filepath=str(COFFEE))
    scene = bpy.context.scene
    box = add_box(scene, (10, 10, 200, 200))
    assert "write what it is" in " ".join(draw_all("PT_scene")["PHYSGEN_PT_scene"].words)
    box.name = "cup"
    assert "write what it is" not in " ".join(draw_all("PT_scene")["PHYSGEN_PT_scene"].words)
    box.name, box.kind = "object 1", "cup"
    assert "write what it is" not in " ".join(draw_all("PT_scene")["PHYSGEN_PT_scene"].words)


def test_both_buttons_that_find_objects_say_what_they_do():
    every, best = (
        PHYSGEN_OT_find_objects.description(bpy.context, SimpleNamespace(every=every)) for every in (True, False)
    )
    assert "every object" in every and best == ""


def test_found_objects_are_reported_by_what_to_do_next():
    bpy.ops.physgen.open_photo(filepath=str(COFFEE))
    scene = bpy.context.scene
    found = [Proposal((10, 10, 200, 200), 0.9), Proposal((300, 200, 500, 390), 0.4)]
    assert found_words(scene, [], 0).startswith("Nothing stands out")
    add_box(scene, (10, 10, 200, 200))
    assert found_words(scene, found, 1) == "1 box added; All adds 1 more. Name them, then Reconstruct"
    assert add_found(scene, found, every=True) == 1
    assert found_words(scene, found, 1) == "1 box added. Name them, then Reconstruct"


def test_every_popup_is_drawn():
    a_body()
    drawn = 0
    for kind in kinds(bpy.types.Operator):
        if "draw" in vars(kind):
            layout = checked_layout.CheckedLayout()
            kind.draw(checked_layout.Drawn(kind, layout), checked_layout.Context())
            drawn += bool(layout.names or layout.words)
    assert drawn > 3
