# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``track``, ``capture``, ``diagnose`` and ``blind-check`` (docs/diagnosis.md, docs/own-recordings.md)."""

from __future__ import annotations

import argparse
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...sim.diagnose.track import track_command
from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ..terminal import Terminal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...sim.diagnose.capture import Capture
    from ...sim.diagnose.diagnosis import Verdict

_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def parse_duration(text: str) -> float:
    """Return the seconds in ``90``, ``90s``, ``5min`` or ``1h``."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|min|h)?\s*", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration: write 90s, 5min or 1h")
    return float(match[1]) * _UNITS[match[2] or "s"]


def parse_steps(text: str) -> int:
    """Return the number of steps in ``250000`` or ``3e8``."""
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of steps: write 3e8") from None


def parse_names(text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated list."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def add_track(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen track``."""
    track_command.add_arguments(parser)


def run_track(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen track``; the exit code."""
    done = track_command.run_command(options, terminal, cancelled)
    terminal(done)
    terminal.line(done["summary"])
    return 0


def parse_column(text: str) -> tuple[str, str]:
    """Return (our name, heading of the table) in ``time=Zeit``."""
    ours, equals, theirs = text.partition("=")
    if not (ours and equals and theirs):
        raise argparse.ArgumentTypeError(f"{text!r} is no mapping: write time=HEADING")
    return ours, theirs


_IMPORT_FIELDS: tuple[tuple[str, Any, str], ...] = (
    ("diameter", float, "diameter of a ball, m"),
    ("mesh", Path, "mesh of a rigid body, in m"),
    ("density", float, "density, kg/m³"),
    ("mass", float, "mass, kg"),
    ("name", str, "name of the body (default: body)"),
    ("rest", Path, "CSV name,x,y,z: positions of the markers on the mesh, m"),
    ("time-unit", str, "unit of times: s, ms, us or ns"),
    ("length-unit", str, "unit of lengths: m, cm, mm or px"),
    ("up", str, "axis that points up: z, y, -y or -z (write --up=-y)"),
    ("scale", float, "metres per pixel"),
    ("fps", float, "frames per second, if rows are frames"),
    ("ground", float, "height of the ground, m (default: 0)"),
    ("friction", float, "friction of the ground (default: 0.5)"),
    ("restitution", float, "restitution of the ground, if known"),
    ("noise", float, "standard deviation of a coordinate, m (default: measured)"),
    ("hold-out", float, "share of the last take that the diagnosis sees; the rest is withheld"),
)


def add_capture(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen capture``."""
    parser.add_argument("action", choices=("import",), help="what to do")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="CSV, .trk, C3D, MCAP, a bag's folder")
    parser.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="new folder for the capture")
    mapped = "PhysGen's name and the table's heading, such as time=Zeit x=X"
    parser.add_argument("--column", nargs="+", type=parse_column, default=[], metavar="OURS=THEIRS", help=mapped)
    chosen = "points to use; for a bag the frame or topic of the body (default: all)"
    parser.add_argument("--points", nargs="+", default=[], metavar="NAME", help=chosen)
    for name, kind, text in _IMPORT_FIELDS:
        parser.add_argument(f"--{name}", type=kind, metavar="VALUE", help=text)


