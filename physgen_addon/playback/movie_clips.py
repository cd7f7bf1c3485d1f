# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks of Blender's Movie Clip editor as a capture, whether tracked by hand or automatically.

Markers are normalised to the clip's size with y up; the centre of a pixel is half a pixel in, as in our images. Frames
are the clip's own, independent of ``frame_start`` in the scene: a capture counts seconds from its first frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.diagnose.capture import Camera, Capture, Trial
from ...sim.diagnose.capture_checks import check_capture
from ...sim.diagnose.track.pose_estimation import FLOOR_PX, Located, Pose, cast, locate, rigid_noise
from ...sim.diagnose.track.track_input import (
    SceneBody,
    belief_warnings,
    believed_ground,
    believed_objects,
    scene_bodies,
    selected_objects,
    video_camera,
)
from ...sim.diagnose.track.track_videos import withhold
from ...sim.errors import InputError
from ...sim.scene.folder import Scene

GUESSED_SIGMA_PX = 0.5
"""Assumed scatter of tracks too few to measure it: that of Blender's tracker and of careful manual tracking."""
LIFT_PX = 3.0
"""Largest median distance of an object's tracks from its fitted pose at which later tracks are projected onto its mesh.
"""
MISFIT = 0.1
"""Largest distance of tracks from the fitted pose, over the image's width, at which they still count."""
DISTORTION = {
    "POLYNOMIAL": ("k1", "k2", "k3"),
    "DIVISION": ("division_k1", "division_k2"),
    "NUKE": ("nuke_k1", "nuke_k2", "nuke_p1", "nuke_p2"),
    "BROWN": ("brown_k1", "brown_k2", "brown_k3", "brown_k4", "brown_p1", "brown_p2"),
}
"""Coefficients of Blender's lens models that are zero without distortion."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ClipTrial:
    """A clip and its use as a trial.

    name: of the trial; "": the clip's. fps: recorded frame rate; None: the clip's, or the scene's for an image
    sequence. predict_from: s after the first frame from which the motion is withheld; None: never.
    """

    clip: bpy.types.MovieClip
    name: str = ""
    fps: float | None = None
    predict_from: float | None = None


def capture_from_clips(clips: Sequence[ClipTrial], folder: Scene, *, objects: Sequence[str] = ()) -> Capture:
    """Return the tracks of ``clips`` on the objects of the scene ``folder``, as a capture of pixels.

    Each clip's first frame with a marker shows the scene as in ``folder``. Tracks seen there are projected onto the
    mesh; later ones onto the mesh at the pose that the earlier tracks give. Points are unobserved in frames without a
    marker or with a muted (disabled) one.
    objects: names to use; empty: all that move. Raises InputError for a clip without usable tracks, with another aspect
    than the photo, or with unknown frame rate.
    """
    if not clips:
        raise InputError("no clip: load a movie clip and track points on it")
    chosen = selected_objects(folder.model, objects)
    everything = scene_bodies(folder)
    warnings = belief_warnings(folder.model, chosen)
    trials, sigmas, cameras = [], [], []
    for entry in clips:
        camera = _camera(folder, entry.clip)
        cameras.append(camera)
        read = _read(entry, camera)
        warnings += read.warnings
        trial, sigma = _lifted(read, everything, chosen, camera, warnings)
        sigmas.append(sigma)
        trials.append(trial if entry.predict_from is None else withhold(trial, entry.predict_from)[0])
    if any(camera != cameras[0] for camera in cameras):
        raise InputError("the clips have different sizes: a capture has one camera; import them apart")
    known = [sigma for sigma in sigmas if sigma is not None]
    if not known:
        warnings.append(f"too few tracks to measure how they scatter: {GUESSED_SIGMA_PX} px is assumed")
    bodies = [everything[i] for i in chosen]
    capture = Capture(
        gravity=folder.model.gravity,
        ground=believed_ground(folder.model, [body.source for body in bodies]),
        objects=believed_objects(bodies),
        noise_sigma=max(FLOOR_PX, float(np.median(known))) if known else GUESSED_SIGMA_PX,
        camera=cameras[0],
        trials=tuple(trials),
    )
    checked = check_capture(capture)
    return dataclasses.replace(capture, warnings=tuple(dict.fromkeys((*warnings, *checked.warnings))))


@dataclass(frozen=True, kw_only=True)
class _Tracks:
    """Tracks of a clip. names: of its tracks, N; pixels: (T, N, 2), NaN where not seen; times: (T,) s."""

    name: str
    names: list[str]
    times: Array
    pixels: Array
    warnings: list[str]


def _camera(folder: Scene, clip: bpy.types.MovieClip) -> Camera:
    width, height = clip.size
    if width <= 0 or height <= 0:
        raise InputError(f"clip {clip.name!r}: its file cannot be read; restore it or choose another ({clip.filepath})")
    return video_camera(folder.model, int(width), int(height), f"clip {clip.name!r}")


def _fps(entry: ClipTrial) -> float:
    fps = entry.fps
    if fps is None:
        fps = float(entry.clip.fps)
        if fps <= 0 and bpy.context.scene is not None:
            fps = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    if not (np.isfinite(fps) and 0 < fps <= 1e5):
        raise InputError(f"clip {entry.clip.name!r}: its frame rate is {fps!r}: give a frame rate up to 100000")
    return fps


def _read(entry: ClipTrial, camera: Camera) -> _Tracks:
    clip = entry.clip
    tracks = [track for item in clip.tracking.objects for track in item.tracks]
    seen = {
        index: {m.frame: np.add(m.co, track.offset) for m in track.markers if not m.mute}
        for index, track in enumerate(tracks)
    }
    frames = sorted({frame for markers in seen.values() for frame in markers})
    if len(frames) < 3:
        raise InputError(
            f"clip {clip.name!r}: its tracks have markers in {len(frames)} frames; a motion needs 3: track points in "
            "the Movie Clip editor first"
        )
    count = frames[-1] - frames[0] + 1
    pixels = np.full((count, len(tracks), 2), np.nan)
    for index, markers in seen.items():
        for frame, (x, y) in markers.items():
            pixels[frame - frames[0], index] = x * camera.width, (1.0 - y) * camera.height
    warnings: list[str] = []
    return _Tracks(
        name="".join(c if c.isalnum() or c in "_- " else "_" for c in entry.name or clip.name).strip() or "clip",
        names=[track.name for track in tracks],
        times=np.arange(count) / _fps(entry),
        pixels=_undistorted(clip, pixels, camera, warnings),
        warnings=warnings,
    )


def _undistorted(clip: bpy.types.MovieClip, pixels: Array, camera: Camera, warnings: list[str]) -> Array:
    """Return ``pixels`` (T, N, 2) without lens distortion, by the clip's lens settings."""
    lens = clip.tracking.camera
    model = lens.distortion_model
    # By name, as Blender 4.5's lens has no tangential terms of the Nuke model.
    numbers = [getattr(lens, name, 0.0) for name in DISTORTION.get(model, ())]
    if not any(numbers):
        return pixels
    if model == "POLYNOMIAL":
        radial = (lens.k1, lens.k2, lens.k3)
    elif model == "BROWN" and lens.brown_k4 == 0:
        radial = (lens.brown_k1, lens.brown_k2, lens.brown_k3)
        if lens.brown_p1 or lens.brown_p2:
            warnings.append(f"clip {clip.name!r}: the tangential part of its lens distortion is not taken out")
    else:
        warnings.append(f"clip {clip.name!r}: lens distortion of the model {model} is not taken out")
        return pixels
    focal = np.array([lens.focal_length_pixels, lens.focal_length_pixels / lens.pixel_aspect])
    # The clip's lens has y up, which radial terms do not mind.
    middle = np.array([lens.principal_point_pixels[0], camera.height - lens.principal_point_pixels[1]])
    bent = (pixels - middle) / focal
    straight = bent.copy()
    for _ in range(60):
        square = (straight**2).sum(axis=-1, keepdims=True)
        straight = bent / (1.0 + square * (radial[0] + square * (radial[1] + square * radial[2])))
    return np.asarray(straight * focal + middle)


