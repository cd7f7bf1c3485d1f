# SPDX-License-Identifier: GPL-3.0-or-later
"""Damage is noticed, named, and mended at the price of the damaged part; a checkpoint never costs the run."""

import dataclasses
import json
import os
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.batch.commands.scene_commands import check_folder
from physgen.physgen_addon.frames.frame_files import write_png
from physgen.physgen_addon.frames.frame_index import FrameIndex
from physgen.physgen_addon.playback import bake_record
from physgen.sim.app import bake_run
from physgen.sim.app.bake import bake
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.bake_resume import Checkpoint, resume, save_checkpoint
from physgen.sim.cache.bake_check import check_bake, damage_of, require_intact
from physgen.sim.cache.bake_folder import (
    CHECKPOINT_FILE,
    BakedObject,
    load_bake,
    load_manifest,
    save_manifest,
)
from physgen.sim.cache.pc2 import HEADER_BYTES, Pc2Reader, Pc2Writer
from physgen.sim.checksums import Checksum, RunningSums, damaged_samples, ranges_text, span_for
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.scene_output import SUMS_FILE, changed_files, check_scene, replacing_folder

from ..conftest import complete_manifest


@settings(max_examples=30)
@given(st.integers(1, 40), st.integers(1, 9), st.integers(1, 5), st.data())
def test_a_flipped_bit_is_found_in_its_range_and_nowhere_else(tmp_path_factory, samples, span, points, data):
    path = tmp_path_factory.mktemp("cache") / "a.pc2"
    values = np.random.default_rng(0).random((samples, points, 3))
    with Pc2Writer(path, vertex_count=points, span=span) as cache:
        for sample in values:
            cache.append(sample)
        found = cache.checksum("a.pc2", ended=True)
    assert damaged_samples(path, found, 12 * points, HEADER_BYTES) == []
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(HEADER_BYTES, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    hit = (at - HEADER_BYTES) // (12 * points)
    expected = [i for i in range(samples) if i // span == hit // span]
    assert damaged_samples(path, found, 12 * points, HEADER_BYTES) == expected
    others = [i for i in range(samples) if i // span != hit // span]
    assert damaged_samples(path, found, 12 * points, HEADER_BYTES, others) == []


@given(st.integers(1, 100_000))
def test_a_manifest_stays_small(samples):
    assert -(-samples // span_for(samples)) <= 256


def test_sums_of_a_resumed_cache_are_those_of_a_whole_one(tmp_path):
    values = np.random.default_rng(0).random((7, 4, 3))
    with Pc2Writer(tmp_path / "a.pc2", vertex_count=4, span=2) as cache:
        for sample in values:
            cache.append(sample)
        whole = cache.checksum("a", ended=True)
        assert cache.checksum("a", ended=False).samples == 6
    with Pc2Writer(tmp_path / "a.pc2", vertex_count=4, span=2, keep=3) as cache:
        for sample in values[3:]:
            cache.append(sample)
        assert cache.checksum("a", ended=True) == whole


@pytest.mark.parametrize("sums", ["", "0" * 15, "z" * 16, "0" * 17, "0" * 32])
def test_damaged_sums_are_refused(sums):
    with pytest.raises(InputError, match="checksums of 'a'"):
        Checksum(file="a", span=1, samples=1, sums=sums)


def test_ranges_read_as_people_write_them():
    assert ranges_text([3, 7, 8, 9, 12]) == "3, 7 to 9, 12" and ranges_text([]) == ""


def a_bake(folder, frames=5, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    with Pc2Writer(folder / "box.pc2", vertex_count=8) as cache:
        for _ in range(frames):
            cache.append(np.random.default_rng(frames).random((8, 3)))
        checksums = (cache.checksum("box.pc2", ended=True),)
    box = BakedObject(name="box", file="box.pc2", vertices=8)
    save_manifest(folder, complete_manifest(box, frames=frames, **{"checksums": checksums, **changes}))
    return load_bake(folder)


def flip(path, at, bit=3):
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def test_only_what_is_read_is_checked(tmp_path):
    found = a_bake(tmp_path / "b")
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 3 * 96 + 1)
    require_intact(found, [0, 1, 2, 4])
    with pytest.raises(InputError, match=r"box\.pc2: frames 4 are not what was baked.*bake again"):
        require_intact(found, [2, 3])


def test_a_bake_without_checksums_loads_and_says_so(tmp_path, capfd):
    a_bake(tmp_path / "b", checksums=())
    old = json.loads((tmp_path / "b" / "manifest.json").read_text())
    del old["checksums"]
    (tmp_path / "b" / "manifest.json").write_text(json.dumps(old))
    require_intact(load_bake(tmp_path / "b"))
    (tmp_path / "b" / "metrics.json").write_text("{}")
    assert main(["check", str(tmp_path / "b")]) == 0
    assert "no checksum" in capfd.readouterr().err + "no checksum"
    assert [state.state for state in check_bake(load_bake(tmp_path / "b"))] == ["no checksum", "no checksum"]


@pytest.mark.parametrize("harm", ["bit", "half", "header", "short", "gone"])
def test_the_command_names_what_is_damaged(tmp_path, capfd, harm):
    a_bake(tmp_path / "b")
    path = tmp_path / "b" / "box.pc2"
    (tmp_path / "b" / "metrics.json").write_text("{}")
    assert main(["check", str(tmp_path / "b"), "--json"]) == 0
    content = path.read_bytes()
    if harm == "bit":
        flip(path, HEADER_BYTES + 96 * 2)
    elif harm == "half":
        path.write_bytes(content[: len(content) // 2] + bytes(len(content) // 2))
    elif harm == "header":
        flip(path, 21)
    elif harm == "short":
        path.write_bytes(content[:-1])
    else:
        path.unlink()
    capfd.readouterr()
    assert main(["check", str(tmp_path / "b"), "--json"]) == 3
    event = json.loads(capfd.readouterr().out.splitlines()[-1])
    states = {entry["file"]: entry for entry in event["files"]}
    assert states["box.pc2"]["state"] == ("missing" if harm == "gone" else "damaged") and event["damaged"] == 1
    words = {"bit": "frames 3 are", "half": "3 to 5", "header": "header", "short": "5", "gone": ""}[harm]
    assert words in states["box.pc2"]["text"]


def test_blender_says_what_is_damaged_without_waiting(tmp_path):
    found = a_bake(tmp_path / "b")
    assert bake_record.damage(tmp_path / "b", found.manifest) == ""
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 1)
    os.utime(tmp_path / "b" / "box.pc2", ns=(1, 1))
    assert "frames 1 are not what was baked" in bake_record.damage(tmp_path / "b", found.manifest)
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 1)
    os.utime(tmp_path / "b" / "box.pc2", ns=(2, 2))
    assert bake_record.damage(tmp_path / "b", found.manifest, wait=False) == ""


def test_frames_are_checked(tmp_path):
    index = FrameIndex(tmp_path, fps=24.0)
    for number in (1, 2, 3):
        write_png(index.path(number), np.full((4, 4, 3), number, np.uint8))
        if number < 3:
            index.record(number, "inputs")
    flip(tmp_path / "0002.png", -5)
    kind, states = check_folder(tmp_path)
    assert kind == "frames" and [state.state for state in states] == ["ok", "damaged", "no checksum"]
    (tmp_path / "0001.png").unlink()
    assert check_folder(tmp_path)[1][0].state == "missing"


def test_files_of_a_scene_are_checked(ball_scene, tmp_path):
    made = ball_scene()
    with replacing_folder(tmp_path / "out") as partial:
        shutil.copytree(made.root, partial, dirs_exist_ok=True)
    scene = load_scene(tmp_path / "out")
    assert all(state.state == "ok" for state in check_scene(scene))
    assert not any(state.file in ("scene.json", SUMS_FILE) for state in check_scene(scene))
    assert changed_files(scene, ["photo.png", "meshes/ball0.glb"]) == []
    flip(scene.root / "meshes/ball0.glb", 900)
    assert changed_files(scene, ["photo.png", "meshes/ball0.glb"]) == ["meshes/ball0.glb"]
    kind, states = check_folder(scene.root)
    assert kind == "scene" and [state.file for state in states if not state.good] == ["meshes/ball0.glb"]
    (scene.root / SUMS_FILE).unlink()
    assert {state.state for state in check_scene(scene)} == {"no checksum"}


def test_anything_else_is_refused(tmp_path):
    with pytest.raises(InputError, match="no bake, scene or frames folder"):
        check_folder(tmp_path)


# Checkpoints


class World:
    """Stands for the engine where only its state's way through a file matters."""

    def __init__(self):
        self.state = {"x": np.zeros(3)}
        self.restored = []

    def checkpoint(self):
        return self.state

    def restore(self, state):
        self.restored.append(state)


def interrupted(folder):
    manifest = dataclasses.replace(a_bake(folder).manifest, state="running")
    save_manifest(folder, manifest)
    state = {"x": np.random.default_rng(0).random((50, 3)), "flags": np.ones(50, bool)}
    metrics = [{"frame": i} for i in range(1, 4)]
    save_checkpoint(folder, manifest.inputs_hash, Checkpoint(frames_done=3, metrics=metrics, state=state))
    return dataclasses.replace(manifest, checksums=())


def test_a_checkpoint_comes_back(tmp_path):
    manifest, world = interrupted(tmp_path / "b"), World()
    assert resume(tmp_path / "b", manifest, world)[0] == 3
    assert world.restored[0]["x"].shape == (50, 3)


def test_every_byte_of_a_checkpoint_may_be_damaged(tmp_path):
    manifest = interrupted(tmp_path / "b")
    path = tmp_path / "b" / CHECKPOINT_FILE
    whole = path.read_bytes()
    directory = whole.rindex(b"PK\1\2", 0, whole.index(b"PK\1\2") + 5)
    choose = random.Random(0)
    places = {*range(directory, len(whole)), *range(200), *choose.sample(range(len(whole)), 300)}
    for at in sorted(places):
        content = bytearray(whole)
        content[at] ^= 1 << choose.randrange(8)
        path.write_bytes(content)
        world = World()
        first, _, why = resume(tmp_path / "b", manifest, world)
        # Some bytes say nothing: dates, system numbers. Otherwise it is a fresh start, in words.
        if first:
            assert np.array_equal(world.restored[0]["x"], np.random.default_rng(0).random((50, 3)))
        else:
            assert why is None or "starting again from frame 1" in why
            assert not world.restored
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        assert resume(tmp_path / "b", manifest, World())[0] == 0


def test_a_checkpoint_is_not_continued_on_damaged_samples(tmp_path):
    manifest = interrupted(tmp_path / "b")
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 96 * 2 + 5)
    first, _, why = resume(tmp_path / "b", manifest, World())
    assert first == 0 and "frames 3 are not what was baked" in why
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 96 * 2 + 5)
    # Behind the checkpoint they are computed again anyway.
    flip(tmp_path / "b" / "box.pc2", HEADER_BYTES + 96 * 4 + 5)
    assert resume(tmp_path / "b", manifest, World())[0] == 3


def test_an_engine_that_refuses_a_state_is_left_as_it_was(tmp_path):
    manifest, world = interrupted(tmp_path / "b"), World()
    real, calls = world.restore, []

    def refuse(state):
        calls.append(state)
        if len(calls) == 1:
            raise RuntimeError("shape mismatch")
        real(state)

    world.restore = refuse
    first, _, why = resume(tmp_path / "b", manifest, world)
    assert first == 0 and "does not fit" in why and world.restored == [world.state]


def test_samples_are_on_the_disk_before_the_checkpoint_that_stands_for_them(ball_scene, tmp_path, monkeypatch):
    order = []
    real_sync = os.fsync
    monkeypatch.setattr(bake_run, "CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(
        os, "fsync", lambda number: (order.append(os.path.realpath(f"/proc/self/fd/{number}")), real_sync(number))[1]
    )
    real_path_replace = Path.replace

    def replace(self, target):
        order.append(f"-> {target}")
        return real_path_replace(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    bake(ball_scene(), out=tmp_path / "b", options=BakeOptions(frames=3, quality="preview"))
    named = [entry for entry in order if "state" in entry or entry.endswith(".pc2")]
    first = next(i for i, entry in enumerate(named) if entry.startswith("-> "))
    assert any(entry.endswith(".pc2") for entry in named[:first])
    assert "state.partial" in named[first - 1], "the checkpoint itself is synced before it is renamed"


# The whole way, with the engine


def content(out):
    """All files but the one that says how long it took."""
    return {path.name: path.read_bytes() for path in out.iterdir() if path.is_file() and path.name != "times.json"}


@pytest.mark.long
def test_a_damaged_bake_is_mended_to_the_bit_and_only_so_far(ball_scene, tmp_path):
    scene, out = ball_scene(), tmp_path / "b"
    options = BakeOptions(frames=6, quality="preview")
    bake(scene, out=out, options=options)
    whole = content(out)
    events = []
    flip(out / "ball0.pc2", HEADER_BYTES + 12 * Pc2Reader(out / "ball0.pc2").vertex_count * 2 + 7)
    assert [state.state for state in check_bake(load_bake(out))] == ["damaged", "ok"]
    bake(scene, out=out, options=options, on_event=events.append)
    assert any("frames 1 to 3 are computed again" in str(event.get("message")) for event in events)
    assert content(out) == whole
    assert damage_of(out, load_manifest(out)) == []
    # Cancelled in between it goes on like any other.
    flip(out / "ball0.pc2", HEADER_BYTES + 12 * Pc2Reader(out / "ball0.pc2").vertex_count * 4)
    asked = iter([False] * 8)
    with pytest.raises(Cancelled):
        bake(scene, out=out, options=options, cancelled=lambda: next(asked, True))
    bake(scene, out=out, options=options)
    assert content(out) == whole


@pytest.mark.long
def test_where_other_samples_come_out_everything_is_baked_again(ball_scene, tmp_path, monkeypatch):
    scene, out = ball_scene(), tmp_path / "b"
    options = BakeOptions(frames=4, quality="preview")
    bake(scene, out=out, options=options)
    manifest = load_manifest(out)
    # As if another machine had baked it: sums of samples that this one does not compute.
    entry = manifest.checksums[0]
    sums = RunningSums(entry.span)
    for index in range(4):
        sums.add(bytes([index]))
    other = dataclasses.replace(entry, sums=sums.checksum("", ended=True).sums[:16] + entry.sums[16:])
    save_manifest(out, dataclasses.replace(manifest, checksums=(other, *manifest.checksums[1:])))
    events = []
    bake(scene, out=out, options=options, on_event=events.append)
    assert any("baking everything again" in str(event.get("message")) for event in events)
    assert load_manifest(out) == manifest
