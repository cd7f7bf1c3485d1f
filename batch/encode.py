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
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any


def _load(module: str) -> ModuleType:
    """A module of the tree, when it is needed: what it imports in turn, Blender may lack."""
    return importlib.import_module(f"..{module}", __package__)


def work(options: argparse.Namespace, on_event: Any, cancelled: Any) -> tuple[dict[str, Any], str]:
    """Encode as ``options`` ask; the event that says so, and the same in words."""
    done = _load("batch.videos").encode(options, on_event, cancelled)
    return done, f"{done['frames']} frames at {done['fps']:g} a second: {options.out}"


def give_up(options: argparse.Namespace) -> Exception:
    """Leave no half of a file, when Blender cannot be waited for; what there is to say."""
    _load("sim.atomic").remove_partials(options.out.parent)
    cancelled: Exception = _load("sim.errors").Cancelled(f"encoding cancelled; {options.out} was not written")
    return cancelled


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry; the exit code. Inside Blender the arguments come after ``--``."""
    text = "Frames → video or animated contact sheet."
    parser = argparse.ArgumentParser(prog="encode.py", description=text, allow_abbrev=False)
    _load("batch.videos").add_encode(parser)
    return int(_load("batch.blender_script").run_script(parser, work, give_up, arguments, stage="encode"))


if __name__ == "__main__":
    if __package__:
        _load("batch.headless").leave(main)
    else:
        # A plain file belongs to no package: it is run once more as a module of the tree that it lies in.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.encode", *sys.argv[1:]])