def _lifted(
    read: _Tracks, everything: Sequence[SceneBody], chosen: Sequence[int], camera: Camera, warnings: list[str]
) -> tuple[Trial, float | None]:
    """Return the trial, and the scatter of rigid objects' tracks about their poses or None."""
    count = len(read.names)
    owner = np.full(count, -1, dtype=np.int64)
    rest = np.full((count, 3), np.nan)
    poses: list[Pose | None] = [body.pose(camera) for body in everything]
    seen = np.isfinite(read.pixels).all(axis=2)
    first = np.where(seen.any(axis=0), seen.argmax(axis=0), -1)
    residual = np.full_like(read.pixels, np.nan)
    # Moving objects without tracks are known in the first frame only.
    moving = [i for i, body in enumerate(everything) if i not in chosen and body.source.role == "dynamic"]
    guesses = [body.pose(camera) for body in everything]
    for frame in range(len(read.times)):
        for i in chosen if frame else ():
            there = np.flatnonzero((owner == i) & seen[frame])
            fitted = _fitted(guesses[i], rest[there], read.pixels[frame, there], camera)
            poses[i] = None
            if fitted is not None:
                residual[frame, there], guesses[i] = fitted.residual, fitted.pose
                off = np.median(np.linalg.norm(fitted.residual, axis=1))
                poses[i] = fitted.pose if off <= LIFT_PX else None
        for i in moving if frame else ():
            poses[i] = None
        new = np.flatnonzero(first == frame)
        if len(new):
            _put(new, read.pixels[frame], everything, poses, camera, owner, rest)
    used = np.isin(owner, chosen)
    if not used.any():
        raise InputError(
            f"clip {read.name!r}: none of its {count} tracks lies on an object to be taken in its first frame; the "
            "clip must begin where the scene stands as reconstructed, seen by the same camera"
        )
    left = [name for name, kept in zip(read.names, used, strict=True) if not kept]
    if left:
        shown = ", ".join(left[:5]) + (" …" if len(left) > 5 else "")
        warnings.append(f"clip {read.name!r}: {len(left)} tracks lie on no object that is taken: {shown}")
    order = {scene_index: index for index, scene_index in enumerate(chosen)}
    trial = Trial(
        name=read.name,
        role="fit",
        times=read.times,
        points=None,
        pixels=read.pixels[:, used],
        object_index=np.array([order[int(i)] for i in owner[used]], dtype=np.int64),
        rest_points=rest[used],
    )
    rigid = used & np.array([i >= 0 and everything[int(i)].rigid for i in owner])
    sigma = rigid_noise(residual[:, rigid], read.pixels[:, rigid]) if rigid.any() else None
    return trial, sigma


def _fitted(guess: Pose, rest: Array, pixels: Array, camera: Camera) -> Located | None:
    """Return the pose of an object fitted to its tracks; only gross errors are outliers, as the user chose the
    tracks.
    """
    return locate(camera, rest, pixels, guess, tolerance=2.0, largest=MISFIT * camera.width)


def _put(
    new: NDArray[np.int64],
    pixels: Array,
    everything: Sequence[SceneBody],
    poses: Sequence[Pose | None],
    camera: Camera,
    owner: NDArray[np.int64],
    rest: Array,
) -> None:
    """Project the tracks ``new`` onto the nearest object hit by the rays through their ``pixels`` (N, 2)."""
    nearest = np.full(len(new), np.inf)
    for i, (body, pose) in enumerate(zip(everything, poses, strict=True)):
        if pose is None:
            continue
        hits = cast(body.surface, pose, camera, pixels[new])
        nearer = hits.depth < nearest
        nearest[nearer] = hits.depth[nearer]
        owner[new[nearer]], rest[new[nearer]] = i, hits.rest[nearer]
