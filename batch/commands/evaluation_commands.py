# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``evaluate``, how real a video is, and ``questionnaire``, people as its judges (docs/evaluation.md)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ...sim.reconstruct.reasoning.chat_client import DEFAULT_KEY_VARIABLE, ChatRequest
from ..terminal import Terminal

if TYPE_CHECKING:
    from ...sim.app.evaluate import JudgeRequest


REPETITIONS = 5


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen evaluate``."""
    video = ".mp4, .webm or a folder of pictures; or a bake folder"
    parser.add_argument("video", type=Path, nargs="?", metavar="VIDEO", help=video)
    many = "score a folder of videos for the Physics-IQ benchmark instead of VIDEO (--against: the benchmark)"
    parser.add_argument("--physics-iq", type=Path, metavar="DIR", help=many)
    real = "recording of the real event from the same camera; twice: two takes of it"
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="REAL", help=real)
    out = "folder for report.html, evaluation.json and tables (default: VIDEO_evaluation beside the video)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)
    parser.add_argument("--seconds", type=float, metavar="S", help="only the first so many seconds (Physics-IQ: 5)")
    rate = "frame rate of a folder of pictures, or to override a video file's"
    parser.add_argument("--fps", type=float, metavar="F", help=rate)
    photo = "the photo that the video was made from, which its first frame should equal"
    parser.add_argument("--photo", type=Path, metavar="FILE", help=photo)
    parser.add_argument("--bake", type=Path, metavar="DIR", help="the bake that the video shows, for physical checks")
    scene = "the scene that was baked (default: the folder scene beside the bake)"
    parser.add_argument("--scene", type=Path, metavar="DIR", help=scene)
    network = "network for optical flow as an ONNX file (default: DIS, without weights)"
    parser.add_argument("--flow", type=Path, metavar="FILE", help=network)
    url = "OpenAI-compatible chat endpoint of a model that scores the video, such as https://host/v1"
    parser.add_argument("--judge", metavar="URL", help=url)
    parser.add_argument("--judge-model", metavar="NAME", help="name of the endpoint's model; it must accept images")
    consent = "consent to sending the photo, frames of the videos and --prompt to that endpoint"
    parser.add_argument("--send-frames", action="store_true", help=f"{consent}; without it nothing is sent")
    parser.add_argument("--prompt", metavar="TEXT", help="what should happen in the video, for --judge")
    beside = "video of the same photo and prompt that is judged together with VIDEO; may be repeated"
    parser.add_argument("--beside", type=Path, action="append", default=[], metavar="VIDEO", help=beside)
    text = f"how often to ask, each time with the videos in another order (default {REPETITIONS})"
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, metavar="N", help=text)
    text = f"environment variable with the API key (default {DEFAULT_KEY_VARIABLE})"
    parser.add_argument("--key-variable", metavar="NAME", default=DEFAULT_KEY_VARIABLE, help=text)


def judge_request(options: argparse.Namespace) -> JudgeRequest | None:
    """Return who is to judge, or None. Raises InputError for an incomplete request or missing consent."""
    from ...sim.app.evaluate import JudgeRequest
    from ...sim.evaluate.model_judge import JudgeOptions

    if options.judge is None:
        if options.judge_model is not None or options.send_frames or options.prompt is not None or options.beside:
            raise InputError("--judge-model, --send-frames, --prompt, --beside: need --judge URL; give it")
        return None
    if options.video is None:
        raise InputError("--judge: needs VIDEO; a table of Physics-IQ is not judged")
    if options.judge_model is None or options.prompt is None:
        raise InputError("--judge: needs --judge-model NAME and --prompt TEXT, what should happen in the video")
    if not options.send_frames:
        raise InputError("--judge: frames are not sent without your agreement; give --send-frames")
    return JudgeRequest(
        endpoint=ChatRequest(
            url=options.judge,
            model=options.judge_model,
            key_variable=options.key_variable,
            consent=options.send_frames,
            timeout_s=300.0,
        ),
        prompt=options.prompt,
        photo=options.photo,
        beside=tuple(options.beside),
        options=JudgeOptions(repetitions=options.repetitions),
    )


def run_evaluate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen evaluate``; the exit code."""
    from ...sim.app.evaluate import EvaluateOptions, evaluate, evaluate_physics_iq, is_bake
    from ...sim.evaluate.evaluation import evaluation_json, summary

    if (options.video is None) == (options.physics_iq is None):
        raise InputError("give VIDEO, or --physics-iq DIR in its place")
    judge = judge_request(options)
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
            judge=judge,
            options=settings,
            on_event=terminal,
            cancelled=cancelled,
        )
    terminal({"event": "done", "stage": "evaluate", "out": str(out), **evaluation_json(found)})
    terminal.line(f"{summary(found)}\n{out}")
    if found.failures:
        several = "a view is" if len(found.failures) == 1 else f"{len(found.failures)} views are"
        terminal(
            {"event": "notice", "stage": "evaluate", "message": f"{several} not compared, so the table is not whole"}
        )
        return InputError.exit_code
    return 0


def add_questionnaire(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen questionnaire``."""
    case = "a case.toml, or the folder of one: prompt, image and [videos]; with --collect: answers or folders of them"
    parser.add_argument("files", nargs="+", type=Path, metavar="CASE", help=case)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the pages, or of the results")
    parser.add_argument("--title", metavar="TEXT", help="title of the pages")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of anonymous names, or of the bootstrap")
    parser.add_argument("--collect", action="store_true", help="evaluate the answers that the pages saved")
    parser.add_argument("--key", type=Path, metavar="FILE", help="key.json of the questionnaire, for --collect")


def run_questionnaire(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen questionnaire``; the exit code."""
    from ...sim.evaluate.questionnaire import QuestionnaireOptions, make_questionnaire
    from ...sim.evaluate.questionnaire_answers import CollectOptions, collect_questionnaire

    if not options.collect:
        if options.key is not None:
            raise InputError("--key: is for --collect; leave it out, or give --collect and the files of answers")
        given = {"title": options.title} if options.title is not None else {}
        page = make_questionnaire(
            options.files,
            out=options.out,
            options=QuestionnaireOptions(seed=options.seed, **given),
            on_event=terminal,
            cancelled=cancelled,
        )
        terminal({"event": "done", "stage": "questionnaire", "page": str(page)})
        terminal.line(f"hand out {page.parent}, first page {page.name}; keep {options.out / 'key.json'}")
        return 0
    if options.key is None:
        raise InputError("--collect: needs --key FILE, the key.json beside the pages")
    found = collect_questionnaire(
        options.files, key=options.key, out=options.out, options=CollectOptions(seed=options.seed)
    )
    for note in found["notes"]:
        terminal({"event": "notice", "stage": "questionnaire", "message": note})
    terminal({"event": "done", "stage": "questionnaire", "out": str(options.out), **found})
    lines = [f"{found['people']} people, {found['cases']} cases"]
    lines += [
        f"  {row['video']}, {row['criterion'].replace('_', ' ')}: none"
        if row["mean"] is None
        else f"  {row['video']}, {row['criterion'].replace('_', ' ')}: {row['mean']:.2f} "
        f"({row['low']:.2f} to {row['high']:.2f}), n = {row['count']}"
        for row in found["means"]
    ]
    terminal.line("\n".join([*lines, str(options.out)]))
    return 0
