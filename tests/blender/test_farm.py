# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen batch`` from a photo to frames: scheduler, worker and renderer are killed, and nothing is lost."""

import json
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from physgen.batch.farm import local_runner
from physgen.batch.farm.planning.job_file import load_job
from physgen.batch.farm.planning.task_graph import make_plan
from physgen.batch.farm.runners import FarmOptions

pytest.importorskip("bpy")

JOB = """
format = "physgen-jobs/1"
name = "balls"
out = "results"
[defaults.bake]
frames = 4
quality = "preview"
[defaults.render]
samples = 1
scale = 0.4
chunk = 2
video = ["sheet"]
[[scenes]]
name = "ball"
photo = "ball.png"
boxes = [[60, 45, 130, 118]]
sizes = [0.08]
presets = ["soft"]
velocities = [0, 0, 0.6]
"""
IDS = [
    "ball/reconstruct",
    *(f"ball/base/{t}" for t in ("variant", "bake", "render-0001-0002", "render-0003-0004", "encode-sheet")),
]


@pytest.fixture
def job(tmp_path):
    image = np.full((150, 200, 3), (140, 120, 100), np.uint8)
    image += np.random.default_rng(5).integers(0, 12, image.shape, dtype=np.uint8)
    cv2.ellipse(image, (108, 110), (34, 8), 0, 0, 360, (60, 50, 45), -1)
    cv2.circle(image, (95, 82), 30, (30, 130, 235), -1)
    cv2.imwrite(str(tmp_path / "ball.png"), image)
    path = tmp_path / "jobs.toml"
    path.write_text(JOB)
    return path


def physgen(job, *arguments):
    line = [sys.executable, "-m", "physgen.batch.cli", "batch", str(job), "--json", *arguments]
    return subprocess.Popen(line, stdout=subprocess.PIPE, text=True)


def processes(*words):
    """Process ids whose command line has all ``words``."""
    listed = subprocess.run(["ps", "-eo", "pid,args", "-ww"], capture_output=True, text=True, check=True).stdout
    found = [line.split(None, 1) for line in listed.splitlines()[1:]]
    return [int(pid) for pid, line in found if all(word in line for word in words) and int(pid) != os.getpid()]


def states(process):
    ended = [e for e in map(json.loads, process.stdout) if e["event"] == "task" and e["state"] != "started"]
    return {e["task"]: e["state"] for e in ended}


@pytest.mark.long
def test_killed_process_costs_only_a_retry(job):
    # The scheduler itself, in the middle of the bake: what it had started ends by itself, what was done is kept.
    scheduler = physgen(job)
    for line in scheduler.stdout:
        if json.loads(line).get("task") == "ball/base/bake":
            break
    second = physgen(job)
    assert "in use by process" in second.stdout.read() and second.wait() == 3, "one scheduler a job"
    scheduler.kill()
    scheduler.wait()
    deadline = time.monotonic() + 60
    while (left := processes(str(job.parent), "batch.cli")) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left

    # In the first chunk the process that renders, so that the command fails; in the second the command itself.
    plan = make_plan(load_job(job))
    victims = {IDS[3]: ["batch.render", "0001-0002"], IDS[4]: ["batch.cli", "render", "0003-0004"]}
    events = []

    def hear(event):
        events.append(event)
        if event["event"] == "progress" and event.get("done") == 1 and event["task"] in victims:
            for pid in processes(str(job.parent), *victims.pop(event["task"])):
                os.kill(pid, signal.SIGKILL)

    outcomes = local_runner.run_local(plan, FarmOptions(workers=2, threads=1), hear, lambda: False)
    assert [o.task for o in outcomes] == IDS and not victims
    # On a busy machine the bake ends before its scheduler does, and is kept too.
    kept = outcomes[2].state == "kept"
    assert [o.state for o in outcomes] == ["kept", "kept", "kept" if kept else "done", "done", "done", "done"], outcomes
    assert [o.attempts for o in outcomes] == [0, 0, 0 if kept else 1, 2, 2, 1]
    retries = {e["task"]: e["message"] for e in events if e["event"] == "notice" and "trying again" in e["message"]}
    assert "was killed" in retries[IDS[3]] and "SIGKILL" in retries[IDS[4]]
    for task in plan.tasks[3:]:
        assert all(cv2.imread(str(plan.root / name)) is not None for name in task.produces)

    # Nothing is left to do, and the summary says so.
    again = physgen(job)
    assert states(again) == dict.fromkeys(IDS, "kept") and again.wait() == 0
    summary = json.loads((job.parent / "results" / "summary.json").read_text())
    assert summary["state"] == "done" and summary["counts"]["kept"] == len(IDS)
    assert (job.parent / "results" / summary["variants"][0]["strip"]).is_file()
    assert not [p for p in job.parent.rglob(".*") if p.is_file()], "no locks, nothing half written"
