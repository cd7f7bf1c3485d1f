# SPDX-License-Identifier: MIT
"""Kill a command before each of its system calls that change the disk, and look at what is left.

``python kill_points.py SCENARIO FOLDER FIRST:LAST:STEP`` runs the scenario once to its end, counting the calls, then
once for each point: a forked process kills itself (SIGKILL) just before that call, and ``check`` judges the disk.
Calls are seen by Python's audit events (open for writing, rename, replace, remove, mkdir, rmdir, link, symlink,
truncate, and ``ctypes`` for the exchange), and by wrapping ``os.write`` and ``os.fsync``, which have none. A file that
was opened last is cut to half at every second point, as if it had been written in part.

Prints one JSON line: the number of calls and of points, and what was wrong.
"""

import contextlib
import dataclasses
import json
import os
import pickle
import re
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from physgen import batch  # noqa: F401
from physgen.batch.farm.planning.plan import Task
from physgen.batch.farm.task_execution import execute_task
from physgen.physgen_addon.frames.frame_files import write_png
from physgen.physgen_addon.frames.frame_index import FrameIndex
from physgen.sim import atomic
from physgen.sim.app import bake_estimate  # noqa: F401 - before the fork
from physgen.sim.app.diagnose import diagnose
from physgen.sim.app.explain import explain
from physgen.sim.app.pack_bake import pack_bake, unpack_bake
from physgen.sim.app.reconstruct import Physics, correct, reconstruct, set_physics
from physgen.sim.app.reconstruct_record import read_stamp, require_request
from physgen.sim.app.scene_variant import make_variant
from physgen.sim.app.set_light import LightRequest, set_light
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, load_bake, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.diagnose import run_diagnosis
from physgen.sim.diagnose.capture_folder import load_capture
from physgen.sim.evaluate.judge_question import CRITERIA
from physgen.sim.evaluate.questionnaire_answers import collect_questionnaire
from physgen.sim.folder_lock import LOCK_FILE, remove_dead_lock
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.scene_output import STAMP_FILE
from physgen.sim.version import VERSION
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))

from compose_scenes import a_scene, ball

cv2.setNumThreads(0)
QUICK = ReconstructOptions(mesh_vertices=500, pitch_deg=25.0, patch_radius=2, sun=False, max_size=96)
REQUESTS = [ObjectRequest(box=(30, 18, 66, 58), name="ball", shape="inflated")]
CHANGING = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"}


class Counter:
    """Counts calls that change the disk below a folder, and dies before the ``fatal``-th."""

    def __init__(self):
        self.on, self.count, self.fatal, self.opened = False, 0, None, None

    def see(self, event, arguments):
        if not self.on:
            return
        opened = None
        if event == "open":
            _, mode, flags = (*arguments, None, None)[:3]
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            if not (writes or (isinstance(mode, str) and set("wax+") & set(mode))):
                return
            opened = arguments[0]
        elif event == "ctypes.call_function":
            pass
        elif event not in CHANGING and event not in ("write", "fsync"):
            return
        self.count += 1
        if self.count == self.fatal:
            self.die()
        self.opened = opened

    def die(self):
        self.on = False
        if self.opened is not None and self.count % 2:
            with contextlib.suppress(OSError, TypeError, ValueError):
                os.truncate(self.opened, Path(self.opened).stat().st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)


counter = Counter()
sys.addaudithook(counter.see)
real_write, real_fsync = os.write, os.fsync
os.write = lambda *given: (counter.see("write", given), real_write(*given))[1]
os.fsync = lambda *given: (counter.see("fsync", given), real_fsync(*given))[1]


def draw(folder):
    rng = np.random.default_rng(2)
    image = np.full((72, 96, 3), (190.0, 175, 140)) + rng.normal(scale=4, size=(72, 96, 1))
    rows, columns = np.mgrid[:72, :96] + 0.5
    image[(columns - 48) ** 2 + (rows - 38) ** 2 < 15**2] = (200, 50, 40)
    Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / "photo.png")


