# SPDX-License-Identifier: MIT
"""The warm worker of the live preview: requests as JSON lines on standard input, events on standard output.

It keeps compiled kernels, meshes and data derived from them, so that only the first run of a scene is slow. Only the
newest request counts: a running one is dropped when another arrives. It ends when its input is closed.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ..errors import Cancelled, InputError, PhysGenError, SimulationError
from ..events import Event, IsCancelled, OnEvent, never
from ..validation import parse

MAX_LINE = 1 << 20
"""Bytes of a request; longer lines are skipped."""


@dataclass(frozen=True, kw_only=True)
class PreviewRequest:
    """A request for a coarse run of a scene.

    id: the client's number of the request, 0 or more; every event of the run carries it.
    scene: absolute path of the scene folder.
    overrides: as read by ``sim.scene.overrides``, such as ``cube.velocity=1,0,0``.
    frames: samples, 2 to 1000; the first is the scene at rest.
    fps: frames per second, 1 to 1000.
    particles: of all deformable bodies together, 500 to 20000.
    """

    id: int
    scene: str
    overrides: tuple[str, ...] = ()
    frames: int = 48
    fps: float = 24.0
    particles: int = 2000

    def __post_init__(self) -> None:
        if self.id < 0:
            raise InputError(f"id is {self.id}: give 0 or more")
        if not 2 <= self.frames <= 1000:
            raise InputError(f"frames is {self.frames}: give 2 to 1000")
        if not (math.isfinite(self.fps) and 1 <= self.fps <= 1000):
            raise InputError(f"fps is {self.fps}: give 1 to 1000 frames per second")
        if not 500 <= self.particles <= 20_000:
            raise InputError(f"particles is {self.particles}: give 500 to 20000")


def parse_request(line: bytes) -> PreviewRequest:
    """Return the request on ``line``. Raises InputError for anything else."""
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        raise InputError("request: not a line of JSON") from None
    if not isinstance(data, dict):
        raise InputError("request: expected a JSON object")
    return parse(PreviewRequest, data, "request")


def request_id(line: bytes) -> int | None:
    """Return the id on ``line`` if it can be read, so that the client learns which request was refused."""
    try:
        found = json.loads(line)["id"]
    except (ValueError, RecursionError, KeyError, TypeError):
        return None
    return found if isinstance(found, int) and not isinstance(found, bool) else None


def read_line(stream: BinaryIO) -> bytes | None:
    """Return the next line of ``stream`` without line end; None at the end of the stream.

    Raises InputError for a line longer than ``MAX_LINE``, after skipping it.
    """
    line = stream.readline(MAX_LINE + 1)
    if not line:
        return None
    if len(line) > MAX_LINE and not line.endswith(b"\n"):
        while True:
            rest = stream.readline(MAX_LINE)
            if not rest or rest.endswith(b"\n"):
                break
        raise InputError(f"request: longer than {MAX_LINE} bytes")
    return line.rstrip(b"\r\n")


LAST_GRACE_S = 5.0
"""Time for a run to notice that it is no longer wanted, before the process ends itself."""

PARENT_CHECK_S = 0.5


class _Inbox:
    """The newest request; a thread reads them. clean: called before the process ends itself."""

    def __init__(self, stream: BinaryIO, on_event: OnEvent, clean: Callable[[], None]) -> None:
        self._stream, self._on_event, self._clean = stream, on_event, clean
        self._news = threading.Condition()
        self._newest: PreviewRequest | None = None
        self._stop_running = False
        self._closed = self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)

    def start(self, cancelled: IsCancelled) -> None:
        """Start reading; ``cancelled`` ends it like the end of the stream."""
        self._reader.start()
        threading.Thread(target=self._watch, args=(os.getppid(), cancelled), daemon=True).start()

    @property
    def reading(self) -> bool:
        """Return whether the thread is still waiting for input."""
        return not self._ended

    def next(self) -> PreviewRequest | None:
        """Wait for a request and return it; None when there will be no more."""
        with self._news:
            while self._newest is None and not self._closed:
                self._news.wait()
            request, self._newest = self._newest, None
            self._stop_running = False
            return None if self._closed else request

    def superseded(self) -> bool:
        """Return whether the current request is obsolete."""
        return self._stop_running or self._closed

    def _read(self) -> None:
        while True:
            line = b""
            try:
                found = read_line(self._stream)
                if found is None:
                    break
                line = found
                if not line.strip():
                    continue
                request = parse_request(line)
            except PhysGenError as error:
                self._on_event(_failure(request_id(line), error))
                continue
            except (OSError, ValueError):
                break
            with self._news:
                self._newest, self._stop_running = request, True
                self._news.notify()
        self._ended = True
        self._close()

    def _watch(self, parent: int, cancelled: IsCancelled) -> None:
        while os.getppid() == parent and not cancelled():
            time.sleep(PARENT_CHECK_S)
        self._close()

    def _close(self) -> None:
        with self._news:
            self._closed = True
            self._news.notify()
        # Compiling a kernel cannot be interrupted.
        threading.Thread(target=self._force_exit, daemon=True).start()

    def _force_exit(self) -> None:
        time.sleep(LAST_GRACE_S)
        self._clean()
        os._exit(Cancelled.exit_code)


def _failure(number: int | None, error: PhysGenError) -> Event:
    return {"event": "error", "id": number, "kind": type(error).__name__, "message": str(error)}


def serve(out: Path, cancelled: IsCancelled = never) -> int:
    """Serve requests from standard input until it is closed or ``cancelled()``; return the exit code.

    Runs are written to ``out/run-NUMBER``; all but the newest two are removed, and those at the end. Every event
    carries the ``id`` of its request (docs/file-formats.md). Raises InputError when ``out`` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: {error.strerror or error}; choose another folder") from error
    # Libraries print to standard output; events get their own descriptor.
    events = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    writing = threading.Lock()

    def emit(event: Event) -> None:
        try:
            with writing:
                events.write(json.dumps(event, ensure_ascii=False) + "\n")
        except OSError:
            # The client is gone; its end of standard input closes too, which ends the process.
            return

    runs = _Runs(out)
    inbox = _Inbox(sys.stdin.buffer, emit, runs.remove)
    inbox.start(cancelled)
    # Imported late: Taichi takes a second, during which requests are already read and bad ones refused.
    from .preview_simulation import PreviewRunner

    emit({"event": "ready"})
    _answer(inbox, PreviewRunner().run, runs, emit)
    runs.remove()
    if inbox.reading:
        # Python cannot exit cleanly while a thread waits for standard input.
        os._exit(Cancelled.exit_code)
    return 0