def run_capture(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen capture import``; the exit code. On a terminal, guesses are asked."""
    from ...sim.app.import_capture import ImportRequest, import_capture

    named = {name.replace("-", "_") for name, _, _ in _IMPORT_FIELDS}
    given = {name: getattr(options, name) for name in named if getattr(options, name) is not None}
    if "up" in given:
        given["up"] = given["up"].strip()
    asks = sys.stdin.isatty() and not options.json

    def confirm(question: str) -> bool:
        terminal.line(f"{question} [y/N]")
        return sys.stdin.readline().strip().lower() in ("y", "yes")

    request = ImportRequest(columns=dict(options.column), points=tuple(options.points), **given)
    capture = import_capture(
        options.files, request, out=options.out, confirm=confirm if asks else None, on_event=terminal
    )
    trials = [trial.name for trial in capture.trials]
    terminal({"event": "done", "out": str(options.out), "trials": trials, "noise_m": capture.noise_sigma})
    terminal.line(f"capture: {options.out} ({', '.join(trials)})\nnext: physgen diagnose {options.out} --out DIR")
    return 0


def add_diagnose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen diagnose``."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the diagnosis")
    budget = "time for the fits on two idle cores, such as 90s or 5min, counted as simulated work (default 5min)"
    parser.add_argument("--budget", type=parse_duration, default=300.0, metavar="TIME", help=budget)
    work = "budget in simulated steps, such as 3e8, instead of --budget"
    parser.add_argument("--work", type=parse_steps, metavar="STEPS", help=work)
    only = "candidate effects, such as air_drag,wind (default: all that can act on the objects)"
    parser.add_argument("--effects", type=parse_names, metavar="NAMES", help=only)
    parser.add_argument("--no-confirm", action="store_true", help="skip the verification run in the particle engine")
    export = "also write the result as a model for MuJoCo (found.xml) or a layer of USD Physics (found.usda)"
    parser.add_argument("--export", nargs="+", choices=("mjcf", "usd"), default=[], help=export)


def run_diagnose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen diagnose``; the exit code."""
    from ...sim.app.diagnose import diagnose
    from ...sim.diagnose.capture_folder import load_capture
    from ...sim.diagnose.run_diagnosis import DiagnoseOptions

    settings = DiagnoseOptions(
        budget_s=options.budget, work=options.work, effects=options.effects, confirm=not options.no_confirm
    )
    capture = load_capture(options.capture)
    found = diagnose(capture, out=options.out, options=settings, on_event=terminal, cancelled=cancelled)
    terminal(_verdict_event(options.out, found.verdict) | {"seconds": found.seconds})
    lines = [found.summary, *_export(capture, options.out, options.export)]
    if found.next_experiment:
        lines.append(f"next: {found.next_experiment}")
    terminal.line("\n".join([*lines, f"report: {options.out / 'report.html'}"]))
    return 0


def _export(capture: Capture, folder: Path, kinds: Sequence[str]) -> list[str]:
    """Write what the diagnosis in ``folder`` found for other simulators; return lines about it."""
    from ...sim.app.add_effect import found_effects
    from ...sim.app.export_patch import FORMATS, patch_text
    from ...sim.atomic import write_bytes
    from ...sim.diagnose.diagnosis import REPORT_FILE
    from ...sim.validation import read_json

    lines: list[str] = []
    for kind in kinds:
        text, notes = patch_text(capture, found_effects(read_json(folder / REPORT_FILE)), kind)
        write_bytes(folder / FORMATS[kind], text.encode())
        lines += [f"{kind}: {folder / FORMATS[kind]}", *notes]
    return lines


def _verdict_event(out: Path, verdict: Verdict) -> dict[str, Any]:
    """Return the last event of a command that has found ``verdict``."""
    return {
        "event": "done",
        "out": str(out),
        "effect": verdict.effect,
        "probability": verdict.probability,
        "alternatives": list(verdict.alternatives),
    }


def add_explain(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen explain``."""
    parser.add_argument("video", type=Path, metavar="VIDEO", help="video of one moving body before a still background")
    known = "the body, such as ball:diameter=0.04,mass=0.0027, cylinder:diameter=0.03,height=0.01 or box:x=…,y=…,z=…"
    parser.add_argument("--object", required=True, metavar="BODY", help=known)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for video and report")
    fps = "true frame rate of the recording (default: the file's own times)"
    parser.add_argument("--fps-override", type=float, metavar="FPS", help=fps)
    parser.add_argument("--start-frame", type=int, default=0, metavar="N", help="first frame to use (default 0)")
    parser.add_argument("--end-frame", type=int, metavar="N", help="last frame to use (default: the last)")
    budget = "time for the fits, such as 90s, counted as simulated work (default 60s)"
    parser.add_argument("--budget", type=parse_duration, default=60.0, metavar="TIME", help=budget)
    only = "candidate effects (default: those that one video of one body can show)"
    parser.add_argument("--effects", type=parse_names, metavar="NAMES", help=only)


def run_explain(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen explain``; the exit code."""
    from ...sim.app.explain import CAPTURE_FOLDER, DIAGNOSIS_FOLDER, VISIBLE, explain
    from ...sim.diagnose.run_diagnosis import DiagnoseOptions
    from ...sim.diagnose.track.track_input import VideoTrial

    found = explain(
        VideoTrial(
            path=options.video,
            start_frame=options.start_frame,
            end_frame=options.end_frame,
            fps_override=options.fps_override,
        ),
        options.object,
        out=options.out,
        options=DiagnoseOptions(budget_s=options.budget, effects=options.effects or VISIBLE, confirm=False),
        on_event=terminal,
        cancelled=cancelled,
    )
    closed = found.closed if math.isfinite(found.closed) else None
    folders = {"capture": str(options.out / CAPTURE_FOLDER), "diagnosis": str(options.out / DIAGNOSIS_FOLDER)}
    verdict = _verdict_event(options.out, found.diagnosis.verdict)
    terminal(verdict | {"closed_fraction": closed, "video": str(found.video), **folders})
    report = options.out / DIAGNOSIS_FOLDER / "report.html"
    terminal.line(f"{found.summary}\nvideo: {found.video}\nreport: {report}")
    return 0


def add_blind_check(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen blind-check``."""
    number = "number of captures, 4 or more (default 30)"
    parser.add_argument("--cases", type=int, default=30, metavar="N", help=number)
    seed = "repeats an earlier check (default: a fresh one each time; it is printed with the score)"
    parser.add_argument("--seed", type=int, metavar="S", help=seed)
    parser.add_argument("--budget", metavar="TIME", help="time for one diagnosis, as of `physgen diagnose`")
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for captures, reports, labels and score")


def run_blind_check(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen blind-check``; the exit code. Raises InputError where the optional package is not installed."""
    try:
        from ...blind_check import BlindCheckOptions, blind_check, score_table
    except ModuleNotFoundError as error:
        if not (error.name or "").endswith("blind_check"):
            raise
        raise InputError(
            "blind-check is not part of the Blender extension: "
            "run `pip install 'physgen[blind]'` in a Python environment and start it there"
        ) from None
    settings = BlindCheckOptions(cases=options.cases, seed=options.seed, budget=options.budget, out=options.out)
    score = blind_check(settings, terminal, cancelled)
    terminal({"event": "done", "stage": "blind-check", "score": score.to_json()})
    terminal.line(score_table(score))
    return 0
