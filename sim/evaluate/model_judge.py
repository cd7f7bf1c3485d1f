# SPDX-License-Identifier: MIT
"""A vision-language model as judge of videos: the protocol of PhysGen3D (supplement B.2, Listing 3).

Ten evenly sampled frames of each video, all videos of one photo and text in one question, three criteria, scores from 0
to 1. Beyond the paper: the question is repeated with the videos in another random order each time, the spread is
reported, and an answer that does not keep to scale and form is asked for again and said.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..events import IsCancelled, never
from ..reconstruct.reasoning.chat_client import ChatRequest, Wording, complete_content
from ..reconstruct.reasoning.material_query import jpeg_bytes
from ..validation import quantity, require_quantities

CRITERIA = ("physical_realism", "photorealism", "semantic_consistency")
"""Criteria, the same for the model as for people."""

TITLES = {name: name.replace("_", " ").capitalize() for name in CRITERIA}
MOST_VIDEOS = 8
MAX_TEXT = 2**16
"""Characters of an answer that are read; a good one has about a hundred for each video."""

MAX_PROMPT = 1000

_WORDING = Wording(sent="frames", lost="the videos were not judged")
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


@dataclass(frozen=True, kw_only=True)
class JudgeOptions:
    """Options of a request to a model as judge. Raises InputError on a value out of range.

    repetitions: questions, each with its own order of the videos, 1 to 100. attempts: times that a question is asked
    until the answer can be read whole, 1 to 5. frames: of each video, 2 to 32 (the paper: 10). longest_side: of a frame
    that is sent, pixels, 64 to 2048. seed: of the orders. temperature: 0 to 2; None leaves it to the model.
    """

    repetitions: int = quantity(5, 1, 100, "a whole number")
    attempts: int = quantity(2, 1, 5, "a whole number")
    frames: int = quantity(10, 2, 32, "a whole number")
    longest_side: int = quantity(512, 64, 2048, "pixels")
    seed: int = quantity(0, 0, 2**31 - 1, "a whole number")
    temperature: float | None = quantity(None, 0.0, 2.0)

    def __post_init__(self) -> None:
        require_quantities(self, "judge option ")


@dataclass(frozen=True, kw_only=True)
class Score:
    """One criterion of one video over the repetitions that were read whole.

    values: in the order of the repetitions, each 0 to 1. mean and spread (standard deviation with n − 1) of them; NaN
    where there are too few.
    """

    values: tuple[float, ...] = ()

    @property
    def mean(self) -> float:
        """Mean of the values; NaN without any."""
        return float(np.mean(self.values)) if self.values else math.nan

    @property
    def spread(self) -> float:
        """Standard deviation of the values; NaN for fewer than two."""
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else math.nan


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A model's judgements of some videos.

    scores: video → criterion → score. orders: the videos as each repetition showed them. answers: as they came, one
    list for each repetition. notes: everything that was wrong with an answer, one sentence each.
    """

    model: str
    endpoint: str
    prompt: str
    options: JudgeOptions
    scores: Mapping[str, Mapping[str, Score]]
    orders: tuple[tuple[str, ...], ...]
    answers: tuple[tuple[str, ...], ...] = field(repr=False)
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON: what is not finite is null."""
        return {
            "model": self.model,
            "endpoint": self.endpoint,
            "prompt": self.prompt,
            "frames": self.options.frames,
            "repetitions": self.options.repetitions,
            "seed": self.options.seed,
            "temperature": self.options.temperature,
            "videos": {
                video: {
                    name: {"mean": _finite(score.mean), "spread": _finite(score.spread), "values": list(score.values)}
                    for name, score in of.items()
                }
                for video, of in self.scores.items()
            },
            "orders": [list(order) for order in self.orders],
            "answers": [list(answers) for answers in self.answers],
            "notes": list(self.notes),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def evenly_sampled(count: int, wanted: int) -> NDArray[np.int64]:
    """Return the numbers of ``wanted`` frames evenly spaced over ``count``, first and last among them.

    All of them where there are fewer. Raises InputError for fewer than two.
    """
    if count < 2:
        raise InputError(
            f"video has {count} frame{'s' * (count != 1)}: give at least 2, a single picture shows no motion"
        )
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, wanted))).astype(np.int64))


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


def judge_videos(
    videos: Mapping[str, Sequence[NDArray[np.uint8]]],
    photo: NDArray[np.uint8],
    prompt: str,
    request: ChatRequest,
    *,
    options: JudgeOptions | None = None,
    notice: Callable[[str], None] = lambda message: None,
    cancelled: IsCancelled = never,
) -> Judgement:
    """Return the scores that ``request.model`` gives to ``videos`` made from ``photo`` and ``prompt``.

    videos: by name, frames (H, W, 3) uint8 sRGB in order of time; names are not sent. photo: (H, W, 3) uint8 sRGB.
    prompt: what should happen. notice: receives the recipient and everything that is wrong with an answer.

    Raises InputError for no or too many videos, for one with fewer than two frames, without a prompt, and where no
    answer arrives; an answer that cannot be read is a note instead, and so is an endpoint that falls silent later, and
    is not asked again then. Raises Cancelled.
    """
    options = options or JudgeOptions()
    if not 1 <= len(videos) <= MOST_VIDEOS:
        raise InputError(f"judge: {len(videos)} videos given; give 1 to {MOST_VIDEOS}, which are judged together")
    if not prompt.strip() or len(prompt) > MAX_PROMPT:
        raise InputError(
            f"prompt has {len(prompt)} characters; say in 1 to {MAX_PROMPT} what should happen in the videos"
        )
    pictures = {name: _sampled(name, frames, options) for name, frames in videos.items()}
    shown = {name: len(frames) for name, frames in pictures.items()}
    notes: list[str] = []

    def note(sentence: str) -> None:
        notes.append(sentence)
        notice(sentence)

    for name, count in shown.items():
        if count < options.frames:
            note(f"{name}: has {count} frames, all of which are shown; {options.frames} are usual")
    photo_jpeg = jpeg_bytes(_scaled(photo, options.longest_side))
    sent = len(photo_jpeg) + sum(len(jpeg) for frames in pictures.values() for jpeg in frames)
    questions = f"{options.repetitions} question{'s' * (options.repetitions != 1)}"
    notice(
        f"frames go to {request.address} (model {request.model}): {questions}, each with the photo and "
        f"{sum(shown.values())} frames of {len(videos)} video{'s' * (len(videos) != 1)}, {sent >> 10} KiB"
    )
    random = np.random.default_rng(options.seed)
    names = list(videos)
    values: dict[str, dict[str, list[float]]] = {name: {c: [] for c in CRITERIA} for name in names}
    orders: list[tuple[str, ...]] = []
    answers: list[tuple[str, ...]] = []
    for repetition in range(1, options.repetitions + 1):
        order = tuple(names[i] for i in random.permutation(len(names)))
        orders.append(order)
        content: list[str | bytes] = [question(len(order), options.frames, prompt), "The photo:", photo_jpeg]
        for number, name in enumerate(order, start=1):
            content += [f"{shown[name]} evenly spaced frames of video {number}:", *pictures[name]]
        best: ReadAnswer | None = None
        raw: list[str] = []
        silent = False
        for attempt in range(1, options.attempts + 1):
            try:
                text = complete_content(
                    request, content, notice, cancelled, temperature=options.temperature, wording=_WORDING
                )
            except InputError as error:
                # What was answered before is not lost, and may have been paid for.
                if not (answers or raw):
                    raise
                note(f"answer {repetition}{f', attempt {attempt}' if attempt > 1 else ''}: {error}")
                silent = True
                break
            raw.append(text[:MAX_TEXT])
            read = read_scores(text, len(order))
            for problem in read.problems:
                note(f"answer {repetition}{f', attempt {attempt}' if attempt > 1 else ''}: {problem}")
            if best is None or _readable(read) > _readable(best):
                best = read
            if _readable(best) == len(order):
                break
        answers.append(tuple(raw))
        for name, scores in zip(order, best.scores if best else (None,) * len(order), strict=True):
            if scores is None:
                note(f"repetition {repetition}: no score for {name}, which has one value less")
                continue
            for criterion, value in scores.items():
                values[name][criterion].append(value)
        if silent:
            left = options.repetitions - repetition
            if left:
                note(f"{left} of {options.repetitions} repetitions were not asked: the endpoint does not answer")
            break
    return Judgement(
        model=request.model,
        endpoint=str(request.address),
        prompt=prompt,
        options=options,
        scores={name: {c: Score(values=tuple(v)) for c, v in of.items()} for name, of in values.items()},
        orders=tuple(orders),
        answers=tuple(answers),
        notes=tuple(notes),
    )


def _readable(read: ReadAnswer) -> int:
    return sum(scores is not None for scores in read.scores)


def _sampled(name: str, frames: Sequence[NDArray[np.uint8]], options: JudgeOptions) -> list[bytes]:
    try:
        numbers = evenly_sampled(len(frames), options.frames)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return [jpeg_bytes(_scaled(frames[int(i)], options.longest_side)) for i in numbers]


def _scaled(picture: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """``picture`` scaled down to at most ``longest`` pixels on its longer side."""
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or 0 in picture.shape:
        raise InputError(f"picture of shape {picture.shape} and type {picture.dtype}: give (H, W, 3) uint8 sRGB")
    share = longest / max(picture.shape[:2])
    if share >= 1:
        return picture
    width, height = (max(1, round(side * share)) for side in (picture.shape[1], picture.shape[0]))
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
