# SPDX-License-Identifier: GPL-3.0-or-later
"""Kill commands at random moments and run them again: is the result that of an undisturbed run, and is all else gone?

    python -m physgen.benchmarks.kills [--kills 300 | --every N] [--seed S] [--cpu SECONDS] [--only STEP …]
                                       [--signals] [--quick]

A chain of small commands (``kill_chain.py``) runs once undisturbed, from reconstruct to batch. Then, for every kill, a
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
import hashlib
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

from physgen.batch import cli, early_stop
from physgen.benchmarks.common import benchmark_parser, print_result
from physgen.benchmarks.kill_chain import STEPS, Step, draw_inputs, with_needed

ORPHANS_S = 25.0
"""A process whose parent was killed has ended so long afterwards (``sim/app/launch.py``)."""
LONGEST_S = 900.0
"""No command takes longer, on however busy a machine."""
END_CODES = (0, 3, 4, 5)
"""Of a command of whose processes another one was killed (docs/cli.md)."""

ASKED = 130
"""Of a command that was asked to stop."""

REFUSED = re.compile(
    r"already exists; choose another|is there already; (name a new|choose another)|is not empty; choose"
)
"""Messages of commands that never replace anything."""

QUICK = ("variant", "light", "capture", "collect")

MEASURED = re.compile(r"(.*/)?times\.json|.*\.log|job/(\.farm/records/.*|summary(\..*|/.*))")
"""Files that say by the clock how long something took: they have to be there, whatever they say."""


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
    root: Path,
    *,
    kills: int,
    seed: int,
    cpu_s: float,
    steps: tuple[Step, ...],
    signals: bool = False,
    every: int = 0,
) -> dict[str, object]:
    """Run the chain and the kills in ``root``; return counts, CPU seconds and all that was wrong.

    signals: commands are asked to stop, and not killed; the longest seconds of each are among the results. every: kills
    of every step, in the place of ``kills`` over all of them.
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
    tries = dict(each)
    began, number = _cpu(), -1
    while (min(each.values()) < every if every else sum(each.values()) < kills) and _cpu() - began < cpu_s:
        number += 1
        rng = random.Random(f"{seed}:{number}")
        step = rng.choices(steps, [step.share for step in steps])[0]
        if every:
            step = min(steps, key=lambda step: each[step.name])
        turn = tries[step.name] if every else number
        tries[step.name] += 1
        victim = rng.choice(["command"] * 3 + ["all"] * 3 + ["one"] * 2)
        moment = rng.random() * durations[step.name]
        place.begin(step.name)
        if signals:
            asking = (signal.SIGINT, signal.SIGTERM)[turn % 2]
            happened, problem = ask(place, step, moment, asking, taken[step.name])
        else:
            happened, problem = kill(place, step, moment, victim, rng.choice)
        counts[happened] += 1
        each[step.name] += happened != "ended before"
        print(f"{step.name}, {number}: {happened} after {moment:.1f} s", file=sys.stderr, flush=True)
        # Asked ones are run again one in four times: it takes longer than all else, and the kills are about that.
        if not problem and not (signals and turn % 4):
            started = time.monotonic()
            problem, _ = run(place, step)
            if problem and REFUSED.search(problem):
                # Killed after its result was whole: some commands say that it is there already, and sweep the rest.
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


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    """Print the counts; return 1 where anything was wrong."""
    parser = benchmark_parser("kills", __doc__, kills=6, only=QUICK)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--every", type=int, default=0, metavar="N", help="so many of every step, in place of --kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cpu", type=float, default=1e9, metavar="S", help="CPU seconds after which no kill begins")
    parser.add_argument("--signals", action="store_true", help="ask commands to stop, and say how long they took")
    parser.add_argument("--only", nargs="+", default=[s.name for s in STEPS], choices=[s.name for s in STEPS])
    options = parser.parse_args()
    steps = tuple(step for step in STEPS if step.name in options.only)
    with tempfile.TemporaryDirectory(prefix="physgen-kills-") as root:
        found = measure(
            Path(root),
            kills=options.kills,
            seed=options.seed,
            cpu_s=options.cpu,
            steps=steps,
            signals=options.signals,
            every=options.every,
        )
    print_result(found, as_json=options.json)
    return int(bool(found["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
