# SPDX-License-Identifier: GPL-3.0-or-later
"""Run one task on this machine, with its log and its record.

The same on a laptop, on a Dask worker and in a SLURM array.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import signal
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue

from ...sim.app.stage_process import (
    CANCEL_GRACE_S,
    MOST_LINE_BYTES,
    ask_to_stop,
    own_command,
    parse_event,
    start_process,
)
from ...sim.atomic import recover
from ...sim.errors import Cancelled, InputError, PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent, ignore, never
from ...sim.folder_lock import is_held
from ...sim.memory import how_it_was_killed, memory_kills
from ...sim.scene.folder import inside
from ...sim.version import VERSION
from .planning.plan import Outcome, Task
from .task_records import (
    Record,
    TaskLog,
    input_hashes,
    log_path,
    produced_hashes,
    record_path,
    save_record,
    up_to_date_record,
)

STOP_GRACE_S = CANCEL_GRACE_S + 5.0
"""Longer than the command itself waits for its child processes."""

FOLDER_WAIT_S = 300.0
"""Time to wait for a folder still held by a process of a killed attempt, which ends after its frame."""

DRAIN_S = 2.0
"""Time to wait for the remaining output of an ended command."""

LOOK_S = 0.1


@dataclass(kw_only=True)
class _Ended:
    """End of a command. code: negative for a signal. final: its ``done`` or ``error`` event. words: last line.

    cancelled: whether it was asked to stop. kills_before: ``memory_kills`` when it began.
    """

    code: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    final: Event | None = None
    words: str = ""
    cancelled: bool = False
    kills_before: int | None = field(default_factory=memory_kills)


def execute_task(
    task: Task,
    root: Path,
    *,
    version: str,
    worker: str,
    cancelled: IsCancelled = never,
    on_event: OnEvent = ignore,
    threads: int = 0,
) -> Outcome:
    """Run ``task`` in the folder ``root``, unless its record shows that its files are up to date; return the outcome.

    version: of the program that planned it; any other refuses. worker: readable name of this machine. on_event:
    receives the command's progress and notices with the task's id as ``task``. threads: CPU threads of a render, 0 for
    all; not part of ``argv``, because the result does not depend on it.

    Failures are in the outcome, with ``attempts`` 1, or 0 if nothing was started; nothing is raised.
    """
    outcome = Outcome(task=task.id, state="failed", exit_code=InputError.exit_code, worker=worker)
    if version != VERSION:
        message = (
            f"{worker} has PhysGen {VERSION}, the job was planned by {version}; install the same version on all "
            "machines"
        )
        return dataclasses.replace(outcome, message=message)
    try:
        for sentence in recover(record_path(task, root)):
            on_event({"event": "notice", "task": task.id, "stage": task.stage, "message": sentence})
        record = up_to_date_record(task, root, version)
        if record is not None:
            return Outcome(
                task=task.id, state="kept", seconds=record.seconds, cpu_seconds=record.cpu_seconds, worker=record.worker
            )
        inputs = input_hashes(task, root)
        _await_folders(task, root, cancelled, on_event)
        ended = _run_command(task, root, cancelled, on_event, threads)
        outcome = dataclasses.replace(
            outcome,
            exit_code=ended.code,
            attempts=1,
            seconds=ended.seconds,
            cpu_seconds=ended.cpu_seconds,
        )
        if ended.cancelled and ended.code != 0:
            return dataclasses.replace(outcome, state="cancelled", exit_code=Cancelled.exit_code, message="cancelled")
        if ended.code != 0:
            return dataclasses.replace(outcome, message=_message(ended))
        return _finish(task, root, inputs, outcome)
    except PhysGenError as error:
        state = "cancelled" if isinstance(error, Cancelled) else "failed"
        return dataclasses.replace(outcome, state=state, exit_code=error.exit_code, message=str(error))


def _finish(task: Task, root: Path, inputs: tuple[tuple[str, str], ...], outcome: Outcome) -> Outcome:
    """Check the files of a finished command and write its record."""
    missing = [name for name in task.produces if not inside(root, name).is_file()]
    if missing:
        message = f"the command succeeded but did not write {missing[0]}; see its log"
        return dataclasses.replace(outcome, exit_code=1, message=message)
    record = Record(
        task=task.id,
        version=VERSION,
        argv=task.argv,
        inputs=inputs,
        produced=produced_hashes(task, root),
        seconds=outcome.seconds,
        cpu_seconds=outcome.cpu_seconds,
        worker=outcome.worker,
    )
    save_record(task, root, record)
    return dataclasses.replace(outcome, state="done")


def _message(ended: _Ended) -> str:
    if ended.final is not None and ended.final["event"] == "error":
        return str(ended.final.get("message"))
    if ended.code < 0:
        try:
            name = signal.Signals(-ended.code).name
        except ValueError:
            name = f"signal {-ended.code}"
        killed = f" ({how_it_was_killed(ended.kills_before)})" if name == "SIGKILL" else ""
        return f"the command was ended by {name}{killed}" + (f": {ended.words}" if ended.words else "")
    return f"the command ended with code {ended.code}: {ended.words or 'no output'}"


def _await_folders(task: Task, root: Path, cancelled: IsCancelled, on_event: OnEvent) -> None:
    """Wait while a process of an earlier attempt, whose parent was killed, still writes into the same folders.

    After ``FOLDER_WAIT_S`` the command is started anyway, and itself reports who holds the folder.
    """
    folders = {inside(root, name).parent for name in task.produces}
    deadline = time.monotonic() + FOLDER_WAIT_S
    reported = False
    while any(is_held(folder) for folder in folders) and time.monotonic() < deadline:
        if not reported:
            on_event({"event": "notice", "task": task.id, "stage": task.stage, "message": "waiting for another run"})
            reported = True
        if cancelled():
            raise Cancelled("cancelled while waiting for another run's folder")
        time.sleep(LOOK_S)


def _run_command(task: Task, root: Path, cancelled: IsCancelled, on_event: OnEvent, threads: int) -> _Ended:
    """Run the command of ``task`` to its end; return how it ended."""
    argv = [*task.argv]
    if threads > 0 and task.stage == "render":
        argv += ["--threads", str(threads)]
    with TaskLog(log_path(task, root), f"physgen {shlex.join(argv)}") as log:
        started = time.monotonic()
        process = start_process(own_command("batch.cli", *argv, "--json", folder=root, ends_with_us=True))
        # Bounded, so that a command with endless output blocks.
        lines: Queue[bytes | None] = Queue(maxsize=256)
        readers = [threading.Thread(target=_read, args=(process, error, lines), daemon=True) for error in (False, True)]
        for reader in readers:
            reader.start()
        ended = _Ended()
        try:
            _attend(process, lines, ended, log, cancelled, lambda event: on_event({**event, "task": task.id}))
        finally:
            _reap(process, ended, kill=True)
            ended.seconds = time.monotonic() - started
            _release(lines, readers)
        log.write(f"==== ended with code {ended.code}, {ended.cpu_seconds:.1f} CPU seconds".encode())
    return ended


def _attend(
    process: subprocess.Popen[bytes],
    lines: Queue[bytes | None],
    ended: _Ended,
    log: TaskLog,
    cancelled: IsCancelled,
    on_event: OnEvent,
) -> None:
    """Relay the output of ``process`` until it has ended, or must be killed."""
    asked_at: float | None = None
    gone_at: float | None = None
    open_pipes = 2
    while True:
        now = time.monotonic()
        if asked_at is None and cancelled():
            asked_at, ended.cancelled = now, True
            ask_to_stop(process)
        if asked_at is not None and now - asked_at > STOP_GRACE_S:
            return
        try:
            line = lines.get(timeout=LOOK_S)
        except Empty:
            # A process that outlives the command may keep its pipes open.
            _reap(process, ended, kill=False)
            if process.returncode is not None:
                gone_at = gone_at or now
                if open_pipes == 0 or now - gone_at > DRAIN_S:
                    return
            continue
        if line is not None:
            _hear(line, ended, log, on_event)
            continue
        open_pipes -= 1
        if open_pipes == 0 and _reaped_soon(process, ended):
            return


def _reaped_soon(process: subprocess.Popen[bytes], ended: _Ended) -> bool:
    """Return whether ``process``, whose pipes are closed, ends now, as it does unless it closed them itself."""
    deadline = time.monotonic() + LOOK_S
    while process.returncode is None and time.monotonic() < deadline:
        _reap(process, ended, kill=False)
        time.sleep(0.001)
    return process.returncode is not None


def _hear(line: bytes, ended: _Ended, log: TaskLog, on_event: OnEvent) -> None:
    event = parse_event(line)
    if event is None:
        log.write(line)
        ended.words = line.decode("utf-8", "replace").strip() or ended.words
    elif event["event"] in ("done", "error"):
        ended.final = event
        log.write(line)
    else:
        if event["event"] != "progress":
            log.write(line)
        on_event(event)


def _read(process: subprocess.Popen[bytes], error: bool, lines: Queue[bytes | None]) -> None:
    stream = process.stderr if error else process.stdout
    assert stream is not None
    while line := stream.readline(MOST_LINE_BYTES):
        lines.put(line)
    lines.put(None)


def _release(lines: Queue[bytes | None], readers: list[threading.Thread]) -> None:
    """Drain the queue of an ended process, so that its reader threads end as well."""
    deadline = time.monotonic() + DRAIN_S
    while any(reader.is_alive() for reader in readers) and time.monotonic() < deadline:
        with contextlib.suppress(Empty):
            lines.get(timeout=0.01)


def _reap(process: subprocess.Popen[bytes], ended: _Ended, *, kill: bool) -> None:
    """Collect the exit code of ``process``, and the CPU time of it and of its waited-for children."""
    if process.returncode is not None:
        return
    if kill:
        process.kill()
    if not hasattr(os, "wait4"):  # no CPU time on Windows
        code = process.wait() if kill else process.poll()
        ended.code = 0 if code is None else code
        return
    pid, status, usage = os.wait4(process.pid, 0 if kill else os.WNOHANG)
    if pid == 0:
        return
    # Popen would wait for it itself.
    process.returncode = ended.code = os.waitstatus_to_exitcode(status)
    ended.cpu_seconds = usage.ru_utime + usage.ru_stime
