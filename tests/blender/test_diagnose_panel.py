# SPDX-License-Identifier: GPL-3.0-or-later
"""The Diagnose panel without its pixels: what its operators do, and what is in the scene at a frame."""

import json
import runpy
import stat
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon import background_jobs
from physgen.physgen_addon.playback.geometry_nodes import COLOUR, RAMP
from physgen.sim.app.stage_process import run_stage
from physgen.sim.diagnose.capture import (
    Camera,
    Capture,
    CaptureObject,
    Ground,
    ObjectBelief,
    Trial,
    save_capture,
)
from physgen.sim.diagnose.diagnosis import (
    Diagnosis,
    Estimate,
    Gap,
    Localisation,
    ObjectShare,
    RankedEffect,
    TrialArrays,
    Verdict,
    write_diagnosis,
)
from physgen.sim.errors import Cancelled
from physgen.sim.scene.folder import load_scene

RATE = 50.0
FRAMES = 12
REST = trimesh.creation.box((0.1, 0.06, 0.04))
TRACKED = np.asarray(REST.vertices)
NOMINAL_OFF, FOUND_OFF = np.array([0.05, 0.0, 0.0]), np.array([0.0, 0.001, 0.0])
"""How far the models of the made-up diagnosis are from the truth."""
LOOK = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -2.0), (0.0, -1.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture(autouse=True)
def addon(fresh_blender):
    physgen.register()
    yield
    physgen.unregister()


def pose(times):
    """A throw with spin about z: rotations (T, 3, 3) and places (T, 3)."""
    c, s, o = np.cos(3 * times), np.sin(3 * times), np.zeros_like(times)
    turns = np.stack([np.stack([c, -s, o], 1), np.stack([s, c, o], 1), np.stack([o, o, o + 1], 1)], axis=1)
    return turns, np.stack([times, 0.2 * times, 0.5 + times - 4.9 * times**2], axis=1)


def moved(times, points=TRACKED):
    turns, places = pose(times)
    return np.einsum("tij,kj->tki", turns, points) + places[:, None]


def a_trial(name, times, *, points=None, role="fit", predict=None, pixels=None):
    count = len(TRACKED)
    return Trial(
        name=name,
        role=role,
        times=times,
        points=None if pixels is not None else (moved(times) if points is None else points),
        pixels=pixels,
        object_index=np.zeros(count, dtype=np.int64),
        rest_points=TRACKED,
        predict_times=predict,
    )


def a_capture(*trials, rigid=True, camera=None):
    belief = ObjectBelief(
        name="box",
        mesh="box.obj",
        density_kg_m3=500.0,
        stiffness="hard" if rigid else "soft",
        youngs_modulus_pa=None if rigid else 1e5,
    )
    body = CaptureObject(belief=belief, vertices=np.asarray(REST.vertices), faces=np.asarray(REST.faces))
    return Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(),
        objects=(body,),
        noise_sigma=0.001,
        camera=camera,
        trials=trials,
    )


def times(count=FRAMES, start=0.3):
    return start + np.arange(count) / RATE


@pytest.fixture
def throw(tmp_path):
    """Two takes of the box; the first has a point that is lost now and then, the second is withheld after 5 frames."""
    first = moved(times())
    first[3:6, 2] = np.nan
    second = a_trial("later", times(5, 0.0), role="predict", predict=times(7, 5 / RATE))
    capture = a_capture(a_trial("take é", times(), points=first), second)
    save_capture(capture, tmp_path / "throw")
    return capture, tmp_path / "throw"


