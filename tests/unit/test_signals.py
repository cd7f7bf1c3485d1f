# SPDX-License-Identifier: MIT
"""SIGINT and SIGTERM end a command soon and with one exit code, whatever it is doing, and it leaves nothing behind."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import cv2
import numpy as np
import pytest
from physgen.sim.cache.bake_folder import BakedObject, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.checksums import span_for
from physgen.sim.evaluate.judge_question import CRITERIA
from physgen.sim.processes import is_running
from PIL import Image

from ..conftest import complete_manifest

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


@pytest.fixture(autouse=True)
def the_end_of_a_terminal_is_heard():
    """Under nohup, tests and all that they start would ignore it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


DEAF = """
import time
from pathlib import Path
def stage(*arguments):
    Path(__file__).with_name("running").touch()
    end = time.monotonic() + 120
    while time.monotonic() < end:
        time.sleep(1)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("started", "module"),
    [
        ("physgen.batch.cli", "physgen.sim.errors"),
        ("physgen.batch.cli", "numpy"),
        ("physgen.batch.cli", "physgen.batch.terminal"),
        ("physgen.__main__", "numpy"),
    ],
)
def test_while_its_modules_are_imported_the_code_is_the_same(number, started, module):
    code = textwrap.dedent(f"""
        import os, runpy, sys
        seen = []
        def hook(event, arguments):
            if event == "import" and arguments[0] == {module!r} and not seen:
                seen.append(1)
                os.kill(os.getpid(), {int(number)})
        sys.addaudithook(hook)
        sys.argv = ["physgen", "doctor"]
        runpy.run_module({started!r}, run_name="__main__", alter_sys=True)
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def typed(tmp_path, *words, then):
    """The command ``words`` as a person starts it, whose worker does ``then`` when it imports NumPy: its process."""
    code = textwrap.dedent(f"""
        import os, runpy, signal, sys, time
        def hook(event, arguments):
            if event == "import" and arguments[0] == "numpy":
                with open({str(tmp_path / "worker")!r}, "w") as file:
                    file.write(str(os.getpid()))
                {then}
        sys.addaudithook(hook)
        sys.argv = {["physgen", *words]!r}
        runpy.run_module("physgen.__main__", run_name="__main__", alter_sys=True)
    """)
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the shell says it")
def test_a_command_that_was_killed_says_so(tmp_path):
    """The kernel kills it as memory runs out: it cannot say anything itself."""
    then = "os.kill(os.getpid(), signal.SIGKILL)"
    with typed(tmp_path, "doctor", then=then) as process:
        out, said = process.communicate(timeout=60)
    assert (process.returncode, out) == (137, "")
    (line,) = said.split("\n")[1:-1]
    assert line.startswith("error: doctor: it was killed") and "MiB are available now" in line
    with typed(tmp_path, "doctor", "--json", then=then) as process:
        out, said = process.communicate(timeout=60)
    assert process.returncode == 137 and said == "" and json.loads(out)["kind"] == "Killed"
    with typed(tmp_path, "doctor", then="os.kill(os.getpid(), signal.SIGSEGV)") as process:
        process.communicate(timeout=60)
    assert process.returncode == -signal.SIGSEGV


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        ("ImportError('libX.so: failed to map segment from shared object')", 3, "error: doctor: memory ran out"),
        ("ImportError('no module X')", 1, "Traceback"),
    ],
)
def test_a_library_that_cannot_be_loaded_for_lack_of_memory_is_one_line(tmp_path, raised, code, words):
    with typed(tmp_path, "doctor", then=f"raise {raised}") as process:
        _, said = process.communicate(timeout=60)
    assert process.returncode == code and said.strip().startswith(words)
    assert (said.strip().count("\n") == 0) == (code == 3)


@pytest.mark.skipif(sys.platform != "linux", reason="one process elsewhere")
@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGTERM, 130), (signal.SIGINT, 130), (signal.SIGHUP, 130), (signal.SIGKILL, -9)],
)
def test_a_signal_to_the_command_reaches_its_worker(tmp_path, number, code):
    with typed(tmp_path, "doctor", then="time.sleep(120)") as process:
        while not (tmp_path / "worker").exists() or not (worker := (tmp_path / "worker").read_text()):
            time.sleep(0.02)
        assert int(worker) != process.pid
        process.send_signal(number)
        process.communicate(timeout=60)
    assert process.returncode == code
    end = time.monotonic() + 60
    while is_running(int(worker)):
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize(("before", "heeded"), [("", "True"), ("trap '' HUP; ", "False")])
def test_the_end_of_the_terminal_is_heeded_unless_it_is_to_be_ignored(before, heeded):
    code = "import signal; from physgen.sim.app.launch import STOP_SIGNALS; print(signal.SIGHUP in STOP_SIGNALS)"
    command = ["sh", "-c", f'{before}exec "$@"', "sh", sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split() == [heeded], done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="one process elsewhere")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_worker_that_hears_nothing_is_ended_in_time(tmp_path, number):
    """As in a library's call that lets no other thread run: neither handlers nor the watching thread get their turn."""
    deaf = "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])"
    then = f"{deaf}; os.mkdir({str(tmp_path / 'deaf')!r}); time.sleep(120)"
    with typed(tmp_path, "doctor", "--json", then=then) as process:
        while not (tmp_path / "deaf").exists():
            time.sleep(0.02)
        worker = (tmp_path / "worker").read_text()
        asked = time.monotonic()
        process.send_signal(number)
        out, _ = process.communicate(timeout=60)
    # Two seconds are the promise; the rest is for a machine that does twenty other things.
    assert process.returncode == 130 and 1.0 < time.monotonic() - asked < 6.0
    assert json.loads(out)["kind"] == "Cancelled" and not is_running(int(worker))


