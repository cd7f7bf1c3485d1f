# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking from Blender with a real worker: what is found, shown, out of date, moved, freed."""

import json
import os
import shutil
import signal
import stat
import time
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from mathutils import Matrix
from physgen.physgen_addon import background_jobs, bake_state, overlays, paths, unsaved_bakes
from physgen.physgen_addon.bake_state import BakeState
from physgen.physgen_addon.operators.bake_ops import Bake
from physgen.physgen_addon.playback import bake_record, point_caches, show_bake
from physgen.sim.cache.bake_folder import load_manifest
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import InputError

FRAMES = 5
START = 3
"""Blender's frame of sample 0."""


pytestmark = pytest.mark.usefixtures("addon")


def a_scene(frames=FRAMES, law="rigid"):
    """A small cube above the ground, the same every time."""
    bpy.ops.mesh.primitive_cube_add(size=0.1)
    item = bpy.context.object
    item.data.transform(Matrix.Translation((0, 0, 0.3)))
    item.physgen.enabled = True
    item.physgen.material.law = law
    scene = bpy.context.scene
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", START, START + frames - 1
    return scene


def save(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def corner(frame, name="Cube"):
    """The first vertex of the evaluated mesh at ``frame``."""
    bpy.context.scene.frame_set(frame)
    item = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array(item.data.vertices[0].co)


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A .blend in a folder with blanks and accents, baked once by the operator; its folder."""
    folder = tmp_path_factory.mktemp("file") / "Würfel auf Boden"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    physgen.register()
    try:
        a_scene()
        save(folder)
        assert bpy.ops.physgen.bake("EXEC_DEFAULT") == {"FINISHED"}
        bpy.ops.wm.save_mainfile()
    finally:
        physgen.unregister()
    return folder


@pytest.fixture
def file(baked, tmp_path):
    """A copy of it with its caches, open."""
    folder = tmp_path / "Kopie é"
    shutil.copytree(baked, folder)
    bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
    return folder


def scene():
    return bpy.context.scene


def status():
    return bake_state.state(scene()).status


def test_a_bake_plays_what_is_in_its_cache(file):
    found = bake_state.state(scene())
    assert (found.status, found.frames_done, found.frames) == ("baked", FRAMES, FRAMES)
    assert found.disk_bytes > 8 * 12 * FRAMES
    item = bpy.data.objects["Cube"]
    assert item.modifiers[0].name == point_caches.MODIFIER
    assert item.modifiers[0].filepath.startswith("//physgen_cache/Scene/bakes/")
    assert scene().physgen.simulation.bake.startswith("//physgen_cache/Scene/bakes/")
    folder = paths.absolute(scene().physgen.simulation.bake)
    cache = Pc2Reader(folder / "Cube.pc2")
    for index in range(FRAMES):
        assert corner(START + index) == pytest.approx(cache.sample(index)[0])
    assert corner(START)[2] == pytest.approx(0.25) and corner(START + FRAMES - 1)[2] < 0.24
    assert load_manifest(folder).objects[0].space == "mesh"


def test_a_bake_of_another_process_is_looked_at_until_it_ends(file, held_elsewhere):
    folder = paths.absolute(scene().physgen.simulation.bake)
    with held_elsewhere(folder):
        assert bake_state.observe(scene()).status == "baking"
        # Nobody tells when it ends, so the timer has to look again.
        assert bake_state.is_dirty(scene())
    assert bake_state.observe(scene()).status == "baked"
    assert not bake_state.is_dirty(scene())


def test_baking_again_does_nothing_twice(file):
    before = sorted(path.stat().st_mtime_ns for path in file.rglob("*.pc2"))
    assert bpy.ops.physgen.bake("EXEC_DEFAULT") == {"FINISHED"}
    assert sorted(path.stat().st_mtime_ns for path in file.rglob("*.pc2")) == before


def test_a_change_is_out_of_date_and_changing_it_back_is_baked(file):
    item = bpy.data.objects["Cube"]
    density = item.physgen.material.density
    item.physgen.material.density = 321.0
    assert status() == "stale" and "Out of date" in bake_state.state(scene()).message
    assert point_caches.MODIFIER in item.modifiers
    item.physgen.material.density = density
    assert status() == "baked"


def test_own_modifiers_stay_behind_the_cache(file):
    item = bpy.data.objects["Cube"]
    item.modifiers.clear()
    item.modifiers.new("Bevel", "BEVEL")
    show_bake.show(scene(), bake_state.shown_record(scene()))
    assert [modifier.name for modifier in item.modifiers] == [point_caches.MODIFIER, "Bevel"]


def test_undo_and_redo_never_lose_a_bake(file):
    bpy.ops.ed.undo_push(message="baked")
    bpy.data.objects["Cube"].physgen.velocity = (1.0, 0.0, 0.0)
    bpy.ops.ed.undo_push(message="changed")
    assert status() == "stale"
    bpy.ops.ed.undo()
    assert status() == "baked"
    bpy.ops.ed.redo()
    assert status() == "stale"
    bpy.ops.ed.undo()
    assert status() == "baked" and corner(START + 4)[2] < 0.24


def test_undoing_a_bake_keeps_it(baked, tmp_path):
    a_scene()
    save(tmp_path / "other")
    bpy.ops.ed.undo_push(message="before")
    assert status() == "none"
    shutil.copytree(baked / "physgen_cache", tmp_path / "other" / "physgen_cache")
    assert bake_state.refresh(scene()).status == "baked"
    bpy.ops.ed.undo_push(message="baked")
    bpy.ops.ed.undo()
    assert status() == "baked" and point_caches.MODIFIER in bpy.data.objects["Cube"].modifiers
    bpy.ops.ed.redo()
    assert status() == "baked"


def test_what_was_undone_during_a_bake_can_be_redone_and_is_baked_then(file):
    show_bake.hide(scene())
    bpy.data.objects["Cube"].physgen.enabled = False
    bpy.ops.ed.undo_push(message="before")
    bpy.data.objects["Cube"].physgen.enabled = True
    bpy.ops.ed.undo_push(message="added")
    live = Live()
    live.begin(bpy.context)
    bpy.ops.ed.undo()
    assert bake_state.state(scene()).status == "baking"
    while (result := live.tick()) is None:
        time.sleep(0.05)
    # A step of undo would end what can be redone.
    assert result == {"CANCELLED"} and "redo it" in live.said[-1][1]
    assert not scene().physgen.simulation.bake and status() == "none"
    bpy.ops.ed.redo()
    assert status() == "baked" and point_caches.MODIFIER in bpy.data.objects["Cube"].modifiers


def test_a_file_that_moves_with_its_caches_plays_and_one_without_says_so(file, tmp_path):
    other = tmp_path / "alone"
    other.mkdir()
    shutil.copy(file / "scene.blend", other)
    bpy.ops.wm.open_mainfile(filepath=str(other / "scene.blend"))
    assert status() == "missing"
    with pytest.raises(RuntimeError, match="is not in there"):
        bpy.ops.physgen.relink_caches(directory=str(other))
    assert bpy.ops.physgen.relink_caches(directory=str(file / "physgen_cache")) == {"FINISHED"}
    assert status() == "baked" and corner(START + 4)[2] < 0.24
    assert ".." in scene().physgen.simulation.bake


def test_saving_elsewhere_keeps_playing(file, tmp_path):
    save(tmp_path / "elsewhere" / "deep")
    assert status() == "baked" and corner(START + 4)[2] < 0.24
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "elsewhere" / "deep" / "scene.blend"))
    assert status() == "baked" and corner(START + 4)[2] < 0.24


def test_saving_a_copy_leaves_this_file_as_it_is_and_the_copy_plays(file, tmp_path):
    before = scene().physgen.simulation.bake
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), copy=True)
    assert scene().physgen.simulation.bake == before and status() == "baked"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "copy.blend"))
    assert status() == "baked" and corner(START + 4)[2] < 0.24


def test_bakes_of_an_unsaved_file_wait_and_come_along_when_it_is_saved(baked, tmp_path):
    found = a_scene()
    found.physgen.simulation.unsaved = paths.unsaved_key()
    waiting = paths.scene_cache(found)
    assert not waiting.is_relative_to(bpy.app.tempdir)
    shutil.copytree(baked / "physgen_cache" / "Scene", waiting)
    assert bake_state.refresh(found).status == "baked"
    assert Path(found.physgen.simulation.bake).is_absolute()
    save(tmp_path / "first save")
    assert not waiting.exists()
    assert found.physgen.simulation.bake.startswith("//physgen_cache/Scene/bakes/")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "first save" / "scene.blend"))
    assert bpy.data.objects["Cube"].modifiers[0].filepath.startswith("//physgen_cache/")
    assert status() == "baked" and corner(START + 4)[2] < 0.24


@pytest.mark.parametrize("key", ["../../elsewhere", "{elsewhere}", "0123456789ab/.."])
def test_a_file_from_somebody_else_cannot_say_what_is_moved_and_deleted(file, tmp_path, key):
    victim = tmp_path / "elsewhere" / scene().name
    victim.mkdir(parents=True)
    scene().physgen.simulation.unsaved = key.format(elsewhere=tmp_path / "elsewhere")
    assert paths.unsaved_cache(scene(), scene().physgen.simulation.unsaved) is None
    unsaved_bakes.settle(scene())
    assert victim.is_dir()


def test_bakes_of_unsaved_files_are_nobody_elses():
    root = paths.unsaved_root()
    root.mkdir(parents=True, exist_ok=True)
    root.chmod(0o777)
    paths.make_unsaved_root()
    assert stat.S_IMODE(root.stat().st_mode) == 0o700
    target = root.with_name("aside")
    root.rename(target)
    try:
        root.symlink_to(target)
        with pytest.raises(InputError, match="belongs to another user"):
            paths.make_unsaved_root()
        root.unlink()
    finally:
        target.rename(root)


def test_a_mesh_that_has_changed_says_so_and_loses_its_cache(file):
    item = bpy.data.objects["Cube"]
    item.data.vertices.add(1)
    found = bake_state.refresh(scene())
    assert found.status == "stale" and "Cube has 9 vertices and its bake 8; bake again" in found.message
    assert point_caches.MODIFIER not in item.modifiers


def test_deleted_and_renamed_objects_are_named(file):
    bpy.data.objects["Cube"].name = "Würfel"
    assert bake_state.refresh(scene()).status == "stale"
    assert corner(START + 4, "Würfel")[2] < 0.24
    bpy.data.objects.remove(bpy.data.objects["Würfel"])
    assert "Cube was baked and is no longer in the scene" in bake_state.refresh(scene()).message


def test_freeing_deletes_what_the_manifest_lists_and_nothing_else(file):
    folder = paths.absolute(scene().physgen.simulation.bake)
    (folder / "mine.txt").write_text("mine")
    assert bpy.ops.physgen.free_bake() == {"FINISHED"}
    assert status() == "none" and not len(bpy.data.objects["Cube"].modifiers)
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]
    assert not bake_record.record_file(folder).exists()
    assert not bpy.ops.physgen.free_bake.poll()


def another_bake(folder: Path) -> Path:
    """A copy of the bake in ``folder``, as of another state of the scene."""
    other = folder.with_name("0123456789ab")
    shutil.copytree(folder, other)
    record = json.loads(bake_record.record_file(folder).read_text())
    bake_record.record_file(other).write_text(json.dumps({**record, "fingerprints": ["another"]}))
    return other


def test_freeing_old_bakes_keeps_the_one_that_is_shown(file):
    folder = paths.absolute(scene().physgen.simulation.bake)
    other = another_bake(folder)
    assert bpy.ops.physgen.free_old_bakes() == {"FINISHED"}
    assert not other.exists() and status() == "baked"


def test_each_bake_is_listed_and_freed_by_itself(file):
    folder = paths.absolute(scene().physgen.simulation.bake)
    other = another_bake(folder)
    listed = bake_state.observe(scene()).bakes
    assert {bake.folder for bake in listed} == {str(folder), str(other)}
    assert all(bake.frames_done == bake.frames == FRAMES and bake.size > 8 * 12 * FRAMES for bake in listed)
    assert sum(bake.size for bake in listed) <= bake_state.state(scene()).disk_bytes
    assert bpy.ops.physgen.free_one_bake(folder=str(other)) == {"FINISHED"}
    assert not other.exists() and status() == "baked"
    with pytest.raises(RuntimeError, match="is no bake of this scene"):
        bpy.ops.physgen.free_one_bake(folder=str(file))
    assert bpy.ops.physgen.free_one_bake(folder=str(folder)) == {"FINISHED"}
    assert not folder.exists() and status() == "none" and file.is_dir()


def test_the_timeline_shows_which_frames_are_cached(file):
    (span,) = overlays.cached_spans(bake_state.state(scene()))
    assert span[:2] == (START - 0.5, START + FRAMES - 0.5) and span[2] == overlays.BAR_COLOURS["baked"]
    bpy.data.objects["Cube"].physgen.material.density *= 2
    (span,) = overlays.cached_spans(bake_state.observe(scene()))
    assert span[2] == overlays.BAR_COLOURS["stale"]
    half = BakeState("paused", 2, 6, frame_start=10)
    assert [part[:2] for part in overlays.cached_spans(half)] == [(9.5, 11.5), (11.5, 15.5)]
    assert overlays.cached_spans(None) == [] == overlays.cached_spans(BakeState("none", 0, 6))


def test_a_first_bake_ends_playback_unless_an_animation_goes_on(baked, file):
    # Of a file whose timeline had Blender's 250 frames.
    assert scene().frame_end == START + FRAMES - 1
    assert bpy.ops.physgen.free_bake() == {"FINISHED"}
    scene().frame_end = 250
    item = bpy.data.objects.new("moving", None)
    item.keyframe_insert("location", frame=100)
    assert bpy.ops.physgen.bake("EXEC_DEFAULT") == {"FINISHED"}
    assert scene().frame_end == 250


def test_two_scenes_of_a_file_keep_to_themselves(file):
    first = scene()
    bpy.ops.scene.new(type="FULL_COPY")
    second = scene()
    assert second != first and paths.scene_cache(first) != paths.scene_cache(second)
    # The copied object has another name, so the bake is not its own; nothing has "changed", though.
    copied = bake_state.state(second)
    assert copied.status == "stale" and copied.advice.startswith("This bake belongs to the scene Scene.")
    second.name = "Zweite"
    assert "belongs to the scene Scene" in bake_state.observe(second).advice
    assert bake_state.state(first).status == "baked"
    with bpy.context.temp_override(scene=second):
        assert bpy.ops.physgen.free_bake() == {"FINISHED"}
    # The files are the first scene's.
    assert bake_state.state(first).status == "baked" and bake_state.state(second).status == "none"
    bpy.data.scenes.remove(second)
    assert bake_state.refresh(first).status == "baked"


def test_baking_reports_why_it_is_impossible(tmp_path):
    with pytest.raises(RuntimeError, match="nothing is simulated yet; select a mesh and press Simulate Selected"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    found = a_scene()
    found.physgen.simulation.frame_end = START
    with pytest.raises(RuntimeError, match="let End come after Start"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    found.physgen.simulation.frame_end = START + 4
    blocked = tmp_path / "file"
    blocked.write_text("")
    found.physgen.simulation.cache = str(blocked)
    with pytest.raises(RuntimeError, match="cannot be made"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_cache_folder_without_permission_is_named(tmp_path):
    found = a_scene()
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    found.physgen.simulation.cache = str(locked)
    with pytest.raises(RuntimeError, match="choose another Cache folder"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")


def test_an_estimate_holds_until_something_changes(tmp_path):
    found = a_scene()
    save(tmp_path)
    assert bpy.ops.physgen.estimate_bake("EXEC_DEFAULT") == {"FINISHED"}
    assert "time steps" in bake_state.state(found).estimate_text
    found.physgen.simulation.frame_end += 10
    assert bake_state.state(found).estimate_text == ""


class Live(Bake):
    """A bake as the modal timer drives it."""

    def __init__(self):
        self.said = []

    def report(self, kind, text):
        self.said.append((*kind, text))

    def run_until(self, reached):
        give_up = time.monotonic() + 120
        while not reached() and time.monotonic() < give_up:
            result = self.tick()
            assert result is None, self.said
            time.sleep(0.05)
        assert reached(), self.said


@pytest.mark.long
def test_a_bake_is_played_stopped_killed_and_goes_on(tmp_path):
    found = a_scene(frames=24, law="fixed_corotated")
    save(tmp_path)
    live = Live()
    job = live.begin(bpy.context)
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    bpy.ops.ed.undo_push(message="before the first frame")
    live.run_until(lambda: (job.done or 0) >= 3)
    # Playable as they arrive.
    assert bake_state.state(found).status == "baking" and bake_state.state(found).frames_done >= 3
    assert corner(START)[2] > corner(START + 2)[2] > 0.2
    # Undo takes the caches out; the next look brings them back.
    bpy.ops.ed.undo_push(message="with some frames")
    bpy.ops.ed.undo()
    count = job.done
    live.run_until(lambda: (job.done or 0) > count and point_caches.MODIFIER in bpy.data.objects["Cube"].modifiers)
    # Cancel does not wait for the worker, and the next bake does.
    bpy.ops.physgen.pause_bake()
    assert live.tick() == {"CANCELLED"} and background_jobs.running() is None
    assert bake_state.state(scene()).status == "paused"
    again = Live()
    job = again.begin(bpy.context)
    again.run_until(lambda: (job.done or 0) > count + 1)
    assert any("continuing at frame" in notice for notice in job.notices)
    folder = Path(job.details["folder"])
    os.kill(json.loads((folder / ".lock").read_text())["pid"], signal.SIGKILL)
    give_up = time.monotonic() + 60
    while (result := again.tick()) is None and time.monotonic() < give_up:
        time.sleep(0.05)
    assert result == {"CANCELLED"} and again.said[-1][0] == "ERROR"
    stopped = bake_state.state(scene())
    assert stopped.status == "paused" and "ended with code" in stopped.message
    assert 3 < stopped.frames_done < 24 and corner(START + 3)[2] < corner(START)[2]
    # Another Blender finds it as it was left.
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert status() == "paused"
    # Deleting what is baked, and its scene, in the middle of it.
    last = Live()
    job = last.begin(bpy.context)
    last.run_until(lambda: (job.done or 0) > 4)
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    last.tick()
    other = bpy.data.scenes.new("other")
    bpy.context.window.scene = other
    bpy.data.scenes.remove(bpy.data.scenes["Scene"])
    while (result := last.tick()) is None:
        time.sleep(0.05)
    assert result == {"CANCELLED"} and "its scene is gone" in last.said[-1][1]
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert status() == "baked" and bake_state.state(scene()).frames_done == 24
