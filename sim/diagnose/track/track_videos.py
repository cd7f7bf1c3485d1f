# SPDX-License-Identifier: MIT
"""One video of a scene becomes one trial; several videos become a capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...scene.folder import Scene
from ..capture import Camera, Capture, Trial
from ..capture_checks import check_capture
from .body_tracker import BodyTracker, View
from .feature_tracking import EVERY, CameraMotionCheck
from .initial_pose import InitialPose, find_initial_poses, load_scene_photo, no_texture
from .pose_estimation import FLOOR_PX, LEAST_POINTS, Array, Pose, Surface, jitter, rigid_noise, silhouette, while_moving
from .track_input import (
    SceneBody,
    TrackOptions,
    VideoTrial,
    belief_warnings,
    believed_ground,
    believed_objects,
    scene_bodies,
    selected_objects,
    video_camera,
)
from .video_file import Frame, Video, frame_times

STAGE = "track"
LEAST_FRAMES = 5
"""Least number of frames (or all frames of a shorter trial) in which a point must be seen."""
MISFIT_PX = 2.0
"""Scatter in px about rigid poses above which the mesh does not match the object."""


@dataclass(frozen=True, kw_only=True)
class TrackedVideo:
    """The result of one video.

    trial: the whole trial, with role ``fit``. camera: the scene's at the video's resolution.
    noise_sigma: px, of one coordinate. poses: (T, objects, 4, 4) world_from_rest, NaN where an object was lost; the
    nearest rigid pose of a deformable body.
    """

    trial: Trial
    camera: Camera
    noise_sigma: float
    poses: Array
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True, kw_only=True)
class TrackedVideos:
    """A capture, and the withheld part of its predict trials, by the trial's name."""

    capture: Capture
    withheld: dict[str, Trial]


