# SPDX-License-Identifier: GPL-3.0-or-later
"""The jobs of the Diagnose panel: diagnosing captures and videos, adding what was found, progress and cancelling."""

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
from physgen.sim.app.stage_process import run_stage
from physgen.sim.errors import Cancelled
from physgen.sim.scene.folder import load_scene

from .diagnose_scenes import (
    FRAMES,
    LOOK,
    a_diagnosis,
    a_throw,
    load,
    save_diagnosis,
    shown_points,
)

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def throw(tmp_path):
    return a_throw(tmp_path)


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


def test_a_diagnosis_beside_the_file_stays_beside_it(throw, tmp_path, interpreter):
    """Not as a path of this machine: file and folders may be moved together."""
    capture, folder = throw
    interpreter(save_diagnosis(a_diagnosis(capture), tmp_path / "prepared"))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder.parent / "a.blend"))
    state = load("//throw")
    assert bpy.ops.physgen.diagnose("EXEC_DEFAULT") == {"FINISHED"}
    assert (state.capture, state.report) == ("//throw", "//throw_diagnosis")


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
    job.title = "Fitting"
    assert background_jobs.progress_text(job) == "Fitting: fits 25 %, 9 s left"
    job.title, job.stage = "Reconstruction", "reconstruct"
    assert background_jobs.progress_text(job) == "Reconstruction 25 %, 9 s left"
    # A long first step is seen to go on.
    job.eta_s, job.started = None, time.monotonic() - 35.0
    assert background_jobs.progress_text(job) == "Reconstruction 25 %, 35 s"
    job.fraction = None
    assert background_jobs.progress_text(job) == "Reconstruction, 35 s"
    job.cancel()
    with pytest.raises(Cancelled):
        job.wait()
