# SPDX-License-Identifier: MIT
"""Video → evaluation folder: figures against recordings and by themselves, a page, JSON and tables.

Where a model judges, the frames of the videos are read, a video that stands still is added, and its scores become
figures.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing_tree, write_bytes
from ..cache.bake_folder import MANIFEST_FILE, Bake, load_bake
from ..errors import Cancelled, InputError
from ..evaluate.bake_physics import bake_physics
from ..evaluate.evaluation import HIGHER, JSON_FILE, NEITHER, Evaluation, Measure, Section, table, write_evaluation
from ..evaluate.flow import dis_flow, network_flow
from ..evaluate.footage import MOST_FRAMES, Footage, Frame, open_footage
from ..evaluate.judge_question import CRITERIA, TITLES
from ..evaluate.model_judge import Judgement, JudgeOptions, evenly_sampled, judge_videos
from ..evaluate.no_reference import without_reference
from ..evaluate.physics_iq import against as against_section
from ..evaluate.physics_iq_folder import (
    FailedView,
    ViewRow,
    physics_iq_section,
    read_benchmark,
    read_submission,
    score_views,
    view_table,
)
from ..evaluate.report import strip_frames, write_page
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..files import is_file
from ..folder_lock import lock_beside
from ..reconstruct.reasoning.chat_client import ChatRequest
from ..scene.folder import SCENE_FILE, Scene, load_scene
from ..srgb import read_rgb
from ..validation import quantity, require_quantities

STILL = "the first frame repeated"


@dataclass(frozen=True, kw_only=True)
class JudgeRequest:
    """A request to a model that judges the video.

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
    return Section(name=JUDGE, title="Judged by a model", text=text, measures=tuple(measures), notices=notices)


