# SPDX-License-Identifier: MIT
"""What a trial observes of a body's pose: residuals, their Jacobians, poses from single frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ...rigid_alignment import nearest_rotation
from ..capture import Camera, Capture, Trial
from .quaternions import as_matrix, as_rotvec, conjugate, from_rotvec, multiply, skew

Array = NDArray[np.float64]

QUATERNION, VELOCITY, SPIN, CONTACT = slice(3, 7), slice(7, 10), slice(10, 13), slice(13, 17)
"""Columns of a state (..., 13) and of a record (..., 17) behind its position in m: quaternion (w first), velocity in
m/s, spin in rad/s; of a record also, added up over all contacts since its start, the four below."""
PUSHED, RUBBED, TOUCHED, SLID = 13, 14, 15, 16
"""Columns of a record's contacts: the normal impulse per mass in m/s, that of friction, the time in contact in s, and
that of sliding."""

LEVEL_SHARE, LEVEL_ANGLE, LEAST_TURN = 0.1, 0.1, 0.3
"""A body slides on a face where its height changes by at most this share of its size, and its upright by this angle in
rad; from this turn in rad on it tells where that face carries."""

OTHER_SIDE = float(np.cos(np.pi / 4))
"""Cosine between the directions that point up, in body axes, below which another side is up: half a right angle."""


def perturbed(states: Array, change: Array) -> Array:
    """Return states (..., 13) plus small changes (..., 12): translation, rotation, velocity, spin."""
    return np.concatenate(
        [
            states[..., :3] + change[..., :3],
            multiply(from_rotvec(change[..., 3:6]), states[..., QUATERNION]),
            states[..., 7:13] + change[..., 6:12],
        ],
        axis=-1,
    )


def state_difference(a: Array, b: Array) -> Array:
    """Return the change (..., 12) from states ``a`` to states ``b``."""
    turn = as_rotvec(multiply(b[..., QUATERNION], conjugate(a[..., QUATERNION])))
    return np.concatenate([b[..., :3] - a[..., :3], turn, b[..., 7:13] - a[..., 7:13]], axis=-1)


SLOW_ERROR = 0.006
"""Largest slow error of a single tracked point, as a share of its path; how large it is, the best candidate shows."""

TOGETHER = 4.0
"""Frames, or fractions of a trial, with common errors where they are correlated."""

LEFT = 0.22
"""Share of the variance of a slow error with the memory of a quarter of a flight that a fitted state, an offset and a
speed, leaves as a residual: the rest moves the state, and with it what is predicted."""

CENTRED = 1e-3
"""Distance in m from the body's centre up to which a point counts as the centre."""

