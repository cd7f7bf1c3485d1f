# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks carried out for real, in processes of their own: done once, kept by content, stopped, refused, retried."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.farm.local_runner import _Board, run_local
from physgen.batch.farm.planning.plan import Outcome, Plan, Task, is_worth_retrying
from physgen.batch.farm.runners import FarmOptions, find_runner
from physgen.batch.farm.task_execution import execute_task
from physgen.batch.farm.task_records import (
    EARLIER_BYTES,
    HEAD_BYTES,
    TAIL_BYTES,
    Record,
    TaskLog,
    input_hashes,
    load_record,
    log_end,
    log_path,
    produced_hashes,
    record_path,
    save_record,
    up_to_date_record,
)
from physgen.sim.cache.bake_folder import BakedObject, save_manifest
from physgen.sim.errors import InputError
from physgen.sim.events import ignore, never
from physgen.sim.version import VERSION

from ..conftest import complete_manifest


def variant(name, source="scene", **changes):
    """A task that takes as long as the program needs to start."""
    out = f"out/{name}"
    fields = {
        "id": f"s/{name}/variant",
        "stage": "variant",
        "argv": ("variant", source, "--out", out, "--preset=soft"),
        "inputs": (f"{source}/scene.json", f"{source}/photo.png"),
        "produces": (f"{out}/scene.json", f"{out}/photo.png"),
    }
    return Task(**{**fields, **changes})


def carry_out(task, root, **changes):
    return execute_task(task, root, **{"version": VERSION, "worker": "here", **changes})


def test_a_task_is_done_once_and_again_when_something_changed(ball_scene, tmp_path):
    ball_scene()
    task = variant("a")
    first = carry_out(task, tmp_path)
    assert (first.state, first.exit_code, first.attempts, first.worker) == ("done", 0, 1, "here"), first
    assert first.cpu_seconds > 0 and first.seconds > 0
    assert "ended with code 0" in log_end(log_path(task, tmp_path))
    kept = carry_out(task, tmp_path)
    assert (kept.state, kept.attempts, kept.seconds) == ("kept", 0, first.seconds)
    # The same bytes written anew are no change; other bytes are.
    photo = tmp_path / "scene" / "photo.png"
    photo.write_bytes(photo.read_bytes())
    assert carry_out(task, tmp_path).state == "kept"
    made = tmp_path / "out" / "a" / "scene.json"
    made.write_text(made.read_text() + " ")
    assert carry_out(task, tmp_path).state == "done"
    assert carry_out(variant("a", argv=(*task.argv[:-1], "--preset=hard")), tmp_path).state == "done"
    assert json.loads(made.read_text())["objects"][0]["material"]["preset"] == "hard"


def test_a_bakes_particles_are_among_what_it_made(tmp_path):
    task = Task(id="bake", stage="bake", argv=("bake",), produces=("b/bake/manifest.json", "b/bake/heap.pc2"))
    heap = BakedObject(name="heap", file="heap.pc2", vertices=3, points_file="heap.points.pc2", points=5)
    manifest = complete_manifest(heap, frames=1)
    folder = tmp_path / "b" / "bake"
    folder.mkdir(parents=True)
    save_manifest(folder, manifest)
    for name in manifest.files:
        (folder / name).write_bytes(b"any")
    names = [name for name, _ in produced_hashes(task, tmp_path)]
    assert names == ["b/bake/heap.pc2", "b/bake/heap.points.pc2", "b/bake/manifest.json"]
    (folder / "heap.points.pc2").unlink()
    with pytest.raises(InputError, match=r"heap\.points\.pc2"):
        produced_hashes(task, tmp_path)


def test_failures_are_recorded_in_the_outcome(ball_scene, tmp_path):
    ball_scene()
    other = carry_out(variant("a"), tmp_path, version="0.0.9")
    assert (other.state, other.exit_code, other.attempts) == ("failed", 3, 0)
    assert VERSION in other.message and "0.0.9" in other.message
    gone = carry_out(variant("a", source="nowhere"), tmp_path)
    assert (gone.state, gone.exit_code, gone.attempts) == ("failed", 3, 0) and "scene.json" in gone.message
    outside = carry_out(variant("a", id="../../a"), tmp_path)
    assert outside.state == "failed" and "without '..'" in outside.message
    less = carry_out(variant("a", produces=("out/a/video.mp4",)), tmp_path)
    assert (less.state, less.exit_code) == ("failed", 1) and "did not write out/a/video.mp4" in less.message
    wrong = carry_out(variant("a", argv=("variant", "scene", "--presto")), tmp_path)
    assert (wrong.state, wrong.exit_code) == ("failed", 2) and "--out" in wrong.message
    (tmp_path / "locked").write_text("a file")
    assert carry_out(variant("a", farm_folder="locked"), tmp_path).state == "failed"


