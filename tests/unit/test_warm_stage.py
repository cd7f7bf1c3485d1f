# SPDX-License-Identifier: MIT
"""A process that stays for the next job: what ends it, and that a job never notices."""

import os
import sys
import textwrap
import time

import pytest
from physgen.sim.app import stage_process
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.bake_worker import SERVE, BakeJob, job_to_json
from physgen.sim.app.stage_process import WarmStage, own_command
from physgen.sim.cache.bake_folder import load_manifest
from physgen.sim.errors import Cancelled, InputError, SimulationError

SERVER = """
    import json, os, sys, time
    def say(**words): print(json.dumps({**words, "pid": os.getpid()}), flush=True)
    for line in sys.stdin:
        if line.strip() == "cancel":
            continue
        wish = json.loads(line).get("wish")
        say(event="progress", stage="s", done=0, total=1)
        if wish == "refuse": say(event="error", kind="InputError", message="no such scene")
        elif wish == "crash": sys.exit("out of ideas")
        elif wish == "sleep": time.sleep(60)
        elif wish == "long":
            assert sys.stdin.readline().strip() == "cancel"
            say(event="error", kind="Cancelled", message="stopped")
        else: say(event="done")
        if wish == "last": sys.exit()
"""
COMMAND = [sys.executable, "-c", textwrap.dedent(SERVER)]


@pytest.fixture
def warm():
    stage = WarmStage()
    yield stage
    stage.stop()


def ask(stage, wish="", *, command=COMMAND, cancelled=lambda: False):
    return stage.run(command, {"wish": wish}, lambda event: None, cancelled)


def has_ended(pid):
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            # Of a child that has ended only an entry is left until somebody asks for its code.
            if os.waitpid(pid, os.WNOHANG)[0]:
                return True
        except ChildProcessError:
            return True
        time.sleep(0.05)
    return False


def test_jobs_share_a_process_also_after_one_that_is_refused(warm):
    first = ask(warm)["pid"]
    with pytest.raises(InputError, match="no such scene"):
        ask(warm, "refuse")
    assert ask(warm)["pid"] == first


def test_a_cancelled_job_leaves_the_process_to_the_next(warm):
    first = ask(warm)["pid"]
    with pytest.raises(Cancelled, match="stopped"):
        ask(warm, "long", cancelled=lambda: True)
    assert ask(warm)["pid"] == first


def test_a_deaf_job_is_killed_and_the_next_gets_a_fresh_process(warm, monkeypatch):
    monkeypatch.setattr(stage_process, "CANCEL_GRACE_S", 0.2)
    first = ask(warm)["pid"]
    with pytest.raises(Cancelled, match="killed"):
        ask(warm, "sleep", cancelled=lambda: True)
    assert has_ended(first) and ask(warm)["pid"] != first


def test_a_crash_is_quoted_and_the_next_job_gets_a_fresh_process(warm):
    first = ask(warm)["pid"]
    with pytest.raises(SimulationError, match="code 1: out of ideas"):
        ask(warm, "crash")
    assert ask(warm)["pid"] != first


def test_a_process_that_ended_while_idle_costs_no_job(warm):
    first = ask(warm, "last")["pid"]
    assert ask(warm)["pid"] != first


def test_another_command_and_stop_end_the_process(warm):
    first = ask(warm)["pid"]
    second = ask(warm, command=[*COMMAND, "other"])["pid"]
    assert has_ended(first) and second != first
    warm.stop()
    assert has_ended(second)


def test_a_prepared_process_takes_the_first_job(warm):
    warm.prepare(COMMAND)
    prepared = warm._listened.process.pid
    warm.prepare(COMMAND)
    assert ask(warm)["pid"] == prepared


@pytest.mark.long
def test_bakes_in_one_process_have_the_bytes_of_bakes_in_their_own(ball_scene, tmp_path, warm):
    """Cancelled in the middle, resumed, and baked again elsewhere: by one worker, which ends with its input."""
    folder, events = ball_scene(), []
    command = own_command("sim.app.bake_worker", SERVE)

    def bake(out, *, frames=6, until=1000, stage=warm):
        options = BakeOptions(frames=frames, fps=24.0, quality="preview")
        job = job_to_json(BakeJob(scene=str(folder.root), out=str(tmp_path / out), options=options))
        events.clear()
        return stage.run(command, job, events.append, lambda: any(e.get("done", 0) >= until for e in events))

    with pytest.raises(Cancelled):
        bake("long", frames=400, until=3)
    worker = warm._listened.process
    assert load_manifest(tmp_path / "long").state == "cancelled" and worker.poll() is None
    with pytest.raises(InputError, match="frames"):
        warm.run(command, {"format": "physgen-job/1", "use_case": "bake", "frames": 1}, events.append, lambda: False)
    assert bake("first")["frames"] == bake("second")["frames"] == 6
    assert warm._listened.process is worker
    alone = WarmStage()
    bake("alone", stage=alone)
    alone.stop()
    assert len({(tmp_path / out / "ball0.pc2").read_bytes() for out in ("first", "second", "alone")}) == 1
    warm.stop()
    assert worker.wait(20) == 0