def edited(folder):
    """A scene whose gravity, wind, velocity and light a user has set."""
    draw(folder)
    scene = reconstruct(folder / "photo.png", REQUESTS, out=folder / "scene", options=QUICK)
    changes = ("scene.gravity=0,0,-1.62", "ball.density=321")
    scene = set_physics(scene, Physics(presets=("hard",), velocities=((1.0, 0.0, 2.0),), overrides=changes))
    wind = json.loads(
        '[{"name": "wind", "parameters": {"wind_x": 1.0, "wind_y": 0.0, "wind_z": 0.0, "drag_per_mass": 0.05}}]'
    )
    model = make_variant(scene, out=folder / "windy", physics=Physics(), effects=json.dumps(wind)).model
    shutil.rmtree(folder / "windy")
    scene.with_model(dataclasses.replace(scene.model, effects=model.effects)).save()
    set_light(load_scene(folder / "scene"), request=LightRequest(sun_direction=(0.0, 0.3, 1.0), sun_strength=2.0))


def do_correct(folder):
    scene = load_scene(folder / "scene")
    earlier = require_request(scene, lambda source, claims: True)
    objects = [dataclasses.replace(earlier.objects[0], size_m=0.3)]
    correct(scene, earlier=earlier, objects=objects, options=earlier.options)


def do_reconstruct(folder):
    """Another photo's worth of options into the same folder."""
    options = dataclasses.replace(QUICK, default_size_m=0.4)
    reconstruct(folder / "photo.png", REQUESTS, out=folder / "scene", options=options)


def do_light(folder):
    set_light(load_scene(folder / "scene"), request=LightRequest(sun_direction=(0.5, 0.3, 1.0), sun_strength=1.0))


def do_variant(folder):
    make_variant(load_scene(folder / "scene"), out=folder / "windy", physics=Physics(presets=("jelly",)))


def do_correct_with_a_journal(folder):
    """As on a system that cannot exchange two folders."""
    atomic._exchange = lambda first, second: False
    do_correct(folder)


def do_bake(folder):
    """Taichi is imported here: it does not survive a fork."""
    from physgen.sim.app.bake import bake
    from physgen.sim.app.bake_options import BakeOptions

    bake(load_scene(folder / "scene"), out=folder / "bake", options=BakeOptions(frames=3, quality="preview"))


def do_compose(folder, by=0.01):
    """What a composition writes, over an earlier one; what it computes changes nothing on the disk."""
    from physgen.sim.app.composition_folder import MovedObject, composition_folder, write_composition

    scene = load_scene(folder / "pair")
    mesh = load_object_mesh(scene, scene.objects[0])
    moved = MovedObject(vertices=mesh.vertices + by, faces=np.asarray(mesh.faces))
    with composition_folder(scene, folder / "fitted") as partial:
        write_composition(scene, partial, {scene.objects[0].name: moved}, {"format": "physgen-compose/1", "pairs": []})


def a_packable_bake(folder):
    """Two samples of a cube; what is in them does not matter."""
    (folder / "whole").mkdir()
    points = np.random.default_rng(0).random((2, 8, 3))
    with Pc2Writer(folder / "whole" / "cube.pc2", vertex_count=8, start_frame=1) as cache:
        for sample in points:
            cache.append(sample)
    item = BakedObject(name="cube", file="cube.pc2", vertices=8)
    numbers = {"inputs_hash": "0" * 64, "fps": 24.0, "frame_start": 1, "frames": 2, "frames_done": 2, "particles": 8}
    manifest = BakeManifest(**numbers, state="complete", engine="mpm", version=VERSION, objects=(item,))
    save_manifest(folder / "whole", manifest)


def do_pack(folder):
    """Packed, and unpacked again."""
    pack_bake(load_bake(folder / "whole"), out=folder / "packed")
    unpack_bake(folder / "packed", out=folder / "unpacked")


KEY = {"format": "physgen questionnaire", "version": 1, "questionnaire": "0", "criteria": list(CRITERIA)}
CASE = {"id": "case_01", "name": "a", "prompt": "It falls.", "videos": {"aa": "ours", "bb": "other"}}


def answers(folder, score):
    scores = {token: dict.fromkeys(CRITERIA, score) for token in ("aa", "bb")}
    sheet = {"format": "physgen questionnaire answers", "version": 1, "questionnaire": "0", "person": "ann"}
    sheet |= {"saved": "2026-01-01T00:00:00Z", "cases": {"case_01": {"order": ["bb", "aa"], "scores": scores}}}
    (folder / "answers.json").write_text(json.dumps(sheet))
    (folder / "key.json").write_text(json.dumps({**KEY, "cases": [CASE]}))


