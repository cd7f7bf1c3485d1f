# SPDX-License-Identifier: MIT
"""Killed at any moment, a command loses nothing, and the next one clears away what it left, and nothing else."""

import ctypes
import errno
import fcntl
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from physgen.batch.cli import main
from physgen.sim import atomic, files, processes
from physgen.sim.errors import InputError
from physgen.sim.folder_lock import lock_beside
from physgen.sim.processes import Mark, own_mark, parse_mark
from physgen.sim.scene.folder import load_scene

HERE = Path(__file__).parent


def kill_points(scenario, folder, points):
    command = [sys.executable, str(HERE / "kill_points.py"), scenario, str(folder), points]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "least"), [("correct", 60), ("journal", 60)])
def test_killed_before_some_calls_a_correction_loses_nothing(tmp_path, scenario, least):
    found = kill_points(scenario, tmp_path, "5:1000:33" if scenario == "correct" else "88:1000:7")
    assert found["wrong"] == [] and found["calls"] >= least and found["points"] >= 2


@pytest.mark.long
def test_a_reconstruction_killed_before_some_calls_loses_nothing(tmp_path):
    found = kill_points("reconstruct", tmp_path, "3:1000:29")
    assert found["wrong"] == [] and found["points"] >= 3


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["correct", "journal", "reconstruct", "light", "variant"])
def test_killed_before_any_call_nothing_is_lost(tmp_path, scenario):
    found = kill_points(scenario, tmp_path, "1:100000:1")
    assert found["wrong"] == [] and found["points"] == found["calls"] > 5


@pytest.mark.long
def test_a_bake_killed_before_some_calls_goes_on_to_the_same_bytes(tmp_path):
    found = kill_points("bake", tmp_path, "3:1000:9")
    assert found["wrong"] == [] and found["points"] >= 3


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "least"), [("compose", 20), ("pack", 20), ("collect", 10)])
def test_what_others_write_is_whole_or_not_there_at_whichever_call_they_are_killed(tmp_path, scenario, least):
    found = kill_points(scenario, tmp_path, "1:1000:1" if scenario != "compose" else "2:1000:3")
    assert found["wrong"] == [] and found["calls"] >= least and found["points"] >= least // 3


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "points"), [("diagnose", "1:1000:6"), ("explain", "2:1000:12"), ("batch", "1:99:4")]
)
def test_reports_and_tasks_of_a_farm_are_whole_or_not_there_at_whichever_call_they_are_killed(
    tmp_path, scenario, points
):
    found = kill_points(scenario, tmp_path, points)
    assert found["wrong"] == [] and found["calls"] >= 10 and found["points"] >= 3


@pytest.mark.long
def test_a_render_killed_at_any_call_goes_on_to_the_same_frames(tmp_path):
    found = kill_points("frames", tmp_path, "1:1000:1")
    assert found["wrong"] == [] and found["points"] >= 20


@pytest.fixture
def dead():
    """The mark of a process that has ended."""
    command = "from physgen.sim.processes import own_mark; print(own_mark())"
    said = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True).stdout
    mark = parse_mark(said.strip())
    assert mark.is_here and mark.is_dead
    return mark


@pytest.fixture
def living():
    """The mark of a process that runs."""
    command = "from physgen.sim.processes import own_mark; print(own_mark(), flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", command], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        mark = parse_mark(process.stdout.readline().decode().strip())
        assert mark.pid == process.pid and not mark.is_dead
        yield mark
        process.kill()


def test_a_mark_is_of_one_process_only(dead, living):
    # The number is used again, by a process that started at another time.
    assert Mark(living.pid, dead.started, dead.machine).is_dead
    assert not Mark(living.pid, "0", dead.machine).is_dead
    assert not Mark(dead.pid, dead.started, "00000000").is_dead
    assert not own_mark().is_dead and parse_mark("1-2") is None


def test_the_next_command_clears_away_what_a_dead_one_left_and_nothing_else(
    tmp_path, dead, living, ball_scene, capsys, monkeypatch
):
    root = ball_scene().root
    other = Mark(dead.pid, dead.started, "00000000")
    gone = [
        root / f".scene.partial-{dead}.json",
        root / "meshes" / f".ball0.partial-{dead}.glb",
        tmp_path / f".scene.partial-{dead}" / "meshes",
        tmp_path / f"..scene.partial-{dead}.partial-{dead}" / "meshes",
        tmp_path / f".scene.old-{dead}" / "meshes",
        # Locks of folders that were being written, which their scenes are saved under.
        tmp_path / f"..scene.partial-{dead}.lock",
        tmp_path / f"..scene.old-{dead}.lock",
        tmp_path / f"...scene.partial-{dead}.partial-{dead}.lock",
    ]
    kept = [
        tmp_path / f"..scene.partial-{living}.lock",
        tmp_path / f"..scene2.partial-{dead}.lock",
        root / f".scene.partial-{living}.json",
        root / f".scene.partial-{other}.json",
        root / f".scene.partial-{dead.pid}.json",
        root / ".notes",
        tmp_path / f".scene2.partial-{dead}",
        tmp_path / f".scene.partial-{living}",
        tmp_path / "my.partial-1",
        tmp_path / f"scene.partial-{dead}",
    ]
    for path in (*gone, *kept):
        path.mkdir(parents=True) if not path.suffix or "-" in path.suffix else path.write_text("half")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("mine")
    (root / f".link.partial-{dead}").symlink_to(outside)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    assert main(["estimate", str(root), "--frames", "2"]) == 0
    said = capsys.readouterr().out
    assert not any(path.exists() for path in gone) and all(path.exists() for path in kept)
    assert not (root / f".link.partial-{dead}").is_symlink() and (outside / "precious").read_text() == "mine"
    assert said.count("removed, left by a run that was killed") == len(gone) + 1


