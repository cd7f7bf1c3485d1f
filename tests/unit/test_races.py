# SPDX-License-Identifier: MIT
"""Two commands at once, as processes: one is held in the middle of its work, another comes, the first goes on."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from physgen.benchmarks.kill_chain import draw_inputs
from physgen.benchmarks.kills import contents

pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc"),
    pytest.mark.long,
]

LONGEST_S = 600.0
TRIES = 20
RECONSTRUCT = "reconstruct photo.png --box 30,18,66,58 --name ball --no-sun --out scene"
BAKE = "bake scene --frames 6 --quality preview --out bake"
RENDER = "render scene --bake bake --frames 1-3 --samples 1 --out frames"


def command(words):
    return [sys.executable, "-m", "physgen.batch.cli", *words.split()]


class Held:
    """A command that was started and, once ``there`` was true, stopped with all its processes.

    On a busy machine the whole command may be over before it can be stopped: where ``over`` is true by then, it is left
    to end, ``again`` removes what it made, and it is started anew.
    """

    def __init__(self, words, there, *, over, again):
        self.log = Path("first.log").absolute()
        for _ in range(TRIES):
            self.start(words, there)
            if self.process.poll() is None and not over():
                return
            code, said = self.go_on()
            assert code == 0, said
            again()
        pytest.fail(f"{words}: over before it could be stopped, {TRIES} times")

    def start(self, words, there):
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command(words), stdout=log, stderr=log)
        end = time.monotonic() + LONGEST_S
        ended = False
        while not there():
            assert not ended and time.monotonic() < end, self.log.read_text()
            time.sleep(0.005)
            ended = (
                self.process.poll() is not None
            )  # asked before the last look: it may just have made what is waited for
        # Until all of them are: one may have started another meanwhile.
        for _ in range(5):
            self.signal(signal.SIGSTOP)

    def members(self):
        mark = f"PHYSGEN_CONFIG={os.environ['PHYSGEN_CONFIG']}".encode()
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                number = int(entry.name) if entry.name.isdigit() else 0
                if number not in (0, os.getpid()) and mark in (entry / "environ").read_bytes().split(b"\0"):
                    yield number

    def signal(self, number):
        for member in self.members():
            with contextlib.suppress(ProcessLookupError):
                os.kill(member, number)

    def go_on(self):
        """Return exit code and words."""
        self.signal(signal.SIGCONT)
        code = self.process.wait(LONGEST_S)
        return code, self.log.read_text()


def run(words):
    done = subprocess.run(command(words), capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stderr + done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scene, a bake of it, frames; the results that undisturbed commands have."""
    folder = tmp_path_factory.mktemp("races") / "made"
    folder.mkdir()
    draw_inputs(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("PHYSGEN_CONFIG", str(folder / ".config"))
        for words in (RECONSTRUCT, BAKE, RENDER):
            code, said = run(words)
            assert code == 0, said
    return folder


@pytest.fixture
def work(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "work" / ".config"))
    return tmp_path / "work"


def frames_done(folder):
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = (folder / "manifest.json").read_text()
        return int(text.split('"frames_done":')[1].split(",")[0])
    return 0


def test_while_a_bake_writes_its_folder_is_its_own_and_its_scene_may_change(work, made):
    shutil.rmtree(work / "bake")
    held = Held(
        BAKE,
        lambda: frames_done(work / "bake") >= 1,
        over=lambda: frames_done(work / "bake") >= 6,
        again=lambda: shutil.rmtree(work / "bake"),
    )
    done = frames_done(work / "bake")
    try:
        for words in ("free bake", BAKE):
            code, said = run(words)
            assert code == 3 and "in use by process" in said, said
        # What is there can be looked at; what is not is waited for by name.
        code, said = run(RENDER.replace("frames 1-3", "frames 1-6"))
        assert code == 3 and f"frames 1 to {done} are baked" in said and "still running: wait for it" in said
        code, said = run("check bake")
        assert code == 0 and "0 damaged" in said, said
        code, said = run("correct scene --size ball=0.3")
        assert code == 0, said
    finally:
        code, said = held.go_on()
    # It read the scene as a whole when it began.
    assert code == 0 and contents(work / "bake") == contents(made / "bake"), said
    assert "0.3" in (work / "scene" / "scene.json").read_text()


def test_while_a_render_writes_nothing_is_recorded_of_what_was_changed_or_freed(work, made):
    shutil.rmtree(work / "frames")
    held = Held(
        RENDER,
        (work / "frames" / "0001.png").exists,
        over=(work / "frames" / "0003.png").exists,
        again=lambda: shutil.rmtree(work / "frames"),
    )
    try:
        code, said = run(RENDER)
        assert code == 3 and "frames: in use by process" in said, said
        code, said = run("light scene --sun-direction 0.5,0.3,1 --sun-strength 2")
        assert code == 0, said
        assert run("free bake")[0] == 0
    finally:
        code, said = held.go_on()
    assert code == 3 and said.count("error: ") == 1 and "another command meanwhile" in said, said
    # With the bake and the scene put back, what is not of them is rendered again.
    for name in ("scene", "bake"):
        shutil.rmtree(work / name, ignore_errors=True)
        shutil.copytree(made / name, work / name)
    code, said = run(RENDER)
    assert code == 0 and contents(work / "frames") == contents(made / "frames"), said


def test_while_a_reconstruction_works_its_folder_is_its_own(work, made):
    shutil.rmtree(work / "scene")
    held = Held(
        RECONSTRUCT,
        lambda: any(work.glob(".scene.partial-*/stages/*.npz")),
        over=(work / "scene").exists,
        again=lambda: shutil.rmtree(work / "scene"),
    )
    try:
        code, said = run(RECONSTRUCT)
        assert code == 3 and "scene: in use by process" in said, said
        assert run("variant scene --preset jelly --out windy")[0] == 3
    finally:
        code, said = held.go_on()
    found, expected = contents(work / "scene"), contents(made / "scene")
    # The record has the place of the photo, and the checksums are of the record too.
    differs = {name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)}
    assert code == 0 and differs <= {"reconstruct.json", "checksums.json"}, said
    assert not list(work.glob(".scene*"))
