# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``physgen`` command: every stage alone, or all of them (docs/cli.md)."""

from __future__ import annotations

import argparse
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence

from ..sim.effects.registry import Effect, effect, effect_to_json, effects
from ..sim.errors import InputError, PhysGenError
from ..sim.events import IsCancelled
from ..sim.version import VERSION
from . import bakes, compositions, diagnosis, doctor, photos, pipeline, variants, videos
from .farm import command as farm_command
from .terminal import Terminal

Command = Callable[[argparse.Namespace, Terminal, IsCancelled], int]


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

    photos.add_run(command("run", photos.run_run, "photo → video: all stages"))
    photos.add_reconstruct(command("reconstruct", photos.run_reconstruct, "photo → scene folder"))
    again = "a reconstructed scene again, with something told that was guessed wrong"
    photos.add_correct(command("correct", photos.run_correct, again))
    photos.add_import(
        command("import", photos.run_import, "folder of PhysGen3D or PhysGen, or file of splats → scene folder")
    )
    varied = "scene folder → the same with other physics and effects, in a folder of its own"
    variants.add_variant(command("variant", variants.run_variant, varied))
    fitted = "scene folder → the same with objects that no longer pass through each other"
    compositions.add_compose(command("compose", compositions.run_compose, fitted))
    views = "pictures of one or two objects from all around → scene folder with their splats"
    compositions.add_fit_splats(command("fit-splats", compositions.run_fit_splats, views))
    photos.add_light(command("light", photos.run_light, "another light for a scene folder"))
    bakes.add_bake(command("bake", bakes.run_bake, "scene folder → bake folder"))
    cost = "what a bake would cost in time, memory and disk; nothing is written"
    bakes.add_estimate(command("estimate", bakes.run_estimate, cost))
    bakes.add_free(command("free", bakes.run_free, "delete a bake: what its manifest lists, and nothing else"))
    previews = "coarse runs as they are asked for on standard input (docs/cli.md)"
    bakes.add_preview(command("preview", bakes.run_preview, previews))
    photos.add_render(command("render", photos.run_render, "scene and bake → frames, video"))
    sheet = "frames → video or animated contact sheet"
    videos.add_encode(command("encode", videos.run_encode, sheet))
    many = "job file → scenes, bakes and videos of all its variants, on one machine or many"
    farm_command.add_batch(command("batch", farm_command.run_batch, many))
    lack = "capture of a real motion → which effect the simulation lacks"
    diagnosis.add_diagnose(command("diagnose", diagnosis.run_diagnose, lack))
    diagnosis.add_track(command("track", diagnosis.run_track, "videos of a scene → capture folder"))
    examined = "the diagnosis examines itself on motion of withheld cause"
    diagnosis.add_blind_check(command("blind-check", diagnosis.run_blind_check, examined))
    listing = command("effects", _effects, "physical effects that a scene can have, with their parameters")
    listing.add_argument("name", nargs="*", metavar="NAME", help="these only (default: all)")
    command("doctor", _doctor, "what is installed and what is missing")
    return parser


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
