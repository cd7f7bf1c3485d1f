# SPDX-License-Identifier: GPL-3.0-or-later
"""Encode frames as a video or an animated contact sheet, with Blender as a Python module or inside Blender:

    python batch/encode.py DIR [DIR …] --out FILE [--fps F] [--frames 1-48x2] [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/encode.py -- DIR [DIR …] --out FILE …

Exit codes: 0 done, 2 usage, 3 bad input, 5 encoding failed, 130 cancelled.
"""

from __future__ import annotations

import argparse
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

# The tree is imported inside functions: Blender may lack packages that it imports in turn.
if TYPE_CHECKING:
    from ..sim.errors import Cancelled


def work(options: argparse.Namespace, on_event: Any, cancelled: Any) -> tuple[dict[str, Any], str]:
    """Encode; return the ``done`` event, and the same in words."""
    from .commands.render_commands import encode

    done = encode(options, on_event, cancelled)
    return done, f"{done['frames']} frames at {done['fps']:g} fps: {options.out}"


def give_up(options: argparse.Namespace) -> Cancelled:
    """Remove incomplete files when Blender does not stop in time; return the error to report."""
    from ..sim.atomic import remove_unfinished
    from ..sim.errors import Cancelled

    remove_unfinished()
    return Cancelled(f"encoding cancelled; {options.out} was not written")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. Inside Blender the arguments follow ``--``."""
    from .blender_script import run_script
    from .commands.render_commands import add_encode

    text = "Frames → video or animated contact sheet."
    parser = argparse.ArgumentParser(prog="encode.py", description=text, allow_abbrev=False)
    add_encode(parser)
    return run_script(parser, work, give_up, arguments, stage="encode")


if __name__ == "__main__":
    if __package__:
        from .headless import leave

        leave(main)
    else:
        # A script belongs to no package: run it again as a module of its tree.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.encode", *sys.argv[1:]])
