# SPDX-License-Identifier: GPL-3.0-or-later
"""The Diagnose panel without its pixels: what is in the scene at a frame."""

import numpy as np
import pytest
import trimesh

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon.playback.geometry_nodes import RAMP
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import save_capture

from .diagnose_scenes import (
    FOUND_OFF,
    FRAMES,
    LOOK,
    NOMINAL_OFF,
    RATE,
    TRACKED,
    a_capture,
    a_diagnosis,
    a_throw,
    a_trial,
    load,
    moved,
    pose,
    save_diagnosis,
    shown_body,
    shown_points,
    sorted_rows,
    times,
)

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def throw(tmp_path):
    return a_throw(tmp_path)


def test_registering_twice_leaves_nothing_behind():
    physgen.unregister()
    assert not hasattr(bpy.types.Scene, "physgen_diagnose")
    assert not hasattr(bpy.types, "PHYSGEN_PT_diagnose")
    physgen.register()
    assert bpy.context.scene.physgen_diagnose.capture == ""


def test_points_are_where_they_were_seen(throw):
    capture, folder = throw
    state = load(folder)
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (1, FRAMES)
    # In the middle of the motion, where its trails are seen; the first frame shows none.
    assert scene.frame_current == (1 + FRAMES) // 2 and "8 points" in state.trials[0].label
    assert scene.render.fps / scene.render.fps_base == pytest.approx(RATE)
    assert state.trial == "take é"
    for index in (0, 4, FRAMES - 1):
        scene.frame_set(1 + index)
        seen = capture.trials[0].points[index]
        seen = seen[np.isfinite(seen).all(axis=1)]
        assert len(seen) == (7 if index == 4 else 8)
        np.testing.assert_allclose(shown_points("observed"), sorted_rows(seen), atol=1e-5)


def test_the_body_goes_with_its_points(throw):
    _, folder = throw
    load(folder)
    corners = sorted_rows(moved(times())[4])
    bpy.context.scene.frame_set(5)
    vertices, _ = shown_body("observed")
    nearest = np.linalg.norm(vertices[None] - corners[:, None], axis=2).min(axis=1)
    assert nearest.max() < 1e-5
    np.testing.assert_allclose(vertices.mean(axis=0), corners.mean(axis=0), atol=1e-4)


def test_choosing_a_trial_shows_it_alone_and_sets_its_time_line(throw):
    _, folder = throw
    save_diagnosis(a_diagnosis(throw[0]), folder.with_name("throw_diagnosis"))
    state = load(folder)
    bpy.context.scene.frame_set(FRAMES)
    state.trial = "later"
    # Five frames seen and seven withheld, of which the diagnosis says where the models would be.
    assert bpy.context.scene.frame_end == 12
    bpy.context.scene.frame_set(3)
    np.testing.assert_allclose(shown_points("observed"), sorted_rows(moved(times(5, 0.0))[2]), atol=1e-5)
    bpy.context.scene.frame_set(9)
    assert len(shown_points("observed")) == 0
    assert len(shown_body("observed")[0]) == 0
    expected = moved(times(7, 5 / RATE))[3] + NOMINAL_OFF
    np.testing.assert_allclose(shown_points("nominal"), sorted_rows(expected), atol=1e-5)


def test_a_dropped_frame_stays_a_gap(tmp_path):
    stamps = np.delete(times(), 5)
    save_capture(a_capture(a_trial("take", stamps)), tmp_path / "gap")
    load(tmp_path / "gap")
    assert bpy.context.scene.frame_end == FRAMES
    bpy.context.scene.frame_set(6)
    assert len(shown_points("observed")) == 0
    bpy.context.scene.frame_set(7)
    np.testing.assert_allclose(shown_points("observed"), sorted_rows(moved(times())[6]), atol=1e-5)


