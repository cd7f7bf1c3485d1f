# SPDX-License-Identifier: MIT
"""Use case: one video of a scene → one trial; several videos → a capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...scene.folder import SceneFolder
from ..capture import Camera, Capture, Trial
from ..capture_checks import check_capture
from .background import EVERY, BackgroundWatch
from .beliefs import (
    SceneBody,
    belief_warnings,
    believed_ground,
    believed_objects,
    chosen_objects,
    scene_bodies,
    video_camera,
)
from .body_tracker import BodyTracker, View
from .noise import FLOOR_PX, jitter, pose_scatter
from .options import Take, TrackOptions
from .pose import LEAST_POINTS, Array, Pose
from .start import Start, load_scene_photo, no_texture, start_of
from .surface import Surface, silhouette
from .video import Frame, Video, frame_times

STAGE = "track"
LEAST_FRAMES = 5
"""A point seen in fewer frames says nothing of a motion and is left out (or in all frames of a shorter take)."""
MISFIT_PX = 2.0
"""Scatter about rigid poses above which the mesh is not the object's."""


@dataclass(frozen=True, kw_only=True)
class TrackedVideo:
    """What came of one video.

    trial: the whole take, with role ``fit``. camera: the scene's at the video's resolution.
    noise_sigma: px, of one coordinate. poses: (T, objects, 4, 4) world_from_rest, NaN where an object was lost: what
    the tracker believed, of a body that deforms the nearest rigid pose.
    """

    trial: Trial
    camera: Camera
    noise_sigma: float
    poses: Array
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True, kw_only=True)
class TrackedVideos:
    """A capture, and what its predict trials withhold: the later part of each, by the trial's name."""

    capture: Capture
    withheld: dict[str, Trial]