class _Runs:
    """Folders of the runs in ``out``: only the newest two are kept, as the previous one may still be read."""

    def __init__(self, out: Path) -> None:
        self._out, self._count = out, 0
        self._kept: list[Path] = []

    def new(self) -> Path:
        """Return the folder for the next run, not yet created."""
        self._count += 1
        folder = self._out / f"run-{self._count}"
        shutil.rmtree(folder, ignore_errors=True)
        self._kept.append(folder)
        while len(self._kept) > 2:
            shutil.rmtree(self._kept.pop(0), ignore_errors=True)
        return folder

    def remove(self) -> None:
        """Remove them all."""
        while self._kept:
            shutil.rmtree(self._kept.pop(), ignore_errors=True)


Run = Callable[[PreviewRequest, Path, OnEvent, IsCancelled], None]


def _answer(inbox: _Inbox, run: Run, runs: _Runs, emit: OnEvent) -> None:
    while (request := inbox.next()) is not None:
        number = request.id
        try:
            run(request, runs.new(), lambda event, number=number: emit({**event, "id": number}), inbox.superseded)  # type: ignore[misc]
        except Cancelled:
            emit({"event": "cancelled", "id": number})
        except PhysGenError as error:
            emit(_failure(number, error))
        except Exception as error:
            # No single scene may end the worker.
            reason = f"preview: {type(error).__name__}: {error}; change the scene or restart the preview"
            emit(_failure(number, SimulationError(reason)))
