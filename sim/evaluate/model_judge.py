# SPDX-License-Identifier: MIT
"""A vision-language model as judge of videos: the protocol of PhysGen3D (supplement B.2, Listing 3).

Ten evenly sampled frames of each video, all videos of one photo and text in one question, three criteria, scores from 0
to 1. Beyond the paper: the question is repeated with the videos in another random order each time, the spread is
reported, and an answer that does not keep to scale and form is asked for again and said.
"""

from __future__ import annotations

import math
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
from ..validation import finite_or_none, quantity, require_quantities
from .judge_question import CRITERIA, MAX_PROMPT, MAX_TEXT, MOST_VIDEOS, ReadAnswer, question, read_scores

_WORDING = Wording(sent="frames", lost="the videos were not judged")


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
                    name: {
                        "mean": finite_or_none(score.mean),
                        "spread": finite_or_none(score.spread),
                        "values": list(score.values),
                    }
                    for name, score in of.items()
                }
                for video, of in self.scores.items()
            },
            "orders": [list(order) for order in self.orders],
            "answers": [list(answers) for answers in self.answers],
            "notes": list(self.notes),
        }


def evenly_sampled(count: int, wanted: int) -> NDArray[np.int64]:
    """Return the numbers of ``wanted`` frames evenly spaced over ``count``, first and last among them.

    All of them where there are fewer. Raises InputError for fewer than two.
    """
    if count < 2:
        raise InputError(
            f"video has {count} frame{'s' * (count != 1)}: give at least 2, a single picture shows no motion"
        )
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, wanted))).astype(np.int64))


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
    questions = _Questions(
        photo=jpeg_bytes(_scaled(photo, options.longest_side)),
        pictures={name: _sampled(name, frames, options) for name, frames in videos.items()},
        prompt=prompt,
        request=request,
        options=options,
        notice=notice,
        cancelled=cancelled,
    )
    questions.announce()
    random = np.random.default_rng(options.seed)
    names = list(videos)
    values: dict[str, dict[str, list[float]]] = {name: {c: [] for c in CRITERIA} for name in names}
    orders: list[tuple[str, ...]] = []
    answers: list[tuple[str, ...]] = []
    for repetition in range(1, options.repetitions + 1):
        order = tuple(names[i] for i in random.permutation(len(names)))
        asked = questions.ask(repetition, order, needed=not answers)
        orders.append(order)
        answers.append(asked.texts)
        for name, scores in zip(order, asked.scores, strict=True):
            if scores is None:
                questions.note(f"repetition {repetition}: no score for {name}, which has one value less")
                continue
            for criterion, value in scores.items():
                values[name][criterion].append(value)
        if asked.silent:
            left = options.repetitions - repetition
            if left:
                questions.note(
                    f"{left} of {options.repetitions} repetitions were not asked: the endpoint does not answer"
                )
            break
    return Judgement(
        model=request.model,
        endpoint=str(request.address),
        prompt=prompt,
        options=options,
        scores={name: {c: Score(values=tuple(v)) for c, v in of.items()} for name, of in values.items()},
        orders=tuple(orders),
        answers=tuple(answers),
        notes=tuple(questions.notes),
    )


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What came of one repetition. texts: all answers; scores: of the videos in the order shown, of the answer that
    could be read best; silent: whether the endpoint stopped answering."""

    texts: tuple[str, ...]
    scores: tuple[Mapping[str, float] | None, ...]
    silent: bool


@dataclass(frozen=True, kw_only=True)
class _Questions:
    """Questions about the same videos in different orders. photo: JPEG; pictures: by video, JPEGs of its frames. notes:
    what was wrong so far."""

    photo: bytes
    pictures: Mapping[str, Sequence[bytes]]
    prompt: str
    request: ChatRequest
    options: JudgeOptions
    notice: Callable[[str], None]
    cancelled: IsCancelled
    notes: list[str] = field(default_factory=list)

    def note(self, sentence: str) -> None:
        """Keep ``sentence`` and tell it."""
        self.notes.append(sentence)
        self.notice(sentence)

    def announce(self) -> None:
        """Tell which videos are short, and what goes where."""
        counts = {name: len(frames) for name, frames in self.pictures.items()}
        for name, count in counts.items():
            if count < self.options.frames:
                self.note(f"{name}: has {count} frames, all of which are shown; {self.options.frames} are usual")
        sent = len(self.photo) + sum(len(jpeg) for frames in self.pictures.values() for jpeg in frames)
        repetitions = self.options.repetitions
        self.notice(
            f"frames go to {self.request.address} (model {self.request.model}): {repetitions} "
            f"question{'s' * (repetitions != 1)}, each with the photo and {sum(counts.values())} frames of "
            f"{len(counts)} video{'s' * (len(counts) != 1)}, {sent >> 10} KiB"
        )

    def ask(self, repetition: int, order: tuple[str, ...], *, needed: bool) -> _Asked:
        """Return the answer about the videos in this ``order``, asked again while it cannot be read whole.

        needed: InputError where nothing arrives at all; otherwise that is a note.
        """
        content: list[str | bytes] = [question(len(order), self.options.frames, self.prompt), "The photo:", self.photo]
        for number, name in enumerate(order, start=1):
            content += [f"{len(self.pictures[name])} evenly spaced frames of video {number}:", *self.pictures[name]]
        best = ReadAnswer(scores=(None,) * len(order), problems=())
        texts: list[str] = []
        silent = False
        for attempt in range(1, self.options.attempts + 1):
            which = f"answer {repetition}{f', attempt {attempt}' if attempt > 1 else ''}"
            try:
                text = complete_content(
                    self.request,
                    content,
                    self.notice,
                    self.cancelled,
                    temperature=self.options.temperature,
                    wording=_WORDING,
                )
            except InputError as error:
                # What was answered before is not lost, and may have been paid for.
                if needed and not texts:
                    raise
                self.note(f"{which}: {error}")
                silent = True
                break
            texts.append(text[:MAX_TEXT])
            read = read_scores(text, len(order))
            for problem in read.problems:
                self.note(f"{which}: {problem}")
            if read.readable > best.readable:
                best = read
            if best.readable == len(order):
                break
        return _Asked(texts=tuple(texts), scores=best.scores, silent=silent)


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
