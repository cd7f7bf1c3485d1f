# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a baked scene into its photo, with Blender as a Python module or inside Blender:

    python batch/render.py SCENE --bake BAKE --out DIR [--frames 1-48x2] [--video out.mp4] [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/render.py -- SCENE --bake BAKE --out DIR …

Exit codes: 0 done, 2 usage, 3 bad input, 5 rendering failed, 130 cancelled; complete frames are kept.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

# The tree is imported inside functions: Blender may lack packages that it imports in turn.
if TYPE_CHECKING:
    from ..sim.errors import Cancelled


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's own arguments."""
    from .commands.render_commands import add_render_flags

    parser = argparse.ArgumentParser(prog="render.py", description="Baked scene → frames, video.", allow_abbrev=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all baked frames)")
    add_render_flags(parser)
    parser.add_argument("--video", type=Path, metavar="VIDEO", help="also encode a video: .mp4 or .webm")
    return parser


def work(options: argparse.Namespace, on_event: Any, cancelled: Any) -> tuple[dict[str, Any], str]:
    """Render; return the ``done`` event, and the same in words."""
    from ..sim.cache.bake_folder import load_bake
    from ..sim.scene.folder import load_scene
    from .commands.render_commands import render_options

    started = time.monotonic()
    scene, bake, settings = load_scene(options.scene), load_bake(options.bake), render_options(options)
    frames = import_module("..physgen_addon.render.render_frames", __package__)
    paths = frames.render_frames(
        scene,
        bake,
        out=options.out,
        options=settings,
        frames=options.frames,
        on_event=on_event,
        cancelled=cancelled,
    )
    done: dict[str, Any] = {"event": "done", "frames": len(paths), "out": str(options.out)}
    done["files"] = [path.name for path in paths]
    if options.video is not None:
        _encode(paths, bake.manifest.fps, options, on_event, cancelled)
        done["video"] = str(options.video)
    done["seconds"] = round(time.monotonic() - started, 1)
    return done, f"{done['frames']} frames in {done['out']}, {done['seconds']:.0f} s"


def _encode(
    paths: Sequence[Path], baked_fps: float, options: argparse.Namespace, on_event: Any, cancelled: Any
) -> None:
    """Encode the frames at ``paths``, unless the video is up to date."""
    from ..physgen_addon.frames.frame_index import FrameIndex, own_fps

    index = FrameIndex(options.out, suffix=paths[0].suffix, fps=baked_fps)
    fps = own_fps([int(path.stem) for path in paths], baked_fps)
    if index.has_video(options.video, paths, fps):
        on_event({"event": "notice", "stage": "encode", "message": f"up to date: {options.video}"})
        return
    video = import_module("..physgen_addon.frames.video_encoding", __package__)
    video.encode_video(paths, options.video, fps=fps, on_event=on_event, cancelled=cancelled)
    index.record_video(options.video, paths, fps)


def give_up(options: argparse.Namespace) -> Cancelled:
    """Remove incomplete files when Blender does not stop in time; return the error to report."""
    from ..sim.atomic import remove_unfinished
    from ..sim.errors import Cancelled
    from ..sim.folder_lock import release_all

    remove_unfinished()
    release_all()
    return Cancelled("cancelled within a frame; complete frames are kept, run it again to continue")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. Inside Blender the arguments follow ``--``."""
    from .blender_script import run_script

    return run_script(build_parser(), work, give_up, arguments, stage="render")


if __name__ == "__main__":
    if __package__:
        from .headless import leave

        leave(main)
    else:
        # A script belongs to no package: run it again as a module of its tree.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.render", *sys.argv[1:]])
