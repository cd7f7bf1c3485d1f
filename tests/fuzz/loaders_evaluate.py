# SPDX-License-Identifier: MIT
"""The loaders of ``physgen evaluate`` and ``questionnaire``: videos, pictures, energies, a benchmark, answers of people
and of a model."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from loaders import add, put_bake, put_json, put_video
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.errors import InputError
from physgen.sim.evaluate.bake_physics import bake_physics
from physgen.sim.evaluate.footage import open_footage
from physgen.sim.evaluate.judge_question import CRITERIA, read_scores
from physgen.sim.evaluate.physics_iq import against
from physgen.sim.evaluate.physics_iq_folder import read_benchmark, read_submission
from physgen.sim.evaluate.questionnaire import FORMAT, load_case, load_key
from physgen.sim.evaluate.questionnaire_answers import collect_questionnaire, read_answers
from physgen.sim.files import read_bytes

RANDOM = np.random.default_rng(0)
PIXELS = RANDOM.integers(0, 255, (4, 24, 32, 3), dtype=np.uint8)
GENERATED = "0001_perspective-left_trimmed-ball.mp4"


def _video(path: Path) -> None:
    put_video(path, PIXELS, fps=8)


def _read_video(folder: Path) -> None:
    footage = open_footage(folder / "v.mp4")
    against(footage, [footage], 6)


def _pictures(folder: Path) -> None:
    (folder / "f").mkdir(exist_ok=True)
    for i, frame in enumerate(PIXELS, 1):
        cv2.imwrite(str(folder / "f" / f"{i:04d}.png"), frame)


def _read_pictures(folder: Path) -> None:
    for _ in open_footage(folder / "f").frames(8):
        pass


def _bake(folder: Path) -> None:
    put_bake(folder)
    frames = [{"kinetic_j": 1.0, "elastic_j": 0.5, "potential_j": 2.0, "frame": i} for i in range(3)]
    (folder / "metrics.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")


def _read_bake(folder: Path) -> None:
    bake_physics(load_bake(folder), None, cancelled=lambda: False)


def _submission(folder: Path) -> None:
    _video(folder / GENERATED)


def _read_submission(folder: Path) -> None:
    read_submission(folder)
    # No benchmark lies there.
    try:
        read_benchmark(folder, 8.0)
    except InputError as error:
        assert "split-videos" in str(error)


add("video to evaluate", "v.mp4", lambda f: _video(f / "v.mp4"), _read_video)
add("pictures to evaluate", ("f/0001.png", "f/0003.png"), _pictures, _read_pictures)
add("energies of a bake", ("metrics.json", "manifest.json"), _bake, _read_bake)
add("videos for Physics-IQ", GENERATED, _submission, _read_submission)


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


add("case of a questionnaire", "case.toml", _case, load_case)
add("key of a questionnaire", "key.json", lambda f: put_json(f / "key.json", KEY), lambda f: load_key(f / "key.json"))
add(
    "answers of a questionnaire",
    "a.json",
    lambda f: put_json(f / "a.json", ANSWERS),
    lambda f: read_answers(f / "a.json", KEY),
)
add(
    "answers that are collected",
    ("a.json", "key.json"),
    lambda f: (put_json(f / "key.json", KEY), put_json(f / "a.json", ANSWERS)),
    lambda f: collect_questionnaire([f / "a.json"], key=f / "key.json", out=f / "results"),
)
add("answer of a judge", "a.txt", lambda f: (f / "a.txt").write_text(JUDGED), _read_judged)