def do_collect(folder):
    """Results of a questionnaire over earlier ones."""
    collect_questionnaire([folder / "answers.json"], key=folder / "key.json", out=folder / "results")


def tossed(folder):
    """A video of a ball, its capture, and what is found of both; Taichi computes it in a process of its own."""
    from physgen.sim.app import explain as app
    from physgen.sim.diagnose.run_diagnosis import DiagnoseOptions
    from physgen.sim.diagnose.run_diagnosis import diagnose as run

    wall = cv2.GaussianBlur(np.random.default_rng(1).integers(90, 200, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    video = cv2.VideoWriter(str(folder / "toss.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 60.0, (160, 120))
    for t in np.arange(30) / 60:
        frame, place = wall.copy(), (30 + 220 * t, 95 - 200 * (2.4 * t - 4.905 * t * t))
        cv2.circle(frame, tuple(int(16 * v) for v in place), 5 * 16, (30, 30, 210), -1, cv2.LINE_AA, 4)
        video.write(frame)
    video.release()

    def keep(capture, options, on_event, cancelled):
        found = run(capture, DiagnoseOptions(budget_s=10.0, effects=("wind",), confirm=False), on_event, cancelled)
        (folder / "found.pickle").write_bytes(pickle.dumps(found))
        return found

    app.run_diagnosis.diagnose = keep
    app.explain(folder / "toss.avi", BALL, out=folder / "explained")
    shutil.move(folder / "explained" / "capture", folder / "captured")
    shutil.rmtree(folder / "explained")


BALL = "ball:diameter=0.05"


def found_before(folder):
    """In the place of the fits, which change nothing on the disk: what they found."""
    found = pickle.loads((folder / "found.pickle").read_bytes())
    run_diagnosis.diagnose = lambda *given, **options: found


def do_diagnose(folder):
    found_before(folder)
    diagnose(load_capture(folder / "captured"), out=folder / "diagnosis")


def do_explain(folder):
    found_before(folder)
    if not (folder / "explained").exists():
        explain(folder / "toss.avi", BALL, out=folder / "explained")


def do_frames(folder):
    """What a render does with its frames: those that are there, whole and of these inputs, stay."""
    index = FrameIndex(folder / "frames", fps=24.0)
    index.begin()
    for number in range(1, 5):
        inputs = f"inputs of {number}"
        if not index.is_complete(number, inputs):
            write_png(index.path(number), np.full((12, 16, 3), 30 * number, np.uint8))
            index.record(number, inputs)


def do_batch(folder):
    """A task of a farm, carried out by a process of its own."""
    scene = "pair"
    produces = ("out/scene.json", "out/meshes/a.ply")
    argv = ("variant", scene, "--out", "out", "--preset=soft")
    task = Task(id="s/a/variant", stage="variant", argv=argv, inputs=(f"{scene}/scene.json",), produces=produces)
    outcome = execute_task(task, folder, version=VERSION, worker="here")
    assert outcome.state in ("done", "kept"), outcome


OUTPUTS = {
    "compose": ("fitted",),
    "pack": ("packed", "unpacked"),
    "collect": ("results",),
    "diagnose": ("diagnosis",),
    "explain": ("explained",),
}
"""Folders that a scenario makes: each as it was before, or as the whole run makes it."""
GOES_ON = {"bake": "bake", "frames": "frames", "batch": "out"}
"""Folders of which a scenario keeps what it has, so that another run goes on from there, to the same bytes."""
CLOCKED = re.compile(r"(manifest|metrics|times)\.json|.*\.lock")
"""Files that may differ: they say when, or how long."""

SCENARIOS = {
    "bake": do_bake,
    "compose": do_compose,
    "pack": do_pack,
    "collect": do_collect,
    "diagnose": do_diagnose,
    "explain": do_explain,
    "frames": do_frames,
    "batch": do_batch,
    "correct": do_correct,
    "journal": do_correct_with_a_journal,
    "reconstruct": do_reconstruct,
    "light": do_light,
    "variant": do_variant,
}


def state(folder):
    """What of the scene lasts: content and record."""
    scene = load_scene(folder / "scene")
    record = read_stamp(folder / "scene")
    assert record is not None, f"{STAMP_FILE} is missing"
    return (scene.model, record.inputs_hash, json.dumps(record.scene, sort_keys=True))


def leftovers(folder):
    return [str(path.relative_to(folder)) for path in folder.rglob(".*") if path.name != Task.farm_folder]


def contents(folder):
    """What is in ``folder``; None where it is not there."""
    if not folder.is_dir():
        return None
    kept = [path for path in folder.rglob("*") if path.is_file() and not CLOCKED.fullmatch(path.name)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in kept}


def check(name, folder, whole, reference):
    """Return what is wrong after a kill and the next command's recovery."""
    atomic.recover(folder / "config" / "trusted.json")
    atomic.recover_scratch(folder / "scratch")
    for part in ("scene", "windy", "bake", "frames", "out", *OUTPUTS.get(name, ())):
        atomic.recover(folder / part)
        remove_dead_lock(folder / f".{part}{LOCK_FILE}")
        remove_dead_lock(folder / part / LOCK_FILE)
    if state(folder) not in whole:
        return "neither the earlier scene nor the new one"
    for part in OUTPUTS.get(name, ()):
        if contents(folder / part) not in (contents(folder.parent / "start" / part), contents(reference / part)):
            return f"{part} is neither what it was nor what it becomes"
    if name in GOES_ON:
        # The next run goes on from what is there, to the same bytes.
        if forked(lambda: SCENARIOS[name](folder)) != 0:
            return "cannot be gone on with"
        if contents(folder / GOES_ON[name]) != contents(reference / GOES_ON[name]):
            return "another result than without a kill"
    left = [*leftovers(folder), *(path.name for path in (folder / "scratch").iterdir())]
    return f"left over: {left[:4]}" if left else None


def forked(work):
    """Run ``work`` in a forked process; its exit status."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def main(name, folder, points):
    action, start = SCENARIOS[name], folder / "start"
    start.mkdir()
    assert forked(lambda: edited(start)) == 0
    if name == "compose":
        # Over an earlier composition, which is exchanged.
        a_scene(start / "pair", {"a": ball(0), "b": ball(0.09)})
        assert forked(lambda: do_compose(start, by=0.02)) == 0
    elif name == "pack":
        a_packable_bake(start)
    elif name == "batch":
        a_scene(start / "pair", {"a": ball(0), "b": ball(0.09)})
    elif name in ("diagnose", "explain"):
        assert forked(lambda: tossed(start)) == 0
    elif name == "collect":
        answers(start, 2)
        do_collect(start)
        answers(start, 4)
    (start / "scratch").mkdir()

    def attempt(number, fatal):
        """Copy the start, run, die before the call ``fatal``; the copy and the number of calls."""
        copy = folder / f"point-{number}"
        shutil.copytree(start, copy)
        reading, writing = os.pipe()

        def work():
            tempfile.tempdir = str(copy / "scratch")
            os.environ["PHYSGEN_CONFIG"] = str(copy / "config")
            counter.fatal, counter.on = fatal, True
            with atomic.own_scratch():
                action(copy)
            counter.on = False
            real_write(writing, str(counter.count).encode())

        code = forked(work)
        os.close(writing)
        said = os.read(reading, 20)
        os.close(reading)
        return copy, code, int(said or 0)

    done, code, calls = attempt(0, None)
    assert code == 0
    # The copies differ in nothing but their place.
    whole = [state(start), state(done)]
    assert whole[0] != whole[1] or name in ("variant", *GOES_ON, *OUTPUTS)
    wrong = [] if check(name, done, [whole[1]], done) is None else ["the whole run left something"]
    first, last, step = points
    tried = 0
    for number in range(first, min(last, calls) + 1, step):
        copy, code, _ = attempt(number, number)
        if code == 0 and name in ("bake", "batch"):
            # It writes its manifest by the clock, and had fewer calls this time.
            continue
        tried += 1
        problem = check(name, copy, whole, done) if code == -signal.SIGKILL else f"ended with {code}"
        if problem is not None:
            wrong.append(f"killed before call {number} of {calls}: {problem}")
        shutil.rmtree(copy)
    sys.stdout.write(json.dumps({"calls": calls, "points": tried, "wrong": wrong}) + "\n")


if __name__ == "__main__":
    first, last, step = (int(part) for part in sys.argv[3].split(":"))
    main(sys.argv[1], Path(sys.argv[2]), (first, last, step))
