# SPDX-License-Identifier: MIT
"""Baking real scenes with the real engine: what comes out, what is not done twice, what survives a crash."""

import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from physgen.sim.app import bake as bake_module
from physgen.sim.app import bake_worker
from physgen.sim.app.bake import bake
from physgen.sim.app.bake_estimate import estimate_bake
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.scene_to_world import steps_text
from physgen.sim.cache.bake_folder import BakedObject, load_manifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import Cancelled, InputError, SimulationError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Effect, Ground, Key, Light, Material, Motion

from ..conftest import complete_manifest

QUICK = BakeOptions(frames=6, fps=24.0, quality="preview")
SHORT = dataclasses.replace(QUICK, frames=2)
"""Where it only counts whether there is a bake."""


def caches(out):
    return {path.name: path.read_bytes() for path in sorted(out.glob("*.pc2"))}


def test_a_thrown_ball_flies_as_it_should(ball_scene, tmp_path):
    folder = ball_scene(velocity=(0.3, 0.0, 1.0))
    manifest = bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK).manifest
    cache = Pc2Reader(tmp_path / "bake" / "ball0.pc2")
    mesh = load_object_mesh(folder, folder.model.objects[0])
    assert (manifest.state, manifest.frames_done, cache.sample_count) == ("complete", 6, 6)
    assert np.array_equal(cache.sample(0), mesh.vertices.astype(np.float32)), "frame 1 is the scene at rest"
    time = 5 / 24
    travelled = cache.sample(5).mean(axis=0) - cache.sample(0).mean(axis=0)
    expected = np.array([0.3 * time, 0.0, time - 0.5 * 9.81 * time**2])
    # 0.5 % of ½gt² is the tolerance for free fall.
    assert np.abs(travelled - expected).max() < 0.005 * 0.5 * 9.81 * time**2
    metrics = json.loads((tmp_path / "bake" / "metrics.json").read_text())["frames"]
    assert [m["frame"] for m in metrics] == [1, 2, 3, 4, 5, 6]


@pytest.mark.long
def test_a_ball_of_clay_is_dented_and_its_skin_follows(ball_scene, tmp_path):
    """Thrown down at 5 m/s it stays flat at the foot: lower than 95 % of itself, wider than before, whole and above the
    ground; and it is still as flat a tenth of a second later (1 % of the diameter)."""
    folder = ball_scene(preset="clay", velocity=(0.0, 0.0, -5.0))
    bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
    cache = Pc2Reader(tmp_path / "bake" / "ball0.pc2")
    rest, middle, last = (np.ptp(cache.sample(i), axis=0) for i in (0, 3, 5))
    assert last[2] < 0.95 * rest[2] and last[0] > rest[0]
    assert np.abs(last - middle).max() < 0.01 * rest[2]
    assert np.isfinite(cache.sample(5)).all() and cache.sample(5)[:, 2].min() > -0.002
    assert np.ptp(cache.sample(5), axis=0).max() < 2 * rest.max()


def test_a_moving_collider_is_baked_where_it_goes(ball_scene, tmp_path):
    folder = ball_scene(count=2, velocity=(0.0, 0.0, 0.0))
    keys = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 2.4, 0.0)))
    wall = dataclasses.replace(folder.model.objects[1], role="collider", motion=Motion(translations=keys))
    save_scene(folder.root, dataclasses.replace(folder.model, objects=(folder.model.objects[0], wall)))
    notices = []
    bake(
        load_scene(folder.root),
        out=tmp_path / "bake",
        options=dataclasses.replace(QUICK, frames=3),
        on_event=notices.append,
    )
    cache = Pc2Reader(tmp_path / "bake" / "ball1.pc2")
    np.testing.assert_allclose(cache.sample(2) - cache.sample(0), np.tile([0.0, 0.2, 0.0], (642, 1)), atol=1e-6)
    assert any("about" in n.get("message", "") and "MiB" in n.get("message", "") for n in notices), "what it will cost"


