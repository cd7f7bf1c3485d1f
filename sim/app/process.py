# SPDX-License-Identifier: MIT
"""A stage in a process of its own: events come back as JSON lines, cancelling is asked for, then enforced.

Taichi and bpy do not share a process (docs/design.md), and memory comes back when a stage ends.
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
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, Queue

from ..errors import Cancelled, InputError, PhysGenError, RenderError, SimulationError
from ..events import Event, IsCancelled, OnEvent

CANCEL_GRACE_S = 10.0
"""How long a stage may take to put things in order before it is killed."""

MOST_LINE_BYTES = 2**20
"""Longer lines are cut: none of ours comes near it."""

_ERRORS: dict[str, type[PhysGenError]] = {e.__name__: e for e in (InputError, SimulationError, RenderError, Cancelled)}
_STRIPPED = ("PYTHON", "LD_", "DYLD_")
_KEPT = ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")
NO_WINDOW = 0x08000000 if os.name == "nt" else 0
"""``creationflags`` of every child: no console window flashes up on Windows."""
_LAUNCHER = Path(__file__).with_name("launch.py")


def child_environment() -> dict[str, str]:
    """This process's environment without what would make another interpreter load the wrong libraries or wait.

    Events are lines of UTF-8, also on Windows, where Python would write something else into a pipe.
    """
    kept = {key: value for key, value in os.environ.items() if key in _KEPT or not key.upper().startswith(_STRIPPED)}
    return {**kept, "PYTHONUTF8": "1"}


def own_command(
    module: str,
    *arguments: str,
    python: str = sys.executable,
    packages: str = "",
    folder: Path | None = None,
    ends_with_us: bool = False,
) -> list[str]:
    """The command that runs ``module`` of this very tree, whatever the package is called in this process.

    module: from the tree's root, such as ``sim.app.worker``. python: interpreter, this one's by default. packages: a
    site-packages folder that it would not find by itself; those that this process was launched with are passed on by
    the environment. folder: where it runs, here by default. ends_with_us: it stops in good order when we die.
    """
    options = [*(["--packages", packages] if packages else []), *(["--folder", str(folder)] if folder else [])]
    if ends_with_us:
        options += ["--parent", str(os.getpid())]
    return [python, str(_LAUNCHER), *options, module, *arguments]


def start_process(command: Sequence[str], *, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
    """Start ``command`` with pipes for what it says, in a session of its own.

    Ctrl-C then reaches this process alone, which asks the other to stop in good order. Raises InputError when it cannot
    be started, as an interpreter that was deleted meanwhile.
    """
    try:
        return subprocess.Popen(
            list(command),
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=child_environment(),
            start_new_session=os.name != "nt",
            creationflags=0x00000200 | NO_WINDOW if os.name == "nt" else 0,  # a process group of its own
        )
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
    """Run ``command`` to its end, pass its events on and return its final ``done`` event.

    restarts: how often the stage is started again, with a notice, after it crashed; for stages that keep what they
    finished and go on from there.
    Raises the PhysGenError that the stage reported; Cancelled when ``cancelled()`` became true; ``failure`` with
    the last lines of its output when it died without a word.
    """
    while True:
        final, code, tail = _run_once(command, on_event, cancelled)
        if restarts == 0 or final is not None or not _crashed(code):
            break
        restarts -= 1
        on_event({"event": "notice", "message": f"the process crashed (code {code}); it goes on where it was"})
    if final is not None and final.get("event") == "error":
        raise _ERRORS.get(str(final.get("kind")), failure)(str(final.get("message")))
    # Asked to stop when its work was done already, a process may die of that before it has ended by itself.
    if final is None or (code != 0 and not cancelled()):
        words = "\n".join(tail).strip() or "it said nothing"
        raise failure(f"{_how_it_ended(code)}: {words}")
    return final


def _crashed(code: int) -> bool:
    """Whether a process with this exit code ended by a fault of its own, not by somebody who killed it."""
    faults = {getattr(signal, name, None) for name in ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGFPE", "SIGILL")}
    return -code in faults or (os.name == "nt" and code & 0xF0000000 == 0xC0000000)


def _how_it_ended(code: int) -> str:
    """Beginning of a sentence about a process with this exit code."""
    text = f"the process ended with code {code}"
    if code == -getattr(signal, "SIGKILL", 0):
        return f"{text} (it was killed, as the system does where memory runs out)"
    return f"{text} (it crashed)" if _crashed(code) else text


def _run_once(
    command: Sequence[str], on_event: OnEvent, cancelled: IsCancelled
) -> tuple[Event | None, int, deque[str]]:
    """The final event of ``command`` if it gave one, its exit code and the last lines of its chatter."""
    process = start_process(command)
    # Bounded, so that whatever prints without end fills no memory, but waits.
    lines: Queue[bytes | None] = Queue(maxsize=256)
    tail: deque[str] = deque(maxlen=30)
    readers = [
        threading.Thread(target=_read_events, args=(process, lines), daemon=True),
        threading.Thread(target=read_errors, args=(process, tail), daemon=True),
    ]
    for reader in readers:
        reader.start()
    try:
        final = _relay(process, lines, tail, on_event, cancelled)
    finally:
        _stop(process)
        for reader in readers:
            reader.join(timeout=5)
    return final, process.returncode, tail


def _relay(
    process: subprocess.Popen[bytes],
    lines: Queue[bytes | None],
    tail: deque[str],
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> Event | None:
    final: Event | None = None
    asked_at: float | None = None
    while True:
        if asked_at is None and cancelled():
            asked_at = time.monotonic()
            ask_to_stop(process)
        if asked_at is not None and time.monotonic() - asked_at > CANCEL_GRACE_S:
            process.kill()
            raise Cancelled("cancelled; the stage did not stop by itself and was killed, complete frames are kept")
        try:
            line = lines.get(timeout=0.1)
        except Empty:
            continue
        if line is None:
            process.wait()
            if final is None and asked_at is not None:
                raise Cancelled("cancelled while starting; run it again to continue")
            return final
        event = parse_event(line)
        if event is None:
            tail.append(line.decode("utf-8", "replace").rstrip())
        elif event["event"] in ("done", "error"):
            final = event
        else:
            on_event(event)


def parse_event(line: bytes) -> Event | None:
    """The event on ``line``, or None for the chatter of a library."""
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
    """Keep the last lines that ``process`` writes to standard error in ``tail``; a thread's work, until it ends."""
    assert process.stderr is not None
    while line := process.stderr.readline(MOST_LINE_BYTES):
        tail.append(line.decode("utf-8", "replace").rstrip())


def ask_to_stop(process: subprocess.Popen[bytes]) -> None:
    """Send ``process`` the signal by which all of ours stop in good order."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.CTRL_BREAK_EVENT if os.name == "nt" else signal.SIGTERM)  # type: ignore[attr-defined]


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Leave no process behind, whatever went wrong on this side."""
    if process.poll() is None:
        process.kill()
    process.wait()
