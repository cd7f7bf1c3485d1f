# SPDX-License-Identifier: GPL-3.0-or-later
"""The warm worker's process as Blender sees it: nothing here ever waits, and nothing of bpy is touched.

A thread finds the interpreter, starts the process and reads what it says; another writes to it, so that a worker that
does not read can never stop Blender.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue

from ...sim.app.process import parse_event, read_errors, start_process
from ...sim.errors import PhysGenError
from ...sim.events import Event

STOP_GRACE_S = 5.0
"""How long the worker may take to end after its input is closed."""


class Client:
    """Starts and stops the worker, sends requests, hands out events.

    command: called in a thread, gives the worker's command line; may take seconds, may raise PhysGenError.
    at_end: called in that thread when the worker is gone.
    """

    def __init__(self, command: Callable[[], Sequence[str]], at_end: Callable[[], None]) -> None:
        self._command, self._at_end = command, at_end
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._requests: SimpleQueue[bytes | None] = SimpleQueue()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="physgen preview", daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    def send(self, request: Event) -> None:
        """Ask for a run; requests wait until the worker is there."""
        self._requests.put(json.dumps(request).encode() + b"\n")

    def events(self) -> list[Event]:
        """What the worker has said since the last call; ``{"event": "ended", "message"}`` when it is gone."""
        found = []
        while True:
            try:
                found.append(self._events.get_nowait())
            except Empty:
                return found

    def stop(self) -> None:
        """Let the worker end, by force if it does not want to; returns at once."""
        self._stopped.set()
        self._requests.put(None)

    def join(self, timeout: float) -> bool:
        """Wait for the worker's end, for at most ``timeout`` s; whether it has ended."""
        if self._thread.ident is None:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            command = list(self._command())
            if self._stopped.is_set():
                return
            self._serve(command)
        except (PhysGenError, OSError) as error:
            self._events.put({"event": "ended", "message": str(error)})
        finally:
            self._at_end()

    def _serve(self, command: list[str]) -> None:
        process = start_process(command, stdin=subprocess.PIPE)
        tail: deque[str] = deque(maxlen=10)
        threads = [
            threading.Thread(target=self._write, args=(process,), daemon=True),
            threading.Thread(target=read_errors, args=(process, tail), daemon=True),
        ]
        for thread in threads:
            thread.start()
        assert process.stdout is not None
        for line in process.stdout:
            event = parse_event(line)
            if event is not None:
                self._events.put(event)
        code = process.wait()
        self._requests.put(None)
        for thread in threads:
            thread.join(1.0)
        words = "" if self._stopped.is_set() else "\n".join(tail).strip() or f"the worker ended with code {code}"
        self._events.put({"event": "ended", "message": words})

    def _write(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            while (line := self._requests.get()) is not None:
                process.stdin.write(line)
                process.stdin.flush()
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(STOP_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
