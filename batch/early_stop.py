# SPDX-License-Identifier: GPL-3.0-or-later
"""First steps of a command, before its modules are imported: heed signals, and watch for how it is killed.

Importing NumPy and the rest takes a second, on a busy machine many. Nothing is written before ``cli.main`` takes
the signals over (``terminal.stop_signals``), so ending at once loses nothing. Imported first, and light; what has
to be set before NumPy is imported is set here, too.

On Linux the command then works in a child. A process that the kernel kills, as memory ran out, cannot say so itself:
its parent, which has imported nothing, waits, passes signals on, and says it. Both end together, whichever is killed.
A worker that hears nothing, in a long call of a library that lets no other thread run, is ended by it, too.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
from pathlib import PurePath
from types import TracebackType

from ..sim.app.launch import ONE_BLAS_THREAD, STOP_SIGNALS

CANCELLED = 130
"""Exit code of ``Cancelled`` in sim/errors.py."""
LAST_S = 1.9
"""A command that was asked to stop has ended so long afterwards, whatever it is doing. By itself it does at
``terminal.STOP_S``, and then leaves nothing for the next command to sweep."""
LACKING = 3
"""Exit code of ``InputError`` there."""
KILLED = 128 + 9
"""Exit code of a command that SIGKILL has ended, as shells give it."""

_PR_SET_PDEATHSIG = 1


def _is_own_process() -> bool:
    """Return whether this process is the ``physgen`` command, not a program that uses its modules."""
    started = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = "" if started is None else started.name
    return module.endswith((".batch.cli", "physgen.__main__")) or PurePath(sys.argv[0]).stem == "physgen"


def _is_typed() -> bool:
    """Return whether it was started as people start it; other programs start ``batch.cli``, and wait for it."""
    started = getattr(sys.modules.get("__main__"), "__spec__", None)
    return PurePath(sys.argv[0]).stem == "physgen" or (
        started is not None and started.name.endswith("physgen.__main__")
    )


def heed() -> None:
    """End this process at once, with the code for cancelled, when it is asked to stop."""
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: os._exit(CANCELLED))


def fill_streams() -> None:
    """Have the null device in the place of standard streams that were closed (``physgen … >&-``): the next files that
    are opened would get their numbers, and what is printed would go into those."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is not None:
            continue
        with contextlib.suppress(OSError):
            null = os.open(os.devnull, os.O_RDWR)
            if null == number:
                os.set_inheritable(number, True)
            else:
                # Nothing was closed there, or something took it since.
                os.close(null)
            setattr(sys, name, open(os.devnull, "r+" if number else "r", encoding="utf-8"))  # noqa: SIM115, PTH123


def _ended_by(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Report what ``cli.main`` did not get to see: libraries that cannot be loaded for lack of memory, in one line."""
    from ..sim.memory import ran_out

    if ran_out(error):
        _say(
            "InputError",
            f"{_command()}: memory ran out while it was starting: close other programs, or raise the limit",
        )
        os._exit(LACKING)
    sys.__excepthook__(kind, error, trace)


def _command() -> str:
    return " ".join(sys.argv[1:2]) or "physgen"


def work_in_child() -> None:
    """Return in a child of this process, which ends with it; this process waits for it and ends as it did.

    Returns in this process where there can be no such child: elsewhere than on Linux, or where no process can start.
    """
    if not sys.platform.startswith("linux"):
        return
    # Imported here: signals have to be heeded before.
    from ..sim.memory import how_it_was_killed, memory_kills

    kills, parent = memory_kills(), os.getpid()
    try:
        child = os.fork()
    except OSError:
        return
    if child == 0:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:
            os._exit(KILLED)
        return
    late: list[int] = []

    def ask(number: int, frame: object) -> None:
        _send(child, number)
        if not any(signal.getitimer(signal.ITIMER_REAL)):
            signal.setitimer(signal.ITIMER_REAL, LAST_S)

    def end(number: int, frame: object) -> None:
        late.append(number)
        _send(child, signal.SIGKILL)

    signal.signal(signal.SIGALRM, end)
    for number in STOP_SIGNALS:
        signal.signal(number, ask)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        os._exit(code)
    if late:
        _say("Cancelled", "cancelled in the middle of a long step; run it again to continue")
        os._exit(CANCELLED)
    if code == -signal.SIGKILL:
        _say("Killed", f"{_command()}: {how_it_was_killed(kills)}; run it again to go on")
        os._exit(KILLED)
    # Of a fault: as if there were no child, for whoever asks how this process ended.
    signal.signal(-code, signal.SIG_DFL)
    os.kill(parent, -code)
    os._exit(128 - code)


def _send(child: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, number)


def _say(kind: str, message: str) -> None:
    """Print the error as ``Terminal`` does, which is not imported here."""
    if "--json" in sys.argv:
        text, to = json.dumps({"event": "error", "kind": kind, "message": message}), 1
    else:
        text, to = f"\nerror: {message}", 2
    with contextlib.suppress(OSError):
        os.write(to, f"{text}\n".encode())


if _is_own_process():
    heed()
    fill_streams()
    sys.excepthook = _ended_by
    os.environ.setdefault(*ONE_BLAS_THREAD)
    if _is_typed():
        work_in_child()
