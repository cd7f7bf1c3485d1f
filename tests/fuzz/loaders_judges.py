# SPDX-License-Identifier: MIT
"""Loaders of the evaluation by people and by a model; importing this adds them to ``LOADERS``."""

from __future__ import annotations

import json
from pathlib import Path

from loaders import LOADERS, Loader
from physgen.sim.evaluate.model_judge import CRITERIA, read_scores
from physgen.sim.evaluate.questionnaire import FORMAT, load_case, load_key
from physgen.sim.evaluate.questionnaire_answers import read_answers
from physgen.sim.files import read_bytes

KEY = {
    "format": FORMAT,
    "version": 1,
    "questionnaire": "0123",
    "criteria": list(CRITERIA),
    "cases": [{"id": "case_01", "name": "apple", "prompt": "It falls.", "videos": {"aa": "ours", "bb": "other"}}],
}
ANSWERS = {
    "format": "physgen questionnaire answers",
    "version": 1,
    "questionnaire": "0123",
    "person": "ann",
    "saved": "2026-01-01T00:00:00Z",
    "cases": {"case_01": {"order": ["bb", "aa"], "scores": {t: dict.fromkeys(CRITERIA, 3) for t in ("aa", "bb")}}},
}
JUDGED = """Video 1: Physical Realism Score: 0.5; Photorealism Score: 0.25; Semantic Consistency Score: 1;
Video 2: Physical Realism Score: 0; Photorealism Score: .5; Semantic Consistency Score: 0,75;
"""


def _case(folder: Path) -> None:
    (folder / "photo.jpg").write_bytes(b"")
    (folder / "a.mp4").write_bytes(b"")
    (folder / "case.toml").write_text('prompt = "It falls."\nimage = "photo.jpg"\n[videos]\nours = "a.mp4"\n')


def _read_judged(folder: Path) -> None:
    try:
        text = read_bytes(folder / "a.txt", 2**20).decode("utf-8", "replace")
    except FileNotFoundError:
        return
    for scores in read_scores(text, 2).scores:
        assert scores is None or all(0 <= value <= 1 for value in scores.values())


LOADERS["case of a questionnaire"] = Loader(_case, load_case, ("case.toml",))
LOADERS["key of a questionnaire"] = Loader(
    lambda f: (f / "key.json").write_text(json.dumps(KEY)), lambda f: load_key(f / "key.json"), ("key.json",)
)
LOADERS["answers of a questionnaire"] = Loader(
    lambda f: (f / "a.json").write_text(json.dumps(ANSWERS)), lambda f: read_answers(f / "a.json", KEY), ("a.json",)
)
LOADERS["answer of a judge"] = Loader(lambda f: (f / "a.txt").write_text(JUDGED), _read_judged, ("a.txt",))
