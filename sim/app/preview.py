# SPDX-License-Identifier: MIT
"""The warm worker of the live preview: requests as JSON lines on standard input, events on standard output.

It keeps compiled kernels, meshes and what was worked out of them, so that only the first run of a scene is slow. Only
the newest request counts: whatever runs is dropped when another one comes. It ends when its input is closed.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from ..errors import Cancelled, InputError, PhysGenError, SimulationError
from ..events import Event, IsCancelled, OnEvent, never
from .preview_request import PreviewRequest, parse_request, read_line, request_id

LAST_GRACE_S = 5.0
"""How long a run may still take to notice that nobody waits for it any more, before the process ends itself."""

PARENT_CHECK_S = 0.5


class _Inbox:
    """The newest request, as a thread reads them. clean: what is left to do when the process must end itself."""

    def __init__(self, stream: BinaryIO, on_event: OnEvent, clean: Callable[[], None]) -> None:
        self._stream, self._on_event, self._clean = stream, on_event, clean
        self._news = threading.Condition()
        self._newest: PreviewRequest | None = None
        self._stop_running = False
        self._closed = self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)

    def start(self, cancelled: IsCancelled) -> None:
        """Begin to read; ``cancelled`` ends it as the end of the stream does."""
        self._reader.start()
        threading.Thread(target=self._watch, args=(os.getppid(), cancelled), daemon=True).start()

    @property
    def reading(self) -> bool:
        """Whether the thread still waits for input."""
        return not self._ended

    def next(self) -> PreviewRequest | None:
        """Wait for a request and take it; None when no more will come."""
        with self._news:
            while self._newest is None and not self._closed:
                self._news.wait()
            request, self._newest = self._newest, None
            self._stop_running = False
            return None if self._closed else request

    def superseded(self) -> bool:
        """Whether the request that was taken last is of no interest any more."""
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
        # A kernel that is being compiled cannot be asked to stop.
        threading.Thread(target=self._end_at_last, daemon=True).start()

    def _end_at_last(self) -> None:
        time.sleep(LAST_GRACE_S)
        self._clean()
        os._exit(Cancelled.exit_code)


def _failure(number: int | None, error: PhysGenError) -> Event:
    return {"event": "error", "id": number, "kind": type(error).__name__, "message": str(error)}


def serve(out: Path, cancelled: IsCancelled = never) -> int:
    """Answer requests from standard input until it is closed or ``cancelled()``; the exit code.

    Runs go to folders ``out/run-NUMBER``; all but the newest two are removed again, those too at the end. Every event
    carries the ``id`` of its request (docs/file-formats.md). Raises InputError when ``out`` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: {error.strerror or error}; choose another folder") from error
    # Libraries print to standard output; events get a descriptor of their own.
    events = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    writing = threading.Lock()

    def emit(event: Event) -> None:
        try:
            with writing:
                events.write(json.dumps(event, ensure_ascii=False) + "\n")
        except OSError:
            # The asker is gone; its end of the input closes as well, and that ends the process.
            return

    runs = _Runs(out)
    inbox = _Inbox(sys.stdin.buffer, emit, runs.remove)
    inbox.start(cancelled)
    # Imported late: Taichi takes a second, in which requests are already read and wrong ones answered.
    from .preview_run import PreviewRunner

    emit({"event": "ready"})
    _answer(inbox, PreviewRunner().run, runs, emit)
    runs.remove()
    if inbox.reading:
        # Python refuses to end in good order while a thread waits for standard input.
        os._exit(Cancelled.exit_code)
    return 0


class _Runs:
    """The folders of the runs in ``out``: only the newest two exist, the one before in case somebody still reads it."""

    def __init__(self, out: Path) -> None:
        self._out, self._count = out, 0
        self._kept: list[Path] = []

    def new(self) -> Path:
        """A folder for the next run, not yet made."""
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
            # The worker outlives whatever a single scene does to it.
            reason = f"preview: {type(error).__name__}: {error}; change the scene or restart the preview"
            emit(_failure(number, SimulationError(reason)))
