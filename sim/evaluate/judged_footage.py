# SPDX-License-Identifier: MIT
"""Video files judged by a model: their frames read, a video that stands still added, the scores as figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..composite.srgb import read_rgb
from ..errors import InputError
from ..events import IsCancelled, never
from ..reconstruct.reasoning.chat_client import ChatRequest
from .evaluation import HIGHER, NEITHER, Measure, Section
from .footage import Footage, open_footage
from .model_judge import CRITERIA, TITLES, Judgement, JudgeOptions, evenly_sampled, judge_videos

STILL = "the first frame repeated"


@dataclass(frozen=True, kw_only=True)
class JudgeRequest:
    """Who judges, and what beside the video itself.

    endpoint: the model; its ``consent`` is to sending the photo and the frames. prompt: what should happen in the
    videos. photo: what they start from; None: the video's first frame. beside: videos of the same photo and prompt,
    judged together with it.
    """

    endpoint: ChatRequest
    prompt: str
    photo: Path | None = None
    beside: Sequence[Path] = ()
    options: JudgeOptions = field(default_factory=JudgeOptions)


def sampled_frames(footage: Footage, most: int, wanted: int) -> list[NDArray[np.uint8]]:
    """Return ``wanted`` evenly spaced frames of the first ``most``, (H, W, 3) uint8 sRGB.

    Raises InputError for fewer than two.
    """
    try:
        numbers = set(evenly_sampled(footage.count(most), wanted).tolist())
    except InputError as error:
        raise InputError(f"{footage.name}: {error}") from None
    return [frame[..., ::-1].copy() for i, frame in enumerate(footage.frames(max(numbers) + 1)) if i in numbers]


def judged(
    footage: Footage,
    most: int,
    judge: JudgeRequest,
    *,
    notice: Callable[[str], None] = lambda message: None,
    cancelled: IsCancelled = never,
) -> tuple[Section, Judgement]:
    """Return the scores of the first ``most`` frames of ``footage`` as figures, and all that the model said.

    Its first frame, repeated, is judged as one more video: what standing still would get. Raises what ``judge_videos``
    raises, and InputError for two videos of one name.
    """
    wanted = judge.options.frames
    videos: dict[str, Sequence[NDArray[np.uint8]]] = {footage.name: sampled_frames(footage, most, wanted)}
    for path in judge.beside:
        other = open_footage(path)
        if other.name in videos:
            raise InputError(f"{path}: another video that is judged has the same name; rename one")
        videos[other.name] = sampled_frames(other, most, wanted)
    first = videos[footage.name][0]
    videos[STILL] = [first] * wanted
    photo = first if judge.photo is None else read_rgb(judge.photo)
    found = judge_videos(
        videos, photo, judge.prompt, judge.endpoint, options=judge.options, notice=notice, cancelled=cancelled
    )
    return _section(found, footage.name), found


def _section(found: Judgement, subject: str) -> Section:
    measures = []
    for name in CRITERIA:
        still = found.scores[STILL][name]
        for video, of in found.scores.items():
            if video == STILL:
                continue
            score, own = of[name], video == subject
            spread = f", standard deviation {score.spread:.2f}" if len(score.values) > 1 else ""
            measures.append(
                Measure(
                    name=f"judge_{name}" if own else f"judge_{name}: {video}",
                    title=f"{TITLES[name]}{'' if own else f' of {video}'}",
                    value=score.mean if score.values else None,
                    better=HIGHER if own else NEITHER,
                    still=still.mean if own and still.values else None,
                    note=f"{len(score.values)} of {found.options.repetitions} answers{spread}",
                )
            )
    text = (
        f"What {found.model} scores from 0 to 1, asked {found.options.repetitions} times about {found.options.frames} "
        f"frames of each video, in another order each time. The text was: {found.prompt}"
    )
    notices = tuple(f"judge: {note}" for note in found.notes)
    return Section(name="judge", title="Judged by a model", text=text, measures=tuple(measures), notices=notices)