def a_diagnosis(capture, effect="air_drag", scores=None):
    trials = {}
    for trial in capture.trials:
        truth = moved(trial.times)
        later = None if trial.predict_times is None else moved(trial.predict_times)
        ramp = np.tile(np.linspace(0, 4, len(trial.times))[:, None], (1, len(TRACKED)))
        trials[trial.name] = TrialArrays(
            times=trial.times,
            frame_score=ramp.mean(axis=1),
            point_score=ramp if scores is None else scores,
            residual=np.zeros((*trial.observed.shape[:2], trial.observed.shape[2])),
            nominal=truth + NOMINAL_OFF,
            found=truth + FOUND_OFF,
            before=None if later is None else later + NOMINAL_OFF,
            after=None if later is None else later + FOUND_OFF,
        )
    drag = {"drag_per_mass": Estimate(value=0.04, unit="1/m", low=0.03, high=0.05)}
    found = () if effect in ("none", "unknown") else (effect,)
    ranking = (
        RankedEffect(name=effect, kind="force", probability=0.7, parameters=drag if found else {}, closed_fraction=0.9),
        RankedEffect(name="wind", kind="force", probability=0.3),
    )
    return Diagnosis(
        verdict=Verdict(effect=effect, probability=0.7, alternatives=("wind",), effects=found),
        effects=ranking,
        gap=Gap(
            before_rms_m=0.05,
            refitted_rms_m=0.02,
            after_rms_m=0.003,
            noise_floor_rms_m=0.002,
            closed_fraction=0.97,
            closed_fraction_ci95=(0.9, 0.99),
            resolvable=True,
        ),
        controls={},
        next_experiment="Throw it the other way.",
        where=Localisation(objects=(ObjectShare(name="box", share=1.0),), intervals=(), direction={}),
        trials=trials,
        summary="Air drag is missing.",
        warnings=("few points",),
    )


def save_diagnosis(diagnosis, folder):
    folder.mkdir(exist_ok=True)
    write_diagnosis(diagnosis, folder)
    return folder


def load(folder):
    state = bpy.context.scene.physgen_diagnose
    state.capture = str(folder)
    assert bpy.ops.physgen.load_capture() == {"FINISHED"}
    return state


def shown_points(layer):
    """Centres (N, 3) of the spheres of ``layer`` at the current frame, sorted."""
    graph = bpy.context.evaluated_depsgraph_get()
    places = [
        tuple(i.matrix_world.translation)
        for i in graph.object_instances
        if i.is_instance and i.parent.original.get("physgen_layer") == layer
    ]
    return sorted_rows(np.array(places).reshape(-1, 3))


def sorted_rows(points):
    """By place, to a tenth of a millimetre, so that two sets of points can be compared."""
    return points[np.lexsort(np.round(points, 4).T)]


def shown_body(layer):
    """Evaluated vertices (V, 3) in world metres and colours (V, 4) of the body of ``layer`` that is in sight."""
    graph = bpy.context.evaluated_depsgraph_get()
    for item in bpy.context.scene.objects:
        if item.get("physgen_role") == "body" and item.get("physgen_layer") == layer and item.visible_get():
            mesh = item.evaluated_get(graph).data
            places, colours = np.empty(3 * len(mesh.vertices)), np.empty(4 * len(mesh.vertices))
            mesh.vertices.foreach_get("co", places)
            if len(mesh.vertices):
                mesh.attributes[COLOUR].data.foreach_get("color", colours)
            matrix = np.asarray(item.matrix_world)
            return places.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3], colours.reshape(-1, 4)
    raise AssertionError(f"no body of {layer} in sight")


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


