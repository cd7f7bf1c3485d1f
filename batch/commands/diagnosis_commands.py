# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``track``, ``diagnose`` and ``blind-check`` (docs/diagnosis.md, docs/diagnosis.md)."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from ...sim.diagnose.track import track_command
from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ..terminal import Terminal

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


def add_diagnose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen diagnose``."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the diagnosis")
    budget = "time for the fits on two idle cores, such as 90s or 5min, counted as simulated work (default 5min)"
    parser.add_argument("--budget", type=parse_duration, default=300.0, metavar="TIME", help=budget)
    work = "the same as simulated steps, such as 3e8, instead of --budget"
    parser.add_argument("--work", type=parse_steps, metavar="STEPS", help=work)
    only = "candidate effects, such as air_drag,wind (default: all that can act on the objects)"
    parser.add_argument("--effects", type=parse_names, metavar="NAMES", help=only)
    parser.add_argument("--no-confirm", action="store_true", help="skip the verification run in the particle engine")


def run_diagnose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen diagnose``; the exit code."""
    from ...sim.app.diagnose import diagnose
    from ...sim.diagnose.capture import load_capture
    from ...sim.diagnose.run_diagnosis import DiagnoseOptions

    settings = DiagnoseOptions(
        budget_s=options.budget, work=options.work, effects=options.effects, confirm=not options.no_confirm
    )
    found = diagnose(
        load_capture(options.capture), out=options.out, options=settings, on_event=terminal, cancelled=cancelled
    )
    verdict = found.verdict
    terminal(
        {
            "event": "done",
            "out": str(options.out),
            "effect": verdict.effect,
            "probability": verdict.probability,
            "alternatives": list(verdict.alternatives),
            "seconds": found.seconds,
        }
    )
    lines = [found.summary]
    if found.next_experiment:
        lines.append(f"next: {found.next_experiment}")
    terminal.line("\n".join([*lines, f"report: {options.out / 'report.html'}"]))
    return 0


def add_blind_check(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen blind-check``."""
    number = "how many captures, 4 or more (default 30)"
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
