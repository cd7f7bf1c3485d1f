# SPDX-License-Identifier: MIT
"""Where an object is, from points of its mesh and the pixels that show them (perspective-n-point)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..capture import Camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_POINTS = 5
"""Points that fix the six numbers of a pose with something left over to tell a wrong one by."""

HUBER = 1.345
"""Residual in standard deviations from which on its weight falls (Huber 1964: 95 % efficient on Gaussian noise)."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """camera_from_rest: rotation (3, 3), translation (3,) in m; camera axes of OpenCV (x right, y down, z forward)."""

    rotation: Array
    translation: Array

    def apply(self, rest: Array) -> Array:
        """``rest`` (N, 3) in the camera's axes."""
        return np.asarray(rest @ self.rotation.T + self.translation)


def continued(before: Pose, now: Pose) -> Pose:
    """The next pose at the velocity and spin that lead from ``before`` to ``now``."""
    return Pose(
        rotation=now.rotation @ before.rotation.T @ now.rotation,
        translation=2 * now.translation - before.translation,
    )


def project(camera: Camera, local: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in the camera's axes; the centre of the top left pixel is (0.5, 0.5).

    NaN for what is not in front of the camera.
    """
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    return np.stack([camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy], axis=1)


@dataclass(frozen=True, kw_only=True)
class Located:
    """A fitted pose; inliers (N,), within ``limit`` px; residual (N, 2) px, observed minus projected, of all points."""

    pose: Pose
    limit: float
    inliers: Mask
    residual: Array


def locate(
    camera: Camera, rest: Array, pixels: Array, guess: Pose, *, tolerance: float, largest: float
) -> Located | None:
    """Fit a pose to points ``rest`` (N, 3) seen at ``pixels`` (N, 2), starting at ``guess``.

    tolerance: px, the least distance of an outlier; where the inliers themselves scatter more (a mesh that is not
    quite the object's), 5 times their median distance, but at most ``largest``.
    None where fewer than LEAST_POINTS agree, or fewer than half of them. Robust Gauss–Newton on the reprojection error;
    where that does not find a majority, RANSAC first (Fischler and Bolles 1981, by cv2.solvePnPRansac).
    """
    if len(rest) < LEAST_POINTS:
        return None
    best = _refined(camera, rest, pixels, guess, tolerance, largest)
    if best is None or best.inliers.mean() < 0.7:
        started = _ransac(camera, rest, pixels, guess, min(2 * tolerance, largest))
        other = None if started is None else _refined(camera, rest, pixels, started, tolerance, largest)
        if other is not None and (best is None or other.inliers.sum() > best.inliers.sum()):
            best = other
    if best is None or best.inliers.sum() < LEAST_POINTS or best.inliers.mean() < 0.5:
        return None
    return best


def _ransac(camera: Camera, rest: Array, pixels: Array, guess: Pose, tolerance: float) -> Pose | None:
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    first_turn, first_shift = cv2.Rodrigues(guess.rotation)[0], guess.translation.reshape(3, 1).copy()
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            rest,
            pixels,
            matrix,
            None,
            first_turn,
            first_shift,
            True,
            200,
            tolerance,
            0.999,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
    except cv2.error:
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()) or shift[2, 0] <= 0:
        return None
    return Pose(
        rotation=np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64), translation=np.asarray(shift, np.float64).ravel()
    )


def _refined(
    camera: Camera, rest: Array, pixels: Array, guess: Pose, tolerance: float, largest: float
) -> Located | None:
    pose = guess
    residual = _residual(camera, rest, pixels, pose)
    for _ in range(30):
        if not np.isfinite(residual).all():
            return None
        distance = np.linalg.norm(residual, axis=1)
        scale = max(1.4826 * float(np.median(distance)) / 1.1774, 1e-3)
        step = _step(camera, rest, pose, residual, 1.0 / np.maximum(distance / (HUBER * scale), 1.0) ** 2)
        if step is None:
            return None
        pose = Pose(
            rotation=Rotation.from_rotvec(step[:3]).as_matrix() @ pose.rotation,
            translation=pose.translation + step[3:],
        )
        residual = _residual(camera, rest, pixels, pose)
        if np.abs(step[3:]).max() < 1e-7 * max(1e-3, float(np.abs(pose.translation).max())):
            break
    distance = np.linalg.norm(residual, axis=1)
    if not np.isfinite(distance).all():
        return None
    limit = min(max(tolerance, 5 * float(np.median(distance))), largest)
    return Located(pose=pose, limit=limit, inliers=distance <= limit, residual=residual)


def _residual(camera: Camera, rest: Array, pixels: Array, pose: Pose) -> Array:
    return np.asarray(pixels - project(camera, pose.apply(rest)))


def _step(camera: Camera, rest: Array, pose: Pose, residual: Array, weights: Array) -> Array | None:
    """Rotation vector (camera axes, about the rest frame's origin) and shift that lessen ``residual``, (6,)."""
    turned = rest @ pose.rotation.T
    x, y, z = (turned + pose.translation).T
    zero = np.zeros_like(x)
    to_pixels = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=1),
            np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=1),
        ],
        axis=1,
    )
    spin = np.zeros((len(rest), 3, 3))
    spin[:, 0, 1], spin[:, 0, 2], spin[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
    spin -= spin.transpose(0, 2, 1)
    jacobian = np.concatenate([to_pixels @ spin, to_pixels], axis=2)
    weighted = jacobian * weights[:, None, None]
    normal = np.einsum("nia,nib->ab", weighted, jacobian)
    # A trace of damping keeps what a few points on one plane leave open near where it was.
    normal += 1e-6 * np.diag(np.diag(normal))
    try:
        return np.linalg.solve(normal, np.einsum("nia,ni->a", weighted, residual))
    except np.linalg.LinAlgError:
        return None
