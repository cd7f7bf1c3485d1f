# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs on a Dask worker; and ``python -m physgen.batch.farm.dask_worker ADDRESS``, a worker that is set up for it.

``dask worker ADDRESS --nthreads 1`` does as well. This one takes certificates on standard input too, so that no file
holds those of a farm that lives for one command.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...sim.errors import PhysGenError
from ...sim.events import Event
from .dask_security import file_security
from .execute import execute
from .task import Outcome, Task

PROGRESS_S = 0.5
"""Progress of a task is told not more often than this: all of it passes through the scheduler."""

_closed: set[str] = set()
_stopped: set[str] = set()
"""Runs of which nothing begins any more, and of which nothing goes on. Only this process's tasks look."""


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
        return run in _stopped

    if run in _closed:
        return Outcome(task=task.id, state="cancelled", exit_code=130, message="cancelled", worker=name)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of a worker: runs until the scheduler or a signal ends it."""
    parser = argparse.ArgumentParser(prog="physgen.batch.farm.dask_worker", description=__doc__, allow_abbrev=False)
    parser.add_argument("address", help="of the scheduler: tcp://HOST:PORT or tls://HOST:PORT")
    slots = "what this machine has of the resources that tasks take, such as gpu=1"
    parser.add_argument("--slot", action="append", default=[], metavar="NAME=COUNT", help=slots)
    parser.add_argument("--host", help="address of this machine that the others see")
    parser.add_argument("--tls-ca", type=Path, metavar="PEM")
    parser.add_argument("--tls-cert", type=Path, metavar="PEM")
    parser.add_argument("--tls-key", type=Path, metavar="PEM")
    parser.add_argument("--security-on-stdin", action="store_true", help="certificates come as JSON on standard input")
    options = parser.parse_args(arguments)
    try:
        resources = {name: float(count) for name, _, count in (slot.partition("=") for slot in options.slot)}
    except ValueError:
        parser.error("--slot: write NAME=COUNT, such as gpu=1")
    try:
        if options.security_on_stdin:
            from distributed.security import Security

            security: Any = Security(**json.load(sys.stdin))
        else:
            security = file_security(options.address, options.tls_ca, options.tls_cert, options.tls_key)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    asyncio.run(_work(options.address, options.host, resources, security))
    return 0


async def _work(address: str, host: str | None, resources: dict[str, float], security: Any) -> None:
    from distributed import Worker

    logging.getLogger("distributed").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory(prefix="physgen-worker-", ignore_cleanup_errors=True) as scratch:
        # The work is done by processes that it starts, so its own memory says nothing.
        worker = Worker(
            address,
            host=host,
            nthreads=1,
            resources=resources,
            security=security,
            local_directory=scratch,
            memory_limit=0,
            dashboard=False,
            dashboard_address=None,
        )
        loop = asyncio.get_running_loop()
        if os.name != "nt":
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, lambda: asyncio.ensure_future(worker.close(reason="signal")))
        async with worker:
            await worker.finished()


if __name__ == "__main__":
    sys.exit(main())
