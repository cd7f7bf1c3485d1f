# SPDX-License-Identifier: MIT
"""Two commands into one folder at once, and clocks that jump: the second is refused by name, and nothing is lost."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import threading
import time

import pytest
from physgen.batch import cli, stages
from physgen.sim.app import set_light
from physgen.sim.app.add_drops import Drop, add_drops
from physgen.sim.app.composition_folder import composition_folder
from physgen.sim.app.default_motion import DefaultMotion
from physgen.sim.app.export_usd import export_usd
from physgen.sim.app.moves import Move
from physgen.sim.app.pack_bake import pack_bake
from physgen.sim.app.reconstruct import Physics, _inputs_hash, set_all_physics, set_physics
from physgen.sim.app.reconstruct_record import Request, stamp_to_json
from physgen.sim.cache.bake_check import unchanged_bake
from physgen.sim.cache.bake_folder import load_bake, save_manifest
from physgen.sim.diagnose.capture_folder import load_capture, save_capture
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.processes import own_mark, parse_mark
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.scene.folder import load_scene, scene_to_json

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="inputs are drawn with limits of Linux")

HOLDER = """
import sys
from contextlib import ExitStack
from pathlib import Path
from physgen.sim.folder_lock import folder_lock, lock_beside
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
        ("physgen.sim.diagnose.capture_folder", lambda out: save_capture(capture, out)),
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
    held = set_light.lock_beside

    def corrected_first(root):
        text = (root / "scene.json").read_text()
        assert '"size_m": 0.1' in text
        (root / "scene.json").write_text(text.replace('"size_m": 0.1', '"size_m": 0.125'))
        return held(root)

    monkeypatch.setattr(set_light, "lock_beside", corrected_first)
    assert cli.main(COMMANDS["light"].split()) == 0
    text = (work / "pair" / "scene.json").read_text()
    assert '"size_m": 0.125' in text and '"sun_direction": null' not in text


def test_nothing_writes_a_scene_that_another_command_changes(work):
    """The steps of `run` and of Python programs after a reconstruction: physics, motion, drops, a changed model."""
    scene = load_scene(work / "pair")
    jelly = Physics(presets=("jelly",))
    times = {"flight_s": 1.0, "settle_s": 0.1, "pause_s": 0.1, "start_s": 0.0}
    move = Move(name="a", height=0.1, aside=(0, 0, 0), **times, velocity=(0, 0, 1), spin=(0, 0, 0))
    drop = Drop(name="c")
    command = [sys.executable, "-c", HOLDER, "pair"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        before = contents(work / "pair")
        for write in (
            scene.save,
            lambda: set_physics(scene, jelly),
            lambda: set_all_physics(scene, jelly),
            lambda: DefaultMotion(moves=(move,), frames=9, fps=24.0, slow=1.0, sentence="").applied(scene),
            lambda: add_drops(scene, [drop]),
        ):
            with pytest.raises(InputError, match=f"in use by process {first.pid}"):
                write()
        assert contents(work / "pair") == before
        first.kill()


def test_a_run_holds_its_scene_from_its_reconstruction_to_its_motion(work):
    """Between the two it was free, and what somebody changed there was lost."""
    photo, out = work / "photo.png", work / "job" / "scene"
    out.parent.mkdir()
    shutil.copytree(work / "pair", out)
    objects = (ObjectRequest(box=(30, 18, 48, 58)), ObjectRequest(box=(48, 18, 66, 58)))
    options = ReconstructOptions()
    made = Request(photo=photo, objects=objects, options=options)
    record = stamp_to_json(
        _inputs_hash(photo, objects, options, None, None), made, scene_to_json(load_scene(out).model)
    )
    (out / "reconstruct.json").write_text(json.dumps(record))
    refused, said = [], []

    def somebody_else():
        with pytest.raises(InputError) as error:
            load_scene(out).save()
        refused.append(str(error.value))

    def asked():
        # Polled by the first rehearsal of the motion.
        other = threading.Thread(target=somebody_else)
        other.start()
        other.join()
        return True

    request = stages.RunRequest(
        photo=photo, objects=objects, video=work / "v.mp4", work=work / "job",
        reconstruct=dataclasses.replace(options, segmenter="none"),
        choices=stages.Choices(motion=True, frames=True, slow=True),
    )  # fmt: skip
    with pytest.raises(Cancelled):
        stages.photo_to_video(request, said.append, asked)
    assert "up to date" in said[0]["message"]
    assert refused and "in use by another job" in refused[0]


def test_what_was_read_of_two_scenes_or_bakes_is_not_written(work):
    """Another command changes the scene, or bakes anew, while this one reads it."""
    scene, bake = load_scene(work / "pair"), load_bake(work / "whole")
    changed = pytest.raises(InputError, match="pair: was changed by another command")
    with changed, composition_folder(scene, work / "fitted"):
        scene.save()
    assert not (work / "fitted").exists()

    def baked_anew():
        name = next(iter(bake.manifest.files))
        content = (bake.root / name).read_bytes()
        (bake.root / name).unlink()
        (bake.root / name).write_bytes(content)
        return False

    with pytest.raises(InputError, match="whole: was baked anew or freed"):
        pack_bake(bake, out=work / "packed", cancelled=baked_anew)
    assert not (work / "packed").exists()
    with pytest.raises(InputError, match="pair: was changed by another command"):
        export_usd(scene, work / "moving.usda", bake=bake, cancelled=lambda: bool(scene.save()) and False)
    with pytest.raises(InputError, match="whole: was baked anew or freed"):
        export_usd(scene, work / "moving.usda", bake=bake, cancelled=baked_anew)
    assert not (work / "moving.usda").exists()


def test_a_bake_that_goes_on_may_be_read(work):
    bake = load_bake(work / "whole")
    with unchanged_bake(bake) as require:
        save_manifest(bake.root, dataclasses.replace(bake.manifest, state="running"))
        require()


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