def test_unchanged_inputs_skip_the_bake(ball_scene, tmp_path):
    folder = ball_scene()
    out = tmp_path / "bake"
    first = bake(load_scene(folder.root), out=out, options=SHORT).manifest
    before = {p: p.stat().st_mtime_ns for p in out.iterdir()}
    notices = []
    bake(load_scene(folder.root), out=out, options=SHORT, on_event=notices.append)
    assert {p: p.stat().st_mtime_ns for p in out.iterdir()} == before
    assert "up to date" in notices[-1]["message"]
    # Light does not move anything, matter does.
    save_scene(folder.root, dataclasses.replace(folder.model, light=Light(sun_strength=3.0)))
    assert bake_module.is_up_to_date(load_scene(folder.root), out, SHORT)
    stiffer = dataclasses.replace(folder.model.objects[0], material=Material(youngs_modulus=1e5, density=200.0))
    save_scene(folder.root, dataclasses.replace(folder.model, objects=(stiffer,)))
    assert not bake_module.is_up_to_date(load_scene(folder.root), out, SHORT)
    assert bake(load_scene(folder.root), out=out, options=SHORT).manifest.inputs_hash != first.inputs_hash


def test_a_scene_that_is_corrected_while_it_is_read_is_not_baked(ball_scene, tmp_path):
    """Its meshes were those of the one scene, the hash that the bake is named by that of the other."""
    folder, other = ball_scene(), ball_scene(name="other", height=0.06)
    mesh = folder.file("meshes/ball0.glb")

    def corrected(event):
        if event.get("message") == "filling objects with particles":
            other.file("meshes/ball0.glb").replace(mesh)

    with pytest.raises(InputError, match="was changed by another command while it was read"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK, on_event=corrected)
    assert not (tmp_path / "bake" / "manifest.json").exists()


def test_a_cancelled_bake_goes_on_to_the_same_bytes(ball_scene, tmp_path, monkeypatch):
    folder = ball_scene(velocity=(0.0, 0.0, -1.0))
    bake(load_scene(folder.root), out=tmp_path / "whole", options=QUICK)
    asked = iter([False] * 14 + [True])
    with pytest.raises(Cancelled, match="run it again"):
        bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK, cancelled=lambda: next(asked))
    stopped = load_manifest(tmp_path / "parts")
    assert stopped.state == "cancelled" and 0 < stopped.frames_done < 6
    # The clock was set back by decades since, and its checkpoint is from the future.
    for path in (tmp_path / "parts").rglob("*"):
        os.utime(path, (4e9, 4e9))
    monkeypatch.setattr(time, "time", lambda: 3e7)
    notices = []
    bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK, on_event=notices.append)
    assert any("continuing" in n.get("message", "") for n in notices)
    assert caches(tmp_path / "parts") == caches(tmp_path / "whole")


def test_a_stiff_ball_takes_implicit_steps_and_goes_on_to_the_same_bytes(ball_scene, tmp_path):
    """Hard plastic in flight: on its parabola within 0.1 mm, with a twentieth of the substeps of explicit ones."""
    folder, notices = ball_scene(preset="hard", velocity=(0.3, 0.0, 1.2)), []
    bake(load_scene(folder.root), out=tmp_path / "whole", options=QUICK, on_event=notices.append)
    assert any("implicit" in n.get("message", "") for n in notices)
    cache, time_s = Pc2Reader(tmp_path / "whole" / "ball0.pc2"), 5 / 24
    way = cache.sample(5).mean(axis=0) - cache.sample(0).mean(axis=0)
    assert np.abs(way - (0.3 * time_s, 0.0, 1.2 * time_s - 0.5 * 9.81 * time_s**2)).max() < 1e-4
    asked = iter([False] * 14 + [True])
    with pytest.raises(Cancelled):
        bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK, cancelled=lambda: next(asked))
    assert 0 < load_manifest(tmp_path / "parts").frames_done < 6
    bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK)
    assert caches(tmp_path / "parts") == caches(tmp_path / "whole")
    short = dataclasses.replace(SHORT, implicit=False)
    bake(load_scene(folder.root), out=tmp_path / "explicit", options=short)
    substeps = [
        json.loads((tmp_path / name / "metrics.json").read_text())["frames"][1]["substeps"]
        for name in ("whole", "explicit")
    ]
    assert 0 < substeps[0] < substeps[1] / 20


