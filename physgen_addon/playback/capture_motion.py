# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials as Blender plays them: one sample and rigid pose per frame, the residual deformation, and skinning weights.

Plain numpy. Frame ``1 + f`` of Blender's time line shows sample f.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.diagnose.capture import Camera
from ...sim.errors import InputError
from ...sim.rigid_alignment import nearest_rotation
from ...sim.skinning import compact_weights

Array = NDArray[np.float64]

CARRIERS = 8
"""Maximum number of tracked points that move a vertex."""
MAX_FRAMES = 20_000
FLAT = 1e-3
"""Second spread as a share of the first below which points are collinear and do not fix a rotation."""


@dataclass(frozen=True)
class Clock:
    """Sample shown by each frame. rate: frames a second; samples: (F,) index, -1 if none is near."""

    rate: float
    samples: NDArray[np.int64]

    @property
    def frames(self) -> int:
        """Number of frames of the trial."""
        return len(self.samples)

    def pick(self, values: Array) -> Array:
        """Return (T, …) per sample as (F, …) per frame, NaN where there is no sample."""
        found = np.asarray(values, dtype=np.float64)[np.maximum(self.samples, 0)]
        found[self.samples < 0] = np.nan
        return found


def clock(times: Array) -> Clock:
    """Return frames at the trial's own rate, the inverse of the usual interval of its samples ``times`` (T,) in s.

    A dropped frame stays a gap, so that the trial plays at the right speed. Raises InputError if the longest gap would
    make it excessively long.
    """
    rate = 1.0 / float(np.median(np.diff(times)))
    count = round(float(times[-1] - times[0]) * rate) + 1
    if count > MAX_FRAMES:
        raise InputError(f"times: last {times[-1] - times[0]:g} s at {rate:g} frames a second; shorten the trial")
    wanted = times[0] + np.arange(count) / rate
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    nearest = np.where(wanted - times[right - 1] <= times[right] - wanted, right - 1, right)
    nearest[np.abs(times[nearest] - wanted) > 0.75 / rate] = -1
    return Clock(rate=rate, samples=nearest)


@dataclass(frozen=True)
class Poses:
    """Poses of a body by frame. rotations: (F, 3, 3); shifts: (F, 3) m; known: (F,) whether any point was seen."""

    rotations: Array
    shifts: Array
    known: NDArray[np.bool_]


def fit_poses(rest: Array, points: Array) -> Poses:
    """Return the rigid motions that best align ``rest`` (K, 3) to ``points`` (F, K, 3), NaN where not seen.

    Least squares [Kabsch 1976]. One, two or collinear points leave the rotation undetermined; the one nearest to the
    previous frame is used. A frame without points repeats the previous one.
    """
    rotations = np.tile(np.eye(3), (len(points), 1, 1))
    seen = np.isfinite(points).all(axis=2)
    known = seen.any(axis=1)
    shifts = np.zeros((len(points), 3))
    turn, last = (
        np.eye(3),
        points[int(np.argmax(known))][seen[int(np.argmax(known))]].mean(axis=0) if known.any() else 0,
    )
    shift = last - rest.mean(axis=0)
    for frame in range(len(points)):
        use = seen[frame]
        if use.any():
            here, there = rest[use].mean(axis=0), points[frame, use].mean(axis=0)
            turn = _rotation(rest[use] - here, points[frame, use] - there, turn)
            shift = there - turn @ here
        rotations[frame], shifts[frame] = turn, shift
    return Poses(rotations=rotations, shifts=shifts, known=known)


def _rotation(rest: Array, points: Array, before: Array) -> Array:
    """Return the rotation of centred ``rest`` (K, 3) onto centred ``points``; ``before`` resolves ambiguity."""
    spread = np.linalg.svd(rest, compute_uv=False)
    moment = points.T @ rest
    if len(rest) < 3 or spread[1] < FLAT * max(spread[0], 1e-12):
        moment = moment + 1e-3 * max(float(spread[0]) ** 2, 1e-12) * before
    return nearest_rotation(moment)


def body_shifts(rest: Array, points: Array, poses: Poses) -> Array:
    """Return the residual of the rigid ``poses``, (F, K, 3) m in the body's frame, interpolated over gaps, else 0."""
    local = np.einsum("fij,fki->fkj", poses.rotations, points - poses.shifts[:, None]) - rest
    frames = np.arange(len(points))
    for k in range(len(rest)):
        seen = np.isfinite(local[:, k]).all(axis=1)
        for axis in range(3):
            local[:, k, axis] = np.interp(frames, frames[seen], local[seen, k, axis]) if seen.any() else 0.0
    return local


def carriers(vertices: Array, points: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the ``points`` (K, 3) that move a vertex: indices and weights, both (V, n), rows sum to 1."""
    if len(points) > 4:
        index, distance = _nearest(vertices, points, min(CARRIERS + 1, len(points)))
        return index[:, :-1], compact_weights(distance)
    distance = np.linalg.norm(vertices[:, None] - points[None], axis=2)
    weights = 1.0 / np.maximum(distance, 1e-6) ** 2
    index = np.tile(np.arange(len(points)), (len(vertices), 1))
    return index, weights / weights.sum(axis=1, keepdims=True)


def _nearest(vertices: Array, points: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """Return the ``count`` points (K, 3) nearest to each vertex (V, 3), sorted: indices and distances, both (V, count).

    Brute force in chunks, as there are only a few hundred tracked points.
    """
    indices, distances = [], []
    for rows in np.array_split(vertices, max(1, len(vertices) * len(points) // 2**20)):
        every = np.linalg.norm(rows[:, None] - points[None], axis=2)
        order = np.argsort(every, axis=1, kind="stable")[:, :count]
        indices.append(order)
        distances.append(np.take_along_axis(every, order, axis=1))
    return np.concatenate(indices), np.concatenate(distances)


def in_space(pixels: Array, camera: Camera, depth: Array) -> Array:
    """Return ``pixels`` (F, K, 2) at ``depth`` (F, K) metres as points (F, K, 3) in world space."""
    matrix = camera.matrix
    x = (pixels[..., 0] - camera.cx) / camera.fx * depth
    y = (pixels[..., 1] - camera.cy) / camera.fy * depth
    return np.stack([x, y, depth], axis=-1) @ matrix[:3, :3].T + matrix[:3, 3]


def depths(points: Array, camera: Camera) -> Array:
    """Return the depth of ``points`` (..., 3) in front of the camera, metres."""
    return (points - camera.matrix[:3, 3]) @ camera.matrix[:3, 2]
