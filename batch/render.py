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
import time
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any


def _load(module: str) -> ModuleType:
    """A module of the tree, when it is needed: what it imports in turn, Blender may lack."""
    return importlib.import_module(f"..{module}", __package__)


def build_parser() -> argparse.ArgumentParser:
    """The script's own arguments."""
    parser = argparse.ArgumentParser(prog="render.py", description="Baked scene → frames, video.", allow_abbrev=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all that are baked)")
    _load("batch.render_arguments").add_render_options(parser)
    parser.add_argument("--video", type=Path, metavar="VIDEO", help="also encode them: .mp4 or .webm")
    return parser


def work(options: argparse.Namespace, on_event: Any, cancelled: Any) -> tuple[dict[str, Any], str]:
    """Render as ``options`` ask; the event that says so, and the same in words."""
    started = time.monotonic()
    frames, settings = _load("physgen_addon.bridge.frames"), _load("batch.render_arguments").render_options(options)
    folder = _load("sim.scene.folder").load_scene(options.scene)
    paths = frames.render_frames(
        folder, options.bake, options.out, settings, on_event, cancelled, frames=options.frames
    )
    done = {"event": "done", "frames": len(paths), "out": str(options.out)}
    if options.video is not None:
        _encode(paths, options, on_event, cancelled)
        done["video"] = str(options.video)
    done["seconds"] = round(time.monotonic() - started, 1)
    return done, f"{done['frames']} frames in {done['out']}, {done['seconds']:.0f} s"


def _encode(paths: Sequence[Path], options: argparse.Namespace, on_event: Any, cancelled: Any) -> None:
    """The video of the frames at ``paths``, unless it is that already."""
    baked_fps = _load("sim.cache.manifest").load_manifest(options.bake).fps
    ledger = _load("physgen_addon.bridge.ledger").Ledger(options.out, suffix=paths[0].suffix, fps=baked_fps)
    fps = _load("physgen_addon.bridge.sequence").own_fps([int(path.stem) for path in paths], baked_fps)
    if ledger.has_video(options.video, paths, fps):
        on_event({"event": "notice", "stage": "encode", "message": f"up to date: {options.video}"})
        return
    _load("physgen_addon.bridge.video").encode(paths, options.video, fps=fps, on_event=on_event, cancelled=cancelled)
    ledger.record_video(options.video, paths, fps)


def give_up(options: argparse.Namespace) -> Exception:
    """Leave complete files only, when Blender cannot be waited for; what there is to say."""
    for folder in {options.out, *([options.video.parent] if options.video else [])}:
        _load("sim.atomic").remove_partials(folder)
    _load("sim.cache.lock").let_go(options.out)
    cancelled: Exception = _load("sim.errors").Cancelled(
        "cancelled within a frame; complete frames are kept, run it again to continue"
    )
    return cancelled


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry; the exit code. Inside Blender the arguments come after ``--``."""
    return int(_load("batch.blender_script").run_script(build_parser(), work, give_up, arguments, stage="render"))


if __name__ == "__main__":
    if __package__:
        _load("batch.headless").leave(main)
    else:
        # A plain file belongs to no package: it is run once more as a module of the tree that it lies in.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.render", *sys.argv[1:]])
