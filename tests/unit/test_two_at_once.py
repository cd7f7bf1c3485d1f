# SPDX-License-Identifier: MIT
"""Two commands into one folder at once, and clocks that jump: the second is refused by name, and nothing is lost."""

import os
import shutil
import subprocess
import sys
import time

import pytest
from physgen.batch import cli
from physgen.sim.app.pack_bake import pack_bake
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.diagnose.capture import load_capture, save_capture
from physgen.sim.errors import InputError
from physgen.sim.processes import own_mark, parse_mark

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="inputs are drawn with limits of Linux")

HOLDER = """
import sys
from contextlib import ExitStack
from pathlib import Path
from physgen.sim.cache.folder_lock import folder_lock, lock_beside
with ExitStack() as held:
    for name in sys.argv[1:]:
        held.enter_context(lock_beside(Path(name)))
    held.enter_context(folder_lock(Path("bake")))
    print("held", flush=True)
    input()
"""
COMMANDS = {
    "reconstruct": "reconstruct photo.png --box 30,18,66,58 --out scene",
    "variant": "variant pair --preset jelly --out windy",
    "light": "light pair --sun-direction 0.5,0.3,1",
    "bake": "bake pair --frames 2 --quality preview --out bake",
    "pack": "pack whole --out packed",
    "capture": "capture import table.csv --diameter 0.1 --mass 0.1 --out captured",
    "diagnose": "diagnose known --budget 10s --no-confirm --effects wind --out diagnosis",
    "evaluate": "evaluate whole --scene pair --out evaluated",
    "compose": "compose pair --no-picture --steps 1 --substeps 1 --cells 8 --out fitted",
    "export": "export pair --bake whole --usd moving.usda",
    "questionnaire": "questionnaire case --out asked",
    "collect": "questionnaire answers.json --collect --key key.json --out results",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with the inputs of ``COMMANDS``."""
    from .limited_commands import draw

    folder = tmp_path_factory.mktemp("two") / "start"
    draw(folder, frames=3)
    names = ["capture", "import", str(folder / "table.csv"), "--diameter", "0.1", "--mass", "0.1"]
    assert cli.main([*names, "--out", str(folder / "known")]) == 0
    return folder


@pytest.fixture
def work(inputs, tmp_path, monkeypatch):
    """A copy of the inputs, the working folder."""
    shutil.copytree(inputs, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"}


def test_of_two_commands_into_one_folder_the_second_is_refused_by_name(work, capsys):
    results = [words.split()[-1] for words in COMMANDS.values() if "bake pair" not in words]
    results[results.index("0.5,0.3,1")] = "pair"
    command = [sys.executable, "-c", HOLDER, *results]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        before = contents(work)
        for name, words in COMMANDS.items():
            capsys.readouterr()
            assert cli.main(words.split()) == 3, name
            assert f"in use by process {first.pid}" in capsys.readouterr().err, name
        assert contents(work) == before
        first.kill()
    # Its locks died with it.
    assert cli.main(COMMANDS["light"].split()) == 0


def test_what_was_finished_while_waiting_for_the_folder_is_not_replaced(work, monkeypatch):
    """Whoever looks before it holds the folder may find it free, and then replace what the other has written."""
    bake, capture = load_bake(work / "whole"), load_capture(work / "known")

    def finished_first(path):
        path.mkdir()
        (path / "theirs").write_text("precious")
        return held(path)

    for module, save in (
        ("physgen.sim.app.pack_bake", lambda out: pack_bake(bake, out=out)),
        ("physgen.sim.diagnose.capture", lambda out: save_capture(capture, out)),
    ):
        out = work / module
        held = sys.modules[module].lock_beside
        with monkeypatch.context() as patch:
            patch.setattr(f"{module}.lock_beside", finished_first)
            with pytest.raises(InputError, match="already"):
                save(out)
        assert [path.name for path in out.iterdir()] == ["theirs"]


def test_a_light_goes_on_from_the_scene_as_a_correction_left_it(work, monkeypatch):
    """It was read before the correction ended, and would have been written over it."""
    from physgen.batch.commands import photo_commands

    held = photo_commands.lock_beside

    def corrected_first(root):
        text = (root / "scene.json").read_text()
        assert '"size_m": 0.1' in text
        (root / "scene.json").write_text(text.replace('"size_m": 0.1', '"size_m": 0.125'))
        return held(root)

    monkeypatch.setattr(photo_commands, "lock_beside", corrected_first)
    assert cli.main(COMMANDS["light"].split()) == 0
    text = (work / "pair" / "scene.json").read_text()
    assert '"size_m": 0.125' in text and '"sun_direction": null' not in text


@pytest.mark.parametrize("year", [1971, 2100])
def test_times_of_files_and_the_clock_change_no_result(work, monkeypatch, year):
    """Inputs, results and locks from long ago or from the future, and a clock that was set back between two runs."""
    monkeypatch.setenv("PHYSGEN_CONFIG", str(work / ".config"))
    words = [COMMANDS[name].split() for name in ("light", "variant", "collect")]
    for command in words:
        assert cli.main(command) == 0
    first = contents(work)
    moment = (year - 1970) * 31_556_952
    for path in work.rglob("*"):
        os.utime(path, (moment, moment))
    monkeypatch.setattr(time, "time", lambda: 86_400.0 * 365 * (year - 1970))
    for command in words:
        assert cli.main(command) == 0
    assert contents(work) == first


def test_a_lock_and_a_leftover_from_the_future_are_those_of_whoever_wrote_them(work, capsys):
    """Whether a process lives is asked of the system, never of a file's time."""
    command = [sys.executable, "-c", "from physgen.sim.processes import own_mark; print(own_mark())"]
    dead = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert parse_mark(dead).is_dead
    left, lock = work / f".windy.partial-{dead}", work / ".windy.lock"
    mine = work / f".windy.partial-{own_mark()}x"
    for path in (left, mine):
        path.mkdir()
    lock.touch()
    for path in (left, mine, lock):
        os.utime(path, (4e9, 4e9))
    assert cli.main(COMMANDS["variant"].split()) == 0
    assert not left.exists() and mine.exists() and not lock.exists()