def test_a_cancelled_task_stops_its_command(ball_scene, tmp_path):
    ball_scene()
    going = threading.Event()

    def hear(event):
        if event["event"] == "progress":
            going.set()

    argv = ("bake", "scene", "--out", "bake", "--frames", "5000", "--quality", "preview")
    task = Task(id="bake", stage="bake", argv=argv, inputs=("scene",), produces=("bake/manifest.json",))
    outcome = carry_out(task, tmp_path, cancelled=going.is_set, on_event=hear)
    assert (outcome.state, outcome.exit_code) == ("cancelled", 130), outcome
    assert not (tmp_path / ".farm" / "records").exists(), "what was stopped is not remembered as done"


def test_a_failure_costs_what_depends_on_it_and_nothing_else(ball_scene, tmp_path):
    ball_scene()
    bad = variant("bad", argv=("variant", "scene", "--out", "out/bad", "--preset=soft", "--set=mug.density=1"))
    after = variant("after", needs=(bad.id,))
    last = variant("last", needs=(after.id,))
    tasks = (bad, after, last, variant("good"))
    plan = Plan(name="p", root=tmp_path, version=VERSION, tasks=tasks)
    events = []
    outcomes = run_local(plan, FarmOptions(workers=2), events.append, never)
    assert [o.state for o in outcomes] == ["failed", "skipped", "skipped", "done"]
    assert outcomes[0].attempts == 1, "bad input is not worth another attempt"
    assert all(bad.id in outcome.message for outcome in outcomes[1:3])
    ended = [e["task"] for e in events if e["event"] == "task" and e["state"] != "started"]
    assert sorted(ended) == sorted(t.id for t in tasks)
    assert [o.state for o in run_local(plan, FarmOptions(), ignore, lambda: True)] == ["cancelled"] * 4


