# SPDX-License-Identifier: MIT
"""A laboratory's folder of generated videos against the Physics-IQ benchmark: names, rates and lengths, and its table.

The benchmark has 66 scenarios from three perspectives, 198 views; two takes of each. A generated video is known by its
number, as the benchmark's own program knows it:

    generated  0001_perspective-left_trimmed-ball-and-block-fall.mp4
    real       split-videos/testing/30FPS/0001_testing-videos_30FPS_perspective-left_take-1_trimmed-….mp4
               split-videos/testing/30FPS/0199_testing-videos_30FPS_perspective-left_take-2_trimmed-….mp4
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import Cancelled, InputError
from ..events import IsCancelled, never
from ..files import without_folder
from .evaluation import HIGHER, Measure, Section
from .footage import Footage, at_rate, open_footage
from .physics_iq import NAMES, TITLES, compare, original_score, quarter, take, verified_scores

VIEWS = 198
RATES = (8, 16, 24, 30)
SECONDS = 5.0
REAL_RATE = 30
FOLDERS = ("split-videos/testing", "split-videos/testing-videos")
"""Of the real videos, by the benchmark's program and by its description."""

_GENERATED = re.compile(r"(\d{4})_.*\.mp4", re.DOTALL)
_REAL = re.compile(
    r"(?P<id>\d{4})_testing-videos_(?P<fps>\d+)FPS_perspective-(?P<view>left|center|right)_"
    r"take-(?P<take>[12])_trimmed-(?P<scenario>[^/]+)\.mp4"
)


@dataclass(frozen=True, kw_only=True)
class Submission:
    """A folder of generated videos. videos: by number. fps: of all. problems: what keeps it from being complete."""

    videos: dict[int, Footage]
    fps: float
    problems: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class RealView:
    """One view of the benchmark: its number, scenario, perspective, and two takes."""

    number: int
    scenario: str
    view: str
    takes: tuple[Path, Path]


@dataclass(frozen=True, kw_only=True)
class ViewRow:
    """The measures of one view, as the benchmark's table has them: ours, a still video's, and of the two takes."""

    view: RealView
    ours: dict[str, float]
    still: dict[str, float]
    takes: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class FailedView:
    """A view that could not be compared, and why."""

    view: RealView
    reason: str


def read_submission(folder: Path) -> Submission:
    """Return the generated videos in ``folder``, looked at but for what they show.

    Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; name the one with the {VIEWS} generated videos")
    problems: list[str] = []
    videos: dict[int, Footage] = {}
    for path in sorted(folder.iterdir()):
        matched = _GENERATED.fullmatch(path.name)
        number = int(matched[1]) if matched else 0
        if path.name.startswith("."):
            continue
        if not 1 <= number <= VIEWS:
            problems.append(f"{path.name}: is no name of the benchmark's, such as 0001_perspective-left_trimmed-….mp4")
        elif number in videos:
            problems.append(f"{path.name}: {number:04d} comes twice; {videos[number].name} counts")
        elif path.is_dir():
            problems.append(f"{path.name}: is a folder; the benchmark takes MP4 files")
        else:
            try:
                videos[number] = open_footage(path)
            except InputError as error:
                problems.append(without_folder(error, path.parent))
    problems += [notice for video in videos.values() for notice in video.notices]
    if not videos:
        raise InputError(f"{folder}: holds no video such as 0001_perspective-left_trimmed-….mp4; name another folder")
    rates = [round(video.fps) for video in videos.values()]
    fps = max(set(rates), key=rates.count)
    if fps not in RATES:
        problems.append(f"{fps} frames per second: the benchmark has {', '.join(map(str, RATES))}")
    for video in videos.values():
        if round(video.fps) != fps:
            problems.append(f"{video.name}: has {video.fps:g} frames per second and the others {fps}")
        count = video.count(round(3 * SECONDS * video.fps))
        if count != round(SECONDS * video.fps):
            problems.append(
                f"{video.name}: is {count / video.fps:.4g} s long; the benchmark takes exactly {SECONDS:g} s"
            )
    missing = [number for number in range(1, VIEWS + 1) if number not in videos]
    if missing:
        shown = ", ".join(f"{number:04d}" for number in missing[:8])
        more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
        problems.append(f"{len(missing)} of {VIEWS} videos are missing: {shown}{more}")
    return Submission(videos=videos, fps=float(fps), problems=tuple(problems))


def read_benchmark(root: Path, fps: float) -> dict[int, RealView]:
    """Return the views of the benchmark in the folder ``root`` by the number of their first take.

    Real videos of the rate ``fps`` where there are any, else those of 30. Raises InputError where there are none, and
    for a view without a second take.
    """
    rates = (f"{round(fps)}FPS", f"{REAL_RATE}FPS")
    places = [root / folder / rate for rate in rates for folder in FOLDERS]
    place = next((path for path in places if path.is_dir()), None)
    if place is None:
        raise InputError(f"{root}: has no {FOLDERS[0]}/{REAL_RATE}FPS; name the folder physics-IQ-benchmark")
    first: dict[tuple[str, str], tuple[int, Path]] = {}
    second: dict[tuple[str, str], Path] = {}
    for path in sorted(place.iterdir()):
        matched = _REAL.fullmatch(path.name)
        if matched is None:
            continue
        key = matched["scenario"], matched["view"]
        if matched["take"] == "1":
            first[key] = int(matched["id"]), path
        else:
            second[key] = path
    lonely = sorted(set(first) ^ set(second))
    if lonely or not first:
        named = f"{lonely[0][0]} from the {lonely[0][1]} has one take" if lonely else "holds no real videos"
        raise InputError(f"{place}: {named}; download the benchmark again")
    return {
        number: RealView(number=number, scenario=key[0], view=key[1], takes=(path, second[key]))
        for key, (number, path) in first.items()
    }


def score_views(
    submission: Submission,
    benchmark: dict[int, RealView],
    *,
    on_row: Callable[[int], None] = lambda done: None,
    cancelled: IsCancelled = never,
) -> tuple[list[ViewRow], list[FailedView]]:
    """Return the measures of each video that the benchmark has a view for, and the views without any, by number.

    A damaged recording or video leaves its view without measures and the others as they are. Raises Cancelled on
    request.
    """
    rows: list[ViewRow] = []
    failed: list[FailedView] = []
    for number in sorted(set(submission.videos) & set(benchmark)):
        if cancelled():
            raise Cancelled("the evaluation was cancelled; nothing was written")
        try:
            rows.append(_score(submission, submission.videos[number], benchmark[number]))
        except InputError as error:
            reason = without_folder(error, benchmark[number].takes[0].parent)
            failed.append(FailedView(view=benchmark[number], reason=reason))
        on_row(len(rows) + len(failed))
    return rows, failed


SHORT = 2
"""Frames by which a recording may be shorter than the benchmark's five seconds: rates do not divide evenly."""


