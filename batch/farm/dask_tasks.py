# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs on a Dask worker, ours or any other."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

from ...sim.errors import Cancelled
from ...sim.events import Event
from .execute import execute
from .task import Outcome, Task

PROGRESS_S = 0.5
"""Progress of a task is told not more often than this: all of it passes through the scheduler."""

_closed: set[str] = set()
_stopped: set[str] = set()
"""Runs of which nothing begins any more, and of which nothing goes on. Only this process's tasks look."""

ending = threading.Event()
"""Set when this worker has to end: then nothing goes on."""


def carry_out(task: Task, root: str, version: str, run: str, threads: int) -> Outcome:
    """Carry out ``task`` in the folder ``root``; what it says goes to the topic ``run``. For a worker's thread."""
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
    return execute(task, Path(root), version=version, worker=name, cancelled=stopped, on_event=tell, threads=threads)


def stop(run: str, begun_too: bool) -> None:
    """Let no task of ``run`` begin at this worker any more; begun_too: ask those that run to stop."""
    _closed.add(run)
    if begun_too:
        _stopped.add(run)


def read_token(path: str) -> str:
    """What this machine finds at ``path``; empty when it finds nothing."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def worker_name() -> str:
    """This process, for people."""
    return f"{socket.gethostname()}:{os.getpid()}"