def test_what_a_library_writes_in_place_of_a_temporary_file_is_cleared_away(tmp_path, dead, living, monkeypatch):
    """usd-core writes x.usda as x.AbC123 first."""
    gone = tmp_path / f".toy.partial-{dead}.lRQV0C"
    names = [
        f".toy.partial-{living}.lRQV0C",
        f".toy.partial-{dead}.short",
        f".cup.partial-{dead}.lRQV0C",
        ".toy.lRQV0C",
    ]
    kept = [tmp_path / name for name in (*names, f".toy.old-{dead}.lRQV0C")]
    for path in (gone, *kept):
        path.write_text("half")
    assert len(atomic.recover(tmp_path / "toy.usda")) == 1
    assert not gone.exists() and all(path.exists() for path in kept)
    # An exit that skips finally blocks removes its own.
    monkeypatch.setattr(atomic, "_unfinished", set())
    with atomic.replacing(tmp_path / "toy.usda") as partial:
        mine = partial.with_suffix(".a1B2c3")
        mine.write_text("half")
        partial.write_text("whole")
        atomic.remove_unfinished()
        assert not mine.exists() and all(path.exists() for path in kept)
        partial.write_text("whole")


def test_a_folder_that_was_moved_aside_is_put_back(tmp_path, dead, ball_scene):
    root = ball_scene().root
    content = (root / "scene.json").read_bytes()
    root.rename(tmp_path / f".scene.old-{dead}")
    (tmp_path / f".scene.partial-{dead}").mkdir()
    # Whoever asks for it first, command or script, finds it again.
    assert load_scene(root).root == root and (root / "scene.json").read_bytes() == content
    assert not (tmp_path / f".scene.partial-{dead}").exists()


def test_temporary_folders_of_dead_processes_are_removed(tmp_path, dead, living):
    names = [f"physgen-{dead}-x1", f"physgen-mesh-{dead}-x2"]
    # A child that outlives its parent for a moment has its own folder in the parent's.
    kept = [f"physgen-{living}-x3", f"physgen-{dead}-x4", "physgen-abc", f"other-{dead}-x", f"physgen-{dead.pid}-x"]
    for name in (*names, *kept):
        (tmp_path / name / "deep").mkdir(parents=True)
    (tmp_path / f"physgen-{dead}-x4" / f"physgen-{living}-x").mkdir()
    assert len(atomic.recover_scratch(tmp_path)) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)


def test_a_command_removes_those_among_the_systems_temporary_files(tmp_path, dead, monkeypatch, capsys):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / f"physgen-{dead}-x1"
    (left / "deep").mkdir(parents=True)
    (tmp_path / "letter").touch()
    assert main(["effects", "wind"]) == 0
    assert f"{left}: removed, left by a run that was killed" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["letter"]


def test_all_temporary_files_of_a_command_and_its_children_lie_in_one_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with atomic.own_scratch() as folder:
        assert parse_mark(folder.name.removeprefix("physgen-").rpartition("-")[0]) == own_mark()
        assert Path(tempfile.mkdtemp()).parent == folder
        command = [sys.executable, "-c", "import tempfile; print(tempfile.gettempdir())"]
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == str(folder)
    assert not list(tmp_path.iterdir()) and tempfile.gettempdir() == str(tmp_path)