def test_why_a_bake_takes_short_steps_is_said(ball_scene):
    """In one line, where implicit steps might pay; a soft ball, for which they would not, has none."""
    folder = ball_scene(preset="hard", count=2)
    wood = dataclasses.replace(folder.model.objects[1], material=load_preset("wood"))
    save_scene(folder.root, dataclasses.replace(folder.model, objects=(folder.model.objects[0], wood)))
    mixed = estimate_bake(load_scene(folder.root), QUICK)
    assert not mixed.solver.implicit
    assert steps_text(mixed) == "short time steps throughout, since 'ball1' is rigid"
    soft = estimate_bake(ball_scene(preset="soft", name="soft"), QUICK)
    assert not soft.solver.implicit and steps_text(soft) is None


@pytest.mark.long
def test_a_killed_worker_costs_a_rerun_and_nothing_else(ball_scene, tmp_path):
    folder = ball_scene()
    job = bake_worker.BakeJob(
        scene=str(folder.root), out=str(tmp_path / "bake"), options=dataclasses.replace(QUICK, frames=400)
    )
    (tmp_path / "job.json").write_text(json.dumps(bake_worker.job_to_json(job)))
    process = subprocess.Popen(
        [sys.executable, "-m", bake_worker.__name__, str(tmp_path / "job.json")], stdout=subprocess.PIPE
    )
    for line in process.stdout:
        if json.loads(line).get("done", 0) >= 3:
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert load_manifest(tmp_path / "bake").state == "running"
    assert not bake_module.is_up_to_date(load_scene(folder.root), tmp_path / "bake", job.options)
    # Another length is another bake: the half-written one gives way.
    assert bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK).manifest.state == "complete"
    assert Pc2Reader(tmp_path / "bake" / "ball0.pc2").sample_count == 6


def test_sigterm_ends_the_worker_with_130(ball_scene, tmp_path):
    folder = ball_scene()
    job = bake_worker.BakeJob(
        scene=str(folder.root), out=str(tmp_path / "bake"), options=dataclasses.replace(QUICK, frames=400)
    )
    (tmp_path / "job.json").write_text(json.dumps(bake_worker.job_to_json(job)))
    process = subprocess.Popen(
        [sys.executable, "-m", bake_worker.__name__, str(tmp_path / "job.json")], stdout=subprocess.PIPE
    )
    events = []
    for line in process.stdout:
        events.append(json.loads(line))
        if events[-1].get("done") == 3:
            process.terminate()
    assert process.wait() == 130
    assert events[-1] == {"event": "error", "kind": "Cancelled", "message": events[-1]["message"]}
    assert not (tmp_path / "bake" / ".lock").exists()


@pytest.mark.parametrize("until", ["filling", "about"])
def test_a_worker_that_still_prepares_can_be_stopped(ball_scene, tmp_path, until):
    """Whether it hears of it or is in the middle of NumPy or a compiler: it says so, and is in no later bake's way."""
    folder = ball_scene()
    job = bake_worker.BakeJob(scene=str(folder.root), out=str(tmp_path / "bake"), options=SHORT)
    (tmp_path / "job.json").write_text(json.dumps(bake_worker.job_to_json(job)))
    command = [sys.executable, "-m", bake_worker.__name__, str(tmp_path / "job.json")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "TI_OFFLINE_CACHE": "0"})
    events = []
    for line in process.stdout:
        events.append(json.loads(line))
        if until in events[-1].get("message", "") and events[-1]["event"] != "error":
            process.terminate()
    assert process.wait() == 130
    assert (events[-1]["event"], events[-1]["kind"]) == ("error", "Cancelled")
    assert bake(load_scene(folder.root), out=tmp_path / "bake", options=SHORT).manifest.state == "complete"


