# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes wrong around a bake is said where it is looked for, in words; nothing of it is a traceback or a hang."""

import contextlib
import json
import os
import random
import re
import shutil
import socket
import struct
import time

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon import background_jobs, bake_state, interpreter, paths
from physgen.physgen_addon.operators import render_ops
from physgen.physgen_addon.operators.bake_ops import Bake
from physgen.physgen_addon.playback import bake_record, particles, point_caches, show_bake
from physgen.physgen_addon.playback.bake_record import BakeRecord, Look
from physgen.physgen_addon.props.scene_props import known_effect
from physgen.physgen_addon.scene_io.export_animation import export_names
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.export_world import effects as exported_effects
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.cache.bake_folder import BakedObject, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.effects.registry import effects as all_effects
from physgen.sim.errors import InputError

from ..conftest import complete_manifest

FRAMES, START, PARTICLES = 3, 10, 20
posix = pytest.mark.skipif(os.name == "nt", reason="scripts of the shell")


@pytest.fixture(autouse=True)
def addon(fresh_blender):
    physgen.register()
    yield
    background_jobs.unregister_jobs()
    with contextlib.suppress(RuntimeError, AttributeError):
        physgen.unregister()


def scene():
    return bpy.context.scene


def cube():
    return bpy.data.objects["Cube"]


def found():
    return bake_state.refresh(scene())


def add_cube():
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=(0.0, 0.0, 1.0))
    item = bpy.context.object
    item.physgen.enabled = True
    simulation = scene().physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", START, START + FRAMES - 1
    return item


@pytest.fixture
def folder(tmp_path):
    """A saved file with a cube of sand that shows a bake of it; the bake's folder."""
    item = add_cube()
    item.physgen.material.law = "sand"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "Datei é.blend"))
    folder = paths.scene_cache(scene()) / bake_record.BAKES / "aaaabbbbcccc"
    folder.mkdir(parents=True)
    corners = np.array([vertex.co for vertex in item.data.vertices])
    grains = np.random.default_rng(0).uniform(-0.2, 0.2, (PARTICLES, 3))
    for name, rest in (("Cube.pc2", corners), ("Cube.points.pc2", grains)):
        with Pc2Writer(folder / name, vertex_count=len(rest)) as writer:
            for index in range(FRAMES):
                writer.append(rest + np.array([0.1 * index, 0.0, 0.0]))
    baked = BakedObject(
        name="Cube", file="Cube.pc2", vertices=8, space="mesh", points_file="Cube.points.pc2", points=PARTICLES
    )
    save_manifest(folder, complete_manifest(baked, frames=FRAMES))
    looks = (Look(name="Cube", shape=bake_record.GRAINS, from_frame=START),)
    record = BakeRecord(folder=str(folder), fingerprints=(fingerprint(scene()),), frame_start=START, looks=looks)
    bake_record.write_record(record)
    assert found().status == "baked" and found().message == ""
    bpy.ops.wm.save_mainfile()
    return folder


# Files that are not what they were


def cut(path):
    path.write_bytes(path.read_bytes()[:-5])


def claim(offset, number):
    def change(path):
        data = path.read_bytes()
        path.write_bytes(data[:offset] + struct.pack("<i", number) + data[offset + 4 :])

    return change


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("Cube.pc2", lambda path: path.unlink(), "there is no such point cache"),
        ("Cube.pc2", cut, "cut off"),
        ("Cube.pc2", claim(16, 2**31 - 1), "is invalid"),
        ("Cube.pc2", claim(28, 1), "1 of 3 frames are there"),
        ("Cube.points.pc2", cut, "cut off"),
        ("Cube.points.pc2", claim(16, 1), "has 1 vertices instead of 20"),
        ("manifest.json", lambda path: path.write_text('{"format": "physgen-bake/2"}'), "bake again with this version"),
    ],
)
def test_a_damaged_bake_is_not_called_baked(folder, file, change, words):
    change(folder / file)
    state = found()
    assert state.status == "missing"
    assert re.search(words, state.trouble), state
    assert bpy.ops.physgen.free_bake() == {"FINISHED"} and point_caches.MODIFIER not in cube().modifiers


@pytest.mark.parametrize("pid", ["1e400", "9" * 30, "-1", "[1]", '"x"'])
def test_a_lock_of_nonsense_locks_nothing(folder, pid):
    (folder / ".lock").write_text(f'{{"pid": {pid}, "host": "{socket.gethostname()}"}}')
    assert found().status == "baked"


def test_a_lock_of_a_living_process_says_how_to_get_rid_of_it(folder, held_elsewhere):
    with held_elsewhere(folder):
        assert found().status == "baking" and str(folder / ".lock") in found().message
    assert found().status == "baked"


