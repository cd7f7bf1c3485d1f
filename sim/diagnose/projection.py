# SPDX-License-Identifier: MIT
"""Between world points and what was observed of them: the same points, or pixels of one camera."""

from __future__ import annotations

import math

import numpy as np

from ..effects.camera_pose import true_camera
from .analysis import CandidateFit
from .capture import Array, Camera, Capture, Trial


def project(camera: Camera, points: Array, world_from_camera: Array | None = None) -> Array:
    """World points (..., 3) in m to pixels (..., 2); NaN behind the camera.

    world_from_camera: (4, 4) in place of the believed one.
    """
    matrix = camera.matrix if world_from_camera is None else world_from_camera
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.where(local[..., 2] > 1e-6, local[..., 2], np.nan)
    return np.stack(
        [camera.fx * local[..., 0] / depth + camera.cx, camera.fy * local[..., 1] / depth + camera.cy], axis=-1
    )


def camera_matrix(capture: Capture, fit: CandidateFit | None) -> Array:
    """world_from_camera (4, 4): the believed one, moved by the fit's ``camera_pose`` if it has one."""
    assert capture.camera is not None
    if fit is None or "camera_pose" not in fit.parameters:
        return capture.camera.matrix
    values = {name: e.value for name, e in fit.parameters["camera_pose"].items()}
    return true_camera(values, capture.camera.matrix, pivot=camera_pivot(capture))


def camera_pivot(capture: Capture) -> tuple[float, float, float]:
    """World point in m about which ``camera_pose`` turns: that of the ground."""
    return capture.ground.point


def observed_residual(capture: Capture, trial: Trial, points: Array, fit: CandidateFit | None = None) -> Array:
    """Observed minus ``points`` (T, K, 3) as they would be observed: (T, K, 3) m or (T, K, 2) pixels."""
    if trial.points is not None:
        return np.asarray(trial.points[: len(points)] - points)
    assert capture.camera is not None and trial.pixels is not None
    return np.asarray(trial.pixels[: len(points)] - project(capture.camera, points, camera_matrix(capture, fit)))


def metres_per_unit(capture: Capture, trial: Trial, points: Array) -> float:
    """Metres that one unit of the observation stands for: 1 with points, depth over focal length with pixels."""
    if trial.points is not None or capture.camera is None:
        return 1.0
    matrix = capture.camera.matrix
    depth = ((points - matrix[:3, 3]) @ matrix[:3, 2]).ravel()
    depth = depth[np.isfinite(depth)]
    return float(np.median(depth)) / capture.camera.fx if len(depth) else math.nan


def observed_distance(
    capture: Capture, trial: Trial, points: Array, frames: slice, fit: CandidateFit | None = None
) -> float:
    """Root mean square distance in m of ``points`` (T, K, 3) from what was seen in ``frames``; across the view only
    where one camera saw it."""
    residual = observed_residual(capture, trial, points, fit)[frames]
    squares = np.square(residual).sum(axis=-1)
    if not np.isfinite(squares).any():
        return math.nan
    return float(math.sqrt(np.nanmean(squares))) * metres_per_unit(capture, trial, points[frames])