@pytest.mark.skipif(os.name == "nt", reason="signals as on Unix")
def test_a_job_that_is_interrupted_stops_in_good_order(ball_scene, tmp_path):
    ball_scene()
    job = tmp_path / "jobs.toml"
    job.write_text(
        'format = "physgen-jobs/1"\nname = "job"\n[[scenes]]\nname = "balls"\nscene = "scene"\n'
        'bake = { frames = 5000, quality = "preview" }\nrender = { video = [] }\n'
    )
    command = [sys.executable, "-m", "physgen.batch.cli", "batch", str(job), "--json"]
    planned = subprocess.run([*command, "--dry-run"], capture_output=True, text=True, check=True).stdout.splitlines()
    assert json.loads(planned[-1]) == {"event": "done", "tasks": 211, "variants": 1}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    events = []
    for line in process.stdout:
        events.append(json.loads(line))
        if events[-1].get("task") == "balls/base/bake":
            process.send_signal(signal.SIGINT)
    assert process.wait() == 130 and events[-1]["kind"] == "Cancelled", events[-1]
    summary = json.loads((tmp_path / "job" / "summary.json").read_text())
    assert summary["state"] == "cancelled" and summary["counts"]["cancelled"] == 210
    assert not (tmp_path / "job" / ".farm" / ".lock").exists()


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=80), st.integers(0, 2**32))
def test_a_damaged_record_is_none(tmp_path_factory, noise, seed):
    root = tmp_path_factory.mktemp("record")
    (root / "in").write_text("in")
    (root / "made").write_text("made")
    task = Task(id="a/b", stage="bake", argv=("x",), inputs=("in",), produces=("made",))
    fields = {"task": "a/b", "version": VERSION, "argv": ("x",), "seconds": 1.0, "cpu_seconds": 2.0, "worker": "w"}
    record = Record(**fields, inputs=input_hashes(task, root), produced=produced_hashes(task, root))
    save_record(task, root, record)
    assert up_to_date_record(task, root, VERSION) == record
    path = record_path(task, root)
    content = bytearray(path.read_bytes())
    at = seed % len(content)
    content[at : at + 1 + len(noise) // 2] = noise
    path.write_bytes(bytes(content))
    assert (
        up_to_date_record(task, root, VERSION) in (None, record) or load_record(task, root).produced == record.produced
    )
    path.write_bytes(noise)
    assert up_to_date_record(task, root, VERSION) is None


def test_retryable_failures():
    def worth(code, attempts=1, state="failed"):
        return is_worth_retrying(Outcome(task="t", state=state, exit_code=code), attempts=attempts, retries=2)

    assert worth(-9) and worth(5) and worth(4) and worth(1, attempts=2)
    assert not (worth(2) or worth(3) or worth(5, attempts=3) or worth(130, state="cancelled") or worth(0, state="done"))


@pytest.mark.parametrize("farm", ["", "cloud", "local://x", "tcp", "tcp://", "dask://x"])
def test_an_unknown_farm_is_refused(farm):
    with pytest.raises(InputError, match="choose local, dask"):
        find_runner(farm)


def test_more_of_a_slot_than_there_is_is_refused(tmp_path):
    plan = Plan(name="p", root=tmp_path, version=VERSION, tasks=(variant("a", slots={"gpu": 2}),))
    with pytest.raises(InputError, match="needs 2 of the slot 'gpu', there are 1"):
        run_local(plan, FarmOptions(), ignore, never)


@st.composite
def graphs(draw):
    count = draw(st.integers(1, 12))
    tasks = []
    for i in range(count):
        needs = draw(st.lists(st.sampled_from(range(i)), max_size=3, unique=True)) if i else []
        slots = draw(st.sampled_from([{}, {"gpu": 1}, {"gpu": 2, "disk": 1}]))
        tasks.append(Task(id=str(i), stage="bake", argv=(), needs=tuple(map(str, needs)), slots=slots))
    failing = draw(st.sets(st.sampled_from(range(count))))
    return tuple(tasks), {str(i) for i in failing}


@settings(deadline=None)
@given(graphs(), st.randoms(), st.integers(1, 4))
def test_any_graph_is_carried_out_in_order_within_its_slots(graph, rng, workers):
    tasks, failing = graph
    plan = Plan(name="p", root=Path(), version=VERSION, tasks=tasks)
    board = _Board(plan, FarmOptions(slots={"gpu": 2}))
    running, good, begun = [], set(), []
    while True:
        while len(running) < workers:
            # As a worker that has nothing to do asks, but without waiting.
            task = board.take(lambda: not board._fitting())
            if task is None:
                break
            assert set(task.needs) <= good and task.id not in begun
            begun.append(task.id)
            running.append(task)
            assert sum(t.slots.get("gpu", 0) for t in running) <= 2
        if not running:
            break
        task = running.pop(rng.randrange(len(running)))
        state = "failed" if task.id in failing else "done"
        good |= {task.id} if state == "done" else set()
        board.settle(task, Outcome(task=task.id, state=state))
    lost = set()
    for task in tasks:
        if set(task.needs) & (lost | failing):
            lost.add(task.id)
    expected = ["skipped" if t.id in lost else "failed" if t.id in failing else "done" for t in tasks]
    assert [o.state for o in board.outcomes()] == expected


@settings(max_examples=12, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=40), st.integers(1, 8000)), max_size=5))
def test_a_log_keeps_its_beginning_and_its_end_within_bounds(tmp_path_factory, chunks):
    path = tmp_path_factory.mktemp("log") / "a" / "t.log"
    with TaskLog(path, "first"):
        pass
    with TaskLog(path, "second") as log:
        for text, times in chunks:
            for _ in range(times):
                log.write(text)
        log.write(b"the end")
    content = path.read_bytes()
    assert len(content) <= EARLIER_BYTES + HEAD_BYTES + TAIL_BYTES + 200
    assert content.startswith(b"==== first\n==== second\n") and content.endswith(b"the end\n")
    assert log_end(path, 9) == "the end\n"


@pytest.mark.skipif(os.name == "nt", reason="pipes and holes of POSIX")
def test_logs_of_a_job_from_somebody_else_keep_nobody_waiting_and_take_no_memory(tmp_path):
    """Each would have hung for ever, or read a terabyte."""
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(60)
    try:
        os.mkfifo(tmp_path / "pipe.log")
        with (tmp_path / "long.log").open("wb") as file:
            file.truncate(2**39)
            file.seek(0, 2)
            file.write(b"\nthe end\n")
        assert log_end(tmp_path / "pipe.log") == ""
        assert log_end(tmp_path / "long.log").endswith("the end\n")
        with pytest.raises(InputError, match=r"pipe\.log: is no regular file"):
            TaskLog(tmp_path / "pipe.log", "next")
        with TaskLog(tmp_path / "long.log", "next"):
            pass
        assert (tmp_path / "long.log").stat().st_size < EARLIER_BYTES + 100
        assert log_end(tmp_path / "long.log").endswith("the end\n==== next\n")
    finally:
        signal.alarm(0)
