# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m physgen.batch.farm.run_task PLAN.json TASK``: one task of a plan, for schedulers that run commands.

With ``--list FILE`` TASK is a line number in FILE, from 0, as a SLURM array gives it. Exits with the code of the
command, or 130 when it was asked to stop.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from ...sim.errors import InputError, PhysGenError
from ...sim.events import IsCancelled, OnEvent
from ...sim.files import read_text
from ..terminal import Terminal, stop_signals
from .planning.plan import RETRIES, Outcome, Plan, Task, find_task, is_worth_retrying, load_plan
from .task_execution import execute_task

MOST_LIST_BYTES = 64 * 2**20


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(prog="physgen.batch.farm.run_task", description=__doc__, allow_abbrev=False)
    parser.add_argument("plan", type=Path)
    parser.add_argument("task")
    parser.add_argument("--list", type=Path, help="file with a task's id on each line")
    parser.add_argument(
        "--retries",
        type=int,
        default=RETRIES,
        help="restarts after a failure that may be temporary (default %(default)s)",
    )
    parser.add_argument("--threads", type=int, default=0, help="CPU threads per render, 0 for all")
    parser.add_argument("--json", action="store_true", help="events as JSON lines")
    options = parser.parse_args(arguments)
    terminal = Terminal(as_json=options.json)
    try:
        plan = load_plan(options.plan)
        task = find_task(plan, options.task if options.list is None else listed_task(options.list, options.task))
        with stop_signals() as stopped:
            outcome = run_with_retries(plan, task, terminal, stopped, retries=options.retries, threads=options.threads)
    except PhysGenError as error:
        terminal.error(type(error).__name__, str(error))
        return error.exit_code
    if outcome.state in ("done", "kept"):
        terminal({"event": "done", **dataclasses.asdict(outcome)})
        terminal.line(f"{outcome.task}: {outcome.state}, {outcome.seconds:.1f} s")
        return 0
    terminal.error(outcome.state, f"{outcome.task}: {outcome.message}")
    # Schedulers do not keep the negative number of a signal.
    return outcome.exit_code if 0 < outcome.exit_code < 256 else 1


def run_with_retries(
    plan: Plan, task: Task, on_event: OnEvent, cancelled: IsCancelled, *, retries: int = RETRIES, threads: int = 0
) -> Outcome:
    """Run ``task`` of ``plan`` on this machine, with retries; return the outcome."""
    attempts = 0
    while True:
        outcome = execute_task(
            task,
            plan.root,
            version=plan.version,
            worker=f"{socket.gethostname()}:{os.getpid()}",
            cancelled=cancelled,
            on_event=on_event,
            threads=threads,
        )
        attempts += outcome.attempts
        if not is_worth_retrying(outcome, attempts=attempts, retries=retries):
            return dataclasses.replace(outcome, attempts=attempts)
        on_event(
            {"event": "notice", "task": task.id, "stage": task.stage, "message": f"trying again: {outcome.message}"}
        )


def listed_task(path: Path, number: str) -> str:
    """Return line ``number``, from 0, of the list of ids at ``path``. Raises InputError if there is none."""
    try:
        lines = read_text(path, MOST_LIST_BYTES, what="list of tasks").splitlines()
    except FileNotFoundError as error:
        raise InputError(f"{path}: cannot be read as a list of tasks ({error})") from error
    if not number.isascii() or not number.isdigit() or len(number) > 9 or int(number) >= len(lines):
        raise InputError(f"{path}: has no line {number!r}; it has {len(lines)}, counted from 0")
    return lines[int(number)]


if __name__ == "__main__":
    sys.exit(main())
