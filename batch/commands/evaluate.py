# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``evaluate``: how real a video is (docs/evaluation.md)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...sim.events import IsCancelled
from ..terminal import Terminal


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen evaluate``."""
    parser.add_argument("video", type=Path, metavar="VIDEO", help=".mp4, .webm or a folder of pictures")
    real = "recording of the real event from the same camera; twice: two takes of it"
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="REAL", help=real)
    out = "folder for report.html, evaluation.json and tables (default: VIDEO_evaluation beside the video)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)
    parser.add_argument("--seconds", type=float, metavar="S", help="only the first so many seconds (Physics-IQ: 5)")
    rate = "frames per second of a folder of pictures, or instead of what a video file says"
    parser.add_argument("--fps", type=float, metavar="F", help=rate)


def run_evaluate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen evaluate``; the exit code."""
    from ...sim.app.evaluate import EvaluateOptions, evaluate
    from ...sim.evaluate.evaluation import evaluation_json, summary

    out = options.out or options.video.with_name(f"{options.video.stem}_evaluation")
    settings = EvaluateOptions(seconds=options.seconds, fps=options.fps)
    found = evaluate(
        options.video, out=out, against=options.against, options=settings, on_event=terminal, cancelled=cancelled
    )
    terminal({"event": "done", "stage": "evaluate", "out": str(out), **evaluation_json(found)})
    terminal.line(f"{summary(found)}\n{out}")
    return 0