def track_videos(
    videos: Sequence[VideoTrial],
    folder: Scene,
    *,
    objects: Sequence[str] = (),
    options: TrackOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> TrackedVideos:
    """Return the capture of ``videos`` of the scene ``folder``.

    objects: names of those to track; empty: all that move. Raises InputError as ``track_video``, and when no trial is
    left to fit to or the videos differ in size; Cancelled on request.
    """
    videos = _named_apart(videos)
    if not videos:
        raise InputError("no video: give at least one")
    if all(trial.predict_from is not None for trial in videos):
        raise InputError("predict_from is given for every video: leave at least one complete, to fit to")
    tracked = [
        track_video(trial, folder, objects=objects, options=options, on_event=on_event, cancelled=cancelled)
        for trial in videos
    ]
    camera = tracked[0].camera
    for trial, item in zip(videos, tracked, strict=True):
        if item.camera != camera:
            raise InputError(
                f"{trial.path}: has {item.camera.width}x{item.camera.height} pixels and {videos[0].path} "
                f"{camera.width}x{camera.height}: a capture has one camera; track them separately"
            )
    trials, withheld = [], {}
    for trial, item in zip(videos, tracked, strict=True):
        if trial.predict_from is None:
            trials.append(item.trial)
        else:
            shown, rest = withhold(item.trial, trial.predict_from)
            trials.append(shown)
            withheld[shown.name] = rest
    scene, chosen = folder.model, selected_objects(folder.model, objects)
    bodies = [body for i, body in enumerate(scene_bodies(folder)) if i in chosen]
    fit = [item.noise_sigma for trial, item in zip(videos, tracked, strict=True) if trial.predict_from is None]
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


def _named_apart(videos: Sequence[VideoTrial]) -> list[VideoTrial]:
    """Return the videos with unique names that are valid file names."""
    named: list[VideoTrial] = []
    for trial in videos:
        clean = "".join(c if c.isalnum() or c in "_- " else "_" for c in trial.trial_name).strip() or "take"
        name, count = clean, 1
        while name in {t.name for t in named}:
            count += 1
            name = f"{clean}_{count}"
        named.append(dataclasses.replace(trial, name=name))
    return named


def withhold(trial: Trial, seconds: float) -> tuple[Trial, Trial]:
    """Return ``trial`` as a predict trial up to ``seconds`` after its first frame, and the withheld rest.

    Points seen only in the rest are left out of both: their positions on the mesh would reveal the rotation.
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
    trial: VideoTrial,
    folder: Scene,
    *,
    objects: Sequence[str] = (),
    options: TrackOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> TrackedVideo:
    """Return the tracked objects of the scene ``folder`` in one video.

    Memory grows only with the tracks. Raises InputError for a file that is not a video, has fewer than 3 frames in the
    selected range or another aspect ratio than the photo, and for an object that is not found at the start, has too
    little texture or is lost at once; Cancelled on request.
    """
    options = options or TrackOptions()
    chosen = selected_objects(folder.model, objects)
    everything = scene_bodies(folder)
    with Video(trial.path) as video:
        camera = video_camera(folder.model, video.info.width, video.info.height, str(trial.path))
        run = _Run(trial, folder, everything, chosen, camera, options)
        last = video.info.frames - 1 if trial.end_frame is None else trial.end_frame
        progress = StageProgress(on_event, STAGE, max(1, last - trial.start_frame + 1))
        for frame in video.frames(trial.start_frame, trial.end_frame):
            if cancelled():
                raise Cancelled("tracking was cancelled; nothing was written")
            run.take_in(frame)
            progress.report(min(len(run.stamps), max(1, last - trial.start_frame + 1)), trial.path.name)
        tracked = run.finish(video)
    for warning in tracked.warnings:
        progress.notice(f"{trial.path.name}: {warning}")
    return tracked


class _Run:
    """One pass over a video."""

    def __init__(
        self,
        trial: VideoTrial,
        folder: Scene,
        everything: Sequence[SceneBody],
        chosen: Sequence[int],
        camera: Camera,
        options: TrackOptions,
    ) -> None:
        self.stamps: list[float] = []
        self._trial, self._folder, self._camera, self._options = trial, folder, camera, options
        self._bodies = [everything[i] for i in chosen]
        self._still: list[tuple[Surface, Pose]] = [
            (body.surface, body.pose(camera))
            for i, body in enumerate(everything)
            if i not in chosen and body.source.role == "collider" and body.source.motion is None
        ]
        self._trackers: list[BodyTracker] = []
        self._watch: CameraMotionCheck | None = None
        self._warnings: list[str] = []
        self._places: list[list[Array]] = []
        self._residuals: list[list[Array]] = []
        self._poses: list[Array] = []

    def take_in(self, frame: Frame) -> None:
        """Track one more frame."""
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
        where = f"{self._trial.path}, frame {frame.index}"
        photo = load_scene_photo(self._folder, self._camera, self._bodies)
        starts: list[InitialPose] = []
        for i, body in enumerate(self._bodies):
            starts.append(find_initial_poses(body, i, photo, frame.grey, self._camera, self._options, where))
        moved = [b.source.name for b, s in zip(self._bodies, starts, strict=True) if not s.in_place]
        if moved:
            self._warnings.append(
                f"frame {frame.index} does not have {', '.join(moved)} at their scene poses; found by their features, "
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
        self._watch = CameraMotionCheck(frame.grey, shown)

    def finish(self, video: Video) -> TrackedVideo:
        """Return the trial of all frames tracked."""
        trial, count = self._trial, len(self.stamps)
        if count < 3:
            read = f"{count} frames" if count else "no frame"
            raise InputError(
                f"{trial.path}: {read} could be read from frame {trial.start_frame} on; a motion needs 3: "
                "check --start-frame and --end-frame, or convert the video to MP4 (H.264)"
            )
        expected = video.info.frames if trial.end_frame is None else trial.end_frame + 1
        if expected and trial.start_frame + count < expected - 1:
            self._warnings.append(
                f"{trial.start_frame + count} of {expected} frames could be read; the rest is missing or damaged"
            )
        times, warning = frame_times(trial.path, self.stamps, video.info, trial.fps_override)
        if warning is not None:
            self._warnings.append(warning)
        if self._watch is not None and self._watch.warning is not None:
            self._warnings.append(self._watch.warning)
        pixels, index, rest, sigmas = [], [], [], []
        for i, tracker in enumerate(self._trackers):
            places = _padded([row[i] for row in self._places], len(tracker.rest))
            residual = _padded([row[i] for row in self._residuals], len(tracker.rest))
            kept = tracker.trusted & (np.isfinite(places).all(axis=2).sum(axis=0) >= min(LEAST_FRAMES, count))
            places = np.where(tracker.trusted[:, None], places, np.nan)
            self._check_seen(tracker, places, count)
            pixels.append(places[:, kept])
            rest.append(tracker.rest[kept])
            index.append(np.full(int(kept.sum()), i, dtype=np.int64))
            sigmas.append(self._sigma(tracker, residual[:, tracker.trusted], places[:, tracker.trusted]))
        return TrackedVideo(
            trial=Trial(
                name=trial.trial_name,
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
                f"{self._trial.path}: object {name!r} is lost after {int(seen.sum())} frames: it moves too far "
                "from frame to frame, is blurred or hidden, or shows too little texture; film at a higher "
                "frame rate with a shorter exposure, or put a pattern on it"
            )
        if not seen.all():
            gone = np.flatnonzero(~seen)
            self._warnings.append(
                f"object {name!r} is not seen in {len(gone)} of {count} frames, first in frame "
                f"{self._trial.start_frame + int(gone[0])}"
            )

    def _sigma(self, tracker: BodyTracker, residual: Array, places: Array) -> float:
        """Return the noise of a coordinate: about the rigid pose, or from frame to frame for deformable bodies."""
        if not tracker.body.rigid:
            return max(jitter(residual) or FLOOR_PX, jitter(while_moving(residual, places)) or FLOOR_PX)
        sigma = rigid_noise(residual, places) or FLOOR_PX
        if sigma > MISFIT_PX:
            self._warnings.append(
                f"points of {tracker.body.source.name!r} lie {sigma:.1f} px off any rigid motion of its mesh: its mesh "
                "or the camera is not quite right; a diagnosis cannot resolve less than that"
            )
        return sigma


def _padded(rows: Sequence[Array], count: int) -> Array:
    """Return (T, count, 2): rows of fewer points, padded with NaN."""
    out = np.full((len(rows), count, 2), np.nan)
    for t, row in enumerate(rows):
        out[t, : len(row)] = row
    return out


def _world_pose(camera: Camera, tracker: BodyTracker) -> Array:
    """Return world_from_rest (4, 4); NaN while the object is lost."""
    if tracker.lost:
        return np.full((4, 4), np.nan)
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = tracker.pose.rotation, tracker.pose.translation
    return np.asarray(camera.matrix @ local)
