# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``questionnaire``: people as judges of videos (docs/evaluation.md)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ..terminal import Terminal


def add_questionnaire(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen questionnaire``."""
    case = "a case.toml, or the folder of one: prompt, image and [videos]; with --collect: answers or folders of them"
    parser.add_argument("files", nargs="+", type=Path, metavar="CASE", help=case)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the pages, or of the results")
    parser.add_argument("--title", metavar="TEXT", help="title of the pages")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of anonymous names, or of the bootstrap")
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