def track_videos(
    takes: Sequence[Take],
    folder: SceneFolder,
    *,
    objects: Sequence[str] = (),
    options: TrackOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> TrackedVideos:
    """Track ``takes`` of the scene ``folder``.

    objects: names of those to track; empty: all that move. Raises InputError as ``track_video`` does, and when no take
    is left to learn from or the videos differ in size; Cancelled when asked to stop.
    """
    takes = _named_apart(takes)
    if not takes:
        raise InputError("no video: give at least one")
    if all(take.predict_from is not None for take in takes):
        raise InputError("predict_from is given for every video: leave at least one whole, to learn from")
    tracked = [
        track_video(take, folder, objects=objects, options=options, on_event=on_event, cancelled=cancelled)
        for take in takes
    ]
    camera = tracked[0].camera
    for take, item in zip(takes, tracked, strict=True):
        if item.camera != camera:
            raise InputError(
                f"{take.path}: has {item.camera.width}x{item.camera.height} pixels and {takes[0].path} "
                f"{camera.width}x{camera.height}: a capture has one camera; track them apart"
            )
    trials, withheld = [], {}
    for take, item in zip(takes, tracked, strict=True):
        if take.predict_from is None:
            trials.append(item.trial)
        else:
            shown, rest = withhold(item.trial, take.predict_from)
            trials.append(shown)
            withheld[shown.name] = rest
    scene, chosen = folder.scene, chosen_objects(folder.scene, objects)
    bodies = [body for i, body in enumerate(scene_bodies(folder)) if i in chosen]
    fit = [item.noise_sigma for take, item in zip(takes, tracked, strict=True) if take.predict_from is None]
    capture = Capture(
        gravity=scene.gravity,
        ground=believed_ground(scene, [body.source for body in bodies]),
        objects=believed_objects(bodies),
        noise_sigma=float(np.sqrt(np.mean(np.square(fit)))),
        camera=camera,
        trials=tuple(trials),
        warnings=(*belief_warnings(scene, chosen), *(w for item in tracked for w in item.warnings)),
    )
    checked = check_capture(capture)
    return TrackedVideos(
        capture=dataclasses.replace(capture, warnings=tuple(dict.fromkeys((*capture.warnings, *checked.warnings)))),
        withheld=withheld,
    )


def _named_apart(takes: Sequence[Take]) -> list[Take]:
    """The takes with names that are fit for files and differ."""
    named: list[Take] = []
    for take in takes:
        clean = "".join(c if c.isalnum() or c in "_- " else "_" for c in take.trial_name).strip() or "take"
        name, count = clean, 1
        while name in {t.name for t in named}:
            count += 1
            name = f"{clean}_{count}"
        named.append(dataclasses.replace(take, name=name))
    return named


def withhold(trial: Trial, seconds: float) -> tuple[Trial, Trial]:
    """``trial`` as a predict trial that shows what is before ``seconds`` after its first frame, and the rest of it.

    Points that only the rest shows are left out of both: where they are on the mesh would tell how the object turns.
    Raises InputError when either part is too short.
    """
    shown = trial.times - trial.times[0] < seconds
    last = float(trial.times[-1] - trial.times[0])
    known = trial.seen[shown].any(axis=0)
    if int(trial.seen[shown].any(axis=1).sum()) < 3 or shown.all():
        raise InputError(
            f"trial {trial.name!r}: predict_from is {seconds:g} s: give a time that leaves at least 3 frames with "
            f"points before it and one after, within {last:.3g} s"
        )
    assert trial.pixels is not None
    parts = [
        dataclasses.replace(
            trial,
            role=role,
            times=trial.times[rows],
            pixels=trial.pixels[rows][:, known],
            object_index=trial.object_index[known],
            rest_points=trial.rest_points[known],
            predict_times=trial.times[~shown] if role == "predict" else None,
        )
        for role, rows in (("predict", shown), ("fit", ~shown))
    ]
    return parts[0], parts[1]


def track_video(
    take: Take,
    folder: SceneFolder,
    *,
    objects: Sequence[str] = (),
    options: TrackOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> TrackedVideo:
    """Follow the objects of the scene ``folder`` through one video.

    Memory does not grow with the video but for the tracks themselves. Raises InputError for a file that is no video,
    has fewer than 3 frames in the chosen range or another shape than the photo, for an object that is not found at the
    start, has too little texture or is lost at once; Cancelled when asked to stop.
    """
    options = options or TrackOptions()
    chosen = chosen_objects(folder.scene, objects)
    everything = scene_bodies(folder)
    with Video(take.path) as video:
        camera = video_camera(folder.scene, video.info.width, video.info.height, str(take.path))
        run = _Run(take, folder, everything, chosen, camera, options)
        last = video.info.frames - 1 if take.end_frame is None else take.end_frame
        progress = StageProgress(on_event, STAGE, max(1, last - take.start_frame + 1))
        for frame in video.frames(take.start_frame, take.end_frame):
            if cancelled():
                raise Cancelled("tracking was cancelled; nothing was written")
            run.take_in(frame)
            progress.report(min(len(run.stamps), max(1, last - take.start_frame + 1)), take.path.name)
        tracked = run.finish(video)
    for warning in tracked.warnings:
        progress.notice(f"{take.path.name}: {warning}")
    return tracked


class _Run:
    """One pass over a video."""

    def __init__(
        self,
        take: Take,
        folder: SceneFolder,
        everything: Sequence[SceneBody],
        chosen: Sequence[int],
        camera: Camera,
        options: TrackOptions,
    ) -> None:
        self.stamps: list[float] = []
        self._take, self._folder, self._camera, self._options = take, folder, camera, options
        self._bodies = [everything[i] for i in chosen]
        self._still: list[tuple[Surface, Pose]] = [
            (body.surface, body.pose(camera))
            for i, body in enumerate(everything)
            if i not in chosen and body.source.role == "collider" and body.source.motion is None
        ]
        self._trackers: list[BodyTracker] = []
        self._watch: BackgroundWatch | None = None
        self._warnings: list[str] = []
        self._places: list[list[Array]] = []
        self._residuals: list[list[Array]] = []
        self._poses: list[Array] = []

    def take_in(self, frame: Frame) -> None:
        """One more frame."""
        view = View.of(frame.grey)
        if not self._trackers:
            self._begin(frame, view)
        else:
            for i, tracker in enumerate(self._trackers):
                tracker.step(view, len(self.stamps), self._around(i))
            if self._watch is not None and len(self.stamps) % EVERY == 0:
                self._watch.look(frame.grey)
        self.stamps.append(frame.time)
        self._places.append([t.places.copy() for t in self._trackers])
        self._residuals.append([t.residual.copy() for t in self._trackers])
        self._poses.append(np.array([_world_pose(self._camera, t) for t in self._trackers]))

    def _around(self, index: int) -> list[tuple[Surface, Pose]]:
        return self._still + [
            (t.body.surface, t.pose) for i, t in enumerate(self._trackers) if i != index and t.lost == 0
        ]

    def _begin(self, frame: Frame, view: View) -> None:
        where = f"{self._take.path}, frame {frame.index}"
        photo = load_scene_photo(self._folder, self._camera, self._bodies)
        starts: list[Start] = []
        for i, body in enumerate(self._bodies):
            starts.append(start_of(body, i, photo, frame.grey, self._camera, self._options, where))
        moved = [b.source.name for b, s in zip(self._bodies, starts, strict=True) if not s.in_place]
        if moved:
            self._warnings.append(
                f"frame {frame.index} does not have {', '.join(moved)} where the scene has them; found by their looks, "
                "which is less exact"
            )
        self._trackers = [
            BodyTracker(body, self._camera, self._options, start.pose, view)
            for body, start in zip(self._bodies, starts, strict=True)
        ]
        shown = np.zeros(frame.grey.shape, dtype=np.bool_)
        for i, (tracker, start) in enumerate(zip(self._trackers, starts, strict=True)):
            count = tracker.add_points(view, 0, start.mask, self._around(i))
            if count < LEAST_POINTS:
                raise InputError(f"{where}: {no_texture(tracker.body.source.name, count, 'on it')}")
            shown |= silhouette(tracker.body.surface, tracker.pose, self._camera)
        self._watch = BackgroundWatch(frame.grey, shown)

    def finish(self, video: Video) -> TrackedVideo:
        """The trial of all frames taken in."""
        take, count = self._take, len(self.stamps)
        if count < 3:
            found = f"{count} frames could be read from frame {take.start_frame} on" if count else "no frame could be"
            raise InputError(
                f"{take.path}: {found}{'' if count else f' read from frame {take.start_frame} on'}; a motion needs 3: "
                "check --start-frame and --end-frame, or convert the video to MP4 (H.264)"
            )
        expected = video.info.frames if take.end_frame is None else take.end_frame + 1
        if expected and take.start_frame + count < expected - 1:
            self._warnings.append(
                f"{take.start_frame + count} of {expected} frames could be read; the rest is missing or damaged"
            )
        times, warning = frame_times(take.path, self.stamps, video.info, take.fps_override)
        if warning is not None:
            self._warnings.append(warning)
        if self._watch is not None and self._watch.warning is not None:
            self._warnings.append(self._watch.warning)
        pixels, index, rest, sigmas = [], [], [], []
        for i, tracker in enumerate(self._trackers):
            places = _padded([row[i] for row in self._places], len(tracker.rest))
            residual = _padded([row[i] for row in self._residuals], len(tracker.rest))
            kept = tracker.trusted & (np.isfinite(places).all(axis=2).sum(axis=0) >= min(LEAST_FRAMES, count))
            places, residual = np.where(tracker.trusted[:, None], places, np.nan), residual[:, tracker.trusted]
            self._check_seen(tracker, places, count)
            pixels.append(places[:, kept])
            rest.append(tracker.rest[kept])
            index.append(np.full(int(kept.sum()), i, dtype=np.int64))
            sigmas.append(self._sigma(tracker, residual))
        return TrackedVideo(
            trial=Trial(
                name=take.trial_name,
                role="fit",
                times=times,
                points=None,
                pixels=np.concatenate(pixels, axis=1),
                object_index=np.concatenate(index),
                rest_points=np.concatenate(rest),
            ),
            camera=self._camera,
            noise_sigma=max([FLOOR_PX, *sigmas]),
            poses=np.array(self._poses),
            warnings=tuple(self._warnings),
        )

    def _check_seen(self, tracker: BodyTracker, places: Array, count: int) -> None:
        name = tracker.body.source.name
        seen = np.isfinite(places).all(axis=2).any(axis=1)
        if seen.sum() < min(LEAST_FRAMES, count):
            raise InputError(
                f"{self._take.path}: object {name!r} is lost after {int(seen.sum())} frames: it moves too far "
                "from frame to frame, is blurred or hidden, or shows too little texture; film at more frames a "
                "second with a shorter exposure, or put a pattern on it"
            )
        if not seen.all():
            gone = np.flatnonzero(~seen)
            self._warnings.append(
                f"object {name!r} is not seen in {len(gone)} of {count} frames, first in frame "
                f"{self._take.start_frame + int(gone[0])}"
            )

    def _sigma(self, tracker: BodyTracker, residual: Array) -> float:
        """Standard deviation of a coordinate: about the rigid pose; of what deforms, from frame to frame."""
        name = tracker.body.source.name
        about_pose, fast = pose_scatter(residual), jitter(residual)
        if tracker.body.rigid:
            sigma = about_pose if about_pose is not None else FLOOR_PX
            if sigma > MISFIT_PX:
                self._warnings.append(
                    f"points of {name!r} lie {sigma:.1f} px off any rigid motion of its mesh: its mesh or the camera "
                    "is not quite right; a diagnosis will not see below that"
                )
            return sigma
        return fast if fast is not None else FLOOR_PX


def _padded(rows: Sequence[Array], count: int) -> Array:
    """(T, count, 2): rows of fewer points, filled up with NaN."""
    out = np.full((len(rows), count, 2), np.nan)
    for t, row in enumerate(rows):
        out[t, : len(row)] = row
    return out


def _world_pose(camera: Camera, tracker: BodyTracker) -> Array:
    """world_from_rest (4, 4); NaN while the object is lost."""
    if tracker.lost:
        return np.full((4, 4), np.nan)
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = tracker.pose.rotation, tracker.pose.translation
    return np.asarray(camera.matrix @ local)
