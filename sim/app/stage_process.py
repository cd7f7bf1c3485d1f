# SPDX-License-Identifier: MIT
"""Run a stage in its own process, fresh for one job or warm for many.

Events come back as JSON lines, cancelling is requested, then enforced. Taichi and bpy cannot share a process
(docs/design.md), and a stage's memory is freed when it ends. A warm process stays for the next job: what it has
imported and compiled is there then. Everything goes through pipes. It ends when this process does, when it has been
idle for some minutes, and when it holds much memory after a job (``bake_worker.py``); the next job starts a fresh one
then, as after a crash.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import Empty, Queue

from ..errors import Cancelled, InputError, PhysGenError, RenderError, SimulationError
from ..events import Event, IsCancelled, OnEvent
from ..memory import how_it_was_killed, memory_kills
from ..processes import note_child

CANCEL_GRACE_S = 1.0
"""Time for a stage to clean up before it is killed: a command ends within two seconds of being asked to
(``batch/terminal.py``). What it had not kept by then is computed again; nothing that was complete is lost."""

MOST_LINE_BYTES = 2**22
"""Longer lines are cut. The longest of ours names the files of 100,000 frames, 1.4 MB."""

_ERRORS: dict[str, type[PhysGenError]] = {e.__name__: e for e in (InputError, SimulationError, RenderError, Cancelled)}
_STRIPPED = ("PYTHON", "LD_", "DYLD_")
_KEPT = ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")
NO_WINDOW = 0x08000000 if os.name == "nt" else 0
"""``creationflags`` of every child: no console window on Windows."""
_LAUNCHER = Path(__file__).with_name("launch.py")


def child_environment() -> dict[str, str]:
    """Return this environment without variables that would make another interpreter load wrong libraries or wait.

    Events are lines of UTF-8, also on Windows, where Python would use another encoding for pipes. Taichi's
    check for updates is disabled, also where it is started by itself.
    """
    kept = {key: value for key, value in os.environ.items() if key in _KEPT or not key.upper().startswith(_STRIPPED)}
    return {**kept, "PYTHONUTF8": "1", "TI_SKIP_VERSION_CHECK": "ON"}


def own_command(
    module: str,
    *arguments: str,
    python: str = sys.executable,
    packages: str = "",
    folder: Path | None = None,
    ends_with_us: bool = False,
) -> list[str]:
    """Return the command that runs ``module`` of this tree, whatever the package is called in this process.

    module: from the tree's root, such as ``batch.cli``. python: interpreter, this one's by default. packages: a
    site-packages folder that it would not find by itself; those that this process was launched with are inherited
    through the environment. folder: working folder, this one's by default. ends_with_us: it stops when we die.
    """
    options = [*(["--packages", packages] if packages else []), *(["--folder", str(folder)] if folder else [])]
    if ends_with_us:
        options += ["--parent", str(os.getpid())]
    return [python, str(_LAUNCHER), *options, module, *arguments]


def start_process(command: Sequence[str], *, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
    """Start ``command`` with pipes for its output, in its own session; return the process.

    Ctrl-C then reaches only this process, which asks the other to stop cleanly. Raises InputError when it cannot be
    started, such as an interpreter that has been deleted.
    """
    try:
        process = subprocess.Popen(
            list(command),
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=child_environment(),
            start_new_session=os.name != "nt",
            creationflags=0x00000200 | NO_WINDOW if os.name == "nt" else 0,  # a process group of its own
        )
        note_child(process)
        return process
    except OSError as error:
        raise InputError(
            f"{command[0]}: cannot be started ({error.strerror or error}); put it back, or choose another interpreter"
        ) from error


def run_stage(
    command: Sequence[str],
    on_event: OnEvent,
    cancelled: IsCancelled,
    *,
    failure: type[PhysGenError] = SimulationError,
    restarts: int = 0,
) -> Event:
    """Run ``command`` to its end, relay its events and return its final ``done`` event.

    restarts: number of restarts, with a notice, after a crash; for stages that resume from finished work.
    Raises the PhysGenError that the stage reported; Cancelled when ``cancelled()`` became true; ``failure`` with the
    last lines of its output when it died without reporting an error.
    """
    kills = memory_kills()
    while True:
        final, code, tail = _run_once(command, on_event, cancelled)
        if restarts == 0 or final is not None or not _crashed(code):
            break
        restarts -= 1
        on_event({"event": "notice", "message": f"the process crashed (code {code}); it is restarted and resumes"})
    raise_reported(final, failure)
    # A process that is asked to stop after its work was done may be killed by the signal while it ends.
    if final is None or (code != 0 and not cancelled()):
        words = "\n".join(tail).strip() or "no output"
        raise failure(f"{how_it_ended(code, kills)}: {words}")
    return final


def raise_reported(final: Event | None, failure: type[PhysGenError]) -> None:
    """Raise the PhysGenError that ``final`` reports, if it is one; ``failure`` where its kind is unknown."""
    if final is not None and final.get("event") == "error":
        raise _ERRORS.get(str(final.get("kind")), failure)(str(final.get("message")))


def _crashed(code: int) -> bool:
    """Return whether a process with this exit code crashed by itself, and was not killed."""
    faults = {getattr(signal, name, None) for name in ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGFPE", "SIGILL")}
    return -code in faults or (os.name == "nt" and code & 0xF0000000 == 0xC0000000)


def how_it_ended(code: int, kills_before: int | None, *, what: str = "the process") -> str:
    """Return the start of a sentence about a process with this exit code. kills_before: ``memory_kills`` at its start.

    A process that the kernel kills for lack of memory has no last word; whoever waits for it says it.
    """
    text = f"{what} ended with code {code}"
    if code == -getattr(signal, "SIGKILL", 0):
        return f"{text} ({how_it_was_killed(kills_before)})"
    return f"{text} (it crashed)" if _crashed(code) else text


def _run_once(
    command: Sequence[str], on_event: OnEvent, cancelled: IsCancelled
) -> tuple[Event | None, int, deque[str]]:
    """Return the final event of ``command`` if any, its exit code and the last lines of its other output."""
    listened = Listened(start_process(command))
    try:
        final = listened.relay(on_event, cancelled)
    finally:
        listened.end()
    return final, listened.process.returncode, listened.tail


class Listened:
    """A process whose output is read by threads.

    tail: the last lines of what it printed besides events.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.tail: deque[str] = deque(maxlen=30)
        # Bounded, so that endless output blocks instead of filling memory.
        self._lines: Queue[bytes | None] = Queue(maxsize=256)
        self._readers = [
            threading.Thread(target=_read_events, args=(process, self._lines), daemon=True),
            threading.Thread(target=read_errors, args=(process, self.tail), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def relay(
        self, on_event: OnEvent, cancelled: IsCancelled, *, stop: Callable[[], None] | None = None
    ) -> Event | None:
        """Relay events until the process has ended; return the final one, None where it had none.

        stop: how the process is asked to drop the present work, of which it then lives on: with it, the final event
        ends the relay. By default it is asked to end. Raises Cancelled when it had to be killed, or ended without one.
        """
        final: Event | None = None
        asked_at: float | None = None
        while True:
            if asked_at is None and cancelled():
                asked_at = time.monotonic()
                (stop or (lambda: ask_to_stop(self.process)))()
            if asked_at is not None and time.monotonic() - asked_at > CANCEL_GRACE_S:
                self.process.kill()
                raise Cancelled("cancelled; the stage did not stop in time and was killed, complete frames are kept")
            try:
                line = self._lines.get(timeout=0.1)
            except Empty:
                continue
            if line is None:
                self.process.wait()
                if final is None and asked_at is not None:
                    raise Cancelled("cancelled while starting; run it again to continue")
                return final
            event = parse_event(line)
            if event is None:
                self.tail.append(line.decode("utf-8", "replace").rstrip())
            elif event["event"] not in ("done", "error"):
                on_event(event)
            elif stop is not None:
                return event
            else:
                final = event

    def end(self) -> None:
        """Kill the process if it still runs, whatever happened here; wait for its readers."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for reader in self._readers:
            reader.join(timeout=5)


def parse_event(line: bytes) -> Event | None:
    """Return the event on ``line``, or None for other output, such as a library's."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) and "event" in value else None


def _read_events(process: subprocess.Popen[bytes], lines: Queue[bytes | None]) -> None:
    assert process.stdout is not None
    while line := process.stdout.readline(MOST_LINE_BYTES):
        lines.put(line)
    lines.put(None)


def read_errors(process: subprocess.Popen[bytes], tail: deque[str]) -> None:
    """Collect the last lines of standard error of ``process`` in ``tail``, until it ends; for a thread."""
    assert process.stderr is not None
    while line := process.stderr.readline(MOST_LINE_BYTES):
        tail.append(line.decode("utf-8", "replace").rstrip())


def ask_to_stop(process: subprocess.Popen[bytes]) -> None:
    """Send ``process`` the signal on which our processes stop cleanly."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.CTRL_BREAK_EVENT if os.name == "nt" else signal.SIGTERM)  # type: ignore[attr-defined]


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