@pytest.mark.long
def test_a_broken_checkpoint_costs_a_fresh_start(ball_scene, tmp_path):
    folder = ball_scene()
    asked = iter([False] * 14 + [True])
    with pytest.raises(Cancelled):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK, cancelled=lambda: next(asked))
    checkpoint = tmp_path / "bake" / bake_module.CHECKPOINT_FILE
    for content in (b"", b"garbage", checkpoint.read_bytes()[: checkpoint.stat().st_size // 2]):
        # A bake that is complete leaves no folder of checkpoints.
        checkpoint.parent.mkdir(exist_ok=True)
        checkpoint.write_bytes(content)
        save = load_manifest(tmp_path / "bake")
        assert bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK).manifest.state == "complete"
        save_manifest(tmp_path / "bake", save)


def test_a_folder_of_somebody_elses_is_left_alone(ball_scene, tmp_path):
    folder = ball_scene()
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="holds other files"):
        bake(load_scene(folder.root), out=tmp_path / "home", options=QUICK)
    assert [p.name for p in (tmp_path / "home").iterdir()] == ["thesis.txt"]
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        bake(load_scene(folder.root), out=tmp_path / "file", options=QUICK)


@pytest.mark.long
@pytest.mark.parametrize("name", ["ball0.pc2", "checkpoints", "ball0.points.pc2"])
def test_nothing_is_written_through_a_link_that_leads_out_of_a_bake(ball_scene, tmp_path, name):
    """A bake from somebody else: its caches would be written where they lead, and the checkpoint removed there."""
    home, out = tmp_path / "home", tmp_path / "bake"
    home.mkdir()
    out.mkdir()
    for file in ("letter", "state.npz"):
        (home / file).write_text("mine")
    (out / name).symlink_to(home if name == "checkpoints" else home / "letter")
    save_manifest(out, complete_manifest(BakedObject(name="ball0", file="ball0.pc2", vertices=642)))
    with pytest.raises(InputError, match=f"{name}.*leads out"):
        bake(ball_scene(), out=out, options=BakeOptions(frames=2, quality="preview"))
    assert {path.name: path.read_text() for path in home.iterdir()} == {"letter": "mine", "state.npz": "mine"}


@pytest.mark.long
def test_a_full_disk_is_said_and_leaves_no_complete_bake(ball_scene, own_kernels, tmp_path):
    folder = ball_scene()
    job = bake_worker.BakeJob(scene=str(folder.root), out=str(tmp_path / "bake"), options=QUICK)
    (tmp_path / "job.json").write_text(json.dumps(bake_worker.job_to_json(job)))
    # A limit on file size fails writes as a full disk does, from the operating system.
    limit = 3 * 642 * 12

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    result = subprocess.run(
        [sys.executable, "-m", bake_worker.__name__, str(tmp_path / "job.json")],
        capture_output=True,
        preexec_fn=small_files,
        env=own_kernels,
        check=False,
    )
    assert result.returncode == 3, result.stderr[-2000:].decode()
    last = json.loads(result.stdout.splitlines()[-1])
    assert (result.returncode, last["kind"]) == (3, "InputError") and "free space" in last["message"], result.stderr[
        -800:
    ]
    assert not bake_module.is_up_to_date(load_scene(folder.root), tmp_path / "bake", QUICK)
    assert bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK).manifest.state == "complete"


def test_effects_of_the_scene_reach_the_engine(ball_scene, tmp_path):
    """Buoyancy that carries the whole weight: the ball stays where it is. An effect that nobody knows is refused."""
    floating = Effect(name="buoyancy", parameters=(("fraction", 1.0),))
    folder = ball_scene(velocity=(0.0, 0.0, 0.0), effects=(floating,))
    bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
    cache = Pc2Reader(tmp_path / "bake" / "ball0.pc2")
    np.testing.assert_allclose(cache.sample(5), cache.sample(0), atol=1e-5)
    save_scene(folder.root, dataclasses.replace(folder.model, effects=(Effect(name="witchcraft"),)))
    with pytest.raises(InputError, match="witchcraft"):
        bake(load_scene(folder.root), out=tmp_path / "other", options=QUICK)


