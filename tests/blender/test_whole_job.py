# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen run`` as a user has it: photo → video in real processes, again, changed, stopped and killed."""

import json
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_manifest

pytest.importorskip("bpy")
pytestmark = pytest.mark.long

FRAMES = 5


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    """A lit orange ball with a soft shadow on a table with grain."""
    rng = np.random.default_rng(5)
    height, width = 150, 200
    y, x = np.mgrid[:height, :width].astype(np.float64)
    table = np.stack([90 + 0 * x, 120 + 0 * x, 150 + 0.1 * y], axis=-1) + 8 * np.sin(y / 3 + x / 40)[..., None]
    table += rng.normal(0, 3, table.shape)
    shadow = np.exp(-((((x - 112) / 34) ** 2 + ((y - 108) / 8) ** 2) ** 2))
    table *= (1 - 0.55 * shadow)[..., None]
    dx, dy = (x - 95) / 30, (y - 82) / 30
    height_map = np.sqrt(np.clip(1 - dx**2 - dy**2, 0, None))
    shade = np.clip(0.35 + 0.75 * (-0.4 * dx - 0.6 * dy + 0.7 * height_map), 0, 1.1)
    ball = shade[..., None] * np.array([30, 130, 235])
    image = np.where((height_map > 0)[..., None], ball, table)
    path = tmp_path_factory.mktemp("photo") / "ball.png"
    cv2.imwrite(str(path), np.clip(cv2.GaussianBlur(image, (3, 3), 0.6), 0, 255).astype(np.uint8))
    return path


def command(photo, work, *extra):
    stages = ["--frames", FRAMES, "--quality", "preview", "--samples", "4"]
    where = ["--out", work / "ball.mp4", "--work", work, "--json"]
    scene = ["run", photo, "--box", "60,45,130,118", "--size", "0.08", "--velocity", "0,0,0.6"]
    return [sys.executable, "-m", "physgen.batch.cli", *map(str, [*scene, *stages, *where, *extra])]


def run(photo, work, *extra):
    result = subprocess.run(command(photo, work, *extra), capture_output=True, text=True, check=False)
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0, result.stderr + result.stdout[-500:]
    return events


