# SPDX-License-Identifier: MIT
"""A user's program run to its end: no shell, a time limit, its last words kept, and nothing of it left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from ...errors import Cancelled, InputError
from ...events import IsCancelled

POLL_S = 0.05
MOST_LINE_BYTES = 2**16
TAIL_LINES = 12
TAIL_CHARACTERS = 2000
_STRIPPED = ("PYTHON", "LD_", "DYLD_")
"""What would make the user's interpreter load this one's libraries; ``environment`` can set it again."""


def run_command(
    arguments: Sequence[str],
    folder: Path,
    environment: Sequence[tuple[str, str]],
    time_limit_s: float,
    output: Path,
    most_bytes: int,
    cancelled: IsCancelled,
    where: str,
) -> None:
    """Run ``arguments`` in ``folder`` until it has written ``output``, a file of at most ``most_bytes``, or a folder.

    It and all that it started are killed when the time is over, ``cancelled()`` is true, ``output`` grows too large, or
    it has ended. Raises InputError, naming ``where`` and the last lines it wrote, unless it ended with 0 and left
    ``output``; Cancelled.
    """
    kept = {name: text for name, text in os.environ.items() if not name.upper().startswith(_STRIPPED)}
    try:
        process = subprocess.Popen(
            list(arguments),
            cwd=folder,
            env={**kept, **dict(environment)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=os.name != "nt",
            creationflags=0x08000200 if os.name == "nt" else 0,  # no window, a process group of its own
        )
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: {arguments[0]} cannot be started ({error}); correct its command") from None
    tail: deque[str] = deque(maxlen=TAIL_LINES)
    assert process.stdout is not None
    reader = threading.Thread(target=_keep_tail, args=(process.stdout, tail), daemon=True)
    reader.start()
    try:
        reason = _wait(process, time_limit_s, output, most_bytes, cancelled)
    finally:
        _kill(process)
        # What escaped into a session of its own may hold the pipe open for ever: it is left alone.
        reader.join(timeout=1)
    words = "\n".join(tail)[-TAIL_CHARACTERS:].strip() or "it said nothing"
    if reason is not None:
        raise InputError(f"{where}: {reason}; it was killed. Its last words: {words}")
    if process.returncode != 0:
        raise InputError(f"{where}: ended with code {process.returncode}. Its last words: {words}")
    if not output.is_file() and not output.is_dir():
        raise InputError(f"{where}: wrote no {output.name}; it must write to {{output}}. Its last words: {words}")
    if output.is_file() and output.stat().st_size > most_bytes:
        raise InputError(f"{where}: {_too_large(output, most_bytes)}")


def _wait(
    process: subprocess.Popen[bytes], limit_s: float, output: Path, most_bytes: int, cancelled: IsCancelled
) -> str | None:
    """Why it had to be stopped; None when it ended by itself."""
    end = time.monotonic() + limit_s
    while process.poll() is None:
        if cancelled():
            raise Cancelled("cancelled while a user's program ran; it was killed")
        if time.monotonic() > end:
            return f"did not end within {limit_s:g} s (time_limit_s)"
        with contextlib.suppress(OSError):
            if output.is_file() and output.stat().st_size > most_bytes:
                return _too_large(output, most_bytes)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(POLL_S)
    return None


def _too_large(output: Path, most_bytes: int) -> str:
    return f"wrote {output.stat().st_size} bytes to {output.name}, more than the {most_bytes} that fit this picture"


def _keep_tail(stream: IO[bytes], tail: deque[str]) -> None:
    with contextlib.suppress(OSError, ValueError):
        while line := stream.readline(MOST_LINE_BYTES):
            text = line.decode("utf-8", "replace").rstrip()
            if text:
                tail.append(text[-TAIL_CHARACTERS:])


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill ``process`` and what it started, also what goes on after it has ended."""
    if os.name == "nt":
        if process.poll() is None:
            system = Path(os.environ.get("SYSTEMROOT", r"C:\Windows")) / "System32" / "taskkill.exe"
            with contextlib.suppress(OSError):
                subprocess.run([str(system), "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False)
    else:
        # Its group has its number, and lives as long as one of its members does.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(OSError):
        process.kill()
    process.wait()