def test_a_wooden_ball_keeps_its_shape_and_bounces_as_told(ball_scene, tmp_path):
    """A rigid body through the whole bake: the baked mesh moves as one; with restitution 1 it comes up again."""
    folder = ball_scene(preset="wood", velocity=(0.0, 0.0, -2.0), ground=Ground(restitution=1.0))
    bake(load_scene(folder.root), out=tmp_path / "bake", options=dataclasses.replace(QUICK, frames=8))
    cache = Pc2Reader(tmp_path / "bake" / "ball0.pc2")
    rest = cache.sample(0) - cache.sample(0).mean(axis=0)
    heights = []
    for frame in range(8):
        points = cache.sample(frame)
        heights.append(points.mean(axis=0)[2])
        centred = points - points.mean(axis=0)
        u, _, vt = np.linalg.svd(centred.T @ rest)
        assert np.abs(centred - rest @ (u @ vt).T).max() < 1e-5
    assert max(heights) == pytest.approx(heights[0] + 2.0**2 / (2 * 9.81), rel=0.1)


def test_surfaces_and_goals_of_objects_are_baked(ball_scene, tmp_path):
    folder = ball_scene(velocity=(1.0, 0.0, 0.0))
    item = dataclasses.replace(folder.model.objects[0], friction=0.1, goal_stiffness=400.0, goal_damping=0.5)
    save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,)))
    assert bake(load_scene(folder.root), out=tmp_path / "bake", options=SHORT).manifest.state == "complete"


def test_an_open_mesh_is_refused_by_its_objects_name(ball_scene, tmp_path):
    import trimesh

    folder = ball_scene()
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    mesh.update_faces(np.arange(len(mesh.faces)) > 10)
    mesh.export(folder.root / "meshes" / "ball0.glb")
    with pytest.raises(InputError, match="object ball0"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)


def test_two_bakes_into_one_folder_at_once(ball_scene, tmp_path):
    folder = ball_scene()
    with bake_module.folder_lock(tmp_path / "bake"):
        code = f"""
from pathlib import Path
from physgen.sim.app.bake import bake
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
try:
    bake(load_scene(Path({str(folder.root)!r})), out={str(tmp_path / "bake")!r})
except InputError as error:
    print(error)
"""
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"in use by process {os.getpid()}" in result.stdout


def test_a_run_that_diverges_names_the_body_and_keeps_the_good_frames(ball_scene, tmp_path):
    folder = ball_scene()
    asked = iter([False] * 14 + [True])
    with pytest.raises(Cancelled):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK, cancelled=lambda: next(asked))
    good = load_manifest(tmp_path / "bake").frames_done
    # Fault injection: the engine goes on from a state in which a particle has lost its velocity. Without its digest, or
    # the checkpoint would count as damaged.
    checkpoint = tmp_path / "bake" / bake_module.CHECKPOINT_FILE
    with np.load(checkpoint) as data:
        state = {key: data[key].copy() for key in data.files if key != "digest"}
    state["state.v"][100] = np.nan
    np.savez(checkpoint, **state)
    with pytest.raises(SimulationError, match="ball0"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
    manifest = load_manifest(tmp_path / "bake")
    assert manifest.state == "cancelled" and manifest.frames_done >= good > 0
    assert Pc2Reader(tmp_path / "bake" / "ball0.pc2").sample_count == manifest.frames_done


def test_a_run_that_would_take_for_ever_is_refused_before_it_starts(ball_scene, tmp_path):
    folder = ball_scene(velocity=(0.0, 0.0, 1e9))
    with pytest.raises(InputError, match=r"time steps.*velocity"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
