# SPDX-License-Identifier: GPL-3.0-or-later
"""Overhead of the local farm: milliseconds per task besides the commands themselves.

    python -m physgen.benchmarks.farm [--tasks 1000] [--workers 1] [--json]
    python -m physgen.benchmarks.farm --scene SCENE --bake BAKE [--frames 1-16] [--samples 16] [--json]

Each task's command is a shell that writes one byte, so that no interpreter start is measured. The time of the commands
is subtracted; the rest is the scheduler, events, summary, logs, hashes and records. The second run finds everything up
to date: all of its time is overhead.

With a scene, its frames are rendered in four chunks by one worker and by two, with one CPU thread each, to measure the
speed-up. Meaningful only with two idle cores.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

from physgen.batch.farm import local_runner, task_execution
from physgen.batch.farm.job_monitor import Monitor
from physgen.batch.farm.planning.plan import Plan, Task
from physgen.batch.farm.planning.task_graph import frame_chunks, range_text
from physgen.batch.farm.runners import FarmOptions
from physgen.benchmarks.common import benchmark_parser
from physgen.physgen_addon.frames.frame_index import parse_frame_range
from physgen.sim.events import ignore, never
from physgen.sim.version import VERSION


def tiny_plan(root: Path, count: int) -> Plan:
    """Return tasks in chains of four, each with an input and an output, like variant, bake, render and encode."""
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
    """Return a command that writes one byte, in place of ``own_command``."""
    return ["/bin/sh", "-c", 'printf x > "$0"', str(folder / argument)]


def render_plan(root: Path, scene: Path, bake: Path, frames: str, samples: int) -> Plan:
    """Return a plan that renders the frames of a scene in four chunks."""
    numbers = parse_frame_range(frames, 1, 100_000)
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
    """Render with one worker and with two; print the times."""
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
        print(f"one worker {seconds[1]:.1f} s, two {seconds[2]:.1f} s: {ratio:.2f} times as fast")
    return 0


def measure(plan: Plan, workers: int) -> dict[str, float]:
    """Run ``plan``; return its seconds, and milliseconds per task besides the commands."""
    monitor = Monitor(plan, ignore)
    started = time.perf_counter()
    outcomes = local_runner.run_local(plan, FarmOptions(workers=workers, threads=1), monitor, never)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("farm", __doc__, tasks=20)
    parser.add_argument("--tasks", type=int, default=1000, help="number of tasks (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, help="concurrent tasks (default: %(default)s)")
    parser.add_argument("--scene", type=Path, help="scene folder, to compare one worker with two")
    parser.add_argument("--bake", type=Path, help="its bake folder")
    parser.add_argument("--frames", default="1-16", help="frames to render (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=16, help="samples per pixel (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.scene is not None:
        return compare_workers(options)
    with (
        mock.patch.object(task_execution, "own_command", shell_command),
        tempfile.TemporaryDirectory(prefix="physgen-") as folder,
    ):
        plan = tiny_plan(Path(folder).resolve() / "job", options.tasks)
        results = {"first_run": measure(plan, options.workers), "all_kept": measure(plan, options.workers)}
    if options.json:
        print(json.dumps({"tasks": options.tasks, "workers": options.workers, **results}))
    else:
        print(f"{options.tasks} tasks, {options.workers} workers")
        for name, result in results.items():
            print(
                f"{name:<10} {result['seconds']:7.2f} s, {result['commands_s']:7.2f} s of them in commands; "
                f"overhead {result['overhead_ms_a_task']:6.2f} ms per task"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
