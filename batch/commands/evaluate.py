# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``evaluate``: how real a video is (docs/evaluation.md)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ..terminal import Terminal


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen evaluate``."""
    video = ".mp4, .webm or a folder of pictures; or a bake folder"
    parser.add_argument("video", type=Path, nargs="?", metavar="VIDEO", help=video)
    many = "videos for the Physics-IQ benchmark, in the place of VIDEO: its table (--against: the benchmark)"
    parser.add_argument("--physics-iq", type=Path, metavar="DIR", help=many)
    real = "recording of the real event from the same camera; twice: two takes of it"
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="REAL", help=real)
    out = "folder for report.html, evaluation.json and tables (default: VIDEO_evaluation beside the video)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)
    parser.add_argument("--seconds", type=float, metavar="S", help="only the first so many seconds (Physics-IQ: 5)")
    rate = "frames per second of a folder of pictures, or instead of what a video file says"
    parser.add_argument("--fps", type=float, metavar="F", help=rate)
    photo = "the photo that the video was made from, which its first frame should equal"
    parser.add_argument("--photo", type=Path, metavar="FILE", help=photo)
    parser.add_argument("--bake", type=Path, metavar="DIR", help="the bake that the video shows, for physical checks")
    scene = "the scene that was baked (default: the folder scene beside the bake)"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=scene)
    network = "network for optical flow as an ONNX file (default: DIS, without weights)"
    parser.add_argument("--flow", type=Path, metavar="FILE", help=network)


def run_evaluate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen evaluate``; the exit code."""
    from ...sim.app.evaluate import EvaluateOptions, evaluate, evaluate_physics_iq, is_bake
    from ...sim.evaluate.evaluation import evaluation_json, summary

    if (options.video is None) == (options.physics_iq is None):
        raise InputError("give VIDEO, or --physics-iq DIR in its place")
    subject = options.physics_iq or options.video
    out = options.out or subject.with_name(f"{subject.stem}_evaluation")
    if options.physics_iq is not None:
        if len(options.against) > 1:
            raise InputError("--against: with --physics-iq it is one folder, the benchmark's")
        benchmark = next(iter(options.against), None)
        found = evaluate_physics_iq(subject, benchmark=benchmark, out=out, on_event=terminal, cancelled=cancelled)
    else:
        settings = EvaluateOptions(seconds=options.seconds, fps=options.fps, flow=options.flow)
        bake = subject if is_bake(subject) else options.bake
        found = evaluate(
            None if bake is subject else subject,
            out=out,
            against=options.against,
            photo=options.photo,
            bake=bake,
            scene=options.scene,
            options=settings,
            on_event=terminal,
            cancelled=cancelled,
        )
    terminal({"event": "done", "stage": "evaluate", "out": str(out), **evaluation_json(found)})
    terminal.line(f"{summary(found)}\n{out}")
    return 0