def test_records_and_manifests_of_random_bytes_are_survived(folder):
    """Looked at as they lie there, and as what the scene is to show next."""
    chance, blend = random.Random(4), bpy.data.filepath
    root = paths.absolute(scene().physgen.simulation.cache)
    shutil.copytree(root, root.with_name("good"))
    names = ("manifest.json", "Cube.pc2", "Cube.points.pc2", "../aaaabbbbcccc.json")
    odd = (r'"\ud800"', "1e999", "9" * 40, "-1", "null", "[]", '"../x"', '"/"', "NaN", "{", "[" * 5000)
    for attempt in range(60):
        shutil.rmtree(root)
        shutil.copytree(root.with_name("good"), root)
        path = folder / names[attempt % len(names)]
        data = bytearray(path.read_bytes())
        if path.suffix == ".json" and attempt % 3:
            text = data.decode()
            values = [i for i, c in enumerate(text[:-1]) if c == ":"]
            at = chance.choice(values)
            end = min(text.index(c, at) for c in ",\n" if c in text[at:])
            data = (text[: at + 1] + chance.choice(odd) + text[end:]).encode("utf-8", "surrogatepass")
        else:
            for _ in range(chance.randint(1, 5)):
                data[chance.randrange(min(len(data), 300))] = chance.randrange(256)
        path.write_bytes(data)
        bpy.ops.wm.open_mainfile(filepath=blend)
        assert found().status in ("baked", "paused", "stale", "missing"), (attempt, bytes(data[:300]))
        show_bake.hide(scene())
        assert found().status in ("none", "baked", "paused", "stale", "missing"), (attempt, bytes(data[:300]))
        scene().frame_set(START + 1)


def test_names_that_no_file_can_have_are_refused(folder):
    text = (folder / "manifest.json").read_text().replace('"Cube.pc2"', r'"\ud800.pc2"')
    (folder / "manifest.json").write_text(text)
    assert found().status == "missing"


# Objects that are not what they were


def test_a_modifier_before_the_cache_is_named(folder):
    cube().modifiers.new("Subdivision", "SUBSURF")
    assert found().status == "baked" and found().trouble == ""
    cube().modifiers.move(len(cube().modifiers) - 1, 0)
    assert "'Subdivision' comes before the bake" in found().trouble


def test_an_object_that_has_lost_its_cache_or_has_it_switched_off_is_named(folder):
    cube().modifiers[point_caches.MODIFIER].show_viewport = False
    assert "is switched off" in found().trouble
    cube().modifiers.remove(cube().modifiers[point_caches.MODIFIER])
    assert "Cube has lost its modifier" in found().trouble
    show_bake.show(scene(), bake_state.shown_record(scene()))
    assert found().trouble == ""


def test_scenes_that_share_objects_say_whose_bake_plays(folder):
    first = scene()
    bpy.ops.scene.new(type="LINK_COPY")
    cube().modifiers[point_caches.MODIFIER].frame_start = 99
    assert "Cube plays the bake of another scene" in bake_state.refresh(first).trouble


def test_changes_that_do_not_affect_motion_keep_the_bake_current(folder):
    before = fingerprint(scene())
    modifier = cube().modifiers.new("Subdivision", "SUBSURF")
    assert fingerprint(scene()) == before
    modifier.levels = 3
    assert fingerprint(scene()) == before
    cube().modifiers.new("Mirror", "MIRROR")
    assert fingerprint(scene()) != before


def test_a_collider_that_looks_at_a_simulated_object_sees_its_modifiers(folder):
    bpy.ops.mesh.primitive_cube_add(size=5.0, location=(0, 0, -9))
    collider = bpy.context.object
    collider.physgen.enabled, collider.physgen.role = True, "collider"
    modifier = collider.modifiers.new("Shrinkwrap", "SHRINKWRAP")
    modifier.target = cube()
    before = fingerprint(scene())
    cube().modifiers.new("Subdivision", "SUBSURF")
    assert fingerprint(scene()) != before


def test_objects_too_far_away_are_reported(tmp_path):
    add_cube().location.x = 1e20
    with pytest.raises(InputError, match="'Cube': is 1e\\+20 m away"):
        export_scene(scene(), tmp_path / "out")


def test_the_export_of_a_bake_is_no_photo_scene_and_says_so(tmp_path):
    add_cube()
    export_scene(scene(), tmp_path / "out")
    with pytest.raises(RuntimeError, match="is a scene without a photo"):
        bpy.ops.physgen.import_scene(filepath=str(tmp_path / "out" / "scene.json"))


# Effects


def test_every_effect_is_exported_at_both_ends_of_its_ranges(folder):
    stack = scene().physgen.world.effects
    for name, kind in all_effects().items():
        if kind.kind == "observation":
            continue
        entry = stack.add()
        entry.effect = name
        for end in ("low", "high"):
            for number, parameter in zip(entry.parameters, kind.parameters, strict=True):
                number.value = getattr(parameter, end)
            values = dict(exported_effects(scene(), export_names(scene()))[-1].parameters)
            assert all(p.low <= values[p.name] <= p.high for p in kind.parameters)