STAGE = "evaluate"
JUDGE = "judge"
JUDGE_FILE = "judge.json"


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Options of an evaluation.

    seconds: only the first so many seconds of every video; None: all that the videos have in common, Physics-IQ has 5.
    fps: frames per second of a folder of pictures, or instead of what a video file says; None: as it says.
    flow: ONNX file of a network for optical flow (docs/evaluation.md); None: DIS.
    """

    seconds: float | None = quantity(None, 0.01, 3600.0, "seconds")
    fps: float | None = quantity(None, 0.01, 1000.0, "frames per second")
    flow: Path | None = None

    def __post_init__(self) -> None:
        require_quantities(self, "")


def evaluate(
    video: str | Path | None,
    *,
    out: str | Path,
    against: Sequence[str | Path] = (),
    photo: str | Path | None = None,
    bake: str | Path | Bake | None = None,
    scene: str | Path | Scene | None = None,
    judge: JudgeRequest | None = None,
    options: EvaluateOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Evaluation:
    """Return how real ``video`` is, and write the evaluation folder ``out``, whole or not at all.

    video: .mp4, .webm or another file that OpenCV reads, a folder of pictures, or None where a bake is given. against:
    recordings of the real event from the same camera, one, or two takes. photo: what the first frame should equal.
    bake: what the video shows, for physical checks; scene: what was baked, by default the folder ``scene`` beside the
    bake where it has the same objects. judge: a model that scores the video, if any. ``out`` holds report.html,
    evaluation.json, measures.csv and curves.csv (docs/evaluation.md); an earlier evaluation there is replaced.

    >>> import physgen
    >>> found = physgen.evaluate("video.mp4", against=["take1.mp4"], out="evaluation")  # doctest: +SKIP
    >>> found["spatial_iou"], [item.name for item in found.below_still]  # doctest: +SKIP
    (0.62, ['mse'])

    Raises InputError for what is no video, for videos too short to compare, and where ``out`` holds something else;
    Cancelled when cancelled, and nothing is written then.
    """
    options, out = options or EvaluateOptions(), Path(out)
    with evaluation_folder(out):
        if video is None and bake is None:
            raise InputError("nothing to evaluate: give a video or a bake")
        if video is None and (against or photo is not None or judge is not None):
            raise InputError("against, photo, judge: compare a video, and none is given; give one beside the bake")
        progress = StageProgress(on_event, STAGE, 3)
        sections: list[Section] = []
        strip: list[Frame] = []
        tables: dict[str, bytes] = {}
        subject = ""
        if video is not None:
            footage = open_footage(Path(video), options.fps)
            subject, most = footage.name, most_frames(footage, options)
            if against:
                recordings = [open_footage(Path(other)) for other in against]
                sections.append(against_section(footage, recordings, most))
            progress.report(1)
            sections.append(_by_itself(footage, most, photo, options, cancelled))
            strip = strip_frames(footage, most)
            if judge is not None:
                section, judgement = judged(footage, most, judge, notice=progress.notice, cancelled=cancelled)
                sections.append(section)
                text = json.dumps(judgement.to_json(), indent=1, ensure_ascii=False)
                tables[JUDGE_FILE] = text.encode("utf-8", "replace")
        if cancelled():
            raise Cancelled("the evaluation was cancelled; nothing was written")
        progress.report(2)
        if bake is not None:
            baked = bake if isinstance(bake, Bake) else load_bake(bake)
            subject = subject or baked.root.resolve().name
            sections.append(bake_physics(baked, _scene_of(baked, scene), cancelled=cancelled))
        found = Evaluation(root=out, subject=subject, sections=tuple(sections))
        _tell(found, progress)
        save(found, out, strip, tables)
        progress.report(3)
        return found


def _by_itself(
    footage: Footage, most: int, photo: str | Path | None, options: EvaluateOptions, cancelled: IsCancelled
) -> Section:
    """Return what ``footage``, of at most ``most`` frames, shows without a recording to compare it with."""
    flow = dis_flow() if options.flow is None else network_flow(options.flow)
    named = "DIS" if options.flow is None else options.flow.name
    still = None if photo is None else Path(photo)
    return without_reference(footage, most, photo=still, flow=flow, flow_name=named, cancelled=cancelled)


def _tell(found: Evaluation, progress: StageProgress) -> None:
    """Say the notices of ``found``; those of a judge were said as they came."""
    said = {notice for section in found.sections if section.name == JUDGE for notice in section.notices}
    for notice in found.notices:
        if notice not in said:
            progress.notice(notice)


VIEWS_FILE = "physics_iq.csv"


def evaluate_physics_iq(
    folder: str | Path,
    *,
    benchmark: str | Path | None,
    out: str | Path,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Evaluation:
    """Return the Physics-IQ table of the generated videos in ``folder``, and write the evaluation folder ``out``.

    benchmark: the folder physics-IQ-benchmark with the real videos; None only checks names, rates and lengths. ``out``
    also has ``physics_iq.csv``, a row for each view. What is wrong with a video is a notice; videos that cannot be read
    or have no name of the benchmark's are left out, and the score then says of how many views it is. A view whose
    recordings are damaged has an empty row, and is among ``failures``.

    Raises InputError where nothing can be compared; Cancelled on request.
    """
    folder, out = Path(folder), Path(out)
    with evaluation_folder(out):
        submission = read_submission(folder)
        rows: list[ViewRow] = []
        failed: list[FailedView] = []
        if benchmark is not None:
            views = read_benchmark(Path(benchmark), submission.fps)
            progress = StageProgress(on_event, STAGE, max(1, len(set(views) & set(submission.videos))))
            rows, failed = score_views(submission, views, on_row=progress.report, cancelled=cancelled)
            if failed and not rows:
                raise InputError(f"{folder}: no view can be compared; the first is {failed[0].reason}")
            if not rows:
                raise InputError(f"{folder}: none of its numbers is one of {benchmark}; name the same benchmark")
        found = Evaluation(
            root=out, subject=folder.name, sections=(physics_iq_section(submission, rows, folder, failed),)
        )
        for notice in found.notices:
            on_event({"event": "notice", "stage": STAGE, "message": notice})
        save(found, out, tables={VIEWS_FILE: table(view_table(rows, failed))} if rows else {})
        return found


def is_bake(path: Path) -> bool:
    """Return whether ``path`` is a bake folder."""
    return is_file(path / MANIFEST_FILE)


def _scene_of(bake: Bake, scene: str | Path | Scene | None) -> Scene | None:
    """Return the scene that is given, or that lies beside ``bake`` as a run leaves it; None for none of its objects."""
    if isinstance(scene, Scene):
        return scene
    if scene is not None:
        return load_scene(scene)
    beside = bake.root.resolve().with_name("scene")
    if not is_file(beside / SCENE_FILE):
        return None
    found = load_scene(beside)
    known = bake.manifest.geometry_hash
    return found if not known or found.geometry_hash() == known else None


def most_frames(footage: Footage, options: EvaluateOptions) -> int:
    """Return how many frames of ``footage`` count. Raises InputError for fewer than two: motion needs as many."""
    if options.seconds is None:
        return MOST_FRAMES
    count = round(options.seconds * footage.fps)
    if count < 2:
        raise InputError(
            f"seconds is {options.seconds:g}: {footage.name} has {footage.fps:g} frames per second; give "
            f"{2 / footage.fps:.2g} or more, motion needs two"
        )
    return min(MOST_FRAMES, count)


@contextmanager
def evaluation_folder(out: Path) -> Iterator[None]:
    """Hold the folder ``out`` during an evaluation: two at once would each take minutes, and one be lost.

    Raises InputError where another process holds it, and where it is there and holds no evaluation.
    """
    if out.exists() and not (out / JSON_FILE).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there and holds no evaluation; choose another folder")
    with lock_beside(out):
        yield


def save(
    found: Evaluation, out: Path, strip: Sequence[Frame] = (), tables: Mapping[str, bytes] = MappingProxyType({})
) -> None:
    """Write ``found`` as the folder ``out``, whole or not at all.

    strip: frames for its page. tables: further files, by name. Raises InputError where it cannot be written.
    """
    try:
        with replacing_tree(out) as partial:
            write_evaluation(found, partial)
            write_page(found, strip, partial)
            for name, content in tables.items():
                write_bytes(partial / name, content)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
