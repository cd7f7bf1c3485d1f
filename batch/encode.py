# SPDX-License-Identifier: GPL-3.0-or-later
"""Encode frames as a video or an animated contact sheet, with Blender as a Python module or inside Blender:

    python batch/encode.py DIR [DIR …] --out FILE [--fps F] [--frames 1-48x2] [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/encode.py -- DIR [DIR …] --out FILE …

Exit codes: 0 done, 2 usage, 3 bad input, 5 encoding failed, 130 cancelled.
"""

from __future__ import annotations

import argparse
import importlib
import runpy
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any


def _load(module: str) -> ModuleType:
    """A module of the tree, when it is needed: what it imports in turn, Blender may lack."""
    return importlib.import_module(f"..{module}", __package__)


def build_parser() -> argparse.ArgumentParser:
    """The script's arguments."""
    text = "Frames → video or animated contact sheet."
    parser = argparse.ArgumentParser(prog="encode.py", description=text, allow_abbrev=False)
    _load("batch.videos").add_encode(parser)
    packages = "folder of modules that Blender's Python lacks (docs/headless.md)"
    parser.add_argument("--packages", type=Path, metavar="DIR", help=packages)
    parser.add_argument("--parent", type=int, metavar="PID", help="stop in good order when this parent process is gone")
    parser.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    return parser


def run(options: argparse.Namespace, terminal: Any, cancelled: Any) -> int:
    """Encode as ``options`` ask, with a ``batch.terminal.Terminal`` to speak to; the exit code."""
    errors, headless = _load("sim.errors"), _load("batch.headless")
    try:
        try:
            import bpy  # noqa: F401
        except ImportError as error:
            raise errors.RenderError(
                f"Blender as a Python module is not usable ({error}); run `make setup`, or run this file in Blender"
            ) from error
        headless.start_empty()
        found = _load("batch.modules").provide_modules(options.packages)
        if found is not None:
            terminal({"event": "notice", "stage": "encode", "message": found})
        done = _load("batch.videos").encode(options, terminal, cancelled)
    except errors.PhysGenError as error:
        return _report(error, terminal)
    except OSError as error:
        # Of the temporary folder, most likely: frames pass through it.
        where = error.filename or Path(tempfile.gettempdir()).parent
        message = f"{where}: {error.strerror or error}; free space, then run again"
        return _report(errors.RenderError(message), terminal)
    terminal(done)
    terminal.line(f"{done['frames']} frames at {done['fps']:g} a second: {options.out}")
    return 0


def _report(error: Any, terminal: Any) -> int:
    """Say what the PhysGenError ``error`` says; the exit code it stands for."""
    terminal.error(type(error).__name__, str(error))
    return int(error.exit_code)


def _give_up(options: argparse.Namespace, terminal: Any) -> None:
    """Leave no half of a file, when Blender cannot be waited for."""
    _load("sim.atomic").remove_partials(options.out.parent)
    _report(_load("sim.errors").Cancelled(f"encoding cancelled; {options.out} was not written"), terminal)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry; the exit code. Inside Blender the arguments come after ``--``."""
    headless, terminals = _load("batch.headless"), _load("batch.terminal")
    options = build_parser().parse_args(headless.script_arguments(sys.argv) if arguments is None else arguments)
    stop = headless.Stop(options.parent)
    with headless.events_apart_from_chatter() as stream, headless.temporary_folder():
        terminal = terminals.Terminal(as_json=options.json, out=stream)
        stop.listen(lambda: _give_up(options, terminal))
        return run(options, terminal, lambda: stop() or terminal.reader_gone)


if __name__ == "__main__":
    if __package__:
        _load("batch.headless").leave(main)
    else:
        # A plain file belongs to no package: it is run once more as a module of the tree that it lies in.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.encode", *sys.argv[1:]])
