# SPDX-License-Identifier: GPL-3.0-or-later
"""What ``batch/render.py`` and ``batch/encode.py`` are besides their work, which needs Blender in this process."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from ..sim.errors import Cancelled, PhysGenError, RenderError
from ..sim.events import Event, IsCancelled, OnEvent
from .headless import Stop, events_apart_from_chatter, script_arguments, start_empty, temporary_folder
from .modules import provide_modules
from .terminal import Terminal

Work = Callable[[argparse.Namespace, OnEvent, IsCancelled], tuple[Event, str]]
"""Does what the options ask for; its ``done`` event, and the same in words. Raises a PhysGenError."""


def add_script_options(parser: argparse.ArgumentParser) -> None:
    """Where the script's modules are, whom it works for, how it speaks."""
    packages = "folder of modules that Blender's Python lacks (docs/headless.md)"
    parser.add_argument("--packages", type=Path, metavar="DIR", help=packages)
    parser.add_argument("--parent", type=int, metavar="PID", help="stop in good order when this parent process is gone")
    parser.add_argument("--json", action="store_true", help="progress and result as JSON lines")


def run_script(
    parser: argparse.ArgumentParser,
    work: Work,
    give_up: Callable[[argparse.Namespace], Cancelled],
    arguments: Sequence[str] | None,
    *,
    stage: str,
) -> int:
    """Parse, prepare Blender and do ``work``; the exit code (docs/headless.md).

    parser: with the script's own arguments. give_up: leaves complete files only, when Blender cannot be waited for, and
    says so. arguments: None for those of the process, which inside Blender come after ``--``. stage: of the events.
    """
    add_script_options(parser)
    options = parser.parse_args(script_arguments(sys.argv) if arguments is None else arguments)
    stop = Stop(options.parent)
    with events_apart_from_chatter() as stream, temporary_folder():
        terminal = Terminal(as_json=options.json, out=stream)
        stop.listen(lambda: _report(give_up(options), terminal))
        try:
            _prepare(options.packages, terminal, stage)
            done, words = work(options, terminal, lambda: stop() or terminal.reader_gone)
        except PhysGenError as error:
            return _report(error, terminal)
        except OSError as error:
            # Of the temporary folder, most likely: layers, textures and frames pass through it.
            where = error.filename or Path(tempfile.gettempdir()).parent
            message = f"{where}: {error.strerror or error}; free space, then run again"
            return _report(RenderError(message), terminal)
        terminal(done)
        terminal.line(words)
        return 0


def _prepare(packages: Path | None, terminal: Terminal, stage: str) -> None:
    """Empty Blender, and find what its Python lacks. Raises RenderError where there is none, or not all."""
    try:
        import bpy  # noqa: F401
    except ImportError as error:
        raise RenderError(
            f"Blender as a Python module is not usable ({error}); run `make setup`, or run this file in Blender"
        ) from error
    start_empty()
    found = provide_modules(packages)
    if found is not None:
        terminal({"event": "notice", "stage": stage, "message": found})


def _report(error: PhysGenError, terminal: Terminal) -> int:
    """Say what ``error`` says; the exit code it stands for."""
    terminal.error(type(error).__name__, str(error))
    return error.exit_code
