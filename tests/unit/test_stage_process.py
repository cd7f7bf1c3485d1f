# SPDX-License-Identifier: MIT
"""Stages in processes of their own: events arrive, errors keep their kind, and a cancelled stage ends."""

import os
import sys
import textwrap
import time

import pytest
from physgen.sim import memory
from physgen.sim.app import stage_process
from physgen.sim.app.stage_process import run_stage
from physgen.sim.errors import Cancelled, InputError, RenderError


def stage(code):
    return [sys.executable, "-c", textwrap.dedent(code)]


def test_events_arrive_in_order_and_chatter_does_not():
    events = []
    code = """
        print('Blender says hello'); print('[1, 2]'); print('{"no": "event"}')
        for i in range(3): print('{"event": "progress", "stage": "s", "done": %d, "total": 3}' % i)
        print('{"event": "done", "value": 7}')
    """
    assert run_stage(stage(code), events.append, lambda: False)["value"] == 7
    assert [e["done"] for e in events] == [0, 1, 2]


def test_an_error_keeps_its_kind_and_words():
    code = """print('{"event": "error", "kind": "InputError", "message": "box 3 is empty"}'); raise SystemExit(3)"""
    with pytest.raises(InputError, match="box 3 is empty"):
        run_stage(stage(code), print, lambda: False)


def test_a_stage_that_dies_without_a_word_is_quoted():
    with pytest.raises(RenderError, match=r"code 1(.|\n)*no such GPU"):
        run_stage(stage("import sys; sys.exit('no such GPU')"), print, lambda: False, failure=RenderError)
    with pytest.raises(RenderError, match=r"code -9 \(it was killed, possibly because memory ran out; [\d,]+ MiB are"):
        run_stage(stage("import os; os.kill(os.getpid(), 9)"), print, lambda: False, failure=RenderError)


def test_the_kernels_count_of_processes_killed_for_memory_tells_why(tmp_path, monkeypatch):
    """A control group's limit ends a process with no last word: whoever waits for it says it."""
    counts = tmp_path / "vmstat"
    counts.write_text("oom_kill_disable 1\noom_kill 7\n")
    assert memory.memory_kills(counts) == 7 and memory.memory_kills(tmp_path / "none") is None
    before = memory.memory_kills(counts)
    monkeypatch.setattr(memory, "memory_kills", lambda: 8)
    assert memory.how_it_was_killed(before).startswith("it was killed by the system, as memory ran out; ")
    assert memory.how_it_was_killed(8).startswith("it was killed, possibly because memory ran out; ")


def test_a_stage_that_ends_well_without_a_result_is_an_error():
    with pytest.raises(RenderError):
        run_stage(stage("pass"), print, lambda: False, failure=RenderError)


def test_a_stage_that_crashes_is_started_again_as_often_as_allowed(tmp_path):
    code = f"""
        import os, pathlib, signal
        with open({str(tmp_path / "starts")!r}, "a") as starts: starts.write("x")
        if pathlib.Path({str(tmp_path / "starts")!r}).stat().st_size < 3: os.kill(os.getpid(), signal.SIGSEGV)
        print('{{"event": "done", "value": 7}}')
    """
    with pytest.raises(RenderError, match="code -11"):
        run_stage(stage(code), print, lambda: False, failure=RenderError, restarts=1)
    events = []
    assert run_stage(stage(code), events.append, lambda: False, failure=RenderError, restarts=1)["value"] == 7
    assert (tmp_path / "starts").stat().st_size == 3 and events == [], "the third start worked at once"


def test_a_stage_that_was_killed_is_not_started_again(tmp_path):
    code = f"""
        import os
        with open({str(tmp_path / "starts")!r}, "a") as starts: starts.write("x")
        os.kill(os.getpid(), 9)
    """
    with pytest.raises(RenderError, match="code -9"):
        run_stage(stage(code), print, lambda: False, failure=RenderError, restarts=1)
    assert (tmp_path / "starts").stat().st_size == 1


def test_a_stage_that_was_done_when_it_was_asked_to_stop_is_done():
    code = """
        import time
        print('{"event": "progress", "stage": "s"}\\n{"event": "done", "value": 7}', flush=True)
        time.sleep(60)
    """
    events = []
    assert run_stage(stage(code), events.append, lambda: bool(events))["value"] == 7
    with pytest.raises(RenderError, match="code 3"):
        run_stage(stage("""print('{"event": "done"}'); raise SystemExit(3)"""), print, bool, failure=RenderError)


def test_a_deaf_stage_is_killed(monkeypatch):
    monkeypatch.setattr(stage_process, "CANCEL_GRACE_S", 0.5)
    pids = []
    code = """
        import os, signal, time
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        print('{"event": "progress", "pid": %d}' % os.getpid(), flush=True)
        time.sleep(60)
    """
    with pytest.raises(Cancelled):
        run_stage(stage(code), lambda e: pids.append(e["pid"]), lambda: bool(pids))
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_much_output_on_both_pipes_does_not_block():
    code = """
        import sys
        for i in range(20000): print('x' * 50); print('y' * 50, file=sys.stderr)
        print('{"event": "done"}')
    """
    started = time.monotonic()
    assert run_stage(stage(code), print, lambda: time.monotonic() - started > 60)["event"] == "done"


def test_the_child_does_not_inherit_what_would_break_it(monkeypatch):
    monkeypatch.setenv("PYTHONHOME", "/nowhere")
    for name in ("LD_PRELOAD", "LD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES", "PYTHONPATH", "PYTHONINSPECT"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("PYTHONPYCACHEPREFIX", "/elsewhere")
    environment = stage_process.child_environment()
    found = {key for key in environment if key.startswith(("PYTHON", "LD_", "DYLD_"))} - {"PYTHONDONTWRITEBYTECODE"}
    assert found == {"PYTHONPYCACHEPREFIX", "PYTHONUTF8"}
    assert environment["PATH"] == os.environ["PATH"]


def test_events_are_utf8_whatever_the_locale(monkeypatch):
    monkeypatch.setenv("LC_ALL", "C")
    monkeypatch.setenv("PYTHONIOENCODING", "latin-1")
    said = run_stage(stage("""print('{"event": "done", "path": "Bäll"}')"""), print, lambda: False)
    assert said["path"] == "Bäll"
