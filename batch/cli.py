# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``physgen`` command: every stage alone, or all of them (docs/cli.md)."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..sim.app.bake_estimate import bake_cost
from ..sim.app.bake_inputs import BakeOptions
from ..sim.app.reconstruct import reconstruct_scene, require_physics, set_all_physics, set_physics, with_physics
from ..sim.app.setup_world import cost_text
from ..sim.cache.folder import free_bake
from ..sim.cache.manifest import SPACES
from ..sim.effects.registry import Effect, effect, effect_to_json, effects
from ..sim.errors import InputError, PhysGenError
from ..sim.events import IsCancelled
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.reconstruct.pipeline import object_names
from ..sim.scene.folder import SceneFolder, load_scene
from ..sim.scene.materials import preset_names
from ..sim.scene.model import Vector
from ..sim.scene.overrides import check_overrides
from ..sim.version import VERSION
from . import diagnosis, doctor, pipeline
from .terminal import Terminal

Command = Callable[[argparse.Namespace, Terminal, IsCancelled], int]


def _numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(n) for n in numbers):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not {what}")
    return numbers


def _box(text: str) -> tuple[float, float, float, float]:
    a, b, c, d = _numbers(text, 4, "a box x0,y0,x1,y1 in pixels")
    return a, b, c, d


def _vector(text: str) -> Vector:
    x, y, z = _numbers(text, 3, "a vector x,y,z")
    return x, y, z


def _add_photo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    box = "x0,y0,x1,y1 in pixels of the upright photo, one an object"
    parser.add_argument("--box", type=_box, nargs="+", action="extend", required=True, metavar="BOX", help=box)
    parser.add_argument(
        "--name", nargs="+", action="extend", default=[], help="names of the objects, in the order of the boxes"
    )
    size = "largest extent in metres, one an object; the first sets the scale of the scene"
    parser.add_argument("--size", type=float, nargs="+", action="extend", default=[], metavar="METRES", help=size)
    horizon = (
        "height of the horizon as a fraction of the photo's, 0 top, 1 bottom; may lie outside (default: estimated)"
    )
    parser.add_argument("--horizon", type=float, metavar="Y", help=horizon)
    pitch = "angle of the view below the horizontal, instead of --horizon; about 50 for a look down at a table"
    parser.add_argument("--pitch", type=float, metavar="DEGREES", help=pitch)
    parser.add_argument(
        "--fov", type=float, metavar="DEGREES", help="field of view of the longer side (default: EXIF, else 50)"
    )


def _add_physics(parser: argparse.ArgumentParser) -> None:
    names = preset_names()
    parser.add_argument(
        "--preset", nargs="+", action="extend", default=[], choices=names, help="material, one for all or one an object"
    )
    velocity = "initial velocity x,y,z in m/s: right, away from the camera, up; one an object"
    parser.add_argument("--velocity", type=_vector, nargs="+", action="extend", default=[], metavar="V", help=velocity)
    parser.add_argument(
        "--spin", type=_vector, nargs="+", action="extend", default=[], metavar="W", help="initial spin x,y,z in rad/s"
    )
    change = "change a field of an object, its material, 'ground' or 'scene', such as cup.density=300"
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], dest="overrides", metavar="OBJECT.FIELD=VALUE", help=change
    )


def _add_bake(parser: argparse.ArgumentParser) -> None:
    defaults = BakeOptions()
    parser.add_argument("--frames", type=int, default=defaults.frames, help=f"how many (default {defaults.frames})")
    parser.add_argument("--fps", type=float, default=defaults.fps, help=f"frames a second (default {defaults.fps:g})")
    parser.add_argument("--quality", default=defaults.quality, help="preset in presets/qualities (default standard)")
    parser.add_argument(
        "--arch", default=defaults.arch, choices=["cpu", "cuda", "vulkan", "metal"], help="where to simulate"
    )
    parser.add_argument("--seed", type=int, default=defaults.seed, metavar="N", help="of the particles' places")


