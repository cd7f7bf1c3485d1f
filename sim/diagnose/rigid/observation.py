# SPDX-License-Identifier: MIT
"""What a take says about the poses of its body: residuals, how they change with the pose, and poses from one frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Camera, Capture, Trial
from ..rotation import nearest_rotation
from .turning import skew, to_matrix

Array = NDArray[np.float64]


SCALE_ERROR = 0.006
"""Of the way that a single point went: how far a film's scale is off from place to place."""

TOGETHER = 4.0
"""Frames, or shares of a take, whose errors are one where they are not independent."""

STIFF = 0.3
"""Root mean square change of distances over the noise, below which points are computed from a pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """One body in one take. T frames, K points of it.

    times: (T,) s. seen: (T, K, 3) m or (T, K, 2) pixels, NaN where not seen. places: (K, 3) m, body axes, about its
    centre. sigma: of one coordinate. columns: (K,) which of the trial's points these are.
    """

    trial: Trial
    times: Array
    seen: Array
    places: Array
    sigma: float
    camera: Camera | None
    columns: NDArray[np.int64]

    @property
    def poses_alone(self) -> bool:
        """Whether one frame fixes a pose: three points that do not lie on a line."""
        spread = self.places - self.places.mean(axis=0)
        return len(self.places) >= 3 and float(np.linalg.svd(spread, compute_uv=False)[1]) > 1e-6

    def residuals(self, x: Array, q: Array, frames: NDArray[np.int64]) -> tuple[Array, Array]:
        """Observed minus modelled over sigma, (F, K, D), 0 where not seen, and its negative slope (F, K, D, 6).

        x (F, 3) and q (F, 4): poses at ``frames`` (F,). The slope is with the shift and the turn in world axes.
        """
        lever = np.einsum("fij,kj->fki", to_matrix(q), self.places)
        points = x[:, None] + lever
        slope = np.concatenate([np.broadcast_to(np.eye(3), (*points.shape[:2], 3, 3)), -skew(lever)], axis=-1)
        seen = self.seen[frames]
        if self.camera is None:
            gap = seen - points
        else:
            gap, view = seen - project(self.camera, points), projection_slope(self.camera, points)
            slope = view @ slope
        there = np.isfinite(gap).all(axis=-1)
        gap = np.where(there[..., None], gap, 0.0)
        slope = np.where(there[..., None, None], slope, 0.0)
        return gap / self.sigma, slope / self.sigma

    def information(self, x: Array, q: Array, frames: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """(chi², (F,); slope against it, (F, 6); information on the pose, (F, 6, 6))."""
        gap, slope = self.residuals(x, q, frames)
        size = gap.shape[0]
        gap, slope = gap.reshape(size, -1), slope.reshape(size, -1, 6)
        turned = slope.swapaxes(1, 2)
        return np.sum(gap**2, axis=1), (turned @ gap[..., None])[..., 0], turned @ slope


def sights(capture: Capture, trial: Trial, index: int, center: Array) -> Sight:
    """Body ``index`` of ``capture`` in ``trial``; center (3,): its centre of mass, rest frame."""
    columns = np.flatnonzero(trial.object_index == index)
    return Sight(
        trial=trial,
        times=trial.times,
        seen=trial.observed[:, columns],
        places=trial.rest_points[columns] - center,
        sigma=effective_sigma(capture, trial, columns),
        camera=capture.camera if trial.pixels is not None else None,
        columns=columns,
    )


def effective_sigma(capture: Capture, trial: Trial, columns: NDArray[np.int64]) -> float:
    """Standard deviation that the coordinates would have if they erred independently, knowing as much as they do.

    Points that keep their distances far better than their noise come from a measured pose, and err together, from frame
    to frame too. A single point in the distance is read off a picture, whose scale errs slowly along the way.
    """
    sigma = capture.noise_sigma
    if trial.points is None:
        return sigma
    points = trial.points[:, columns]
    if len(columns) == 1:
        seen = points[np.isfinite(points).all(axis=(1, 2)), 0]
        reach = float(np.linalg.norm(np.ptp(seen, axis=0))) if len(seen) else 0.0
        return float(np.hypot(sigma, SCALE_ERROR * reach * np.sqrt(max(1.0, len(seen) / TOGETHER))))
    if len(columns) < 4:
        return sigma
    rest = trial.rest_points[columns]
    off = []
    for frame in points[np.isfinite(points).all(axis=(1, 2))][:40]:
        apart = np.linalg.norm(frame[1:] - frame[:1], axis=1) - np.linalg.norm(rest[1:] - rest[:1], axis=1)
        off.append(apart)
    if len(off) >= 3 and float(np.sqrt(np.mean(np.square(off)))) < STIFF * sigma:
        return float(sigma * np.sqrt(len(columns) / 2 * TOGETHER))
    return sigma


def project(camera: Camera, points: Array) -> Array:
    """Pixels (..., 2) of world points (..., 3)."""
    matrix = camera.matrix
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.maximum(local[..., 2], 1e-3)
    u = camera.fx * local[..., 0] / depth + camera.cx
    v = camera.fy * local[..., 1] / depth + camera.cy
    return np.stack([u, v], axis=-1)


def projection_slope(camera: Camera, points: Array) -> Array:
    """How pixels change with world points: (..., 2, 3)."""
    matrix = camera.matrix
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.maximum(local[..., 2], 1e-3)
    zero = np.zeros_like(depth)
    rows = [
        np.stack([camera.fx / depth, zero, -camera.fx * local[..., 0] / depth**2], axis=-1),
        np.stack([zero, camera.fy / depth, -camera.fy * local[..., 1] / depth**2], axis=-1),
    ]
    return np.stack(rows, axis=-2) @ matrix[:3, :3].T


def rigid_turn(places: Array, found: Array) -> Array:
    """Rotation (3, 3) that takes ``places`` (K, 3) nearest to ``found`` (K, 3), both about their middles."""
    return nearest_rotation(found.T @ places)


def frame_pose(sight: Sight, frame: int, guess: tuple[Array, Array] | None = None) -> tuple[Array, Array] | None:
    """Pose (x (3,), rotation (3, 3)) from one frame alone; None where too few points are seen.

    Nearest rigid motion for points; perspective-n-point for pixels, from ``guess`` where there is one.
    """
    seen = sight.seen[frame]
    there = np.isfinite(seen).all(axis=1)
    places, found = sight.places[there], seen[there]
    if sight.camera is None:
        if len(found) == 0:
            return None
        if len(found) < 3 or not sight.poses_alone:
            turn = np.eye(3) if guess is None else guess[1]
            return found.mean(axis=0) - turn @ places.mean(axis=0), turn
        turn = rigid_turn(places - places.mean(axis=0), found - found.mean(axis=0))
        return found.mean(axis=0) - turn @ places.mean(axis=0), turn
    if len(found) < 4:
        return None
    c = sight.camera
    lens = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1.0]])
    matrix = c.matrix
    if guess is None:
        good, way, shift = cv2.solvePnP(places, found, lens, None, flags=cv2.SOLVEPNP_SQPNP)
    else:
        local = matrix[:3, :3].T @ guess[1]
        way, shift = cv2.Rodrigues(local)[0], (matrix[:3, :3].T @ (guess[0] - matrix[:3, 3]))[:, None]
        good = True
    if not good:
        return None
    good, way, shift = cv2.solvePnP(places, found, lens, None, way, shift, True, cv2.SOLVEPNP_ITERATIVE)
    turn = matrix[:3, :3] @ cv2.Rodrigues(way)[0]
    return matrix[:3, :3] @ shift[:, 0] + matrix[:3, 3], turn
