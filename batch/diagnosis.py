# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``track``, ``diagnose`` and ``blind-check`` (docs/tracking.md, docs/diagnosis.md)."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from ..sim.diagnose.blind import command as blind_command
from ..sim.diagnose.track import command as track_command
from ..sim.events import IsCancelled
from .terminal import Terminal

_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def duration(text: str) -> float:
    """Seconds in ``90``, ``90s``, ``5min`` or ``1h``."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|min|h)?\s*", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no duration: write 90s, 5min or 1h")
    return float(match[1]) * _UNITS[match[2] or "s"]


def names(text: str) -> tuple[str, ...]:
    """Names separated by commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def add_track(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen track``."""
    track_command.add_arguments(parser)


def run_track(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen track``; the exit code."""
    done = track_command.command(options, terminal, cancelled)
    terminal(done)
    terminal.line(done["summary"])
    return 0


def add_diagnose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen diagnose``."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the diagnosis")
    budget = "time that the fits aim to stay below, such as 90s or 5min (default 5min)"
    parser.add_argument("--budget", type=duration, default=300.0, metavar="TIME", help=budget)
    only = "try these effects only, such as air_drag,wind (default: all that can act on the objects)"
    parser.add_argument("--effects", type=names, metavar="NAMES", help=only)
    parser.add_argument(
        "--no-confirm", action="store_true", help="do not run the verdict again in the particle engine: faster"
    )


def run_diagnose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen diagnose``; the exit code."""
    from ..sim.app.diagnose import diagnose_capture
    from ..sim.diagnose.conclude import DiagnoseOptions

    settings = DiagnoseOptions(budget_s=options.budget, effects=options.effects, confirm=not options.no_confirm)
    found = diagnose_capture(options.capture, options.out, settings, terminal, cancelled)
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
    blind_command.add_arguments(parser)


def run_blind_check(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen blind-check``; the exit code."""
    done, table = blind_command.command(options, terminal, cancelled)
    terminal(done)
    terminal.line(table)
    return 0