def state(work):
    """Every file's time of change; logs and locks are none of them."""
    return {p.relative_to(work): p.stat().st_mtime_ns for p in work.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def job(photo, tmp_path_factory):
    """A finished job; tests that change it work on what it leaves, in the order of this file."""
    work = tmp_path_factory.mktemp("job") / "Arbeit mit Ümlaut"
    events = run(photo, work)
    shutil.copytree(work, work.parent / "prepared", ignore=shutil.ignore_patterns("frames", "*.mp4"))
    return work, events


@pytest.fixture(scope="module")
def prepared(job):
    """That job as it was before its first frame: for tests of what happens from there on. To be copied."""
    return job[0].parent / "prepared"


def test_a_photo_becomes_a_video(job, photo):
    work, events = job
    assert events[-1]["event"] == "done" and events[-1]["video"] == str(work / "ball.mp4")
    progress = [e for e in events if e["event"] == "progress"]
    assert [s for s in ("reconstruct", "bake", "render", "encode") if any(e["stage"] == s for e in progress)] == [
        "reconstruct", "bake", "render", "encode",
    ]  # fmt: skip
    assert all(e["job_eta_s"] >= 0 for e in progress)
    assert sorted(p.name for p in (work / "frames").glob("*.png")) == [f"{i:04d}.png" for i in range(1, FRAMES + 1)]
    video = cv2.VideoCapture(str(work / "ball.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES
    first = cv2.imread(str(work / "frames" / "0001.png")).astype(float)
    truth = cv2.imread(str(photo)).astype(float)
    mask = cv2.imread(str(work / "scene" / "masks" / "object_1.png"), cv2.IMREAD_GRAYSCALE) > 127
    error = ((first - truth) ** 2).mean(axis=2)
    # 35 dB in the mask and 38 dB overall are the thresholds.
    assert 10 * np.log10(255**2 / error[mask].mean()) >= 35.0
    assert 10 * np.log10(255**2 / error.mean()) >= 38.0
    last = cv2.imread(str(work / "frames" / f"{FRAMES:04d}.png")).astype(float)
    assert np.abs(last - first).max() > 50, "something moves"


def test_the_same_again_does_nothing(job, photo):
    work, _ = job
    before = state(work)
    events = run(photo, work)
    assert state(work) == before
    assert sum("up to date" in e.get("message", "") for e in events) >= 4


def contents(work):
    """Every file's bytes, but for how long the frames of the bake took, logs and locks."""
    files = [p for p in work.rglob("*") if p.is_file() and p.name not in ("times.json", ".lock")]
    return {str(p.relative_to(work)): p.read_bytes() for p in files if p.suffix != ".log"}


def test_the_same_command_from_nothing_gives_the_same_bytes(job, photo, tmp_path):
    work, _ = job
    before = contents(work)
    shutil.move(work, tmp_path / "before")
    run(photo, work)
    after = contents(work)
    assert {"ball.mp4", "scene/scene.json", "scene/light/environment.exr", "bake/manifest.json"} <= before.keys()
    assert after.keys() == before.keys()
    assert [name for name in sorted(before) if after[name] != before[name]] == []


@pytest.mark.long
def test_another_material_bakes_again_without_reconstructing(job, photo):
    work, _ = job
    before, baked = state(work), load_manifest(work / "bake").inputs_hash
    run(photo, work, "--preset", "soft")
    after = state(work)
    assert load_manifest(work / "bake").inputs_hash != baked
    changed = {str(p) for p in after if after[p] != before.get(p)}
    assert {p for p in changed if p.startswith("scene")} == {"scene/scene.json"}
    # Frame 1 shows the scene at rest, of whatever it is made.
    assert "frames/0001.png" not in changed and f"frames/{FRAMES:04d}.png" in changed


@pytest.mark.parametrize("how", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGKILL])
def test_a_stopped_run_goes_on(prepared, photo, tmp_path, how):
    work = tmp_path / "work"
    shutil.copytree(prepared, work)
    process = subprocess.Popen(command(photo, work), stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        event = json.loads(line)
        if event.get("stage") == "render" and event.get("done", 0) >= 2:
            process.send_signal(how)
            break
    rest = process.stdout.read()
    assert process.wait() == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert how == signal.SIGKILL or json.loads(rest.splitlines()[-1])["kind"] == "Cancelled"
    assert not (work / "ball.mp4").exists()
    # The render process notices that its parent is gone, ends with a whole frame and gives the folder back.
    deadline = time.monotonic() + 60
    while (work / "frames" / ".lock").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    done = {p.name for p in (work / "frames").glob("[0-9]*.png")}
    assert 2 <= len(done) < FRAMES and all(cv2.imread(str(work / "frames" / name)) is not None for name in done)
    before = state(work)
    run(photo, work)
    after = state(work)
    assert all(before[p] == after[p] for p in before if p.name in done), "complete frames are kept"
    assert sorted(p.name for p in (work / "frames").glob("*.png")) == [f"{i:04d}.png" for i in range(1, FRAMES + 1)]
    assert (work / "ball.mp4").is_file()
    assert not [p for p in work.rglob(".*") if "partial" in p.name]


def test_a_bake_of_another_scene_is_refused(job, tmp_path):
    work, _ = job
    shutil.copytree(work / "scene", tmp_path / "scene")
    path = tmp_path / "scene" / "scene.json"
    data = json.loads(path.read_text())
    data["objects"][0]["world_from_mesh"][0][3] += 0.2
    path.write_text(json.dumps(data))
    render = ["render", tmp_path / "scene", "--bake", work / "bake", "--out", tmp_path / "frames", "--samples", "4"]
    line = [sys.executable, "-m", "physgen.batch.cli", *map(str, render)]
    result = subprocess.run(line, capture_output=True, text=True, check=False)
    assert result.returncode == 3 and "bake the scene again" in result.stderr


def test_a_full_disk_is_named(job, tmp_path):
    work, _ = job
    # A limit on file size fails writes as a full disk does, from the operating system.
    script = 'ulimit -f 20; exec "$@"'
    render = ["render", work / "scene", "--bake", work / "bake", "--out", tmp_path / "frames", "--samples", "4"]
    line = ["bash", "-c", script, "bash", sys.executable, "-m", "physgen.batch.cli", *map(str, render)]
    result = subprocess.run(line, capture_output=True, text=True, check=False)
    assert result.returncode in (3, 5) and "free space" in result.stderr and "Traceback" not in result.stderr
    assert not list((tmp_path / "frames").glob("*.png"))
