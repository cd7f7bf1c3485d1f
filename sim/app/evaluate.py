# SPDX-License-Identifier: MIT
"""Video → evaluation folder: figures against recordings and by themselves, a page, JSON and tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..atomic import replacing_tree
from ..cache.folder_lock import lock_beside
from ..errors import Cancelled, InputError
from ..evaluate.against import against as against_section
from ..evaluate.evaluation import JSON_FILE, Evaluation, Section, write_evaluation
from ..evaluate.footage import MOST_FRAMES, Footage, open_footage
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..validation import quantity, require_quantities

STAGE = "evaluate"


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What an evaluation does.

    seconds: only the first so many seconds of every video; None: all that the videos have in common, Physics-IQ has 5.
    fps: frames per second of a folder of pictures, or instead of what a video file says; None: as it says.
    """

    seconds: float | None = quantity(None, 0.01, 3600.0, "seconds")
    fps: float | None = quantity(None, 0.01, 1000.0, "frames per second")

    def __post_init__(self) -> None:
        require_quantities(self, "")


def evaluate(
    video: str | Path,
    *,
    out: str | Path,
    against: Sequence[str | Path] = (),
    options: EvaluateOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Evaluation:
    """Return how real ``video`` is, and write the evaluation folder ``out``, whole or not at all.

    video: .mp4, .webm or another file that OpenCV reads, or a folder of pictures. against: recordings of the real
    event from the same camera, one, or two takes. ``out`` holds report.html, evaluation.json, measures.csv and
    curves.csv (docs/evaluation.md); an earlier evaluation there is replaced.

    >>> import physgen
    >>> found = physgen.evaluate("video.mp4", against=["take1.mp4"], out="evaluation")  # doctest: +SKIP
    >>> found["spatial_iou"], [item.name for item in found.below_still]  # doctest: +SKIP
    (0.62, ['mse'])

    Raises InputError for what is no video, for videos too short to compare, and where ``out`` holds something else;
    Cancelled when cancelled, and nothing is written then.
    """
    options, out, path = options or EvaluateOptions(), Path(out), Path(video)
    require_evaluation_folder(out)
    progress = StageProgress(on_event, STAGE, 2)
    footage = open_footage(path, options.fps)
    sections: list[Section] = []
    if against:
        recordings = [open_footage(Path(other)) for other in against]
        sections.append(against_section(footage, recordings, most_frames(footage, options)))
    if cancelled():
        raise Cancelled("the evaluation was cancelled; nothing was written")
    progress.report(1)
    found = Evaluation(root=out, subject=footage.name, sections=tuple(sections))
    for notice in found.notices:
        progress.notice(notice)
    save(found, out)
    progress.report(2)
    return found


def most_frames(footage: Footage, options: EvaluateOptions) -> int:
    """Return how many frames of ``footage`` count."""
    if options.seconds is None:
        return MOST_FRAMES
    return min(MOST_FRAMES, max(1, round(options.seconds * footage.fps)))


def require_evaluation_folder(out: Path) -> None:
    """Raise InputError where ``out`` is there and holds no evaluation."""
    if out.exists() and not (out / JSON_FILE).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there and holds no evaluation; choose another folder")


def save(found: Evaluation, out: Path) -> None:
    """Write ``found`` as the folder ``out``, whole or not at all. Raises InputError where it cannot be written."""
    try:
        with lock_beside(out), replacing_tree(out) as partial:
            write_evaluation(found, partial)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
