# SPDX-License-Identifier: MIT
"""The simulation process: ``python -m physgen.sim.app.bake_worker JOB.json``.

The job file is ``{"format": "physgen-job/1", "use_case": "bake", "scene": …, "out": …, "options": {…}}``. Events
go to standard output as JSON lines; SIGTERM, or the parent's death, cancels.

With ``--serve`` in place of the file it takes one job after the other as lines of standard input, so that imports and
compiled kernels are there for the next one (``stage_process.py``); the line ``cancel`` cancels. It ends when its input
is closed, when it has had no job for some minutes, and after a job that has left it large.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TextIO

from ..atomic import remove_unfinished
from ..errors import OUT_OF_MEMORY, Cancelled, InputError, PhysGenError
from ..events import Event, IsCancelled, OnEvent
from ..folder_lock import release_all
from ..memory import ran_out, resident_memory
from ..scene.folder import load_scene
from ..validation import parse, read_json, to_json
from .bake_options import BakeOptions, inputs_hash
from .launch import STOP_SIGNALS

JOB_FORMAT = "physgen-job/1"
SERVE = "--serve"
"""The argument in place of a job file."""
UNHEARD_S = 0.5
"""A bake checks for cancelling every tenth of a second. One that does not react within this time is compiling kernels
or preparing the scene, so there is nothing to save, and the process ends at once, as after a crash."""

RUNNING_UNHEARD_S = 0.7
"""The same once frames are computed: with millions of particles, or on a busy machine, a launch takes longer, and there
is something to save."""

RUNNING_LOOKS = 50
"""After this many checks a bake is computing frames."""

LAST_GRACE_S = 15.0
"""Longer than the caller waits before it kills (``run_stage``), in case the caller is gone."""


@dataclass(frozen=True, kw_only=True)
class BakeJob:
    """One bake.

    scene, out: absolute folders.
    expected_inputs: the caller's ``inputs_hash``, so that a scene changed by another process is never baked under the
    wrong name; None accepts the scene as it is.
    """

    scene: str
    out: str
    options: BakeOptions = field(default_factory=BakeOptions)
    expected_inputs: str | None = None


def job_to_json(job: BakeJob) -> dict[str, Any]:
    """Return the content of a job file."""
    return {"format": JOB_FORMAT, "use_case": "bake", **to_json(job)}


def run_job(path: Path, emit: OnEvent, cancelled: IsCancelled) -> Event:
    """Run the job file at ``path``; return the ``done`` event."""
    return _run(read_json(path), str(path), emit, cancelled)


def _run(data: Any, where: str, emit: OnEvent, cancelled: IsCancelled) -> Event:
    if not isinstance(data, dict) or data.pop("format", None) != JOB_FORMAT:
        raise InputError(f"{where}: not a job of format {JOB_FORMAT!r}")
    use_case = data.pop("use_case", None)
    if use_case != "bake":
        raise InputError(f"{where}: use_case is {use_case!r}: this version knows 'bake'")
    job = parse(BakeJob, data, where)
    if job.expected_inputs not in (None, inputs_hash(load_scene(Path(job.scene)), job.options)):
        raise InputError(f"{job.scene}: was changed by another run since this one started; run it again")
    # The commands that start this process need the job's format alone.
    from .bake import bake

    manifest = bake(
        load_scene(Path(job.scene)), out=job.out, options=job.options, on_event=emit, cancelled=cancelled
    ).manifest
    return {"event": "done", "stage": "bake", "out": job.out, "frames": manifest.frames_done}


class _Wish:
    """Whether this process is to stop, and whether its work has heard of it."""

    def __init__(self, parent: int | None = None) -> None:
        self.asked = threading.Event()
        self.heard = threading.Event()
        self.over = threading.Event()
        """Set when the work has ended and the process goes on."""
        self.looks = 0
        self._parent = os.getppid() if parent is None else parent

    def listen(self) -> None:
        """Take the signals that ask to stop, at once: Python's handlers wait until the main thread's present call into
        NumPy or SciPy is over, which can take seconds. The main thread calls this."""
        read, write = os.pipe()
        if os.name != "nt":
            os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in STOP_SIGNALS:
            signal.signal(number, lambda *_: self.asked.set())
        threading.Thread(target=self._await_signal, args=(read,), daemon=True).start()

    def _await_signal(self, pipe: int) -> None:
        os.read(pipe, 1)
        self.asked.set()

    def pending(self) -> bool:
        """Return whether cancelling was requested, or the caller is gone."""
        return self.asked.is_set() or os.getppid() != self._parent

    def cancelled(self) -> bool:
        """The same, asked by the work itself, which then stops in good order."""
        self.looks += 1
        if self.pending():
            self.heard.set()
        return self.heard.is_set()


def _force_exit(wish: _Wish, emit: OnEvent) -> None:
    """End the process when it was asked to stop and does not."""
    while not wish.pending():
        if wish.over.wait(0.05):
            return
    if not wish.heard.wait(UNHEARD_S if wish.looks < RUNNING_LOOKS else RUNNING_UNHEARD_S):
        with contextlib.suppress(OSError):
            emit(_error(Cancelled("bake cancelled in the middle of a long step; run it again to continue")))
    elif wish.over.wait(LAST_GRACE_S):
        return
    remove_unfinished()
    release_all()
    os._exit(Cancelled.exit_code)


def _error(error: PhysGenError) -> Event:
    return {"event": "error", "kind": type(error).__name__, "message": str(error)}


IDLE_S = 300.0
"""A process that has had no job for this long ends."""

MOST_KEPT_BYTES = 2**30
"""A process that holds more than this after a job ends: memory that Taichi keeps is freed with it."""

_CANCEL = b"cancel"


def _serve(emit: OnEvent) -> None:
    """Take jobs from standard input until it is closed, or for IDLE_S there is none."""
    inbox = _Inbox()
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: inbox.close())
    threading.Thread(target=inbox.read, daemon=True).start()
    # What every job needs, while the first one is not there yet.
    from .bake import bake  # noqa: F401
    from .simulation import build_world  # noqa: F401

    while (line := inbox.next()) is not None:
        _take_job(line, inbox.wish, emit)
        gc.collect()
        kept = resident_memory()
        if kept is None or kept > MOST_KEPT_BYTES:
            return


def _take_job(line: bytes, wish: _Wish, emit: OnEvent) -> None:
    """Run the job on ``line``; its error is an event, and the process lives on."""
    threading.Thread(target=_force_exit, args=(wish, emit), daemon=True).start()
    try:
        try:
            data = json.loads(line)
        except (ValueError, RecursionError):
            raise InputError("job: not a line of JSON") from None
        final = _run(data, "job", emit, wish.cancelled)
    except PhysGenError as error:
        final = _error(error)
    wish.over.set()
    emit(final)


class _Inbox:
    """Lines of standard input, read in a thread."""

    def __init__(self) -> None:
        self._parent = os.getppid()
        self._jobs: SimpleQueue[bytes | None] = SimpleQueue()
        self.wish = _Wish(self._parent)

    def next(self) -> bytes | None:
        """Wait for a job; None when there will be none."""
        try:
            return self._jobs.get(timeout=IDLE_S)
        except Empty:
            return None

    def close(self) -> None:
        """Cancel the present job; there will be no more."""
        self.wish.asked.set()
        self._jobs.put(None)

    def read(self) -> None:
        """Read until the input is closed, which cancels, too."""
        # Not sys.stdin: its lock would be held when the interpreter ends, and Taichi writes its kernels then.
        text = b""
        while found := os.read(0, 2**16):
            *lines, text = (text + found).split(b"\n")
            for line in lines:
                if line.strip() == _CANCEL:
                    self.wish.asked.set()
                elif line.strip():
                    self.wish = _Wish(self._parent)
                    self._jobs.put(line)
        self.close()


def main(arguments: list[str]) -> int:
    """Entry of the process; the exit code of docs/cli.md."""
    serves = arguments == [SERVE]
    wish = _Wish()
    if not serves:
        wish.listen()
    # Libraries print to standard output; events get a descriptor of their own.
    events: TextIO = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)

    def emit(event: Event) -> None:
        # Whoever asked may be gone: the end of the input then ends a process that serves.
        with contextlib.suppress(OSError) if serves else contextlib.nullcontext():
            events.write(json.dumps(event, ensure_ascii=False) + "\n")

    try:
        if serves:
            _serve(emit)
            return 0
        threading.Thread(target=_force_exit, args=(wish, emit), daemon=True).start()
        if len(arguments) != 1:
            raise InputError(f"worker: expected one job file, found {len(arguments)} arguments")
        emit(run_job(Path(arguments[0]), emit, wish.cancelled))
    except PhysGenError as error:
        emit(_error(error))
        return error.exit_code
    except (MemoryError, RuntimeError) as error:
        # Taichi's allocations and NumPy's fail by different names.
        if not ran_out(error):
            raise
        emit(_error(InputError(f"bake: {OUT_OF_MEMORY}")))
        return InputError.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
