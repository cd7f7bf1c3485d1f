# SPDX-License-Identifier: MIT
"""Bake folders on a disk: what they take, finding them, and deleting what a manifest lists and nothing else."""

import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import (
    BakedObject,
    disk_usage,
    free_bake,
    load_bake,
    load_manifest,
    remove_leftovers,
    save_manifest,
)
from physgen.sim.cache.pc2 import Pc2Reader, Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.folder_lock import folder_lock

from ..conftest import complete_manifest

SAND = BakedObject(name="sand", file="sand.pc2", vertices=4, space="mesh", points_file="sand.points.pc2", points=9)


def a_bake(folder, **changes):
    """A folder as a cancelled bake leaves it."""
    folder.mkdir(parents=True, exist_ok=True)
    cancelled = {"frames_done": 1, "state": "cancelled", "engine": "mls-mpm/cpu", "particles": 9}
    cup = BakedObject(name="cup", file="cup.pc2", vertices=2)
    manifest = complete_manifest(SAND, cup, **{**cancelled, **changes})
    for name, count in manifest.files.items():
        with Pc2Writer(folder / name, vertex_count=count) as writer:
            writer.append(np.zeros((count, 3)))
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "state.npz").write_bytes(b"state")
    (folder / "metrics.json").write_text("{}")
    save_manifest(folder, manifest)
    return folder


def test_a_manifest_says_space_and_points_and_old_ones_say_neither(tmp_path):
    bake = a_bake(tmp_path / "bake")
    assert load_manifest(bake).objects[0] == SAND
    assert load_manifest(bake).files == {"sand.pc2": 4, "sand.points.pc2": 9, "cup.pc2": 2}
    old = json.loads((bake / "manifest.json").read_text())
    for item in old["objects"]:
        for name in ("space", "points_file", "points"):
            del item[name]
    (bake / "manifest.json").write_text(json.dumps(old))
    first = load_manifest(bake).objects[0]
    assert (first.space, first.points_file, first.points) == ("world", None, 0)
    old["objects"][0]["points_file"] = "../elsewhere.pc2"
    old["objects"][0]["points"] = 3
    (bake / "manifest.json").write_text(json.dumps(old))
    with pytest.raises(InputError, match="elsewhere"):
        load_manifest(bake)
    for changes in ({"space": "camera"}, {"points": 3}, {"points_file": "a.pc2"}):
        with pytest.raises(InputError, match="object cup"):
            BakedObject(**{"name": "cup", "file": "cup.pc2", "vertices": 2, **changes})


def test_a_bake_prints_as_one_line(tmp_path):
    folder = a_bake(tmp_path / "bake")
    assert repr(load_bake(folder)) == f"Bake(root={str(folder)!r}, frames 1 to 1)"


def test_reported_size_equals_freed_size(tmp_path):
    bake = a_bake(tmp_path / "bake")
    files = [p for p in bake.rglob("*") if p.is_file()]
    assert disk_usage(bake) == sum(p.stat().st_size for p in files) > 3 * 32
    assert free_bake(bake) > 0
    assert not bake.exists() and tmp_path.is_dir()
    with pytest.raises(InputError, match="no bake there"):
        free_bake(bake)


def test_unlisted_files_are_kept(tmp_path):
    bake = a_bake(tmp_path / "bake")
    (bake / "thesis.txt").write_text("years of work")
    (bake / "checkpoints" / "mine.npz").write_text("mine")
    free_bake(bake)
    assert sorted(p.relative_to(bake).as_posix() for p in bake.rglob("*")) == [
        "checkpoints",
        "checkpoints/mine.npz",
        "thesis.txt",
    ]


def test_nothing_is_deleted_through_a_link(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "state.npz").write_text("somebody else's")
    bake = a_bake(tmp_path / "bake")
    (bake / "checkpoints" / "state.npz").unlink()
    (bake / "checkpoints").rmdir()
    (bake / "checkpoints").symlink_to(elsewhere)
    (tmp_path / "shortcut").symlink_to(bake)
    with pytest.raises(InputError, match="is a link"):
        free_bake(tmp_path / "shortcut")
    free_bake(bake)
    assert (elsewhere / "state.npz").read_text() == "somebody else's"
    # A cache that leads out of the folder: the manifest is refused as it stands.
    outside = tmp_path / "outside.pc2"
    outside.write_text("somebody else's")
    other = a_bake(tmp_path / "other")
    (other / "cup.pc2").unlink()
    (other / "cup.pc2").symlink_to(outside)
    with pytest.raises(InputError, match="leads out"):
        free_bake(other)
    assert outside.exists() and (other / "sand.pc2").exists()


def test_a_folder_that_was_made_for_nothing_goes_again(tmp_path):
    """As of a bake that is refused for lack of memory."""
    new, there, full = tmp_path / "new", tmp_path / "there", tmp_path / "full"
    there.mkdir()
    for folder in (new, there, full):
        with pytest.raises(InputError, match="refused"), folder_lock(folder):
            if folder == full:
                (folder / "a.pc2").write_text("")
            raise InputError("refused")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["full", "there"]


def test_a_bake_that_runs_is_not_freed(tmp_path):
    bake = a_bake(tmp_path / "bake", state="running")
    code = textwrap.dedent(f"""
        import sys
        from pathlib import Path
        from physgen.sim.folder_lock import folder_lock
        with folder_lock(Path({str(bake)!r})):
            print("held", flush=True)
            sys.stdin.read()
    """)
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    before = sorted(p.name for p in bake.iterdir())
    with pytest.raises(InputError, match=f"in use by process {process.pid}"):
        free_bake(bake)
    assert sorted(p.name for p in bake.iterdir()) == before
    # Killed, it leaves its lock; that of a dead process holds nobody up.
    process.kill()
    process.communicate()
    assert (bake / ".lock").exists()
    free_bake(bake)
    assert not bake.exists()


def test_undeletable_files_are_named_and_freed_later(tmp_path):
    bake = a_bake(tmp_path / "bake")
    (bake / "sand.points.pc2").unlink()
    (bake / "sand.points.pc2").mkdir()
    with pytest.raises(InputError, match=r"sand\.points\.pc2: cannot be deleted"):
        free_bake(bake)
    assert load_manifest(bake).files
    (bake / "sand.points.pc2").rmdir()
    free_bake(bake)
    assert not bake.exists()


def test_half_written_files_of_killed_runs_are_cleared_away(tmp_path):
    bake = a_bake(tmp_path / "bake")
    gone = subprocess.Popen([sys.executable, "-c", "pass"])
    gone.wait()
    leftovers = [
        bake / f".manifest.partial-{gone.pid}.json",
        bake / "checkpoints" / f".state.partial-{gone.pid}.npz",
        bake / f".lock-{gone.pid}-0123abcd",
    ]
    kept = [bake / f".lock-{os.getpid()}-0123abcd", bake / ".notes.partial-1.txt"]
    for path in leftovers + kept:
        path.write_text("half")
    with folder_lock(bake):
        remove_leftovers(bake)
    assert [p.exists() for p in leftovers + kept] == [False, False, False, True, True]
    assert load_manifest(bake).frames == 3


def test_a_reader_survives_a_cache_that_is_cut_short_meanwhile(tmp_path):
    path = tmp_path / "a.pc2"
    with Pc2Writer(path, vertex_count=100_000) as writer:
        for value in range(3):
            writer.append(np.full((100_000, 3), value))
    reader = Pc2Reader(path)
    with Pc2Writer(path, vertex_count=100_000, keep=1):
        pass
    assert reader.sample(0).max() == 0.0
    with pytest.raises(InputError, match="cut off"):
        reader.sample(2)