def _score(submission: Submission, video: Footage, view: RealView) -> ViewRow:
    """Return the measures of ``video``. Raises InputError for what cannot be compared."""
    count = round(SECONDS * submission.fps)
    real = [open_footage(path) for path in view.takes]
    size = quarter(real[0].width, real[0].height)
    ours = take(video.frames(count), size, name=video.name)
    takes = [take(at_rate(item, submission.fps, count), size, name=item.name) for item in real]
    for item, found in zip(real, takes, strict=True):
        if len(found) < count - SHORT:
            raise InputError(
                f"{item.name}: ends after {len(found) / submission.fps:.3g} of {SECONDS:g} s; download it again"
            )
    common = min(map(len, (ours, *takes)))
    ours, first, other = (item.first(common) for item in (ours, *takes))
    return ViewRow(
        view=view,
        ours=compare(first, ours).rounded(),
        still=compare(first, first.still()).rounded(),
        takes=compare(first, other).rounded(),
    )


def physics_iq_section(
    submission: Submission, rows: Sequence[ViewRow], folder: Path, failed: Sequence[FailedView] = ()
) -> Section:
    """Return the section of ``rows``; without any, of the check of names alone. failed: views that have no row."""
    complete = len(rows) == VIEWS and not submission.problems
    failures = [f"{item.view.number:04d} is not compared: {item.reason}" for item in failed]
    notices = [*failures, *submission.problems]
    if rows and not complete:
        notices.append(f"a score of {len(rows)} of {VIEWS} views: not the benchmark's score, which is of all")
    # A still video overlaps with a recording in which the masks find no motion, and with no other.
    calm = sum(row.still["spatial_iou"] == 1.0 for row in rows)
    if calm:
        notices.append(
            f"in {calm} of {len(rows)} views nothing moves in the real video by the measures' threshold: a video that "
            "stands still has full overlaps there"
        )
    if not rows:
        text = (
            f"{len(submission.videos)} videos at {submission.fps:g} a second in {folder.name}, checked and not compared"
        )
        return Section(name="physics_iq", title="Physics-IQ", text=text, measures=(), notices=tuple(notices))
    means = {kind: {n: float(np.mean([getattr(row, kind)[n] for row in rows])) for n in NAMES} for kind in KINDS}
    measures = [
        Measure(name=n, title=TITLES[n][0], value=means["ours"][n], better=TITLES[n][1], still=means["still"][n])
        for n in NAMES
    ]
    verified = {
        kind: 100.0 * float(np.mean([list(verified_scores(getattr(row, kind), row.takes).values()) for row in rows]))
        for kind in ("ours", "still")
    }
    original = [original_score(means[kind], means["takes"]) for kind in ("ours", "still")]
    scores: dict[str, tuple[float | None, float | None]] = {
        "physics_iq": (original[0], original[1]),
        "physics_iq_verified": (verified["ours"], verified["still"]),
    }
    titles = {"physics_iq": "Physics-IQ score", "physics_iq_verified": "Physics-IQ verified score"}
    for name, (value, still) in scores.items():
        note = "" if value is not None else "the two takes have no motion in common"
        measures.append(Measure(name=name, title=titles[name], value=value, better=HIGHER, still=still, note=note))
    text = f"{len(rows)} of {VIEWS} views of {folder.name} at {submission.fps:g} frames a second"
    return Section(
        name="physics_iq",
        title="Physics-IQ",
        text=text,
        measures=tuple(measures),
        notices=tuple(notices),
        failures=tuple(failures),
    )


KINDS = ("ours", "still", "takes")


def view_table(rows: Sequence[ViewRow], failed: Sequence[FailedView] = ()) -> Iterator[list[object]]:
    """Yield the table of all views, headings first: each measure of the video, of a still one, and of the two takes.

    The row of a view in ``failed`` has no values, and says why.
    """
    columns = [f"{kind}_{name}" for kind in KINDS for name in NAMES]
    yield ["id", "scenario", "view", *columns, "verified_score", "problem"]
    values: dict[int, list[object]] = {
        item.view.number: [*(None for _ in columns), None, item.reason] for item in failed
    }
    for row in rows:
        score = 100.0 * float(np.mean(list(verified_scores(row.ours, row.takes).values())))
        values[row.view.number] = [*(getattr(row, kind)[name] for kind in KINDS for name in NAMES), score, None]
    for view in sorted([item.view for item in rows] + [item.view for item in failed], key=lambda view: view.number):
        yield [f"{view.number:04d}", view.scenario, view.view, *values[view.number]]