def test_what_windows_asks_by_is_heeded_like_the_others():
    """By Ctrl-Break, which ends a process at once otherwise; here another signal stands in for it."""
    code = textwrap.dedent("""
        import os, signal, sys
        signal.SIGBREAK = signal.SIGUSR1
        from physgen.batch import terminal
        from physgen.sim.app import launch
        with terminal.stop_signals() as stopped:
            os.kill(os.getpid(), signal.SIGUSR1)
            assert stopped() or not __import__("time").sleep(1) and stopped()
        def load(root):
            os.kill(os.getpid(), signal.SIGUSR1)
        launch.load_tree = load
        launch.main(["batch.cli"])
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_work_is_done_does_not_become_its_exit_code(number):
    """While Python ends, it puts the system's own handlers back."""
    code = textwrap.dedent(f"""
        import os, sys
        from physgen.batch import cli
        class Last:
            def __del__(self, kill=os.kill, own=os.getpid()):
                kill(own, {int(number)})
        sys.modules["kept to the very end"] = Last()
        sys.argv = ["physgen", "effects", "wind"]
        sys.exit(cli.main())
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and done.stdout.startswith("wind") and done.stderr == ""


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (72, 96, 3), dtype=np.uint8)).save(path)
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_step_that_hears_nothing_is_ended_and_leaves_nothing(photo, tmp_path, number):
    (tmp_path / "deaf.py").write_text(DEAF)
    scratch, running = tmp_path / "tmp", tmp_path / "running"
    scratch.mkdir()
    command = [sys.executable, "-m", "physgen.batch.cli", "reconstruct", str(photo), "--box", "20,15,70,60", "--json"]
    command += ["--segmenter", f"python:{tmp_path}/deaf.py:stage", "--out", str(tmp_path / "scene")]
    environment = {**os.environ, "TMPDIR": str(scratch)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
        while not running.exists() and process.poll() is None:
            time.sleep(0.05)
        assert list(scratch.glob("physgen-*"))
        asked = time.monotonic()
        process.send_signal(number)
        said, _ = process.communicate(timeout=60)
    # Two seconds are the promise; the rest is for a machine that does twenty other things.
    assert process.returncode == 130 and time.monotonic() - asked < 6.0
    assert json.loads(said.splitlines()[-1])["kind"] == "Cancelled"
    assert not list(scratch.iterdir())
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith((".", "scene"))) == []


def a_toss(path):
    """A video of a small red ball in flight."""
    rng = np.random.default_rng(1)
    wall = cv2.GaussianBlur(rng.integers(90, 200, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 60.0, (160, 120))
    for t in np.arange(30) / 60:
        frame, place = wall.copy(), (30 + 220 * t, 95 - 200 * (2.4 * t - 4.905 * t * t))
        cv2.circle(frame, tuple(int(16 * v) for v in place), 5 * 16, (30, 30, 210), -1, cv2.LINE_AA, 4)
        video.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    video.release()


@pytest.fixture
def inputs(photo, tmp_path):
    """Of the commands below, in ``tmp_path``."""
    a_toss(tmp_path / "toss.avi")
    rows = [f"{t:.4f},{1.1 * t:.5f},0,{2 + 1.5 * t - 4.905 * t * t:.5f}" for t in np.arange(24) / 60]
    (tmp_path / "table.csv").write_text("\n".join(["t,x,y,z", *rows]) + "\n")
    case = tmp_path / "case"
    case.mkdir()
    for name in ("ours", "other"):
        video = cv2.VideoWriter(str(case / f"{name}.webm"), cv2.VideoWriter_fourcc(*"VP80"), 8, (80, 60))
        for level in range(4):
            video.write(np.full((60, 80, 3), 40 * level + len(name), np.uint8))
        video.release()
    (case / "photo.png").write_bytes(photo.read_bytes())
    listed = '[videos]\nours = "ours.webm"\nother = "other.webm"\n'
    (case / "case.toml").write_text(f'prompt = "It falls."\nimage = "photo.png"\n{listed}')
    scores = {token: dict.fromkeys(CRITERIA, 3) for token in ("aa", "bb")}
    sheet = {"format": "physgen questionnaire answers", "version": 1, "questionnaire": "0", "person": "ann"}
    sheet |= {"saved": "2026-01-01", "cases": {"case_01": {"order": ["bb", "aa"], "scores": scores}}}
    (tmp_path / "answers.json").write_text(json.dumps(sheet))
    told = {"id": "case_01", "name": "a", "prompt": "It falls.", "videos": {"aa": "ours", "bb": "other"}}
    key = {"format": "physgen questionnaire", "version": 1, "questionnaire": "0", "criteria": list(CRITERIA)}
    (tmp_path / "key.json").write_text(json.dumps({**key, "cases": [told]}))
    (tmp_path / "bake").mkdir()
    with Pc2Writer(tmp_path / "bake" / "box.pc2", vertex_count=8, span=span_for(3)) as cache:
        for sample in np.random.default_rng(0).random((3, 8, 3)):
            cache.append(sample)
        checksums = (cache.checksum("box.pc2", ended=True),)
    (tmp_path / "bake" / "metrics.json").write_text('{"frames": []}\n')
    box = BakedObject(name="box", file="box.pc2", vertices=8)
    save_manifest(tmp_path / "bake", complete_manifest(box, checksums=checksums))
    return tmp_path


BALL = "--object ball:diameter=0.05"
COMMANDS = {
    "explain": f"explain toss.avi {BALL} --budget 10s --effects wind --out OUT",
    "track": f"track toss.avi {BALL} --out OUT",
    "evaluate": "evaluate toss.avi --seconds 0.2 --out OUT",
    "questionnaire": "questionnaire case --out OUT",
    "collect": "questionnaire answers.json --collect --key key.json --out OUT",
    "propose": "propose photo.png --segmenter none --out OUT",
    "capture": "capture import table.csv --diameter 0.1 --mass 0.1 --out OUT",
    "pack": "pack bake --out OUT",
    "check": "check bake",
    "models": "models list",
}
QUICK = ("questionnaire", "collect", "capture", "pack", "check", "models")
"""Those that take a second of computing; the others are ``long``."""


def start(name, folder, out):
    scratch = folder / "tmp"
    scratch.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "physgen.batch.cli", *COMMANDS[name].replace("OUT", out).split()]
    environment = {**os.environ, "TMPDIR": str(scratch)}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, cwd=folder)


def files(folder, *besides):
    """Path and content of all files, but those that say how long something took."""
    found = {path.relative_to(folder): path for path in sorted(folder.rglob("*"))}
    kept = {name: path for name, path in found.items() if name.name not in besides and path.is_file()}
    return {str(name): path.read_bytes() for name, path in kept.items()}


LONG = [pytest.param(name, marks=() if name in QUICK else pytest.mark.long) for name in COMMANDS]


@pytest.mark.parametrize("name", LONG)
def test_the_same_command_writes_the_same_bytes(inputs, name):
    results = []
    for turn in range(2):
        with start(name, inputs, "out") as process:
            said, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors.decode()[-800:]
        results.append((said if name in ("check", "models") else b"", files(inputs / "out", "times.json")))
        if (inputs / "out").exists():
            (inputs / "out").rename(inputs / f"kept-{turn}")
            # Nothing in there is by the second in which it was written.
            time.sleep(1.1 - time.time() % 1)
    assert results[0] == results[1] and (results[0][1] or name in ("check", "models"))


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", list(COMMANDS))
def test_a_command_is_ended_whatever_it_does_and_leaves_nothing(inputs, name, number):
    before = set(inputs.rglob("*"))
    with start(name, inputs, "out") as process:
        # Its temporary folder is the first thing it makes; short ones may be over by then. Imports are tested above.
        while not any((inputs / "tmp").iterdir()) and process.poll() is None:
            time.sleep(0.02)
        time.sleep(0.3)
        asked = time.monotonic()
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
        took = time.monotonic() - asked
    # Two seconds are the promise; the rest is for a machine that does twenty other things. It may have ended before.
    assert process.returncode in (0, 130) and took < 6.0, errors.decode()[-800:]
    assert b"Traceback" not in errors
    out, left = inputs / "out", set(inputs.rglob("*")) - before - {inputs / "tmp"}
    if process.returncode == 130 and left:
        # Asked between the last rename and the end: all is there then.
        assert all(path.is_relative_to(out) for path in left)
        out.rename(inputs / "kept")
        with start(name, inputs, "out") as process:
            process.communicate(timeout=600)
        assert files(inputs / "kept", "times.json") == files(out, "times.json")
