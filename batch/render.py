# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a baked scene into its photo, with Blender as a Python module or inside Blender:

    python batch/render.py SCENE --bake BAKE --out DIR [--frames 1-48x2] [--video out.mp4] [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/render.py -- SCENE --bake BAKE --out DIR …

Exit codes: 0 done, 2 usage, 3 bad input, 5 rendering failed, 130 cancelled; complete frames are kept.
"""

from __future__ import annotations

import argparse
import importlib
import runpy
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any


def _load(module: str) -> ModuleType:
    """A module of the tree, when it is needed: what it imports in turn, Blender may lack."""
    return importlib.import_module(f"..{module}", __package__)


def build_parser() -> argparse.ArgumentParser:
    """The script's arguments."""
    parser = argparse.ArgumentParser(prog="render.py", description="Baked scene → frames, video.", allow_abbrev=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all that are baked)")
    _load("batch.render_arguments").add_render_options(parser)
    parser.add_argument("--video", type=Path, metavar="VIDEO", help="also encode them: .mp4 or .webm")
    packages = "folder of modules that Blender's Python lacks (docs/headless.md)"
    parser.add_argument("--packages", type=Path, metavar="DIR", help=packages)
    parser.add_argument("--parent", type=int, metavar="PID", help="stop in good order when this parent process is gone")
    parser.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    return parser


def run(options: argparse.Namespace, terminal: Any, cancelled: Any) -> int:
    """Render as ``options`` ask, with a ``batch.terminal.Terminal`` to speak to; the exit code."""
    errors, headless = _load("sim.errors"), _load("batch.headless")
    started = time.monotonic()
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
            terminal({"event": "notice", "stage": "render", "message": found})
        frames, settings = _load("physgen_addon.bridge.frames"), _load("batch.render_arguments").render_options(options)
        folder = _load("sim.scene.folder").load_scene(options.scene)
        paths = frames.render_frames(
            folder, options.bake, options.out, settings, terminal, cancelled, frames=options.frames
        )
        done = {"event": "done", "frames": len(paths), "out": str(options.out)}
        if options.video is not None:
            manifest = _load("sim.cache.manifest").load_manifest(options.bake)
            bridge = _load("physgen_addon.bridge.ledger")
            ledger = bridge.Ledger(options.out, suffix=paths[0].suffix, fps=manifest.fps)
            fps = _load("physgen_addon.bridge.sequence").own_fps([int(path.stem) for path in paths], manifest.fps)
            if ledger.has_video(options.video, paths, fps):
                terminal({"event": "notice", "stage": "encode", "message": f"up to date: {options.video}"})
            else:
                _load("physgen_addon.bridge.video").encode(
                    paths, options.video, fps=fps, on_event=terminal, cancelled=cancelled
                )
                ledger.record_video(options.video, paths, fps)
            done["video"] = str(options.video)
    except errors.PhysGenError as error:
        return _report(error, terminal)
    except OSError as error:
        # Of the temporary folder, most likely: layers and textures pass through it.
        where = error.filename or Path(tempfile.gettempdir()).parent
        message = f"{where}: {error.strerror or error}; free space, then run again"
        return _report(errors.RenderError(message), terminal)
    done["seconds"] = round(time.monotonic() - started, 1)
    terminal(done)
    terminal.line(f"{done['frames']} frames in {done['out']}, {done['seconds']:.0f} s")
    return 0


def _report(error: Any, terminal: Any) -> int:
    """Say what the PhysGenError ``error`` says; the exit code it stands for."""
    terminal.error(type(error).__name__, str(error))
    return int(error.exit_code)


def _give_up(options: argparse.Namespace, terminal: Any) -> None:
    """Leave complete files only, when Blender cannot be waited for."""
    for folder in {options.out, *([options.video.parent] if options.video else [])}:
        _load("sim.atomic").remove_partials(folder)
    _load("sim.cache.lock").let_go(options.out)
    error = _load("sim.errors").Cancelled(
        "cancelled within a frame; complete frames are kept, run it again to continue"
    )
    _report(error, terminal)


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
        runpy.run_path(str(launch))["main"](["batch.render", *sys.argv[1:]])
