# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``encode``, and the flags of ``RenderOptions`` for ``physgen render`` and ``batch/render.py``.

Imported in Blender's own process too: nothing here may need more than rendering does.
"""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

from ...physgen_addon.frames.frame_index import FRAME_NAME, FrameSequence, gather_frames
from ...physgen_addon.render.render_options import SHEET_SUFFIXES, VIDEO_CODECS, RenderOptions, flagged_fields
from ...sim.app.stage_process import own_command, run_stage
from ...sim.errors import InputError, RenderError
from ...sim.events import Event, IsCancelled, OnEvent
from ..terminal import Terminal


def add_render_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of ``RenderOptions``."""
    group = parser.add_argument_group("rendering")
    for item, flag, kind in flagged_fields():
        text, default = item.metadata["help"], item.default
        if kind is bool:
            text += f" (default: {'on' if default else 'off'})"
            group.add_argument(flag, action=argparse.BooleanOptionalAction, default=default, help=text)
            continue
        if default is not None:
            text += f" (default {default:g})" if isinstance(default, float) else f" (default {default})"
        choices, metavar = item.metadata["choices"], item.metadata["metavar"]
        group.add_argument(flag, type=kind, default=default, choices=choices, metavar=metavar, help=text)


def render_options(options: argparse.Namespace) -> RenderOptions:
    """Return the options given. Raises InputError for a value out of range."""
    values = {item.name: getattr(options, item.name) for item, _, _ in flagged_fields()}
    if values["camera"] is not None:
        # The process that renders may have another working folder.
        values["camera"] = str(Path(values["camera"]).absolute())
    return RenderOptions(**values)


USUAL_FPS = 24.0
LEAST_FPS, MOST_FPS = 0.01, 1000.0


def add_encode(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen encode``."""
    parser.add_argument(
        "folders", type=Path, nargs="+", metavar="DIR", help="frames folder, or several with chunks of one clip"
    )
    out = ".mp4 (H.264) or .webm (VP9): a video; .png or .webp: an animated contact sheet"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    fps = f"frames per second (default: real-time speed; {USUAL_FPS:g} if the bake's rate is unknown)"
    parser.add_argument("--fps", type=float, metavar="F", help=fps)
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all present)")
    parser.add_argument("--allow-gaps", action="store_true", help="ignore missing frames")
    parser.add_argument("--tiles", metavar="CxR", help="contact sheet: columns and rows of stills (default 3x2)")
    parser.add_argument("--width", type=int, metavar="PX", help="contact sheet: width in pixels (default 960)")


def run_encode(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen encode``; the exit code."""
    if options.out.suffix.lower() in VIDEO_CODECS:
        # Refuse bad input before starting a process with bpy.
        _frame_sequence(options)
        done = run_stage(_command(options), terminal, cancelled, failure=RenderError, restarts=1)
    else:
        done = encode(options, terminal, cancelled)
    terminal(done)
    terminal.line(f"{done['frames']} frames at {done['fps']:g} fps: {options.out}")
    return 0


def encode(options: argparse.Namespace, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Encode the ``options`` of ``add_encode``; return the ``done`` event. A video needs bpy in this process.

    Raises InputError for unusable folders, frames, options or file names, RenderError when Blender fails, Cancelled on
    request.
    """
    chosen, fps = _frame_sequence(options)
    if options.out.suffix.lower() in VIDEO_CODECS:
        from ...physgen_addon.frames import video_encoding

        video_encoding.encode_video(chosen.paths, options.out, fps=fps, on_event=on_event, cancelled=cancelled)
    else:
        from ...physgen_addon.frames.contact_sheet import write_contact_sheet

        columns, rows = _tiles(options.tiles)
        size = {} if options.width is None else {"width": options.width}
        write_contact_sheet(
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


def _frame_sequence(options: argparse.Namespace) -> tuple[FrameSequence, float]:
    """Return the frames to encode and the frames per second. Raises InputError."""
    _require_name(options.out)
    if options.out.suffix.lower() in VIDEO_CODECS:
        for name in ("tiles", "width"):
            if getattr(options, name) is not None:
                raise InputError(
                    f"--{name}: is for contact sheets ({', '.join(SHEET_SUFFIXES)}), not {options.out.name}"
                )
    if options.fps is not None and not LEAST_FPS <= options.fps <= MOST_FPS:
        raise InputError(f"fps is {options.fps:g}: give {LEAST_FPS:g} to {MOST_FPS:g}")
    chosen = gather_frames(options.folders, frames=options.frames, allow_gaps=options.allow_gaps)
    return chosen, options.fps or chosen.own_fps or USUAL_FPS


def _require_name(out: Path) -> None:
    known = (*VIDEO_CODECS, *SHEET_SUFFIXES)
    if out.suffix.lower() not in known or out.is_dir():
        raise InputError(f"{out}: give a file name that ends in {', '.join(known[:-1])} or {known[-1]}")
    if FRAME_NAME.fullmatch(out.name):
        raise InputError(f"{out}: is a frame's name; give another, such as {out.with_name('clip' + out.suffix)}")


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