@pytest.fixture
def interpreter(tmp_path, monkeypatch):
    """Stands in for a Python with Taichi: its ``diagnose`` copies a diagnosis, its ``bake`` shifts all by a metre."""

    def write(diagnosis: Path):
        path = tmp_path / "python stub"
        path.write_text(
            f"#!{sys.executable}\n"
            + textwrap.dedent(f"""
            import json, shutil, sys
            sys.path[:0] = {[str(Path(physgen.__file__).resolve().parents[1])]!r}
            if sys.argv[2] == "sim.app.requirements":
                print(json.dumps({{"python": "3.13.0", "missing": [], "trouble": None, "installs": True}}))
                sys.exit(0)
            verb, source = sys.argv[3:5]
            out = sys.argv[sys.argv.index("--out") + 1]
            print(json.dumps({{"event": "progress", "stage": verb, "done": 1, "total": 2}}), flush=True)
            if verb == "diagnose":
                shutil.copytree({str(diagnosis)!r}, out)
                print(json.dumps({{"event": "done", "out": out}}), flush=True)
                sys.exit(0)
            from pathlib import Path
            from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, save_manifest
            from physgen.sim.cache.pc2 import Pc2Writer
            from physgen.sim.scene.folder import load_scene
            from physgen.sim.scene.meshes import load_object_mesh
            folder, out = load_scene(Path(source)), Path(out)
            out.mkdir()
            mesh = load_object_mesh(folder, folder.model.objects[0]).vertices
            with Pc2Writer(out / "ball.pc2", vertex_count=len(mesh)) as writer:
                for frame in range(3):
                    writer.append(mesh + [0, 0, frame * (2.0 if folder.model.effects else 1.0)])
            save_manifest(out, BakeManifest(
                inputs_hash="0", fps=30.0, frame_start=1, frames=3, frames_done=3, state="complete", engine="test",
                version="0", particles=1, geometry_hash=folder.geometry_hash(),
                objects=(BakedObject(name="ball", file="ball.pc2", vertices=len(mesh)),),
            ))
            print(json.dumps({{"event": "done", "bake": str(out)}}), flush=True)
            """),
            encoding="utf-8",
        )
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PHYSGEN_PYTHON", str(path))
        return path

    return write


def test_diagnosing_from_a_script_blocks_and_shows_what_was_found(throw, tmp_path, interpreter):
    capture, folder = throw
    interpreter(save_diagnosis(a_diagnosis(capture), tmp_path / "prepared"))
    state = load(folder)
    assert not state.has_report
    assert bpy.ops.physgen.diagnose("EXEC_DEFAULT") == {"FINISHED"}
    assert state.has_report and state.verdict == "air_drag"
    assert Path(state.report) == folder.with_name("throw_diagnosis")
    assert len(shown_points("nominal")) == 8


def test_a_video_without_a_body_in_it_is_refused_and_leaves_nothing(tmp_path):
    video = bpy.context.scene.physgen_diagnose.video
    for name, message in (("", "Video is empty: choose a file"), (str(tmp_path / "no.mp4"), "no.mp4 is no file")):
        video.file = name
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.physgen.explain_video("EXEC_DEFAULT")
    (tmp_path / "words.mp4").write_text("no video at all", encoding="utf-8")
    video.file, video.kind = str(tmp_path / "words.mp4"), "mesh"
    with pytest.raises(RuntimeError, match="Mesh is empty"):
        bpy.ops.physgen.explain_video("EXEC_DEFAULT")
    video.kind = "cylinder"
    with pytest.raises(RuntimeError, match="not a readable video"):
        bpy.ops.physgen.explain_video("EXEC_DEFAULT")
    assert [f.name for f in tmp_path.iterdir()] == ["words.mp4"]
    assert bpy.context.scene.physgen_diagnose.root is None


@pytest.mark.long
def test_a_video_of_a_slide_is_explained_and_shown(tmp_path):
    film = runpy.run_path(str(Path(physgen.__file__).resolve().parent / "examples" / "video_to_cause.py"))
    film["film"](tmp_path / "slide.avi")
    state = bpy.context.scene.physgen_diagnose
    video = state.video
    video.file, video.kind, video.fps = str(tmp_path / "slide.avi"), "cylinder", film["FPS"]
    video.diameter, video.height = 0.1, film["EDGE"]
    assert bpy.ops.physgen.explain_video("EXEC_DEFAULT") == {"FINISHED"}
    assert state.verdict == "friction" and state.closed > 0.8
    assert Path(state.report) == tmp_path / "slide_explained" / "diagnosis"
    assert Path(video.comparison).is_file()
    assert state.has_motion and len(shown_points("found" if state.found.points else "nominal")) > 0


def test_an_interpreter_that_cannot_simulate_is_named(throw, monkeypatch):
    _, folder = throw
    load(folder)
    monkeypatch.setenv("PHYSGEN_PYTHON", "/nowhere/python")
    with pytest.raises(RuntimeError, match="/nowhere/python, named in PHYSGEN_PYTHON, is no Python"):
        bpy.ops.physgen.diagnose("EXEC_DEFAULT")


