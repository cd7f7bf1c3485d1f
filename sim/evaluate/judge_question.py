# SPDX-License-Identifier: MIT
"""What is asked of who judges videos: the criteria, the question to a model, and its scores as read from its answer.

Criteria and question are those of PhysGen3D (supplement B.2, Listing 3).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

CRITERIA = ("physical_realism", "photorealism", "semantic_consistency")
"""Criteria, the same for the model as for people."""

TITLES = {name: name.replace("_", " ").capitalize() for name in CRITERIA}
MOST_VIDEOS = 8
MAX_TEXT = 2**16
"""Characters of an answer that are read; a good one has about a hundred for each video."""

MAX_PROMPT = 1000


_QUESTION = """\
You are asked to judge {count} generated from the same photo and the same text. You see the photo first, then {frames} \
evenly spaced frames of each video, in order of time. The text says what should happen: '{prompt}'

Judge each video by three criteria:
- Physical realism: does the motion follow the laws of physics, and do things show real properties such as \
weight, elasticity and friction? A video in which nothing moves must lose points here, even though stillness is real.
- Photorealism: the visual quality. Are there artefacts or jumps, and how well are light, shadow, texture and \
material of the photo kept?
- Semantic consistency: how well does what happens agree with the text?

Give a score from 0 to 1 for each criterion, 1 being the best. Write one line for each video, exactly in this form, \
with a ';' after each score, and nothing else:
{lines}
"""
_LINE = "Video {}: Physical Realism Score: [score]; Photorealism Score: [score]; Semantic Consistency Score: [score];"


def question(count: int, frames: int, prompt: str) -> str:
    """Return the question about ``count`` videos of which ``frames`` frames each are shown."""
    lines = "\n".join(_LINE.format(number) for number in range(1, count + 1))
    what = "one video" if count == 1 else f"{count} videos"
    plain = " ".join("".join(c if c.isprintable() else " " for c in prompt).split()).replace("'", "’")
    return _QUESTION.format(count=what, frames=frames, prompt=plain[:MAX_PROMPT], lines=lines)


@dataclass(frozen=True, kw_only=True)
class ReadAnswer:
    """An answer as far as it can be read.

    scores: for each video in the order shown, its criteria; None unless all three are there and within 0 to 1.
    problems: what is wrong, one sentence each.
    """

    scores: tuple[Mapping[str, float] | None, ...]
    problems: tuple[str, ...]

    @property
    def readable(self) -> int:
        """Return how many videos have scores."""
        return sum(scores is not None for scores in self.scores)


_VIDEO = re.compile(r"\bvideo\W{0,4}(\d{1,3})\b", re.IGNORECASE)
_NUMBER = re.compile(
    r"\s*(?:score)?[\s:=\[(\"'*_`]*([+-]?(?:\d{1,9}(?:[.,]\d{1,9})?|[.,]\d{1,9}))"
    r"(\s*(?:%|/\s*\d{1,6}|out\s+of\s+\d{1,6}|(?:-|–|to)\s*[\d.,]{1,9}))?",
    re.IGNORECASE,
)
_CRITERIA = {name: re.compile(name.replace("_", r"[\s_-]*"), re.IGNORECASE) for name in CRITERIA}


def read_scores(text: str, count: int) -> ReadAnswer:
    """Parse an answer about ``count`` videos. Never raises.

    Markdown, brackets, JSON's quotes and other line breaks than asked for are understood. Nothing is clamped or scaled:
    a number outside of 0 to 1, a percentage, or 8/10 is a problem, and its video has no score.
    """
    problems: list[str] = []
    if len(text) > MAX_TEXT:
        problems.append(f"the answer has {len(text)} characters; only the first {MAX_TEXT} are read")
    # Reasoning models draft answers before the final one.
    text = text[: 2 * MAX_TEXT].rpartition("</think>")[2][:MAX_TEXT]
    # "Photorealism" holds no other criterion's name, but "physical realism" may be written as one word.
    marks = list(_VIDEO.finditer(text))
    found: list[dict[str, float] | None] = [None] * count
    seen: set[int] = set()
    for index, mark in enumerate(marks):
        number = int(mark[1])
        part = text[mark.end() : marks[index + 1].start() if index + 1 < len(marks) else len(text)]
        if not any(pattern.search(part) for pattern in _CRITERIA.values()):
            continue
        if not 1 <= number <= count:
            problems.append(f"video {number}: there {'is' if count == 1 else 'are'} {count}; left out")
            continue
        scores, wrong = _criteria(part)
        if number in seen:
            # The model contradicts itself, or the answer has a draft: neither can be trusted.
            problems.append(f"video {number}: answered more than once; left out")
            found[number - 1] = None
            continue
        seen.add(number)
        problems += [f"video {number}: {sentence}" for sentence in wrong]
        found[number - 1] = scores if not wrong else None
    missing = [number for number in range(1, count + 1) if number not in seen]
    if len(missing) == count:
        problems.append(f"no line of scores in the answer, which begins {_quoted(text)}")
    else:
        problems += [f"video {number}: no line in the answer" for number in missing]
    return ReadAnswer(scores=tuple(found), problems=tuple(problems[:40]))


def _criteria(part: str) -> tuple[dict[str, float], list[str]]:
    scores: dict[str, float] = {}
    wrong: list[str] = []
    for name, pattern in _CRITERIA.items():
        label = name.replace("_", " ")
        mark = pattern.search(part)
        number = None if mark is None else _NUMBER.match(part, mark.end())
        if mark is None or number is None:
            wrong.append(f"no {label}" if mark is None else f"{label} without a number")
            continue
        value, unit = float(number[1].replace(",", ".")), " ".join((number[2] or "").split())
        if unit.replace(" ", "") not in ("", "/1", "outof1") or not 0.0 <= value <= 1.0:
            wrong.append(f"{label} is {f'{number[1]} {unit}'.strip()!r}, not a number on the scale of 0 to 1")
        else:
            scores[name] = value
    return scores, wrong


def _quoted(text: str) -> str:
    plain = " ".join("".join(c if c.isprintable() else " " for c in text[:400]).split())
    return repr(plain if len(plain) <= 120 else plain[:119] + "…")