def test_one_tracked_point_moves_the_body_without_turning_it(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    path = np.stack([times(), 0 * times(), 1 - times()], axis=1)[:, None]
    belief = ObjectBelief(name="ball", mesh="ball.obj", density_kg_m3=100.0, stiffness="hard")
    body = CaptureObject(belief=belief, vertices=np.asarray(ball.vertices), faces=np.asarray(ball.faces))
    trial = Trial(
        name="drop",
        role="fit",
        times=times(),
        points=path,
        pixels=None,
        object_index=np.zeros(1, dtype=np.int64),
        rest_points=np.zeros((1, 3)),
    )
    capture = Capture(
        gravity=(0, 0, -9.81), ground=Ground(), objects=(body,), noise_sigma=0.001, camera=None, trials=(trial,)
    )
    save_capture(capture, tmp_path / "drop")
    load(tmp_path / "drop")
    bpy.context.scene.frame_set(8)
    vertices, _ = shown_body("observed")
    np.testing.assert_allclose(vertices.max(axis=0) - vertices.min(axis=0), np.ptp(ball.vertices, axis=0), atol=1e-6)
    np.testing.assert_allclose(vertices.mean(axis=0), path[7, 0], atol=1e-4)


def test_a_soft_body_takes_the_shape_of_its_points(tmp_path):
    stretch = 1 + 0.05 * np.arange(FRAMES)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rest = grid * [0.1, 0.06, 0.04]
    points = rest[None] * np.stack([0 * stretch + 1, 0 * stretch + 1, stretch], axis=1)[:, None] + [0, 0, 0.4]
    trial = Trial(
        name="pull",
        role="fit",
        times=times(),
        points=points,
        pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64),
        rest_points=rest,
    )
    save_capture(a_capture(trial, rigid=False), tmp_path / "pull")
    load(tmp_path / "pull")
    for frame in (1, FRAMES):
        bpy.context.scene.frame_set(frame)
        vertices, _ = shown_body("observed")
        height = 0.04 * stretch[frame - 1]
        assert np.ptp(vertices[:, 2]) == pytest.approx(height, rel=0.08)
        np.testing.assert_allclose(np.ptp(vertices[:, :2], axis=0), [0.1, 0.06], rtol=1e-3)


def test_pixels_lie_on_their_rays(tmp_path):
    camera = Camera(width=640, height=480, fx=700.0, fy=710.0, cx=310.0, cy=250.0, world_from_camera=LOOK)
    matrix = np.asarray(LOOK)

    def project(points):
        local = (points - matrix[:3, 3]) @ matrix[:3, :3]
        return local[..., :2] / local[..., 2:] * [700.0, 710.0] + [310.0, 250.0]

    pixels = project(moved(times()))
    save_capture(a_capture(a_trial("take", times(), pixels=pixels), camera=camera), tmp_path / "film")
    load(tmp_path / "film")
    assert bpy.context.scene.camera is not None
    bpy.context.scene.frame_set(4)
    found = shown_points("observed")
    assert len(found) == 8
    np.testing.assert_allclose(np.sort(project(found), axis=0), np.sort(pixels[3], axis=0), atol=0.05)


def test_models_stand_beside_the_recording_and_the_report_in_the_panel(throw):
    capture, folder = throw
    save_diagnosis(a_diagnosis(capture), folder.with_name("throw_diagnosis"))
    state = load(folder)
    state.found.points = True
    bpy.context.scene.frame_set(7)
    truth = moved(times())[6]
    np.testing.assert_allclose(shown_points("nominal"), sorted_rows(truth + NOMINAL_OFF), atol=1e-5)
    np.testing.assert_allclose(shown_points("found"), sorted_rows(truth + FOUND_OFF), atol=1e-5)
    state.nominal.points = False
    assert len(shown_points("nominal")) == 0
    assert [(e.name, round(e.probability, 3)) for e in state.effects] == [("air_drag", 0.7), ("wind", 0.3)]
    assert (state.effects[0].parameters[0].name, state.effects[0].parameters[0].high) == (
        "drag_per_mass",
        pytest.approx(0.05),
    )
    assert state.summary == "Air drag is missing." and state.alternatives == "wind"
    assert state.before_m == pytest.approx(0.05) and state.numerics_m == -1
    assert [w.text for w in state.warnings] == ["few points"]


