# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that run on a Dask worker, ours or any other."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

from ...sim.errors import Cancelled
from ...sim.events import Event
from .planning.plan import Outcome, Task
from .task_execution import execute_task

PROGRESS_S = 0.5
"""Minimum interval between progress events of a task: they all pass through the scheduler."""

_closed: set[str] = set()
_stopped: set[str] = set()
"""Runs whose tasks may not start, and whose running tasks must stop, in this process."""

ending = threading.Event()
"""Set when this worker must end, which stops its tasks."""


def run_on_worker(task: Task, root: str, version: str, run: str, threads: int) -> Outcome:
    """Run ``task`` in the folder ``root`` in a worker's thread; its events go to the topic ``run``."""
    from distributed import get_worker

    worker = get_worker()
    name = worker_name()
    last = 0.0

    def tell(event: Event) -> None:
        nonlocal last
        if event.get("event") == "progress" and event.get("done") != event.get("total"):
            if time.monotonic() - last < PROGRESS_S:
                return
            last = time.monotonic()
        worker.log_event(run, event)

    def stopped() -> bool:
        return run in _stopped or ending.is_set()

    if run in _closed:
        return Outcome(task=task.id, state="cancelled", exit_code=Cancelled.exit_code, message="cancelled", worker=name)
    worker.log_event(run, {"event": "started", "task": task.id, "place": name})
    return execute_task(
        task, Path(root), version=version, worker=name, cancelled=stopped, on_event=tell, threads=threads
    )


def stop_run(run: str, begun_too: bool) -> None:
    """Start no more tasks of ``run`` at this worker; begun_too: also ask running ones to stop."""
    _closed.add(run)
    if begun_too:
        _stopped.add(run)


def read_token(path: str) -> str:
    """Return the content of ``path`` on this machine; empty if there is none."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def worker_name() -> str:
    """Return a readable name of this process."""
    return f"{socket.gethostname()}:{os.getpid()}"
