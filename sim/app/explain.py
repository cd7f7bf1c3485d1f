# SPDX-License-Identifier: MIT
"""A video → its cause: followed, diagnosed, simulated as believed and with the cause, and shown side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing_tree, write_json
from ..composite.side_by_side import (
    BoxPose,
    box_faces,
    box_pose,
    cut_out,
    window_around,
    with_body,
    with_box,
    write_comparison,
)
from ..diagnose import run_diagnosis
from ..diagnose.capture_folder import load_capture, save_capture
from ..diagnose.diagnosis import NONE, UNKNOWN, Diagnosis, write_diagnosis
from ..diagnose.report import write_report
from ..diagnose.report.effect_words import found_effects
from ..diagnose.report.wording import remains
from ..diagnose.run_diagnosis import REFITTED, DiagnoseOptions
from ..diagnose.track.track_input import BodyRequest, VideoTrial, parse_body
from ..errors import InputError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..folder_lock import lock_beside
from ..rigid_alignment import nearest_pose

if TYPE_CHECKING:
    from ..diagnose.track.moving_regions import Region
    from ..diagnose.track.plain_bodies import VideoMotion

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

FORMAT = "physgen-explain/1"
EXPLAIN_FILE, VIDEO_FILE = "explain.json", "comparison.mp4"
CAPTURE_FOLDER, DIAGNOSIS_FOLDER = "capture", "diagnosis"

VISIBLE = (
    "friction", "restitution", "rolling_resistance", "air_drag", "magnus", "buoyancy", "time_scale"
)  # fmt: skip
"""Effects that one video of one plain body can show: those across the picture plane and hidden masses it
cannot, and a tilt of the ground is measured in the picture: in one run it would be the same motion as friction."""
PLAYBACK_FPS, SHOWN_S = 20.0, 8.0
"""Frames per second, and longest duration, of the comparison."""
FACE_FRAMES = 24
"""Frames that a box's faces are taken from."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Result of ``explain``. diagnosis: of its capture. video: the comparison. setting: flight, slope or surface.

    closed: share of the gap that the cause closes on withheld time, NaN where there is no gap to close. notes: what was
    decided about scale, gravity, ground and clock.
    """

    diagnosis: Diagnosis
    root: Path
    video: Path
    setting: str
    closed: float
    notes: tuple[str, ...]

    @property
    def summary(self) -> str:
        """Return the verdict in a sentence."""
        return self.diagnosis.summary


def explain(
    video: VideoTrial | str | Path,
    body: BodyRequest | str,
    *,
    out: str | Path,
    options: DiagnoseOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Explanation:
    """Return why the motion of ``body`` in ``video`` differs from its simulation; ``out`` is a new folder.

    body: what is known of it, such as ``"ball:diameter=0.04,mass=0.0027"``. ``out`` holds ``comparison.mp4`` (real,
    simulated as believed, with the cause found, and the distance of both from the real path), ``capture/``,
    ``diagnosis/`` with its report, and ``explain.json``. The second half of the motion is withheld from the numbers
    that are judged. options: None tries the effects that such a video can show, for a minute.

    >>> import physgen
    >>> found = physgen.explain("drop.mp4", "ball:diameter=0.04", out="why")  # doctest: +SKIP
    >>> found.diagnosis.verdict.effect, found.closed  # doctest: +SKIP
    ('restitution', 0.93)

    Raises InputError for a video in which no such body moves freely, and when ``out`` exists; Cancelled on request.
    """
    from ..diagnose.track.plain_bodies import follow_plain_body

    out = Path(out)
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder")
    trial = video if isinstance(video, VideoTrial) else VideoTrial(path=Path(video))
    request = parse_body(body) if isinstance(body, str) else body
    options = options or DiagnoseOptions(budget_s=60.0, effects=VISIBLE, confirm=False)
    notes: list[str] = []

    def listen(event: dict[str, Any]) -> None:
        if event.get("event") == "notice" and event.get("stage") == "track":
            notes.append(str(event["message"]).removeprefix(f"{trial.path.name}: "))
        on_event(event)

    motion = follow_plain_body(trial, request, on_event=listen, cancelled=cancelled)
    with lock_beside(out), replacing_tree(out) as partial:
        partial.mkdir(parents=True, exist_ok=True)
        save_capture(motion.capture, partial / CAPTURE_FOLDER)
        capture = load_capture(partial / CAPTURE_FOLDER)
        diagnosis = run_diagnosis.diagnose(capture, options, on_event, cancelled)
        (partial / DIAGNOSIS_FOLDER).mkdir()
        write_diagnosis(diagnosis, partial / DIAGNOSIS_FOLDER)
        write_report(diagnosis, capture, partial / DIAGNOSIS_FOLDER)
        _compare(trial, motion, diagnosis, partial / VIDEO_FILE, on_event)
        closed = diagnosis.gap.closed_fraction if diagnosis.verdict.effect != NONE else math.nan
        found = Explanation(
            diagnosis=diagnosis,
            root=out,
            video=out / VIDEO_FILE,
            setting=motion.view.kind,
            closed=closed,
            notes=tuple(notes),
        )
        write_json(partial / EXPLAIN_FILE, _record(found, trial, motion))
    return found


def _record(found: Explanation, trial: VideoTrial, motion: VideoMotion) -> dict[str, Any]:
    """Return what ``explain.json`` says."""
    verdict, gap = found.diagnosis.verdict, found.diagnosis.gap
    return {
        "format": FORMAT,
        "video": trial.path.name,
        "setting": found.setting,
        "frames": [int(motion.frames[0]), int(motion.frames[-1])],
        "pixels_per_metre": round(motion.view.scale, 3),
        "effect": verdict.effect,
        "probability": verdict.probability,
        "closed_fraction": found.closed if math.isfinite(found.closed) else None,
        "before_rms_m": gap.before_rms_m,
        "after_rms_m": gap.after_rms_m,
        "notes": list(found.notes),
    }


def title_of_cause(diagnosis: Diagnosis) -> str:
    """Return the verdict with its numbers in a few words, in plain ASCII for drawing."""
    verdict = diagnosis.verdict
    if verdict.effect == NONE:
        return "no effect stands out" if remains(diagnosis.gap) else "nothing is missing"
    if verdict.effect == UNKNOWN:
        refitted = diagnosis.gap.after_rms_m < REFITTED * diagnosis.gap.before_rms_m
        return "no known effect; contacts re-fitted" if refitted else "no known effect; the same motion"
    words = []
    for name in found_effects(verdict):
        numbers = next((item.parameters for item in diagnosis.effects if item.name == name), {})
        first = next(iter(numbers.values()), None)
        words.append(name.replace("_", " ") + ("" if first is None else f" {first.value:.3g}"))
    return "with " + " and ".join(words)


def _compare(trial: VideoTrial, motion: VideoMotion, diagnosis: Diagnosis, path: Path, on_event: OnEvent) -> None:
    """Write the comparison of ``motion``."""
    from ..diagnose.track.moving_regions import aligned_frames

    capture, view, found = motion.capture, motion.view, motion.found
    arrays = next(iter(diagnosis.trials.values()))
    times = capture.trials[0].times
    step = max(1, math.ceil(len(times) / (PLAYBACK_FPS * SHOWN_S)))
    picks = np.arange(0, len(times), step)
    real3 = capture.trials[0].observed[:, 0]
    before, after = arrays.nominal[:, 0], arrays.found[:, 0]
    gaps = np.linalg.norm(before - real3, axis=1), np.linalg.norm(after - real3, axis=1)
    scale = found.scale
    wanted = motion.frames[picks]
    draw = _drawn_box if motion.box is not None else _drawn_cut_out
    one = draw(trial, motion, (arrays.nominal[picks], arrays.found[picks]))
    others: dict[int, list[Region]] = {}
    for other in motion.others:
        for region in other:
            others.setdefault(region.frame, []).append(region)

    progress = StageProgress(on_event, "compare", len(picks))

    def both(k: int, picture: Picture) -> tuple[Picture, Picture]:
        progress.report(k + 1, path.name)
        ground = found.background
        for region in others.get(int(wanted[k]), []):
            # What is not simulated is shown as it was recorded.
            ground = with_body(ground, cut_out(picture, region.outline, region.middle), region.middle)
        return one(0, k, ground), one(1, k, ground)

    seen = (view.pixels(real3[picks]) if motion.box is not None else motion.places[picks]) * scale
    believed, caused = view.pixels(before[picks]) * scale, view.pixels(after[picks]) * scale
    size = float(np.sqrt(np.median([r.area for r in motion.regions])))
    shown = [seen, believed, caused]
    shown += [
        np.array([r.middle for r in other if wanted[0] <= r.frame <= wanted[-1]]).reshape(-1, 2)
        for other in motion.others
    ]
    height, width = found.background.shape[:2]
    real: Iterator[Picture] = aligned_frames(trial.path, found, wanted)
    write_comparison(
        path,
        real,
        draw=both,
        window=window_around(np.concatenate(shown), 1.2 * size, (width, height)),
        seen=seen,
        believed=believed,
        found=caused,
        times=times[picks],
        gaps=(gaps[0][picks], gaps[1][picks]),
        withheld=0.5 * float(times[0] + times[-1]),
        titles=("real", "simulated as believed", title_of_cause(diagnosis)),
        fps=PLAYBACK_FPS,
    )


Drawing = Callable[[int, int, Picture], Picture]
"""Draws simulation 0 or 1 of frame k over a background."""


def _drawn_cut_out(trial: VideoTrial, motion: VideoMotion, simulated: tuple[Array, Array]) -> Drawing:
    """Return how to draw the body by its own pixels, moved without turning. simulated: two (T, N, 3) m."""
    from ..diagnose.track.moving_regions import aligned_frames

    found = motion.found
    areas = np.array([r.area for r in motion.regions])
    typical = int(np.argmin(np.abs(areas - np.median(areas)) + 1e-3 * np.arange(len(areas))))
    model = next(aligned_frames(trial.path, found, np.array([motion.frames[typical]])))
    region = motion.regions[typical]
    body = cut_out(model, region.outline, region.middle)
    places = [motion.view.pixels(points[:, 0]) * found.scale for points in simulated]
    return lambda which, k, ground: with_body(ground, body, places[which][k])


def _drawn_box(trial: VideoTrial, motion: VideoMotion, simulated: tuple[Array, Array]) -> Drawing:
    """Return how to draw a box with the faces that the video shows, turned as simulated. simulated: two (T, N, 3) m."""
    from ..diagnose.track.moving_regions import aligned_frames

    box, view, found = motion.box, motion.view, motion.found
    assert box is not None and view.camera is not None and view.start is not None
    trial3, camera = motion.capture.trials[0], view.camera.place - view.start
    rest, edges = trial3.rest_points, box.edges

    def pose(points: Array) -> BoxPose:
        turn, centre = nearest_pose(rest, points)
        return box_pose(centre, turn, edges, lambda p: view.pixels(p) * found.scale, camera)

    few = np.unique(np.linspace(0, len(motion.frames) - 1, FACE_FRAMES).round().astype(int))
    pictures = aligned_frames(trial.path, found, motion.frames[few])
    faces = box_faces((picture, pose(trial3.observed[k])) for k, picture in zip(few, pictures, strict=True))
    return lambda which, k, ground: with_box(ground, faces, pose(simulated[which][k]))