def test_colours_follow_the_discrepancy_over_time(throw):
    capture, folder = throw
    save_diagnosis(a_diagnosis(capture), folder.with_name("throw_diagnosis"))
    state = load(folder)
    state.most = 4.0
    bpy.context.scene.frame_set(1)
    np.testing.assert_allclose(
        shown_body("observed")[1][:, :3], [RAMP[0][1]] * len(shown_body("observed")[1]), atol=1e-3
    )
    bpy.context.scene.frame_set(FRAMES)
    np.testing.assert_allclose(
        shown_body("observed")[1][:, :3], [RAMP[-1][1]] * len(shown_body("observed")[1]), atol=1e-3
    )
    state.colours = False
    plain = shown_body("observed")[1]
    assert np.ptp(plain, axis=0).max() < 1e-6
    assert not np.allclose(plain[0, :3], RAMP[-1][1], atol=0.05)


def test_colours_are_where_the_discrepancy_is(throw):
    capture, folder = throw
    right = TRACKED[:, 0] > 0
    only = a_capture(capture.trials[0])
    scores = np.tile(np.where(right, 4.0, 0.0), (FRAMES, 1))
    save_capture(only, folder.with_name("one"))
    save_diagnosis(a_diagnosis(only, scores=scores), folder.with_name("one_diagnosis"))
    load(folder.with_name("one")).most = 4.0
    bpy.context.scene.frame_set(5)
    vertices, colours = shown_body("observed")
    turns, places = pose(times())
    local = (vertices - places[4]) @ turns[4]
    # The ramp's last colour is almost without green, its first is grey.
    assert colours[local[:, 0] > 0.045, 1].max() < 0.15
    assert colours[local[:, 0] < -0.045, 1].min() > 0.35


def test_saved_file_plays_without_the_addon(throw, tmp_path):
    capture, folder = throw
    save_diagnosis(a_diagnosis(capture), folder.with_name("throw_diagnosis"))
    load(folder).most = 4.0
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    physgen.unregister()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
        bpy.context.scene.frame_set(FRAMES)
        np.testing.assert_allclose(shown_points("observed"), sorted_rows(moved(times())[-1]), atol=1e-5)
        colours = shown_body("observed")[1]
        np.testing.assert_allclose(colours[:, :3], [RAMP[-1][1]] * len(colours), atol=1e-3)
    finally:
        physgen.register()
    assert bpy.context.scene.physgen_diagnose.summary == "Air drag is missing."
    assert bpy.context.scene.physgen_diagnose.trial == "take é"


def test_nothing_stands_around_the_recording(throw, capfd):
    """Blender's default cube, in which a recording of something small disappeared."""
    bpy.ops.mesh.primitive_cube_add(size=50)
    around = bpy.context.object
    bpy.ops.mesh.primitive_cube_add(size=1, location=(100, 0, 0))
    beside = bpy.context.object
    state = load(throw[1])
    assert around.hide_viewport and around.hide_render and not beside.hide_viewport
    assert not any(item.hide_viewport for item in state.root.all_objects if item.type == "CAMERA")
    assert f"loaded; {around.name} hidden" in capfd.readouterr().out
    around.hide_viewport = False
    load(throw[1])
    assert not around.hide_viewport, "who shows it again wants it"


def test_loading_again_and_clearing_leave_nothing_behind(throw):
    _, folder = throw
    state = load(folder)
    kinds = ("objects", "meshes", "collections", "actions")
    count = {kind: len(getattr(bpy.data, kind)) for kind in kinds}
    state.observed.trail = False
    load(folder)
    assert {kind: len(getattr(bpy.data, kind)) for kind in kinds} == count
    assert not state.observed.trail
    assert {c.name for c in state.root.children} == {"take é", "later"}
    bpy.ops.physgen.clear_capture()
    assert {kind: len(getattr(bpy.data, kind)) for kind in kinds} == dict.fromkeys(kinds, 0)
    assert state.root is None and not len(state.trials)


def test_bad_input_is_named_and_changes_nothing(throw, tmp_path):
    _, folder = throw
    state = load(folder)
    objects = set(bpy.data.objects.keys())
    for path, message in ((tmp_path / "nowhere", "choose the folder of a capture"), ("", "Capture is empty")):
        state.capture = str(path)
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.physgen.load_capture()
    state.capture = str(folder)
    state.report = str(save_diagnosis(a_diagnosis(a_capture(a_trial("take é", times(4)))), tmp_path / "other"))
    with pytest.raises(RuntimeError, match="of another capture"):
        bpy.ops.physgen.load_diagnosis()
    assert set(bpy.data.objects.keys()) == objects and state.root is not None
