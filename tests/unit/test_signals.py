# SPDX-License-Identifier: MIT
"""SIGINT and SIGTERM end a command soon and with one exit code, whatever it is doing, and it leaves nothing behind."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")

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
