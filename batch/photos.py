# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs from a photo to its video: ``run``, ``reconstruct``, ``correct``, ``import``, ``light``, ``render``."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..physgen_addon.bridge.formats import require_video_name
from ..sim.app.correct import correct_scene, require_stamp
from ..sim.app.import_folder import import_folder
from ..sim.app.import_splats import DEFAULT_UP, UPS
from ..sim.app.light import set_light
from ..sim.app.reconstruct import reconstruct_scene, require_physics, set_all_physics
from ..sim.events import IsCancelled
from ..sim.reconstruct.pipeline import object_names
from ..sim.scene.json_fields import to_json
from ..sim.scene.overrides import check_overrides
from . import pipeline
from .arguments import (
    add_bake_options,
    add_physics,
    add_sun,
    bake_options,
    light_request,
    physics,
)
from .photo_arguments import (
    add_asking,
    add_environment,
    add_objects,
    add_reading,
    chat_request,
    corrected_requests,
    object_requests,
    reconstruct_options,
)
from .render_arguments import add_render_options, render_options
from .terminal import Terminal


def add_run(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen run``."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    add_objects(parser)
    add_reading(parser)
    add_asking(parser)
    add_physics(parser)
    add_bake_options(parser)
    add_render_options(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="VIDEO.mp4", help="the video")
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="keeps scene, bake and frames (default: beside the video)"
    )


def add_reconstruct(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen reconstruct``."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    add_objects(parser)
    add_reading(parser)
    add_asking(parser)
    add_physics(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")


def add_correct(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen correct``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a scene folder that was reconstructed from a photo")
    add_objects(parser, boxes=False)
    add_reading(parser)


def add_import(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen import``."""
    what = "folder of PhysGen3D or PhysGen (docs/importing.md), or PLY file of splats (docs/moving-splats.md)"
    parser.add_argument("folder", type=Path, metavar="SOURCE", help=what)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")
    scale = "largest extent of the first object; sets the scale of the scene (default: as simulated there, else 0.15)"
    parser.add_argument("--size", type=float, metavar="METRES", help=scale)
    up = f"axis of a file of splats that points up, or down (default: {DEFAULT_UP})"
    parser.add_argument("--up", choices=UPS, help=up)
    settings = "of PhysGen3D's simulation, with velocities and friction (default: looked for)"
    parser.add_argument("--settings", type=Path, metavar="FILE.yaml", help=settings)


def add_light(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen light``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    add_environment(parser)
    add_sun(parser)


def add_render(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen render``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all)")
    parser.add_argument("--video", type=Path, metavar="VIDEO", help="also encode them: .mp4 or .webm")
    add_render_options(parser)


def run_run(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen run``; the exit code."""
    require_video_name(options.out)
    work = options.work or options.out.resolve().with_name(options.out.resolve().stem + "_work")
    request = pipeline.RunRequest(
        photo=options.photo,
        objects=object_requests(options, work / "scene"),
        video=options.out,
        work=work,
        presets=tuple(options.preset),
        velocities=tuple(options.velocity),
        spins=tuple(options.spin),
        overrides=tuple(options.overrides),
        reconstruct=reconstruct_options(options),
        ask=chat_request(options),
        bake=bake_options(options),
        render=render_options(options),
    )
    pipeline.run(request, terminal, cancelled)
    terminal(
        {"event": "done", "video": str(request.video), "scene": str(request.work / "scene"), "work": str(request.work)}
    )
    terminal.line(f"video: {request.video}\nscene: {request.work / 'scene'}")
    return 0


def run_reconstruct(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen reconstruct``; the exit code."""
    settings, ask = reconstruct_options(options), chat_request(options)
    requests = object_requests(options, options.out)
    require_physics(len(requests), options.preset, options.velocity, options.spin)
    check_overrides(object_names(requests), options.overrides)
    reconstruct_scene(options.photo, requests, options.out, settings, terminal, cancelled, ask=ask)
    set_all_physics(options.out, **physics(options), friction=settings.friction)
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0


def run_correct(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen correct``; the exit code."""
    stamp = require_stamp(options.scene)
    requests, settings = corrected_requests(options, stamp.objects), reconstruct_options(options, stamp.options)
    correct_scene(options.scene, requests, settings, terminal, cancelled)
    terminal({"event": "done", "scene": str(options.scene)})
    terminal.line(f"scene: {options.scene}")
    return 0


def run_import(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen import``; the exit code."""
    import_folder(
        options.folder,
        options.out,
        size_m=options.size,
        settings=options.settings,
        up=options.up,
        on_event=terminal,
        cancelled=cancelled,
    )
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0


def run_light(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen light``; the exit code."""
    light = set_light(options.scene, light_request(options), terminal).scene.light
    terminal({"event": "done", "scene": str(options.scene), "light": to_json(light)})
    terminal.line(f"scene: {options.scene}")
    return 0


def run_render(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen render``; the exit code."""
    done = pipeline.render_stage(
        options.scene,
        options.bake,
        options.out,
        render_options(options),
        terminal,
        cancelled,
        frames=options.frames,
        video=options.video,
    )
    terminal(done)
    terminal.line(f"frames: {options.out}" + (f"\nvideo: {options.video}" if options.video else ""))
    return 0