def a_scene_folder(root):
    from physgen.sim.scene.folder import save_scene
    from physgen.sim.scene.model import Camera as SceneCamera
    from physgen.sim.scene.model import SceneModel, SceneObject

    root.mkdir()
    trimesh.creation.icosphere(subdivisions=1, radius=0.05).export(root / "ball.stl")
    for name in ("photo.png", "background.png"):
        (root / name).write_bytes(b"-")
    camera = SceneCamera(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, world_from_camera=LOOK)
    save_scene(root, SceneModel(camera=camera, objects=(SceneObject(name="ball", mesh="ball.stl", size_m=0.1),)))
    return root


def test_the_found_effect_goes_into_the_scene_and_both_bakes_are_shown(throw, tmp_path, interpreter):
    capture, folder = throw
    interpreter(save_diagnosis(a_diagnosis(capture), folder.with_name("throw_diagnosis")))
    state = load(folder)
    root = a_scene_folder(tmp_path / "scene")
    state.scene_folder = str(root)
    assert bpy.ops.physgen.add_found_effect("EXEC_DEFAULT") == {"FINISHED"}
    written = json.loads((root / "scene.json").read_text())["effects"]
    assert written == [{"name": "air_drag", "parameters": {"drag_per_mass": pytest.approx(0.04)}}]
    assert Path(state.before) == tmp_path / "scene_bake_before"
    assert Path(state.after) == tmp_path / "scene_bake_after"
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end, scene.render.fps) == (1, 3, 30)
    scene.frame_set(3)
    heights = {}
    graph = bpy.context.evaluated_depsgraph_get()
    for collection in (state.before_root, state.after_root):
        mesh = collection.objects[0].evaluated_get(graph).data
        heights[collection["physgen_bake"]] = np.mean([v.co.z for v in mesh.vertices])
    assert heights == {"before": pytest.approx(2.0, abs=1e-3), "after": pytest.approx(4.0, abs=1e-3)}
    state.overlay = "AFTER"
    assert state.before_root.hide_viewport and not state.after_root.hide_viewport
    state.overlay = "BOTH"
    assert not state.before_root.hide_viewport
    # Once more: the bake from before is kept, the new one gets a folder of its own, the effect is not there twice.
    assert bpy.ops.physgen.add_found_effect("EXEC_DEFAULT") == {"FINISHED"}
    assert Path(state.after) == tmp_path / "scene_bake_after_2"
    assert [e.name for e in load_scene(root).model.effects] == ["air_drag"]
    assert len([c for c in bpy.data.collections if "physgen_bake" in c]) == 2
    assert state.root.hide_viewport
    bpy.ops.physgen.clear_overlay()
    assert not state.root.hide_viewport and state.before_root is None and scene.frame_end == FRAMES


@pytest.mark.parametrize("verdict", ["none", "unknown"])
def test_without_a_finding_there_is_nothing_to_add(throw, verdict):
    capture, folder = throw
    save_diagnosis(a_diagnosis(capture, effect=verdict), folder.with_name("throw_diagnosis"))
    load(folder)
    assert not bpy.ops.physgen.add_found_effect.poll()


def test_a_job_reports_progress_and_is_cancelled():
    event = {"event": "progress", "stage": "fits", "done": 1, "total": 4, "eta_s": 9}
    code = f"import json, time; print({json.dumps(event)!r}, flush=True); time.sleep(60)"
    job = background_jobs.Job(
        "Test", lambda on_event, cancelled: run_stage([sys.executable, "-c", code], on_event, cancelled)
    )
    job.start()
    give_up = time.monotonic() + 30
    while job.fraction is None and time.monotonic() < give_up:
        assert not job.step()
        time.sleep(0.02)
    assert background_jobs.progress_text(job) == "Test: fits 25 %, 9 s left"
    job.cancel()
    with pytest.raises(Cancelled):
        job.wait()
