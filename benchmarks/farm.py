# SPDX-License-Identifier: GPL-3.0-or-later
"""What the local farm adds to its tasks: milliseconds a task, apart from the time of the commands themselves.

    python benchmarks/farm.py [--tasks 1000] [--workers 1] [--json]
    python benchmarks/farm.py --scene SCENE --bake BAKE [--frames 1-16] [--samples 16] [--json]

The command of every task is a shell that writes one byte, so that no interpreter's start is measured. Of a run with one
worker, the time that its commands ran (from their start to their end) is taken off; what is left is the scheduler, its
events and summary, logs, hashes and records. The second run finds everything done: all of its time is overhead.

With a scene, its frames are rendered by one worker and by two, with one CPU thread each, in four chunks: how many times
faster the two are. It means something on a machine with two idle cores.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from physgen.batch.farm import execute, local
from physgen.batch.farm.graph import frame_chunks, range_text
from physgen.batch.farm.monitor import Monitor
from physgen.batch.farm.runners import FarmOptions
from physgen.batch.farm.task import Plan, Task
from physgen.physgen_addon.bridge.frame_range import parse_range
from physgen.sim.events import ignore, never
from physgen.sim.version import VERSION


def tiny_plan(root: Path, count: int) -> Plan:
    """Tasks in chains of four, each with an input and a file to write, as variant, bake, render and encode are."""
    (root / "out").mkdir(parents=True)
    (root / "input.txt").write_text("input")
    tasks = []
    for number in range(count):
        chain, link = divmod(number, 4)
        tasks.append(
            Task(
                id=f"scene/v{chain}/task{link}",
                stage="render" if link == 2 else "bake",
                argv=(f"out/{number}.txt",),
                needs=(f"scene/v{chain}/task{link - 1}",) if link else (),
                inputs=(f"out/{number - 1}.txt" if link else "input.txt",),
                produces=(f"out/{number}.txt",),
                farm_folder="out/.farm",
            )
        )
    return Plan(name="tiny", root=root, version=VERSION, tasks=tuple(tasks), out="out")


def shell_command(module: str, argument: str, *rest: str, folder: Path, ends_with_us: bool) -> list[str]:
    """In place of ``own_command``: write one byte."""
    return ["/bin/sh", "-c", 'printf x > "$0"', str(folder / argument)]


def render_plan(root: Path, scene: Path, bake: Path, frames: str, samples: int) -> Plan:
    """The frames of a scene in four chunks."""
    numbers = parse_range(frames, 1, 100_000)
    tasks = []
    for chunk in frame_chunks(numbers, -(-len(numbers) // 4)):
        out = f"out/{chunk[0]:04d}"
        argv = ["render", str(scene), "--bake", str(bake), "--out", out, "--frames", range_text(chunk)]
        tasks.append(
            Task(
                id=f"scene/frames/{chunk[0]:04d}",
                stage="render",
                argv=(*argv, "--samples", str(samples)),
                produces=tuple(f"{out}/{number:04d}.png" for number in chunk),
                farm_folder="out/.farm",
            )
        )
    return Plan(name="frames", root=root, version=VERSION, tasks=tuple(tasks), out="out")


def compare_workers(options: argparse.Namespace) -> int:
    """Render with one worker and with two; print how long each took."""
    seconds = {}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory(prefix="physgen-") as folder:
            root = Path(folder).resolve()
            plan = render_plan(root, options.scene.resolve(), options.bake.resolve(), options.frames, options.samples)
            seconds[workers] = measure(plan, workers)["seconds"]
    ratio = seconds[1] / seconds[2]
    if options.json:
        print(json.dumps({"one_worker_s": seconds[1], "two_workers_s": seconds[2], "times_faster": ratio}))
    else:
        print(f"one worker {seconds[1]:.1f} s, two {seconds[2]:.1f} s: {ratio:.2f} times faster")
    return 0


def measure(plan: Plan, workers: int) -> dict[str, float]:
    """Seconds of one run, and milliseconds a task of it that were not its commands'."""
    monitor = Monitor(plan, ignore)
    started = time.perf_counter()
    outcomes = local.run(plan, FarmOptions(workers=workers, threads=1), monitor, never)
    seconds = time.perf_counter() - started
    summary_started = time.perf_counter()
    monitor.finish(outcomes, cancelled=False)
    summary = time.perf_counter() - summary_started
    wrong = [outcome for outcome in outcomes if outcome.state not in ("done", "kept")]
    if wrong:
        sys.exit(f"a task failed: {wrong[0]}")
    commands = sum(outcome.seconds for outcome in outcomes if outcome.attempts) / workers
    return {
        "seconds": seconds + summary,
        "commands_s": commands,
        "overhead_ms_a_task": 1000 * (seconds + summary - commands) / len(outcomes),
    }


def main() -> int:
    """Entry of the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--bake", type=Path)
    parser.add_argument("--frames", default="1-16")
    parser.add_argument("--samples", type=int, default=16)
    options = parser.parse_args()
    if options.scene is not None:
        return compare_workers(options)
    execute.own_command = shell_command  # type: ignore[assignment]
    with tempfile.TemporaryDirectory(prefix="physgen-") as folder:
        plan = tiny_plan(Path(folder).resolve() / "job", options.tasks)
        results = {"first_run": measure(plan, options.workers), "all_kept": measure(plan, options.workers)}
    if options.json:
        print(json.dumps({"tasks": options.tasks, "workers": options.workers, **results}))
    else:
        print(f"{options.tasks} tasks, {options.workers} at a time")
        for name, result in results.items():
            print(
                f"{name:<10} {result['seconds']:7.2f} s, of these {result['commands_s']:7.2f} s in commands; "
                f"{result['overhead_ms_a_task']:6.2f} ms a task besides"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