def test_of_two_reconstructs_into_one_folder_the_second_is_refused_by_name(tmp_path, ball_scene, capsys):
    root = ball_scene().root
    code = f"""
from pathlib import Path
from physgen.sim.folder_lock import lock_beside
with lock_beside(Path({str(root)!r})):
    print("held", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        given = ["--box", "5,5,30,30", "--out", str(root)]
        assert main(["reconstruct", str(root / "photo.png"), *given]) == 3
        assert f"scene: in use by process {first.pid}" in capsys.readouterr().err
        first.kill()
    with lock_beside(root):
        pass
    assert not (tmp_path / ".scene.lock").exists()


def test_a_replaced_folder_is_whole_at_every_moment(tmp_path, monkeypatch):
    """With an exchange there is no moment without it; a failure leaves the earlier one."""
    out = tmp_path / "scene"
    out.mkdir()
    (out / "old").touch()
    seen = []
    monkeypatch.setattr(atomic, "to_disk", lambda path: seen.append((out / "old").exists() or (out / "new").exists()))
    with atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert all(seen) and [path.name for path in out.iterdir()] == ["new"]
    with pytest.raises(InputError), atomic.replacing_tree(out):
        raise InputError("no")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM, None])
def test_where_the_system_has_no_exchange_the_earlier_folder_is_moved_aside(tmp_path, monkeypatch, number):
    """Old kernels, NFS, FAT and Windows: the call is refused, or is not there at all."""

    class Library:
        if number is not None:

            def renameat2(self, *given):
                ctypes.set_errno(number)
                return -1

    monkeypatch.setattr(atomic.ctypes, "CDLL", lambda *given, **options: Library())
    out = tmp_path / "scene"
    out.mkdir()
    (out / "old").touch()
    with atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert [path.name for path in out.iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_folder_that_windows_holds_for_a_moment_is_replaced_all_the_same(tmp_path, monkeypatch):
    """There, nothing that another program is reading can be renamed, nor a folder with such a file."""
    refused = []

    def replace(path, target, former=Path.replace):
        if refused.count((path, target)) < 2:
            refused.append((path, target))
            raise PermissionError(errno.EACCES, "in use", str(path))
        return former(path, target)

    monkeypatch.setattr(atomic, "_exchange", lambda first, second: False)
    monkeypatch.setattr(atomic, "WINDOWS_PAUSES", (0.0, 0.0, 0.0))
    monkeypatch.setattr(Path, "replace", replace)
    out = tmp_path / "scene"
    out.mkdir()
    (out / "old").touch()
    with pytest.raises(PermissionError), atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert [path.name for path in out.iterdir()] == ["old"], "other systems refuse for good"
    refused.clear()
    monkeypatch.setattr(atomic, "_PATIENT", True)
    with atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert [path.name for path in out.iterdir()] == ["new"] and len(refused) == 4
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_what_counts_is_on_the_disk_before_on_windows_too(tmp_path, monkeypatch):
    """Windows writes out no file that was opened for reading, and opens no folder."""
    synced = []

    def opened(path, flags, *given, former=os.open):
        if Path(path).is_dir() and not flags & os.O_CREAT:
            raise PermissionError(errno.EACCES, "a folder", str(path))
        return former(path, flags, *given)

    def fsync(file):
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "not open for writing")
        synced.append(Path(f"/proc/self/fd/{file}").readlink().name)

    monkeypatch.setattr(files, "_SYNC_FLAGS", os.O_RDWR)
    monkeypatch.setattr(files.os, "open", opened)
    monkeypatch.setattr(files.os, "fsync", fsync)
    with atomic.replacing_tree(tmp_path / "scene") as partial:
        (partial / "a.json").write_text("a")
    atomic.write_bytes(tmp_path / "b.json", b"b")
    assert synced[0] == "a.json" and synced[1].startswith(".b.partial-") and len(synced) == 2


def test_a_disk_that_fails_at_the_end_leaves_the_earlier_folder(tmp_path, monkeypatch):
    def fsync(file):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files.os, "fsync", fsync)
    out = tmp_path / "scene"
    out.mkdir()
    (out / "old").touch()
    with pytest.raises(OSError, match="Input/output error"), atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert [path.name for path in out.iterdir()] == ["old"] and len(list(tmp_path.iterdir())) == 1


def test_two_machines_of_one_name_are_two(tmp_path, monkeypatch):
    """On a disk that they share, each would take the other's living processes for dead ones of its own."""
    marks = []
    for number in ("1f", "2e", ""):
        place = tmp_path / f"machine-id-{number}"
        place.write_text(f"{number}\n")
        monkeypatch.setattr(processes, "MACHINE_IDS", (tmp_path / "none", place))
        processes._machine.cache_clear()
        marks.append(processes._machine())
    processes._machine.cache_clear()
    assert len(set(marks)) == 3 and all(re.fullmatch("[0-9a-f]{8}", mark) for mark in marks)


def test_an_exchange_that_fails_for_another_reason_leaves_the_earlier_folder(tmp_path, monkeypatch):
    class Library:
        def renameat2(self, *given):
            ctypes.set_errno(errno.EIO)
            return -1

    monkeypatch.setattr(atomic.ctypes, "CDLL", lambda *given, **options: Library())
    out = tmp_path / "scene"
    out.mkdir()
    (out / "old").touch()
    with pytest.raises(OSError, match="Input/output error"), atomic.replacing_tree(out) as partial:
        (partial / "new").touch()
    assert [path.name for path in out.iterdir()] == ["old"] and len(list(tmp_path.iterdir())) == 1