def test_an_effect_of_another_version_is_named_and_can_be_removed(folder):
    entry = scene().physgen.world.effects.add()
    entry.effect = "wind"
    entry["effect"] = 99
    if entry.effect:
        pytest.skip("this Blender keeps its properties elsewhere")
    assert known_effect(entry) is None
    entry.parameters[0].value = 3.0
    assert found().status == "stale"
    with pytest.raises(RuntimeError, match="effect 1: this version does not know it"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    assert bpy.ops.physgen.remove_stack_effect() == {"FINISHED"}


def test_a_panel_that_is_drawn_first_does_not_hide_that_a_bake_is_to_be_found(folder):
    show_bake.hide(scene())
    bake_state.forget()
    bake_state.mark_dirty()
    assert bake_state.state(scene()).status == "none"
    assert bake_state.is_dirty(scene())
    assert found().status == "baked" and not bake_state.is_dirty(scene())


# Operators


def operators():
    return sorted(name.removeprefix("PHYSGEN_OT_") for name in dir(bpy.types) if name.startswith("PHYSGEN_OT_"))


@pytest.mark.parametrize("what", ["empty", "mesh", "light", "edited"])
def test_operators_say_what_is_missing_and_never_break(what, capfd, monkeypatch):
    monkeypatch.setenv(interpreter.VARIABLE, "/nowhere/python")
    if what == "light":
        bpy.ops.object.light_add()
    elif what != "empty":
        add_cube()
        scene().physgen.simulation.frame_end = 0
    if what == "edited":
        bpy.ops.object.mode_set(mode="EDIT")
    for windowless in (False, True):
        for name in operators():
            context = {"window": None, "area": None, "region": None} if windowless else {}
            with bpy.context.temp_override(**context), contextlib.suppress(RuntimeError):
                getattr(bpy.ops.physgen, name)("EXEC_DEFAULT")
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err


def test_lost_bakes_are_looked_for_where_none_is_shown(folder, tmp_path):
    show_bake.hide(scene())
    (tmp_path / "empty").mkdir()
    with pytest.raises(RuntimeError, match="a bake of this scene is not in there"):
        bpy.ops.physgen.relink_caches(directory=str(tmp_path / "empty"))
    assert bpy.ops.physgen.relink_caches(directory=str(folder.parent.parent)) == {"FINISHED"}
    assert found().status == "baked"


def test_files_beside_each_other_do_not_delete_each_others_bakes(folder, tmp_path):
    first, second = bpy.data.filepath, str(tmp_path / "second.blend")
    bpy.ops.wm.save_as_mainfile(filepath=second)
    assert bpy.ops.physgen.free_bake() == {"FINISHED"} and folder.is_dir()
    bpy.ops.wm.save_mainfile()
    assert bpy.ops.physgen.free_old_bakes() == {"FINISHED"} and folder.is_dir()
    bpy.ops.wm.open_mainfile(filepath=first)
    assert found().status == "baked" and found().trouble == ""
    # The second one no longer shows it.
    assert bpy.ops.physgen.free_bake() == {"FINISHED"} and not folder.exists()


def test_a_bake_that_cannot_be_deleted_stays_in_the_scene(folder):
    (folder / ".lock").write_text(json.dumps({"pid": os.getppid(), "host": "elsewhere"}))
    with pytest.raises(RuntimeError, match="elsewhere"):
        bpy.ops.physgen.free_bake()
    assert point_caches.MODIFIER in cube().modifiers and particles.find(scene(), "Cube") is not None
    assert scene().physgen.simulation.bake


# The Python that simulates


@pytest.fixture
def python(tmp_path, monkeypatch):
    """A function that lets a shell script be the Python that simulates."""

    def name(text):
        path = tmp_path / "python"
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
        monkeypatch.setenv(interpreter.VARIABLE, str(path))
        interpreter.forget()
        return path

    yield name
    interpreter.forget()


GOOD = """'{"python": "3.13.0", "missing": [], "installs": true, "trouble": ""}'"""


@posix
@pytest.mark.parametrize(
    "text",
    [
        "echo hello",
        """echo '{"python": "x.y", "missing": ["a"], "installs": 0, "trouble": ""}'""",
        """echo '{"python": "3.13", "missing": 5, "installs": 0, "trouble": ""}'""",
        """echo '{"python": "3.13", "missing": []}'""",
        "head -c 100000 /dev/zero | tr '\\0' '['",
        "exec yes nonsense",
        "cat /dev/zero",
        "kill -SEGV $$",
    ],
)
def test_other_programs_than_python_are_reported(python, text):
    python(text)
    with pytest.raises(interpreter.NoPython, match="named in PHYSGEN_PYTHON, cannot simulate: "):
        interpreter.find_python()


@posix
@pytest.mark.parametrize("text", ["sleep 100", "sleep 100 & sleep 100"])
def test_unresponsive_interpreter_times_out(python, text, monkeypatch):
    monkeypatch.setattr(interpreter, "_TIMEOUT_S", 0.3)
    python(text)
    with pytest.raises(interpreter.NoPython, match=r"did not answer within 0.3 s"):
        interpreter.find_python()


@posix
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"echo {GOOD}", "ended with code 0"),
        (f'echo {GOOD}; case "$*" in *bake*) kill -SEGV $$;; esac', "it crashed"),
        (f'echo {GOOD}; case "$*" in *bake*) kill -KILL $$;; esac', "memory ran out"),
        (f'echo {GOOD}; case "$*" in *bake*) head -c 30000000 /dev/zero; exit 3;; esac', "ended with code 3"),
    ],
)
def test_a_worker_that_ends_without_a_word_is_told_in_the_panel(python, tmp_path, text, words):
    add_cube()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    python(text)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    assert words in found().trouble and found().advice == bake_state.MESSAGES["none"]