STIFF = 0.3
"""RMS change of point distances over the noise below which points must come from a tracked pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObservedBody:
    """Observations of one body in one trial. T frames, K points.

    times: (T,) s. seen: (T, K, 3) m or (T, K, 2) pixels, NaN where not seen. places: (K, 3) m, body axes, about its
    centre. sigma: noise of one coordinate with independent frames. columns: (K,) indices of its points in the trial.
    white: noise of one coordinate as stated.
    """

    trial: Trial
    times: Array
    seen: Array
    places: Array
    sigma: float
    camera: Camera | None
    columns: NDArray[np.int64]
    white: float = 0.0

    @property
    def hides_spin(self) -> bool:
        """Return whether only the body's centre is tracked, so that its spin shows in nothing but its path."""
        return self.camera is None and len(self.places) == 1 and float(np.abs(self.places).max()) < CENTRED

    @cached_property
    def measured(self) -> NDArray[np.bool_]:
        """Return (D,) along which axes anything was measured: of a video of one view not the depth."""
        there = self.seen[np.isfinite(self.seen).all(axis=(1, 2))]
        return np.ptp(there, axis=(0, 1)) > 0 if len(there) else np.zeros(self.seen.shape[2], dtype=bool)

    @property
    def _shared(self) -> float:
        """Return how many frames have one slow error in common: those of a quarter of the trial."""
        return max(1.0, float(np.isfinite(self.seen).all(axis=(1, 2)).sum()) / TOGETHER)

    @property
    def slow(self) -> float:
        """Return the standard deviation in m of the slow error that leaves what ``sigma`` holds; single points only."""
        left = max(self.sigma**2 - self.white**2, 0.0) / self._shared
        return float(np.sqrt(left / LEFT)) if self.hides_spin else 0.0

    @property
    def bare(self) -> ObservedBody:
        """Return the same without a slow error."""
        return dataclasses.replace(self, sigma=self.white)

    def sharpened(self, residual: float) -> ObservedBody:
        """Return the same with the noise that a residual RMS of a coordinate, in m, implies; never more than now.

        What exceeds the white noise is slow: it is common to the frames of a quarter of the trial.
        """
        slow = max(residual**2 - self.white**2, 0.0) * self._shared
        return dataclasses.replace(self, sigma=min(self.sigma, float(np.hypot(self.white, np.sqrt(slow)))))

    def disturbed(self, rng: np.random.Generator) -> ObservedBody:
        """Return the same with noise added once more: white, and slow with the memory of a quarter of the trial.

        ``sigma`` counts a slow error as independent noise with the same information about a mean. Taken for noise
        of single frames it would move speeds from a few frames by many times what an error that hardly changes within
        them does.
        """
        noise = self.white * rng.normal(size=self.seen.shape)
        if self.slow > 0:
            off = (self.times[:, None] - self.times) / max(float(np.ptp(self.times)) / TOGETHER, 1e-9)
            root = np.linalg.cholesky(np.exp(-0.5 * off**2) + 1e-8 * np.eye(len(off)))
            noise += self.slow * np.einsum("fg,gkd->fkd", root, rng.normal(size=self.seen.shape))
        return dataclasses.replace(self, seen=self.seen + noise * self.measured)

    @property
    def poses_alone(self) -> bool:
        """Return whether one frame determines a pose: three points not on a line."""
        spread = self.places - self.places.mean(axis=0)
        return len(self.places) >= 3 and float(np.linalg.svd(spread, compute_uv=False)[1]) > 1e-6

    def residuals(self, x: Array, q: Array, frames: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return (observed minus modelled) / sigma (F, K, D), 0 where not seen, and its negative Jacobian (F, K, D, 6).

        x (F, 3) and q (F, 4): poses at ``frames`` (F,). Derivatives are with translation and rotation in world axes.
        """
        lever = np.einsum("fij,kj->fki", as_matrix(q), self.places)
        points = x[:, None] + lever
        slope = np.concatenate([np.broadcast_to(np.eye(3), (*points.shape[:2], 3, 3)), -skew(lever)], axis=-1)
        seen = self.seen[frames]
        if self.camera is None:
            gap = seen - points
        else:
            gap, view = seen - project(self.camera, points), projection_jacobian(self.camera, points)
            slope = view @ slope
        there = np.isfinite(gap).all(axis=-1)
        gap = np.where(there[..., None], gap, 0.0)
        slope = np.where(there[..., None, None], slope, 0.0)
        return gap / self.sigma, slope / self.sigma

    def information(self, x: Array, q: Array, frames: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Return chi² (F,), its descent direction (F, 6) and the information matrix of the pose (F, 6, 6)."""
        if self.camera is None:
            return points_information(self.moments.at(frames), x, q)
        gap, slope = self.residuals(x, q, frames)
        size = gap.shape[0]
        gap, slope = gap.reshape(size, -1), slope.reshape(size, -1, 6)
        turned = slope.swapaxes(1, 2)
        return np.sum(gap**2, axis=1), (turned @ gap[..., None])[..., 0], turned @ slope

    @cached_property
    def moments(self) -> PointMoments:
        """Return the sums over seen points of every frame; of points only."""
        there = np.isfinite(self.seen).all(axis=-1)
        count = there.sum(axis=1).astype(np.float64)
        share = there / np.maximum(count, 1.0)[:, None]
        seen = np.where(there[..., None], self.seen, 0.0)
        middle, center = np.einsum("fk,fki->fi", share, seen), share @ self.places
        off = np.where(there[..., None], seen - middle[:, None], 0.0)
        lever = np.where(there[..., None], self.places - center[:, None], 0.0)
        weight = 1.0 / self.sigma**2
        return PointMoments(
            count=weight * count,
            middle=middle,
            center=center,
            square=weight * np.sum(off**2, axis=(1, 2)),
            both=weight * np.einsum("fki,fkj->fij", lever, off),
            spread=weight * np.einsum("fki,fkj->fij", lever, lever),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMoments:
    """Sums over F frames' points for the chi² of a pose: weighted by 1/sigma², about their means.

    count: (F,) points seen. middle: (F, 3) m, mean seen. center: (F, 3) m, mean place, body axes. square: (F,) sum of
    squared distances seen. both, spread: (F, 3, 3) sums of place times seen, and of place times place.
    """

    count: Array
    middle: Array
    center: Array
    square: Array
    both: Array
    spread: Array

    def at(self, frames: NDArray[np.int64] | slice) -> PointMoments:
        """Return those of ``frames``."""
        return PointMoments(**{f.name: getattr(self, f.name)[frames] for f in dataclasses.fields(self)})

    @staticmethod
    def joined(parts: list[PointMoments]) -> PointMoments:
        """Return those of all frames of ``parts``."""
        names = [f.name for f in dataclasses.fields(PointMoments)]
        return PointMoments(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def points_information(seen: PointMoments, x: Array, q: Array) -> tuple[Array, Array, Array]:
    """Return what ``ObservedBody.information`` does, from the moments of its points instead of every single one.

    With the distance d of the means, lever l and rotation R, the sums over points of |g|², g, l × g and of the levers'
    products are functions of the moments.
    """
    turn = as_matrix(q)
    lever = (turn @ seen.center[..., None])[..., 0]
    off = seen.middle - x - lever
    both = turn @ seen.both
    trace = np.trace(seen.spread, axis1=1, axis2=2)
    chi2 = seen.count * np.sum(off**2, axis=1) + seen.square + trace - 2 * np.trace(both, axis1=1, axis2=2)
    slope = np.empty((len(x), 6))
    slope[:, :3] = seen.count[:, None] * off
    around = seen.count[:, None] * np.cross(lever, off)
    around += np.stack([both[:, i, j] - both[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    slope[:, 3:] = around
    info = np.zeros((len(x), 6, 6))
    info[:, [0, 1, 2], [0, 1, 2]] = seen.count[:, None]
    arm = seen.count[:, None, None] * skew(lever)
    info[:, :3, 3:], info[:, 3:, :3] = -arm, arm
    size = seen.count * np.sum(lever**2, axis=1) + trace
    info[:, 3:, 3:] = -(seen.count[:, None, None] * lever[:, :, None] * lever[:, None, :])
    info[:, 3:, 3:] -= turn @ seen.spread @ turn.swapaxes(1, 2)
    info[:, [3, 4, 5], [3, 4, 5]] += size[:, None]
    return np.maximum(chi2, 0.0), slope, info


def observe_body(capture: Capture, trial: Trial, index: int, center: Array) -> ObservedBody:
    """Return the observations of body ``index`` in ``trial``; center (3,): its centre of mass, rest frame."""
    columns = np.flatnonzero(trial.object_index == index)
    return ObservedBody(
        trial=trial,
        times=trial.times,
        seen=trial.observed[:, columns],
        places=trial.rest_points[columns] - center,
        sigma=effective_sigma(capture, trial, columns),
        camera=capture.camera if trial.pixels is not None else None,
        columns=columns,
        white=capture.noise_sigma,
    )


def effective_sigma(capture: Capture, trial: Trial, columns: NDArray[np.int64]) -> float:
    """Return the standard deviation of independent coordinates with the same information content.

    Points that keep their distances far better than their noise come from a tracked pose, with errors correlated
    between points and frames. A single point may have a slow error: at first the largest one is assumed.
    """
    sigma = capture.noise_sigma
    if trial.points is None:
        return sigma
    points = trial.points[:, columns]
    if len(columns) == 1:
        seen = points[np.isfinite(points).all(axis=(1, 2)), 0]
        reach = float(np.linalg.norm(np.ptp(seen, axis=0))) if len(seen) else 0.0
        return float(np.hypot(sigma, SLOW_ERROR * reach * np.sqrt(max(1.0, len(seen) / TOGETHER))))
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
    """Return pixels (..., 2) of world points (..., 3)."""
    matrix = camera.matrix
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.maximum(local[..., 2], 1e-3)
    u = camera.fx * local[..., 0] / depth + camera.cx
    v = camera.fy * local[..., 1] / depth + camera.cy
    return np.stack([u, v], axis=-1)


def projection_jacobian(camera: Camera, points: Array) -> Array:
    """Return the Jacobian (..., 2, 3) of pixels with respect to world points."""
    matrix = camera.matrix
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = np.maximum(local[..., 2], 1e-3)
    zero = np.zeros_like(depth)
    rows = [
        np.stack([camera.fx / depth, zero, -camera.fx * local[..., 0] / depth**2], axis=-1),
        np.stack([zero, camera.fy / depth, -camera.fy * local[..., 1] / depth**2], axis=-1),
    ]
    return np.stack(rows, axis=-2) @ matrix[:3, :3].T


def fit_rotation(places: Array, found: Array) -> Array:
    """Return the rotation (3, 3) that best aligns ``places`` (K, 3) with ``found`` (K, 3), both about their means."""
    return nearest_rotation(found.T @ places)


def frame_pose(
    observations: ObservedBody, frame: int, guess: tuple[Array, Array] | None = None
) -> tuple[Array, Array] | None:
    """Return the pose (x (3,), rotation (3, 3)) from one frame alone; None with too few points.

    Rigid alignment of points; perspective-n-point for pixels, starting from ``guess`` if given.
    """
    seen = observations.seen[frame]
    there = np.isfinite(seen).all(axis=1)
    places, found = observations.places[there], seen[there]
    if observations.camera is None:
        if len(found) == 0:
            return None
        if len(found) < 3 or not observations.poses_alone:
            turn = np.eye(3) if guess is None else guess[1]
            return found.mean(axis=0) - turn @ places.mean(axis=0), turn
        turn = fit_rotation(places - places.mean(axis=0), found - found.mean(axis=0))
        return found.mean(axis=0) - turn @ places.mean(axis=0), turn
    if len(found) < 4:
        return None
    c = observations.camera
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


def another_side_up(one: Array, other: Array, up: Array) -> bool:
    """Return whether a body with the orientations ``one`` and ``other``, quaternions, has two different sides up. up:
    (3,), the ground's normal."""
    return float((up @ as_matrix(one)) @ (up @ as_matrix(other))) < OTHER_SIDE


def turns_on_a_face(seen: Sequence[ObservedBody], normal: Array, bound: float) -> bool:
    """Return whether a body slides on one face in all of ``seen``, upright and at one height, and turns meanwhile.

    normal: (3,) of the ground. bound: m, the body's largest distance from its centre of mass.
    """
    turned = 0.0
    side = np.cross(normal, (1.0, 0.0, 0.0) if abs(normal[0]) < 0.8 else (0.0, 1.0, 0.0))
    for observations in seen:
        if observations.hides_spin or observations.camera is not None or not observations.poses_alone:
            return False
        poses = [frame_pose(observations, frame) for frame in range(len(observations.times))]
        known = [pose for pose in poses if pose is not None]
        if len(known) < 2:
            return False
        heights = np.array([place for place, _ in known]) @ normal
        turns = np.array([turn for _, turn in known]) @ known[0][1].T
        upright = (turns @ normal) @ normal
        if np.ptp(heights) > LEVEL_SHARE * bound or upright.min() < np.cos(LEVEL_ANGLE):
            return False
        ways = turns @ side
        angles = np.unwrap(np.arctan2(ways @ np.cross(normal, side), ways @ side))
        turned = max(turned, float(np.ptp(angles)))
    return turned > LEAST_TURN
