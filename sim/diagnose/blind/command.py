# SPDX-License-Identifier: MIT
"""``physgen blind-check``: its arguments, and what it prints."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...events import Event, IsCancelled, OnEvent
from .check import BlindCheckOptions, blind_check
from .plan import LEAST_CASES
from .table import score_table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``physgen blind-check`` (``--json`` is added for every command elsewhere)."""
    defaults = BlindCheckOptions()
    number = f"how many captures, {LEAST_CASES} or more (default {defaults.cases})"
    parser.add_argument("--cases", type=int, default=defaults.cases, metavar="N", help=number)
    seed = "repeats an earlier check (default: a fresh one each time; it is printed with the score)"
    parser.add_argument("--seed", type=int, metavar="S", help=seed)
    parser.add_argument("--budget", metavar="TIME", help="time for one diagnosis, as of `physgen diagnose`")
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for captures, reports, labels and score")


def command(options: argparse.Namespace, on_event: OnEvent, cancelled: IsCancelled) -> tuple[Event, str]:
    """Run the check: the ``done`` event for machines, and the table for people. Raises as ``blind_check``."""
    score = blind_check(
        BlindCheckOptions(cases=options.cases, seed=options.seed, budget=options.budget, out=options.out),
        on_event,
        cancelled,
    )
    return {"event": "done", "stage": "blind-check", "score": score.to_json()}, score_table(score)
