# SPDX-License-Identifier: MIT
"""Initial state of a body that rests or slides on a face: the ground gives the depth that one camera leaves open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull

from .observed_poses import QUATERNION, ObservedBody, frame_pose
from .quaternions import as_matrix, from_rotvec, multiply
from .world_settings import BodyScene

Array = NDArray[np.float64]

SHOWN = 0.1
"""Time in s from the start in which the body must rest on a face."""

LIES = 1.4
"""RMS residual over the noise up to which it does."""

TIPPED = 0.6
"""Largest error in rad of a pose from a single frame."""


def resting_state(scene: BodyScene, observations: ObservedBody) -> tuple[Array, Array] | None:
    """Return state (13,) and standard deviations (12,) of a body that slides on a face from the start, else None.

    Its path in the plane and its rotation about the normal are quadratic in time; the pixels must agree with that.
    """
    if observations.camera is None or scene.body.round or not observations.poses_alone:
        return None
    late = observations.times - observations.times[0]
    frames = np.flatnonzero(late <= SHOWN)
    if len(frames) < 5:
        return None
    pose = next((p for p in (frame_pose(observations, int(f)) for f in frames) if p is not None), None)
    if pose is None:
        return None
    normal, foot = scene.capture.ground.unit_normal, np.asarray(scene.capture.ground.point)
    eye = observations.camera.matrix[:3, 3]
    side = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.8 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.cross(normal, side)
    best: tuple[float, Array] | None = None
    faces = np.unique(np.round(ConvexHull(scene.body.corners).equations, 6), axis=0)
    for face in faces:
        down = pose[1] @ face[:3]
        angle = float(np.arccos(np.clip(-down @ normal, -1.0, 1.0)))
        if angle > TIPPED:
            continue
        axis = np.cross(down, -normal)
        size = float(np.linalg.norm(axis))
        upright = from_rotvec(axis / size * angle if size > 1e-9 else np.zeros(3))
        start = multiply(upright, _quaternion(pose[1]))
        # Intersect the viewing ray with the height of the centre at rest.
        ray, height = pose[0] - eye, -float(face[3])
        reach = (height - (eye - foot) @ normal) / float(ray @ normal)
        place = eye + reach * ray if reach > 0 else pose[0] - ((pose[0] - foot) @ normal - height) * normal
        fit = _slide(observations, frames, place, start, (side, across, normal))
        if best is None or fit[0] < best[0]:
            best = fit
    if best is None or best[0] > LIES:
        return None
    prior = np.repeat([1.0, 1.0, 20.0, 60.0], 3)
    if abs(normal[2]) > 0.999:
        prior[[2, 3, 4, 8, 9, 10]] = [1e-3, 0.01, 0.01, 0.05, 0.5, 0.5]
    return best[1], prior


def _slide(
    observations: ObservedBody, frames: NDArray[np.int64], place: Array, start: Array, axes: tuple[Array, Array, Array]
) -> tuple[float, Array]:
    """Return (RMS residual over the noise, state (13,)) of the best quadratic path in the plane."""
    side, across, normal = axes
    t = observations.times[frames] - observations.times[0]
    powers = np.stack([np.ones_like(t), t, 0.5 * t**2], axis=1)
    scale = np.concatenate([np.repeat([0.02, 0.3, 3.0], 2), [0.1, 1.0, 10.0]])

    def poses(z: Array) -> tuple[Array, Array]:
        way = powers @ (scale[:6] * z[:6]).reshape(3, 2)
        yaw = powers @ (scale[6:] * z[6:])
        x = place + way[:, :1] * side + way[:, 1:] * across
        return x, multiply(from_rotvec(yaw[:, None] * normal), np.broadcast_to(start, (len(t), 4)))

    def off(z: Array) -> Array:
        gap = observations.residuals(*poses(z), frames)[0].ravel()
        return np.asarray(np.clip(gap, -1e4, 1e4))

    found = least_squares(off, np.zeros(9), loss="linear", max_nfev=40)
    z = scale * found.x
    x, q = poses(found.x)
    count = max(int(np.isfinite(observations.seen[frames]).sum()) - 9, 1)
    state = np.concatenate([x[0], q[0], z[2] * side + z[3] * across, z[7] * normal])
    return float(np.sqrt(2 * found.cost / count)), state


def _quaternion(matrix: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(matrix).as_quat(), 1)


def height(scene: BodyScene, state: Array) -> tuple[float, Array]:
    """Return the height of the lowest point in m and its gradient (6,) with translation and rotation."""
    normal, foot = scene.capture.ground.unit_normal, np.asarray(scene.capture.ground.point)
    levers = scene.body.corners @ as_matrix(state[QUATERNION]).T
    heights = (state[:3] + levers - foot) @ normal - scene.body.radius
    low = int(np.argmin(heights))
    return float(heights[low]), np.concatenate([normal, np.cross(levers[low], normal)])
