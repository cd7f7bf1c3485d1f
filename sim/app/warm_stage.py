# SPDX-License-Identifier: MIT
"""A stage whose process stays for the next job: what it has imported and compiled is there then.

Everything goes through pipes. The process ends when this one does, when it has been idle for some minutes, and when it
holds much memory after a job (``bake_worker.py``); the next job starts a fresh one then, as after a crash.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
from collections.abc import Sequence

from ..errors import Cancelled, PhysGenError, SimulationError
from ..events import Event, IsCancelled, OnEvent
from ..memory import memory_kills
from .stage_process import Listened, how_it_ended, raise_reported, start_process

CLOSE_GRACE_S = 2.0
"""Time that a process whose input is closed has for writing what it has compiled, s."""


class WarmStage:
    """At most one process, with one job at a time. Threads may share it: a job waits until the one before has ended."""

    def __init__(self) -> None:
        self._command: tuple[str, ...] = ()
        self._listened: Listened | None = None
        self._last_words = ""
        self._busy = threading.Lock()

    def run(
        self,
        command: Sequence[str],
        request: Event,
        on_event: OnEvent,
        cancelled: IsCancelled,
        *,
        failure: type[PhysGenError] = SimulationError,
    ) -> Event:
        """Send ``request`` to the process that ``command`` starts, relay its events, return its final ``done`` event.

        A process of another command is ended first. Raises as ``run_stage``: the PhysGenError that was reported;
        Cancelled when ``cancelled()`` became true; ``failure`` when the process died.
        """
        with self._busy:
            is_kept = self._is_ready(command)
            final, heard = self._ask(command, request, on_event, cancelled)
            if final is None and is_kept and not heard:
                # It ended, idle, just when the job came.
                final, _ = self._ask(command, request, on_event, cancelled)
            raise_reported(final, failure)
            if final is None:
                raise failure(self._last_words)
            return final

    def _ask(
        self,
        command: Sequence[str],
        request: Event,
        on_event: OnEvent,
        cancelled: IsCancelled,
    ) -> tuple[Event | None, bool]:
        """Send ``request``; return the final event, None where the process died, and whether there was any other."""
        listened, kills = self._listened or self._start(command), memory_kills()
        heard = False

        def relayed(event: Event) -> None:
            nonlocal heard
            heard = True
            on_event(event)

        listened.tail.clear()
        self._send(listened, json.dumps(request).encode())
        try:
            final = listened.relay(relayed, cancelled, stop=lambda: self._send(listened, b"cancel"))
        except Cancelled:
            self._drop()
            raise
        if final is None:
            self._drop()
            words = "\n".join(listened.tail).strip() or "no output"
            self._last_words = f"{how_it_ended(listened.process.returncode, kills)}: {words}"
        return final, heard

    def prepare(self, command: Sequence[str]) -> None:
        """Start the process for a job that will come, unless it runs; returns at once. Raises InputError."""
        if self._busy.acquire(blocking=False):
            try:
                if not self._is_ready(command):
                    self._start(command)
            finally:
                self._busy.release()

    def stop(self) -> None:
        """End the process: its input is closed, and a job is cancelled. Returns at once."""
        listened = self._listened
        if listened is not None and listened.process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                listened.process.stdin.close()

    def _is_ready(self, command: Sequence[str]) -> bool:
        """Return whether a process of ``command`` runs; one of another command, or one that has ended, is dropped."""
        listened = self._listened
        if listened is None:
            return False
        stdin = listened.process.stdin
        if self._command == tuple(command) and listened.process.poll() is None and stdin and not stdin.closed:
            return True
        self._drop()
        return False

    def _start(self, command: Sequence[str]) -> Listened:
        self._command = tuple(command)
        self._listened = Listened(start_process(command, stdin=subprocess.PIPE))
        return self._listened

    def _send(self, listened: Listened, line: bytes) -> None:
        """Write a line; a process that has ended says so by the end of its output."""
        assert listened.process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            listened.process.stdin.write(line + b"\n")
            listened.process.stdin.flush()

    def _drop(self) -> None:
        """End the process and forget it."""
        listened, self._listened = self._listened, None
        if listened is not None:
            assert listened.process.stdin is not None
            with contextlib.suppress(OSError, ValueError):
                listened.process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                listened.process.wait(CLOSE_GRACE_S)
            listened.end()
