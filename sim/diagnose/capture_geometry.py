# SPDX-License-Identifier: MIT
"""Observations of world points in a trial: projections, distances, means of what is known."""

from __future__ import annotations

import math

import numpy as np

from ..effects.camera_pose import true_camera
from .capture import Array, Camera, Capture, Trial
from .fits import CandidateFit


def mean_known(values: Array, axis: int | tuple[int, ...] | None = None) -> Array:
    """Return the mean of the finite numbers along ``axis``; NaN, without a warning, where there are none."""
    good = np.isfinite(values)
    count = good.sum(axis=axis)
    total = np.where(good, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def project(camera: Camera, points: Array, world_from_camera: Array | None = None) -> Array:
    """Project world points (..., 3) in m to pixels (..., 2); NaN behind the camera.

    world_from_camera: (4, 4), replaces the given pose.
    """
    matrix = camera.matrix if world_from_camera is None else world_from_camera
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.where(local[..., 2] > 1e-6, local[..., 2], np.nan)
    return np.stack(
        [camera.fx * local[..., 0] / depth + camera.cx, camera.fy * local[..., 1] / depth + camera.cy], axis=-1
    )


def camera_matrix(capture: Capture, fit: CandidateFit | None) -> Array:
    """Return world_from_camera (4, 4), corrected by the fit's ``camera_pose`` if it has one."""
    assert capture.camera is not None
    if fit is None or "camera_pose" not in fit.parameters:
        return capture.camera.matrix
    values = {name: e.value for name, e in fit.parameters["camera_pose"].items()}
    return true_camera(values, capture.camera.matrix, pivot=camera_pivot(capture))


def camera_pivot(capture: Capture) -> tuple[float, float, float]:
    """Return the world point in m about which ``camera_pose`` rotates: that of the ground."""
    return capture.ground.point


def observed_residual(capture: Capture, trial: Trial, points: Array, fit: CandidateFit | None = None) -> Array:
    """Return observed minus modelled ``points`` (T, K, 3): (T, K, 3) m or (T, K, 2) pixels."""
    if trial.points is not None:
        return np.asarray(trial.points[: len(points)] - points)
    assert capture.camera is not None and trial.pixels is not None
    return np.asarray(trial.pixels[: len(points)] - project(capture.camera, points, camera_matrix(capture, fit)))


def metres_per_unit(capture: Capture, trial: Trial, points: Array) -> float:
    """Return metres per unit of the observation: 1 for points, median depth over focal length for pixels."""
    if trial.points is not None or capture.camera is None:
        return 1.0
    matrix = capture.camera.matrix
    depth = ((points - matrix[:3, 3]) @ matrix[:3, 2]).ravel()
    depth = depth[np.isfinite(depth)]
    return float(np.median(depth)) / capture.camera.fx if len(depth) else math.nan


def observed_distance(
    capture: Capture, trial: Trial, points: Array, frames: slice, fit: CandidateFit | None = None
) -> float:
    """Return the RMS distance in m of ``points`` (T, K, 3) from the observations in ``frames``.

    With pixels only the distance perpendicular to the viewing direction counts.
    """
    residual = observed_residual(capture, trial, points, fit)[frames]
    squares = np.square(residual).sum(axis=-1)
    return float(np.sqrt(mean_known(squares))) * metres_per_unit(capture, trial, points[frames])
