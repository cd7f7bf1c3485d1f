# SPDX-License-Identifier: GPL-3.0-or-later
"""Overhead of Dask: many tasks that are up to date, so that only scheduling is measured.

python -m physgen.benchmarks.farm_dask [--tasks 1000] [--workers 2] [--farm dask|tcp://…] [--json]
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from physgen.batch.farm.planning.plan import Plan, Task
from physgen.batch.farm.runners import FarmOptions, find_runner
from physgen.batch.farm.task_records import Record, produced_hashes, save_record
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.events import never
from physgen.sim.version import VERSION


def done_plan(root: Path, count: int) -> Plan:
    """Return a plan of ``count`` tasks, ten per bake, whose records show that they are up to date."""
    tasks: list[Task] = []
    for index in range(count):
        bake = f"v{index // 10}/bake"
        name = bake if index % 10 == 0 else f"v{index // 10}/render-{index % 10}"
        task = Task(
            id=name,
            stage="bake" if name == bake else "render",
            argv=("effects", "wind"),
            needs=() if name == bake else (bake,),
            produces=(f"{name}.txt",),
        )
        file = root / task.produces[0]
        file.parent.mkdir(exist_ok=True)
        file.write_text(name)
        save_record(
            task,
            root,
            Record(
                task=name,
                version=VERSION,
                argv=task.argv,
                inputs=(),
                produced=produced_hashes(task, root),
                seconds=0.0,
                cpu_seconds=0.0,
                worker="here",
            ),
        )
        tasks.append(task)
    return Plan(name="tiny", root=root, version=VERSION, tasks=tuple(tasks))


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("farm_dask", __doc__, tasks=20, workers=1)
    parser.add_argument("--tasks", type=int, default=1000, help="number of tasks (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="local workers (default: %(default)s)")
    parser.add_argument("--farm", default="dask", help="dask, or the address of a scheduler (default: %(default)s)")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        plan = done_plan(Path(folder), options.tasks)
        marks: list[float] = []
        began = time.perf_counter()
        farm = FarmOptions(farm=options.farm, workers=options.workers)
        outcomes = find_runner(options.farm)(plan, farm, lambda _: marks.append(time.perf_counter()), never)
        total = time.perf_counter() - began
    assert all(outcome.state == "kept" for outcome in outcomes)
    result = {
        "tasks": options.tasks,
        "workers": options.workers,
        "start_s": round(marks[0] - began, 2),
        "a_task_ms": round(1000 * (marks[-1] - marks[0]) / options.tasks, 2),
        "total_s": round(total, 2),
    }
    if options.json:
        print(json.dumps(result))
    else:
        print(f"{options.tasks} tasks on {options.workers} workers of {options.farm}:")
        print(f"    {result['start_s']} s until the first starts, then {result['a_task_ms']} ms each")
    return 0


if __name__ == "__main__":
    sys.exit(main())
