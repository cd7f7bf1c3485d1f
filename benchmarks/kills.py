# SPDX-License-Identifier: GPL-3.0-or-later
"""Kill commands at random moments and run them again: is the result that of an undisturbed run, and is all else gone?

    python -m physgen.benchmarks.kills [--kills 300] [--seed S] [--cpu SECONDS] [--only STEP …] [--signals] [--quick]

A chain of small commands runs once undisturbed: reconstruct, variant, light, correct, bake, pack, evaluate, render,
encode, propose, import of a capture, diagnose, track, explain, compose, questionnaire, batch. Then, for every kill, a
command begins from the same folder as then, is killed (SIGKILL) at a random moment, and is run again. Three in eight
kills hit the command alone, three all of its processes at once, two any one of them. Everything in the folder, hidden
files, locks and the list of trusted folders included, has to have the bytes of the undisturbed run then, and the
temporary folder has to be empty. Kill N follows from the seed and N, its moment from how long the undisturbed run took.

With --signals the command is asked to stop instead, by SIGINT or SIGTERM in turn: it has to end with 130 (or 0, where
its work was done), to have left nothing in the temporary folder by then, and the seconds that it took are reported.

Commands are forked from one process that has imported the libraries, so that moments are spent in the work and not in
imports; the processes that a command starts are those that it always starts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import trimesh
from physgen.batch import cli, early_stop
from physgen.benchmarks.common import benchmark_parser, print_result
from physgen.sim.evaluate.model_judge import CRITERIA
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.model import Camera, SceneModel, SceneObject
from PIL import Image

LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)
JOBS = """format = "physgen-jobs/1"
name = "job"
[[scenes]]
name = "ball"
scene = "scene"
[defaults.bake]
frames = 2
quality = "preview"
[defaults.render]
frames = "1"
samples = 1
video = []
[matrix]
presets = ["hard"]
"""

ORPHANS_S = 25.0
"""A process whose parent was killed has ended so long afterwards (``sim/app/launch.py``)."""
LONGEST_S = 900.0
"""No command takes longer, on however busy a machine."""
END_CODES = (0, 3, 4, 5)
"""Of a command of whose processes another one was killed (docs/cli.md)."""

ASKED = 130
"""Of a command that was asked to stop."""

REFUSED = re.compile(r"already exists; choose another|is there already; name a new")
"""What commands that never replace anything say."""


@dataclasses.dataclass(frozen=True)
class Step:
    """A command. line: its words; after: the step before it; share: of the kills, less where it takes long."""

    name: str
    line: str
    after: str = ""
    share: float = 1.0


BODY = "--object ball:diameter=0.05"
STEPS = (
    Step("reconstruct", "reconstruct photo.png --box 30,18,66,58 --name ball --no-sun --out scene", share=0.4),
    Step("variant", "variant pair --preset jelly --out windy"),
    Step("light", "light windy --sun-direction 0.5,0.3,1 --sun-strength 2", "variant"),
    Step("correct", "correct scene --size ball=0.3", "reconstruct", 0.4),
    Step("bake", "bake scene --frames 3 --quality preview --out bake", "reconstruct"),
    Step("pack", "pack bake --out packed", "bake"),
    Step("unpack", "pack packed --unpack --out unpacked", "pack"),
    Step("evaluate", "evaluate bake --scene scene --out evaluated", "bake"),
    Step("render", "render scene --bake bake --frames 1-2 --samples 1 --out frames --video clip.mp4", "bake"),
    Step("encode", "encode frames --out sheet.webp", "render"),
    Step("propose", "propose photo.png --segmenter none --out proposed"),
    Step("capture", "capture import table.csv --diameter 0.1 --mass 0.1 --out captured"),
    Step("diagnose", "diagnose captured --budget 10s --no-confirm --effects wind --out diagnosis", "capture"),
    Step("track", f"track toss.avi {BODY} --out tracked"),
    Step("explain", f"explain toss.avi {BODY} --budget 10s --effects wind --out explained"),
    Step("compose", "compose pair --no-picture --steps 1 --substeps 1 --cells 8 --out fitted", share=0.3),
    Step("questionnaire", "questionnaire case --out asked"),
    Step("collect", "questionnaire answers.json --collect --key key.json --out results"),
    Step("batch", "batch jobs.toml --workers 2", "reconstruct", 0.3),
)
QUICK = ("variant", "light", "capture", "collect")

MEASURED = re.compile(r"(.*/)?times\.json|.*\.log|job/(\.farm/records/.*|summary(\..*|/.*))")
"""Files that say by the clock how long something took: they have to be there, whatever they say."""


def draw_inputs(folder: Path) -> None:
    """Write photo, table, video, scene of two balls that touch, case, answers and job into ``folder``."""
    rng = np.random.default_rng(2)
    image = np.full((72, 96, 3), (190.0, 175, 140)) + rng.normal(scale=4, size=(72, 96, 1))
    rows, columns = np.mgrid[:72, :96] + 0.5
    image[(columns - 48) ** 2 + (rows - 38) ** 2 < 15**2] = (200, 50, 40)
    Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / "photo.png")
    (folder / "pair" / "meshes").mkdir(parents=True)
    items = []
    for number, name in enumerate("ab"):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
        mesh.apply_translation((0.09 * number, 0, 0.05))
        mesh.export(folder / "pair" / "meshes" / f"{name}.ply")
        items.append(SceneObject(name=name, mesh=f"meshes/{name}.ply", size_m=0.1, occlusion_order=2 - number))
    save_scene(folder / "pair", SceneModel(camera=CAMERA, objects=tuple(items), photo=None, background=None))
    times = np.arange(24) / 60
    lines = [f"{t:.4f},{1.1 * t:.5f},0,{2 + 1.5 * t - 4.905 * t * t:.5f}" for t in times]
    (folder / "table.csv").write_text("\n".join(["t,x,y,z", *lines]) + "\n")
    wall = cv2.GaussianBlur(rng.integers(90, 200, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    video = cv2.VideoWriter(str(folder / "toss.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 60.0, (160, 120))
    for t in np.arange(30) / 60:
        frame, place = wall.copy(), (30 + 220 * t, 95 - 200 * (2.4 * t - 4.905 * t * t))
        cv2.circle(frame, tuple(int(16 * v) for v in place), 5 * 16, (30, 30, 210), -1, cv2.LINE_AA, 4)
        video.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    video.release()
    (folder / "case").mkdir()
    Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(folder / "case" / "photo.jpg")
    for name in ("ours", "other"):
        writer = cv2.VideoWriter(str(folder / "case" / f"{name}.webm"), cv2.VideoWriter_fourcc(*"VP80"), 8, (80, 60))
        for level in range(4):
            writer.write(np.full((60, 80, 3), 40 * level, np.uint8))
        writer.release()
    videos = "\n".join(f'{name} = "{name}.webm"' for name in ("ours", "other"))
    (folder / "case" / "case.toml").write_text(f'prompt = "It falls."\nimage = "photo.jpg"\n[videos]\n{videos}\n')
    scores = {token: dict.fromkeys(CRITERIA, 3) for token in ("aa", "bb")}
    sheet = {"format": "physgen questionnaire answers", "version": 1, "questionnaire": "0", "person": "ann"}
    sheet |= {"saved": "2026-01-01T00:00:00Z", "cases": {"case_01": {"order": ["bb", "aa"], "scores": scores}}}
    (folder / "answers.json").write_text(json.dumps(sheet))
    case = {"id": "case_01", "name": "a", "prompt": "It falls.", "videos": {"aa": "ours", "bb": "other"}}
    key = {"format": "physgen questionnaire", "version": 1, "questionnaire": "0", "criteria": list(CRITERIA)}
    (folder / "key.json").write_text(json.dumps({**key, "cases": [case]}))
    (folder / "jobs.toml").write_text(JOBS)


def contents(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file in ``folder`` by its path there, hidden ones included; links by where to."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"-> {path.readlink()}"
        elif path.is_dir():
            found[name] = "folder"
        else:
            found[name] = "measured" if MEASURED.fullmatch(name) else hashlib.sha256(path.read_bytes()).hexdigest()
    return found


class Place:
    """The folders of one measurement: the commands always run in ``work``, so that paths are the same."""

    def __init__(self, root: Path) -> None:
        """Make them below ``root``."""
        self.work, self.scratch, self.starts, self.log = root / "work", root / "tmp", root / "starts", root / "log"
        self.scratch.mkdir()
        self.starts.mkdir()
        self.environment = {"TMPDIR": str(self.scratch), "PHYSGEN_CONFIG": str(self.work / ".config")}

    def keep(self, name: str) -> None:
        """Keep what is in ``work`` as the start of the step ``name``."""
        shutil.copytree(self.work, self.starts / name, symlinks=True)

    def begin(self, name: str) -> None:
        """Put the start of the step ``name`` into ``work``."""
        shutil.rmtree(self.work, ignore_errors=True)
        shutil.rmtree(self.scratch)
        self.scratch.mkdir()
        shutil.copytree(self.starts / name, self.work, symlinks=True)

    def start(self, step: Step) -> int:
        """Start the command of ``step`` as a process forked from this one; return its number."""
        sys.stdout.flush()
        # As in a process of its own, there is no moment without its first handlers.
        signal.pthread_sigmask(signal.SIG_BLOCK, early_stop.STOP_SIGNALS)
        pid = os.fork()
        if pid == 0:
            early_stop.heed()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, early_stop.STOP_SIGNALS)
        if pid != 0:
            return pid
        code = 70
        try:
            os.setsid()
            log = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(log, 1)
            os.dup2(log, 2)
            os.chdir(self.work)
            os.environ.update(self.environment)
            tempfile.tempdir = None
            sys.argv = ["physgen", *step.line.split()]
            code = cli.main()
            sys.stdout.flush()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)

    def others(self, pid: int) -> list[int]:
        """Return the processes that work for the command ``pid``, known by their environment."""
        mark = f"PHYSGEN_CONFIG={self.environment['PHYSGEN_CONFIG']}".encode()
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                other = entry.name.isdigit() and int(entry.name) not in (pid, os.getpid())
                if other and mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
        return found


def wait(pid: int, until: float) -> tuple[int | None, float]:
    """Return the exit status of ``pid`` and the CPU seconds that it and its children took; None: not by ``until``."""
    while time.monotonic() < until:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        time.sleep(0.005)
    return None, 0.0


def run(place: Place, step: Step) -> tuple[str | None, float]:
    """Run ``step`` to its end; return what is wrong, None for nothing, and the CPU seconds."""
    pid = place.start(step)
    code, cpu = wait(pid, time.monotonic() + LONGEST_S)
    if code is None:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return "does not end", cpu
    words = place.log.read_text(errors="replace").strip()[-600:]
    return (None if code == 0 else f"ended with code {code}: {words}"), cpu


def difference(found: dict[str, str], expected: dict[str, str]) -> str | None:
    """Return in words how the folder ``found`` differs from ``expected``; None if not."""
    gone, new = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    other = sorted(name for name in found.keys() & expected.keys() if found[name] != expected[name])
    kinds = {"lost": gone, "left over": new, "with other bytes": other}
    return "; ".join(f"{kind}: {', '.join(names[:6])}" for kind, names in kinds.items() if names) or None


def kill(place: Place, step: Step, after_s: float, victim: str, choose: Callable[[list[int]], int]) -> tuple[str, str]:
    """Start ``step``, kill ``victim`` (command, all, one) after ``after_s``; return what happened and what is wrong."""
    pid = place.start(step)
    code, _ = wait(pid, time.monotonic() + after_s)
    if code is not None:
        return "ended before", "" if code == 0 else f"ended with code {code} undisturbed"
    others = place.others(pid)
    chosen = [pid] if victim == "command" else [pid, *others] if victim == "all" else [choose([pid, *others])]
    for number in chosen:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    code, _ = wait(pid, time.monotonic() + LONGEST_S)
    words = place.log.read_text(errors="replace") if place.log.exists() else ""
    happened = "command" if chosen == [pid] else "all" if pid in chosen else "one of its processes"
    if pid not in chosen and (code not in END_CODES or "Traceback" in words):
        return happened, f"ended with code {code} when one of its processes was killed: {words[-600:]}"
    end = time.monotonic() + ORPHANS_S
    while (left := place.others(pid)) and time.monotonic() < end:
        time.sleep(0.05)
    for number in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    return happened, f"{len(left)} of its processes ran on" if left else ""


def ask(place: Place, step: Step, after_s: float, number: int, taken: list[float]) -> tuple[str, str]:
    """Start ``step``, send the signal ``number`` after ``after_s``; return what happened and what is wrong.

    taken: gets the seconds from the signal to the command's end.
    """
    pid = place.start(step)
    code, _ = wait(pid, time.monotonic() + after_s)
    if code is not None:
        return "ended before", "" if code == 0 else f"ended with code {code} undisturbed"
    asked = time.monotonic()
    os.kill(pid, number)
    code, _ = wait(pid, asked + LONGEST_S)
    taken.append(time.monotonic() - asked)
    end = time.monotonic() + ORPHANS_S
    while (left := place.others(pid)) and time.monotonic() < end:
        time.sleep(0.05)
    words = f"{len(left)} of its processes ran on" if left else ""
    if code not in (0, ASKED):
        words = f"ended with code {code}: {place.log.read_text(errors='replace')[-600:]}"
    names = sorted(path.name for path in place.scratch.iterdir())
    return "asked", words or (f"left in the temporary folder: {', '.join(names[:4])}" if names else "")


def measure(
    root: Path, *, kills: int, seed: int, cpu_s: float, steps: tuple[Step, ...], signals: bool = False
) -> dict[str, object]:
    """Run the chain and the kills in ``root``; return counts, CPU seconds and all that was wrong.

    signals: commands are asked to stop, and not killed; the longest seconds of each are among the results.
    """
    place = Place(root)
    place.work.mkdir()
    draw_inputs(place.work)
    durations: dict[str, float] = {}
    whole: dict[str, dict[str, str]] = {}
    wrong: list[str] = []
    for step in with_needed(steps):
        place.keep(step.name)
        started = time.monotonic()
        problem, cpu = run(place, step)
        durations[step.name] = time.monotonic() - started
        whole[step.name] = contents(place.work)
        print(f"{step.name}: {durations[step.name]:.1f} s, {cpu:.1f} CPU s", file=sys.stderr, flush=True)
        if problem is not None:
            return {"kills": 0, "wrong": [f"{step.name}, undisturbed: {problem}"]}
    counts: dict[str, float] = {"command": 0, "all": 0, "one of its processes": 0, "asked": 0, "ended before": 0}
    taken: dict[str, list[float]] = {step.name: [] for step in steps}
    each = dict.fromkeys((step.name for step in steps), 0)
    began, number = _cpu(), -1
    while sum(each.values()) < kills and _cpu() - began < cpu_s:
        number += 1
        rng = random.Random(f"{seed}:{number}")
        step = rng.choices(steps, [step.share for step in steps])[0]
        victim = rng.choice(["command"] * 3 + ["all"] * 3 + ["one"] * 2)
        moment = rng.random() * durations[step.name]
        place.begin(step.name)
        if signals:
            asking = (signal.SIGINT, signal.SIGTERM)[number % 2]
            happened, problem = ask(place, step, moment, asking, taken[step.name])
        else:
            happened, problem = kill(place, step, moment, victim, rng.choice)
        counts[happened] += 1
        each[step.name] += happened != "ended before"
        # Asked ones are run again one in four times: it takes longer than all else, and the kills are about that.
        if not problem and not (signals and number % 4):
            started = time.monotonic()
            differs = difference(contents(place.work), whole[step.name])
            problem, _ = run(place, step)
            if problem and REFUSED.search(problem) and differs is None:
                # Killed after its result was whole: some commands then say that it is there already.
                problem = None
            problem = problem or difference(contents(place.work), whole[step.name]) or ""
            left = sorted(path.name for path in place.scratch.iterdir())
            problem = problem or (f"left in the temporary folder: {', '.join(left[:4])}" if left else "")
            if happened == "ended before":
                # As long as it takes now that the machine has other things to do.
                durations[step.name] = 0.5 * (durations[step.name] + min(moment, durations[step.name]))
        if problem:
            wrong.append(f"{step.name}, kill {number} ({happened}, after {moment:.2f} s): {problem}")
            print(wrong[-1], file=sys.stderr, flush=True)
    for name, seconds in taken.items():
        if seconds:
            counts[f"seconds of {name}"] = round(max(seconds), 2)
    done = {"kills": sum(each.values()), **counts, "cpu_s": round(_cpu() - began, 1), "seed": seed}
    return {**done, **{f"kills of {name}": count for name, count in each.items()}, "wrong": wrong}


def with_needed(steps: tuple[Step, ...]) -> list[Step]:
    """Return ``steps`` and those that make what they read, in the order of the chain."""
    wanted = {step.name for step in steps}
    for step in reversed(STEPS):
        if step.name in wanted and step.after:
            wanted.add(step.after)
    return [step for step in STEPS if step.name in wanted]


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    """Print the counts; return 1 where anything was wrong."""
    parser = benchmark_parser("kills", __doc__, kills=6, only=QUICK)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cpu", type=float, default=1e9, metavar="S", help="CPU seconds after which no kill begins")
    parser.add_argument("--signals", action="store_true", help="ask commands to stop, and say how long they took")
    parser.add_argument("--only", nargs="+", default=[s.name for s in STEPS], choices=[s.name for s in STEPS])
    options = parser.parse_args()
    steps = tuple(step for step in STEPS if step.name in options.only)
    with tempfile.TemporaryDirectory(prefix="physgen-kills-") as root:
        found = measure(
            Path(root), kills=options.kills, seed=options.seed, cpu_s=options.cpu, steps=steps, signals=options.signals
        )
    print_result(found, as_json=options.json)
    return int(bool(found["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