def _add_samples(parser: argparse.ArgumentParser) -> None:
    defaults = BakeOptions()
    space = "what the samples are in: world metres, or the coordinates of each object's mesh file"
    parser.add_argument("--space", default=defaults.space, choices=SPACES, help=f"{space} (default {defaults.space})")
    points = "also keep the particles of what is sand, fluid or snow, or turns to sand"
    parser.add_argument("--points", action="store_true", default=defaults.points, help=points)


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--engine", default="cycles", choices=["cycles"], help="render engine")
    parser.add_argument("--samples", type=int, metavar="N", help="samples a pixel")
    parser.add_argument("--scale", type=float, default=1.0, help="of the photo's resolution (default 1)")


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(
        prog="physgen",
        description="One photo becomes a small physical world: reconstruct, simulate, render.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"physgen {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Command, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.add_argument("--json", action="store_true", help="progress and result as JSON lines")
        sub.set_defaults(run=run)
        return sub

    run = command("run", _run, "photo → video: all stages")
    _add_photo(run)
    _add_physics(run)
    _add_bake(run)
    _add_render(run)
    run.add_argument("--out", type=Path, required=True, metavar="VIDEO.mp4", help="the video")
    run.add_argument(
        "--work", type=Path, metavar="DIR", help="keeps scene, bake and frames (default: beside the video)"
    )

    reconstruct = command("reconstruct", _reconstruct, "photo → scene folder")
    _add_photo(reconstruct)
    _add_physics(reconstruct)
    reconstruct.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")

    bake = command("bake", _bake, "scene folder → bake folder")
    bake.add_argument("scene", type=Path, metavar="SCENE")
    bake.add_argument("--out", type=Path, metavar="BAKE", help="the bake folder")
    bake.add_argument("--estimate", action="store_true", help="the same as physgen estimate")
    bake.set_defaults(wrong_usage=bake.error)
    _add_physics(bake)
    _add_bake(bake)
    _add_samples(bake)

    cost = command("estimate", _estimate, "what a bake would cost in time, memory and disk; nothing is written")
    cost.add_argument("scene", type=Path, metavar="SCENE")
    _add_physics(cost)
    _add_bake(cost)
    _add_samples(cost)

    free = command("free", _free, "delete a bake: what its manifest lists, and nothing else")
    free.add_argument("bake", type=Path, metavar="BAKE")

    render = command("render", _render, "scene and bake → frames, video")
    render.add_argument("scene", type=Path, metavar="SCENE")
    render.add_argument("--bake", type=Path, required=True, metavar="BAKE")
    render.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the frames")
    render.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all)")
    render.add_argument("--video", type=Path, metavar="VIDEO.mp4", help="also encode the frames")
    _add_render(render)

    diagnosis.add_diagnose(
        command("diagnose", diagnosis.run_diagnose, "capture of a real motion → which effect the simulation lacks")
    )

    diagnosis.add_track(command("track", diagnosis.run_track, "videos of a scene → capture folder"))
    diagnosis.add_blind_check(
        command("blind-check", diagnosis.run_blind_check, "the diagnosis examines itself on motion of withheld cause")
    )

    listing = command("effects", _effects, "physical effects that a scene can have, with their parameters")
    listing.add_argument("name", nargs="*", metavar="NAME", help="these only (default: all)")

    command("doctor", _doctor, "what is installed and what is missing")
    return parser


def _object_requests(options: argparse.Namespace) -> tuple[ObjectRequest, ...]:
    boxes = options.box
    for flag in ("name", "size"):
        if len(getattr(options, flag)) > len(boxes):
            raise InputError(
                f"--{flag}: {len(getattr(options, flag))} given for {len(boxes)} boxes; give at most one a box"
            )
    return tuple(
        ObjectRequest(
            box=box,
            name=options.name[i] if i < len(options.name) else None,
            size_m=options.size[i] if i < len(options.size) else None,
        )
        for i, box in enumerate(boxes)
    )


def _physics(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "presets": options.preset,
        "velocities": options.velocity,
        "spins": options.spin,
        "overrides": options.overrides,
    }


def _reconstruct_options(options: argparse.Namespace) -> ReconstructOptions:
    changes = {"horizon_y": options.horizon, "pitch_deg": options.pitch, "fov_deg": options.fov}
    return dataclasses.replace(ReconstructOptions(), **{k: v for k, v in changes.items() if v is not None})


def _bake_options(options: argparse.Namespace) -> BakeOptions:
    names = ("frames", "fps", "quality", "arch", "seed", "space", "points")
    return BakeOptions(**{name: getattr(options, name) for name in names if hasattr(options, name)})


def _render_request(options: argparse.Namespace, frames: str | None = None) -> pipeline.RenderRequest:
    return pipeline.RenderRequest(engine=options.engine, samples=options.samples, scale=options.scale, frames=frames)


def _run(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    pipeline.check_render(_render_request(options), options.out)
    request = pipeline.RunRequest(
        photo=options.photo,
        objects=_object_requests(options),
        video=options.out,
        work=options.work or options.out.resolve().with_name(options.out.resolve().stem + "_work"),
        presets=tuple(options.preset),
        velocities=tuple(options.velocity),
        spins=tuple(options.spin),
        overrides=tuple(options.overrides),
        reconstruct=_reconstruct_options(options),
        bake=_bake_options(options),
        render=_render_request(options),
    )
    pipeline.run(request, terminal, cancelled)
    terminal(
        {"event": "done", "video": str(request.video), "scene": str(request.work / "scene"), "work": str(request.work)}
    )
    terminal.line(f"video: {request.video}\nscene: {request.work / 'scene'}")
    return 0


def _reconstruct(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    requests, settings = _object_requests(options), _reconstruct_options(options)
    require_physics(len(requests), options.preset, options.velocity, options.spin)
    check_overrides(object_names(requests), options.overrides)
    reconstruct_scene(options.photo, requests, options.out, settings, terminal, cancelled)
    set_all_physics(options.out, **_physics(options), friction=settings.friction)
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0


def _bake(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    if options.estimate:
        return _estimate(options, terminal, cancelled)
    if options.out is None:
        options.wrong_usage("the following arguments are required: --out (or --estimate)")
    folder = set_physics(options.scene, **_physics(options))
    done = pipeline.bake_stage(folder, options.out, _bake_options(options), terminal, cancelled)
    terminal(done)
    terminal.line(f"bake: {options.out}")
    return 0


def _estimate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    folder = load_scene(options.scene)
    scene = with_physics(folder.scene, **_physics(options))
    cost = bake_cost(SceneFolder(root=folder.root, scene=scene), _bake_options(options))
    for warning in cost.prepared.warnings:
        terminal({"event": "notice", "stage": "estimate", "message": warning})
    terminal({"event": "done", "stage": "estimate", **cost.to_json()})
    terminal.line(f"{cost_text(cost.prepared)}; {cost.disk_bytes / 2**20:.0f} MiB on the disk")
    cost.prepared.require_affordable()
    return 0


def _free(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    freed = free_bake(options.bake)
    terminal({"event": "done", "stage": "free", "bytes": freed})
    terminal.line(f"{freed / 2**20:.1f} MiB are free again: {options.bake}")
    return 0


def _render(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    request = _render_request(options, options.frames)
    terminal(
        pipeline.render_stage(
            options.scene, options.bake, options.out, request, terminal, cancelled, video=options.video
        )
    )
    terminal.line(f"frames: {options.out}" + (f"\nvideo: {options.video}" if options.video else ""))
    return 0


def _effects(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    found = [effect(name) for name in options.name] or list(effects().values())
    terminal({"event": "done", "effects": [effect_to_json(item) for item in found]})
    terminal.line("\n\n".join(_effect_text(item) for item in found))
    return 0


def _effect_text(item: Effect) -> str:
    lines = [f"{item.name} ({item.kind}): {item.summary}"]
    lines += [f"    {title.lower()}: {item.section(title)}" for title in ("Equation", "Bodies", "Source")]
    for p in item.parameters:
        unit = "" if p.unit == "1" else f" {p.unit}"
        lines.append(f"    {p.name} = {p.default:g}{unit}, {p.low:g} to {p.high:g}: {p.description}")
    return "\n".join(lines)


def _doctor(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    report = doctor.examine()
    terminal({"event": "done", "report": report})
    terminal.line("\n".join(f"{'ok     ' if ok else 'MISSING'} {name}: {text}" for name, ok, text in report))
    return 0 if all(ok for _, ok, _ in report) else InputError.exit_code


def _keep_negative_vectors(arguments: Sequence[str]) -> list[str]:
    """``--velocity -1,0,2`` looks like a flag to argparse; a leading blank tells it otherwise."""
    return [f" {a}" if re.match(r"-[\d.][\d.,eE+-]*$", a) else a for a in arguments]


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of ``physgen``; the exit code, as docs/cli.md lists them."""
    options = build_parser().parse_args(_keep_negative_vectors(sys.argv[1:] if arguments is None else arguments))
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    expected = pipeline.expected_seconds(options.frames) if options.command == "run" else None
    terminal = Terminal(as_json=options.json, expected_s=expected)
    try:
        run: Command = options.run
        return run(options, terminal, lambda: stop.is_set() or terminal.reader_gone)
    except PhysGenError as error:
        terminal.error(type(error).__name__, str(error))
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