@posix
def test_where_blenders_own_python_lacks_packages_the_one_that_simulates_renders(python, monkeypatch):
    monkeypatch.setitem(interpreter.RENDERING, "no_such_module", "Something")
    path = python(f"echo {GOOD}")
    with pytest.raises(interpreter.NoPython, match="cannot render into a photo: it lacks bpy") as raised:
        render_ops.render_command()
    assert raised.value.command.startswith(f"{path} -m pip install 'bpy")
    check = interpreter.PhotoCheck()
    check.look("")
    assert check.trouble == raised.value.reason
    python(f"echo {GOOD}".replace("}", ', "renders": true}'))
    assert render_ops.render_command() == [str(path), str(render_ops.SCRIPT)]
    check.look("")
    assert not check.trouble


@posix
def test_a_python_that_is_gone_when_it_is_needed_is_named(python, tmp_path):
    add_cube()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    path = python(f"echo {GOOD}")
    interpreter.find_python()
    path.write_text("\x7fELF")
    with pytest.raises(RuntimeError, match=r"python: cannot be started"):
        bpy.ops.physgen.bake("EXEC_DEFAULT")
    assert background_jobs.running() is None


# Blender under it


class Live(Bake):
    """A bake as the modal timer drives it."""

    def __init__(self):
        self.said = []

    def report(self, kind, text):
        self.said.append((*kind, text))


@posix
def test_the_extension_may_be_disabled_while_a_bake_runs(python, tmp_path):
    add_cube()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    python(f'echo {GOOD}; case "$*" in *bake*) exec sleep 100;; esac')
    live = Live()
    job = live.begin(bpy.context)
    assert live.tick() is None
    physgen.unregister()
    assert live.tick() == {"CANCELLED"} and background_jobs.running() is None
    give_up = time.monotonic() + 30
    while not job.has_ended and time.monotonic() < give_up:
        time.sleep(0.05)
    assert job.has_ended
    physgen.register()


def test_a_fault_of_ours_is_reported_and_ends_the_job(caplog):
    class Broken(Live):
        bl_idname = "physgen.broken"

        def request(self, context):
            return lambda on_event, cancelled: {}["nothing"]

    live = Broken()
    live.begin(bpy.context)
    give_up = time.monotonic() + 30
    while (result := live.tick()) is None and time.monotonic() < give_up:
        time.sleep(0.05)
    assert result == {"CANCELLED"} and background_jobs.running() is None
    assert "has failed (KeyError: 'nothing')" in live.said[-1][1] and "KeyError" in caplog.text


@pytest.mark.parametrize("copy", [False, True])
def test_folders_that_a_scene_names_are_found_from_a_file_saved_elsewhere(tmp_path, copy):
    (tmp_path / "shots").mkdir()
    (tmp_path / "other").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shots" / "a.blend"))
    scene().physgen.folder = "//scène 1/"
    scene().physgen_diagnose.capture = "//throw"
    second = tmp_path / "other" / "b.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(second), copy=copy)
    if copy:
        assert (scene().physgen.folder, scene().physgen_diagnose.capture) == ("//scène 1/", "//throw")
        bpy.ops.wm.open_mainfile(filepath=str(second))
    assert paths.absolute(scene().physgen.folder) == tmp_path / "shots" / "scène 1"
    assert paths.absolute(scene().physgen_diagnose.capture) == tmp_path / "shots" / "throw"
    assert scene().physgen.folder.startswith("//") and scene().physgen.rendering.output == "//physgen_render"
