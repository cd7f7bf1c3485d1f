# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``encode``: frames, of one folder or in chunks, become a video or an animated contact sheet."""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

from ..physgen_addon.bridge.formats import SHEET_SUFFIXES, VIDEO_CODECS
from ..physgen_addon.bridge.ledger import FRAME_NAME
from ..physgen_addon.bridge.sequence import FrameSequence, gather
from ..sim.app.process import own_command, run_stage
from ..sim.errors import InputError, RenderError
from ..sim.events import Event, IsCancelled, OnEvent
from .terminal import Terminal

USUAL_FPS = 24.0
LEAST_FPS, MOST_FPS = 0.01, 1000.0


def add_encode(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen encode``."""
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="frames, or chunks of one clip's frames")
    out = ".mp4 (H.264) or .webm (VP9): a video; .png or .webp: an animated contact sheet"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    fps = f"frames a second (default: so that things move at their own speed; {USUAL_FPS:g} where it is not known)"
    parser.add_argument("--fps", type=float, metavar="F", help=fps)
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all that are there)")
    parser.add_argument("--allow-gaps", action="store_true", help="go on without frames that are missing")
    parser.add_argument("--tiles", metavar="CxR", help="of a contact sheet: columns and rows of stills (default 3x2)")
    parser.add_argument("--width", type=int, metavar="PX", help="of a contact sheet (default 960)")


def run_encode(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen encode``; the exit code."""
    if options.out.suffix.lower() in VIDEO_CODECS:
        # What can be refused is, before a process starts that holds bpy.
        _chosen(options)
        done = run_stage(_command(options), terminal, cancelled, failure=RenderError, restarts=1)
    else:
        done = encode(options, terminal, cancelled)
    terminal(done)
    terminal.line(f"{done['frames']} frames at {done['fps']:g} a second: {options.out}")
    return 0


def encode(options: argparse.Namespace, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Encode as ``options`` of ``add_encode`` say, a video in a process that holds bpy; the event that says so.

    Raises InputError for folders, frames, options and a file that cannot be used, RenderError when Blender fails,
    Cancelled when asked to stop.
    """
    chosen, fps = _chosen(options)
    if options.out.suffix.lower() in VIDEO_CODECS:
        from ..physgen_addon.bridge import video

        video.encode(chosen.paths, options.out, fps=fps, on_event=on_event, cancelled=cancelled)
    else:
        from ..physgen_addon.bridge.contact_sheet import write_sheet

        columns, rows = _tiles(options.tiles)
        size = {} if options.width is None else {"width": options.width}
        write_sheet(
            chosen.paths,
            chosen.numbers,
            options.out,
            fps=fps,
            columns=columns,
            rows=rows,
            on_event=on_event,
            cancelled=cancelled,
            **size,
        )
    return {"event": "done", "out": str(options.out), "frames": len(chosen.paths), "fps": fps}


def _chosen(options: argparse.Namespace) -> tuple[FrameSequence, float]:
    """What is to be encoded, and at how many frames a second. Raises InputError for what cannot be."""
    _require_name(options.out)
    if options.out.suffix.lower() in VIDEO_CODECS:
        for name in ("tiles", "width"):
            if getattr(options, name) is not None:
                raise InputError(
                    f"--{name}: is for contact sheets ({', '.join(SHEET_SUFFIXES)}), not {options.out.name}"
                )
    if options.fps is not None and not LEAST_FPS <= options.fps <= MOST_FPS:
        raise InputError(f"fps is {options.fps:g}: give {LEAST_FPS:g} to {MOST_FPS:g}")
    chosen = gather(options.folders, frames=options.frames, allow_gaps=options.allow_gaps)
    return chosen, options.fps or chosen.own_fps or USUAL_FPS


def _require_name(out: Path) -> None:
    known = (*VIDEO_CODECS, *SHEET_SUFFIXES)
    if out.suffix.lower() not in known or out.is_dir():
        raise InputError(f"{out}: give a file name that ends in {', '.join(known[:-1])} or {known[-1]}")
    if FRAME_NAME.fullmatch(out.name):
        raise InputError(f"{out}: is the name of a frame; give another, such as {out.with_name('clip' + out.suffix)}")


def _tiles(text: str | None) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text or "3x2")
    if match is None:
        raise InputError(f"tiles is {text!r}: write columns and rows, such as 3x2")
    return int(match[1]), int(match[2])


def _command(options: argparse.Namespace) -> list[str]:
    command = own_command("batch.encode", *(str(folder.resolve()) for folder in options.folders))
    command += ["--out", str(options.out.resolve()), "--json", "--parent", str(os.getpid())]
    if options.fps is not None:
        command += [f"--fps={options.fps!r}"]
    if options.frames is not None:
        command += [f"--frames={options.frames}"]
    return [*command, *(["--allow-gaps"] if options.allow_gaps else [])]
