# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the scripts of ``batch/``: work in a process that may be Blender's (docs/farm.md).

Started through ``sim/app/launch.py``, which makes a script a module of its tree.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from ..physgen_addon.interpreter import find_python, wheels_for
from ..sim.app import requirements
from ..sim.app.launch import PACKAGES_VARIABLE, STOP_SIGNALS
from ..sim.app.stage_process import child_environment, own_command
from ..sim.atomic import scratch_prefix
from ..sim.errors import Cancelled, InputError, PhysGenError
from .terminal import Terminal

STOP_GRACE_S = 0.7
"""Time for the current frame to finish when the process is asked to stop; the caller waits a little longer
 (``sim/app/stage_process.py``), and then kills."""

ECHO_S = 1.0
"""Signals within this time of the first count as one request."""

_FAULT = 1
"""Exit code of a bug in the program, as in Python."""


def in_blender() -> bool:
    """Return whether this is Blender's own process, not a Python with Blender as a module."""
    bpy: Any = sys.modules.get("bpy")
    return bpy is not None and bool(bpy.app.binary_path)


def script_arguments(argv: Sequence[str]) -> list[str]:
    """Return the script's part of the process's ``argv``: what follows ``--``, otherwise all except Blender's."""
    if "--" in argv:
        return list(argv[argv.index("--") + 1 :])
    return [] if in_blender() else list(argv[1:])


@contextlib.contextmanager
def events_apart_from_chatter() -> Iterator[TextIO]:
    """Yield the real standard output, while output of Blender's C code is redirected to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(kept), "w", encoding="utf-8", buffering=1) as stream:
            yield stream
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield one folder for all temporary files of this process, so that it can be removed at any time."""
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder:
        tempfile.tempdir = folder
        try:
            yield Path(folder)
        finally:
            tempfile.tempdir = None


def start_empty() -> None:
    """Inside Blender, unload the file, add-ons and settings that it was started with, without saving.

    Rendering into a photo then sees no scenes, handlers or preferences but Blender's own.
    """
    if in_blender():
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        # Persistent handlers survive loading.
        for name in dir(bpy.app.handlers):
            if name.startswith(("render_", "frame_change_", "depsgraph_update_", "composite_")):
                getattr(bpy.app.handlers, name).clear()


class Stop:
    """Whether this process should stop: after SIGINT, SIGTERM or the end of its parent."""

    def __init__(self, parent: int | None = None) -> None:
        """parent: process that this one works for, or None."""
        self._asked, self._insisted = threading.Event(), threading.Event()
        self._parent = parent

    def __call__(self) -> bool:
        """Return whether to stop; the work checks it between steps."""
        return self._asked.is_set() or (self._parent is not None and os.getppid() != self._parent)

    def listen(self, on_timeout: Callable[[], object]) -> None:
        """Install the signal handlers; called by the main thread.

        Work that has not ended ``STOP_GRACE_S`` after the request is inside a long render: another thread then calls
        ``on_timeout`` and ends the process as cancelled. A second signal does not wait.
        """
        # Python's handlers run when the main thread returns from Blender; the pipe is written at once.
        reading, writing = os.pipe()
        if os.name != "nt":
            os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        for number in STOP_SIGNALS:
            signal.signal(number, lambda *_: self._asked.set())
        threading.Thread(target=self._hear, args=(reading,), daemon=True).start()
        threading.Thread(target=self._force_exit, args=(on_timeout,), daemon=True).start()

    def _hear(self, pipe: int) -> None:
        heard_at: float | None = None
        while os.read(pipe, 1):
            now = time.monotonic()
            self._asked.set()
            heard_at = heard_at or now
            # ``timeout`` and schedulers signal the process and then its group: one request, not two.
            if now - heard_at > ECHO_S:
                self._insisted.set()

    def _force_exit(self, on_timeout: Callable[[], object]) -> None:
        while not self():
            time.sleep(0.05)
        self._insisted.wait(STOP_GRACE_S)
        with contextlib.suppress(OSError):
            on_timeout()
        if tempfile.tempdir is not None:
            shutil.rmtree(tempfile.tempdir, ignore_errors=True)
        _end(Cancelled.exit_code)


def leave(work: Callable[[], int]) -> NoReturn:
    """Do ``work`` and end the process with the exit code that it returns.

    In Blender a script that raises SystemExit ends with ``--python-exit-code``, or 0; and Blender occasionally crashes
    during shutdown, after all work is done, which a farm would take for a failed render. So where Blender is loaded it
    is not shut down.
    """
    try:
        code = work()
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else _FAULT if error.code else 0
    except KeyboardInterrupt:
        code = Cancelled.exit_code
    except Exception:
        traceback.print_exc()
        code = _FAULT
    if "bpy" not in sys.modules:
        sys.exit(code)
    _end(code)


def _end(code: int) -> NoReturn:
    """End at once, leaving no temporary files of Blender."""
    _remove_blenders_folder()
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


def _remove_blenders_folder() -> None:
    bpy: Any = sys.modules.get("bpy")
    if bpy is not None and Path(bpy.app.tempdir).name.startswith("blender_"):
        shutil.rmtree(bpy.app.tempdir, ignore_errors=True)


def run_verb(verb: str, given: Sequence[str]) -> int:
    """Run ``physgen VERB`` with the arguments ``given``; return the exit code, unless this process was replaced.

    Runs here if everything is installed, otherwise in the Python that simulates; never in Blender's own process.
    """
    asks = "-h" in given or "--help" in given
    if asks or not (in_blender() or requirements.missing()):
        try:
            from . import cli
        except ModuleNotFoundError:
            # Blender's Python lacks a package; the other one prints the same help.
            pass
        else:
            return cli.main([verb, *given])
    # Blender's own handler would ignore it, and the other Python would start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Packages for Blender's Python do not fit another; its own are passed below.
    os.environ.pop(PACKAGES_VARIABLE, None)
    try:
        python = find_python()
        _become(own_command("batch.cli", verb, *given, python=str(python), packages=wheels_for(python)))
    except PhysGenError as error:
        with events_apart_from_chatter() as stream:
            Terminal(as_json="--json" in given, out=stream).error(type(error).__name__, str(error))
        return error.exit_code


def _become(command: Sequence[str]) -> NoReturn:
    """Replace this process with ``command``: the same process for callers that wait for it, signal it or read it."""
    _remove_blenders_folder()
    sys.stdout.flush()
    sys.stderr.flush()
    try:
        if os.name != "nt":
            os.execve(command[0], list(command), child_environment())  # noqa: S606
        # Windows has no exec. Ctrl-C reaches both processes; the other one reports when it has stopped.
        signal.signal(signal.SIGINT, lambda *_: None)
        os._exit(subprocess.call(list(command), env=child_environment()))
    except OSError as error:
        raise InputError(f"{command[0]}: cannot be started ({error.strerror or error}); name another Python") from error


def main() -> int:
    """Entry point for the scripts of this folder, ``launch.py batch.headless VERB ARGS…``; returns the exit code."""
    return run_verb(sys.argv[1], script_arguments(sys.argv[1:]))


if __name__ == "__main__":
    leave(main)
