# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``batch``: run a job file, or export it for another program (docs/farm.md)."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from ...sim.errors import Cancelled, InputError, PhysGenError, RenderError, SimulationError
from ...sim.events import IsCancelled
from ...sim.folder_lock import folder_lock
from ..terminal import Terminal
from .job_monitor import SUMMARY_PAGE, Monitor
from .planning.job_file import load_job
from .planning.plan import RETRIES, Outcome, Plan
from .planning.task_graph import make_plan
from .runners import EXPORTERS, FarmOptions, add_cluster_options, cluster_options, find_exporter, find_runner

_OF_STAGE: dict[str, type[PhysGenError]] = {"bake": SimulationError, "render": RenderError, "encode": RenderError}


def add_batch(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen batch``."""
    parser.add_argument("job", type=Path, metavar="JOBS.toml", help="the job file")
    where = "local (default), dask, slurm, or the address of a Dask scheduler, tcp://HOST:PORT or tls://HOST:PORT"
    parser.add_argument("--farm", default="local", metavar="WHERE", help=where)
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="concurrent tasks (default: half the cores)"
    )
    parser.add_argument(
        "--threads", type=int, default=0, metavar="N", help="CPU threads per render (default: cores divided by workers)"
    )
    again = f"restarts of a task after a failure that may be temporary (default {RETRIES})"
    parser.add_argument("--retries", type=int, default=RETRIES, metavar="N", help=again)
    slots = "available slots by name, such as gpu=2 (default: one of each)"
    parser.add_argument("--slots", type=_slot, nargs="+", action="extend", default=[], metavar="NAME=N", help=slots)
    fast = "start nothing new after the first failure (default: continue with all that does not depend on it)"
    parser.add_argument("--fail-fast", action="store_true", help=fast)
    parser.add_argument("--dry-run", action="store_true", help="only list the tasks")
    parser.add_argument("--export", choices=[*EXPORTERS], help="write the job for another program and run nothing")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the files of --export")
    add_cluster_options(parser)
    parser.set_defaults(wrong_usage=parser.error)


def _slot(text: str) -> tuple[str, int]:
    name, _, count = text.partition("=")
    if not name or not count.isdecimal() or int(count) > 10_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=N, such as gpu=2")
    return name, int(count)


def run_batch(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen batch``; return the exit code, 0 only if every task is done."""
    if (options.export is None) != (options.out is None):
        options.wrong_usage("--export and --out belong together")
    farm = FarmOptions(
        farm=options.farm,
        workers=options.workers,
        threads=options.threads,
        retries=options.retries,
        fail_fast=options.fail_fast,
        slots=dict(options.slots),
        out=options.out,
        cluster=cluster_options(options),
    )
    runner = find_runner(farm.farm)
    plan = make_plan(load_job(options.job))
    if options.export is not None:
        files = [str(path) for path in find_exporter(options.export)(plan, farm)]
        terminal({"event": "done", "files": files})
        terminal.line("\n".join(files))
        return 0
    if options.dry_run:
        return _list(plan, terminal)
    results = plan.root / plan.out
    with folder_lock(results / ".farm"):
        monitor = Monitor(plan, terminal)
        outcomes = runner(plan, farm, monitor, cancelled)
        summary = monitor.finish(outcomes, cancelled=cancelled())
    page = results / SUMMARY_PAGE
    if summary.state == "cancelled":
        raise Cancelled(f"stopped; finished tasks are kept, run it again to resume: {page}")
    if summary.state == "failed":
        raise _failure(plan, outcomes, page)
    terminal({"event": "done", "counts": dict(summary.counts), "summary": str(page), "out": str(results)})
    terminal.line(f"summary: {page}")
    return 0


def _list(plan: Plan, terminal: Terminal) -> int:
    for task in plan.tasks:
        terminal({"event": "task", "state": "planned", "task": task.id, "stage": task.stage, "argv": list(task.argv)})
        terminal.line(f"{task.id}: physgen {shlex.join(task.argv)}")
    terminal({"event": "done", "tasks": len(plan.tasks), "variants": len(plan.meanings)})
    terminal.line(f"{len(plan.tasks)} tasks, {len(plan.meanings)} variants")
    return 0


def _failure(plan: Plan, outcomes: Sequence[Outcome], page: Path) -> PhysGenError:
    """Return the error of a job with failures: of the type of the first one."""
    failed = [(task, o) for task, o in zip(plan.tasks, outcomes, strict=True) if o.state == "failed"]
    task, outcome = failed[0]
    kinds = {kind.exit_code: kind for kind in (InputError, SimulationError, RenderError)}
    kind = kinds.get(outcome.exit_code) or _OF_STAGE.get(task.stage, InputError)
    return kind(
        f"{len(failed)} of {len(plan.tasks)} tasks failed, the first is {task.id}: {outcome.message}; run it again to "
        f"resume, {page} has the logs"
    )
