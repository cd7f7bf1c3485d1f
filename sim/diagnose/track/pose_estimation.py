# SPDX-License-Identifier: MIT
"""Pose of an object from mesh points and their pixels (perspective-n-point), pixel noise, and mesh visibility.

Rays are cast in the image: a triangle in front of the camera covers a pixel where its projection does, and inverse
depth is linear over it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...rigid_alignment import nearest_rotation
from ...robust_deviation import robust_deviation
from ..capture import Camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_POINTS = 5
"""Least number of points for a pose, with redundancy to reject wrong ones."""

HUBER = 1.345
"""Huber threshold in standard deviations (Huber 1964: 95 % efficient on Gaussian noise)."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """camera_from_rest: rotation (3, 3), translation (3,) in m; camera axes of OpenCV (x right, y down, z forward)."""

    rotation: Array
    translation: Array

    def apply(self, rest: Array) -> Array:
        """Return ``rest`` (N, 3) in the camera's axes."""
        return np.asarray(rest @ self.rotation.T + self.translation)


def continued(before: Pose, now: Pose) -> Pose:
    """Return the next pose, extrapolated from ``before`` and ``now`` at constant velocity and spin."""
    return Pose(
        # A transpose is no inverse of what rounding made of a rotation: its error grew 1 + √2 times a frame.
        rotation=nearest_rotation(now.rotation @ before.rotation.T @ now.rotation),
        translation=2 * now.translation - before.translation,
    )


def project(camera: Camera, local: Array) -> Array:
    """Return pixels (N, 2) of points (N, 3) in the camera's axes; the centre of the top left pixel is (0.5, 0.5).

    NaN behind the camera.
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
    """Return the pose of points ``rest`` (N, 3) seen at ``pixels`` (N, 2), starting at ``guess``.

    tolerance: least outlier distance in px; where the inliers scatter more (inexact mesh), 5 times their median
    distance, but at most ``largest``. None where fewer than LEAST_POINTS, or fewer than half of the points, agree.
    Robust Gauss–Newton on the reprojection error; without a majority, RANSAC first (Fischler and Bolles 1981, by
    cv2.solvePnPRansac).
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
    # Imported late: every command imports the options of tracking, and through them this file.
    from scipy.spatial.transform import Rotation

    pose = guess
    residual = _residual(camera, rest, pixels, pose)
    for _ in range(30):
        if not np.isfinite(residual).all():
            return None
        distance = np.linalg.norm(residual, axis=1)
        scale = max(float(robust_deviation(distance)) / 1.1774, 1e-3)
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
    """Return the Gauss–Newton step (6,): rotation vector (camera axes, about the rest origin) and translation."""
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
    # Slight damping, for directions that a few coplanar points leave open.
    normal += 1e-6 * np.diag(np.diag(normal))
    try:
        return np.linalg.solve(normal, np.einsum("nia,ni->a", weighted, residual))
    except np.linalg.LinAlgError:
        return None


FLOOR_PX = 0.05
"""Lower bound of tracking noise in compressed video, whatever a short static trial suggests."""


def pose_scatter(residual: Array) -> float | None:
    """Return the standard deviation in px of ``residual`` (T, K, 2) about fitted poses; None with too few points.

    Robust (median absolute deviation), corrected for the six degrees of freedom of each frame's pose.
    """
    seen = np.isfinite(residual).all(axis=2)
    per_frame = seen.sum(axis=1)
    rows = per_frame >= 5
    if not rows.any():
        return None
    values = residual[rows][seen[rows]]
    share = (2 * per_frame[rows] - 6).sum() / (2 * per_frame[rows]).sum()
    return float(robust_deviation(values)) / float(np.sqrt(share))


MOVING_PX = 0.5
"""Way per frame in px from which a body moves: patches are blurred, and found between pixels."""

MOST_OF_A_FRAME = 3.0
"""A frame's noise counts at most as this many times that of the median frame."""


def while_moving(residual: Array, places: Array) -> Array:
    """Return ``residual`` (T, K, 2) with NaN in frames in which points hardly move, nor in the one before.

    places: (T, K, 2) px of the points, NaN where not seen.
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
    known = np.isfinite(steps)
    way = np.array([float(np.median(s[k])) if k.any() else 0.0 for s, k in zip(steps, known, strict=True)])
    moves = np.concatenate([way, [0.0]]) > MOVING_PX
    moves[1:] |= way > MOVING_PX
    return np.where(moves[:, None, None], residual, np.nan)


def rigid_noise(residual: Array, places: Array) -> float | None:
    """Return the noise of a coordinate in px of points of a rigid body; None with too few points.

    residual: (T, K, 2) px about fitted poses. places: (T, K, 2) px. Where the body moves the noise is that of moving
    frames: at rest, the same patch is found at the same place in every frame, to hundredths of a pixel. What all points
    have in common moves the pose, and is not seen. Never less than ``pose_scatter``.
    """
    least = pose_scatter(residual)
    moving = while_moving(residual, places)
    seen = np.isfinite(moving).all(axis=2)
    count = seen.sum(axis=1)
    squares = np.sum(np.where(seen[..., None], moving, 0.0) ** 2, axis=(1, 2))
    # Outlying points are part of it, unlike in a median: a fit squares them.
    frames = (squares / np.maximum(2 * count - 6, 1))[count >= LEAST_POINTS]
    if least is None or len(frames) == 0:
        return least
    frames = np.minimum(frames, MOST_OF_A_FRAME**2 * float(np.median(frames)))
    return max(least, float(np.sqrt(np.mean(frames))))


def jitter(residual: Array) -> float | None:
    """Return the frame-to-frame noise in px of ``residual`` (T, K, 2); None with too few points.

    From third differences over time, to which smooth motion and a wrong mesh contribute little; white noise of standard
    deviation s gives sqrt(20) s.
    """
    if len(residual) < 4:
        return None
    differences = np.diff(residual, n=3, axis=0)
    values = differences[np.isfinite(differences)]
    return None if len(values) < 20 else float(robust_deviation(values)) / float(np.sqrt(20.0))


_PAIRS_AT_ONCE = 1_000_000
"""Pixel-triangle pairs tested at once, to bound the memory."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A mesh in its rest frame: vertices (V, 3) m, faces (F, 3)."""

    vertices: Array
    faces: NDArray[np.int64]

    @property
    def normals(self) -> Array:
        """Return unit normals (F, 3) of the faces."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


@dataclass(frozen=True, kw_only=True)
class Hits:
    """Ray hits by pixel: face (N,), -1 for none; rest (N, 3) m and depth (N,) m, NaN and inf for none."""

    face: NDArray[np.int64]
    rest: Array
    depth: Array


def cast(surface: Surface, pose: Pose, camera: Camera, pixels: Array) -> Hits:
    """Return the nearest points of ``surface`` at ``pose`` on the rays of ``pixels`` (N, 2)."""
    local = pose.apply(surface.vertices)
    flat, depth = project(camera, local)[surface.faces], local[surface.faces, 2]
    usable = np.flatnonzero(_over_corners(np.minimum, depth) > 1e-6)
    flat, depth = flat[usable], depth[usable]
    low, high = _over_corners(np.minimum, flat), _over_corners(np.maximum, flat)
    count = len(pixels)
    face = np.full(count, -1, dtype=np.int64)
    rest = np.full((count, 3), np.nan)
    nearest = np.full(count, np.inf)
    # Pixels sorted by x: those in a triangle's bounds are contiguous.
    by_x = np.argsort(pixels[:, 0], kind="stable")
    left = np.searchsorted(pixels[by_x, 0], low[:, 0], side="left")
    counts = np.searchsorted(pixels[by_x, 0], high[:, 0], side="right") - left
    for part in _parts(counts):
        triangle = np.repeat(part, counts[part])
        step = np.arange(len(triangle)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
        which = by_x[left[triangle] + step]
        beside = (pixels[which, 1] >= low[triangle, 1]) & (pixels[which, 1] <= high[triangle, 1])
        which, triangle = which[beside], triangle[beside]
        a, b, c = (flat[triangle, i] for i in range(3))
        p = pixels[which]
        area = _cross(b - a, c - a)
        area = np.where(np.abs(area) < 1e-12, np.nan, area)
        weights = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=1) / area[:, None]
        hit = (weights >= -1e-9).all(axis=1)
        which, triangle, weights = which[hit], triangle[hit], weights[hit]
        shares = weights / depth[triangle]
        z = 1.0 / shares.sum(axis=1)
        order = np.lexsort((z, which))
        first = order[np.unique(which[order], return_index=True)[1]]
        first = first[z[first] < nearest[which[first]]]
        rows = which[first]
        face[rows], nearest[rows] = usable[triangle[first]], z[first]
        corners = surface.vertices[surface.faces[face[rows]]]
        rest[rows] = (corners * (shares[first] * z[first][:, None])[:, :, None]).sum(axis=1)
    return Hits(face=face, rest=rest, depth=nearest)


def _over_corners(smaller: np.ufunc, values: Array) -> Array:
    """Return minimum or maximum of ``values`` (F, 3, …) over the corners; NumPy's reduction is slow on short axes."""
    return np.asarray(smaller(smaller(values[:, 0], values[:, 1]), values[:, 2]))


def _parts(counts: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield indices of triangles in batches with a bounded total of ``counts`` pixels."""
    wanted = np.flatnonzero(counts > 0)
    bins = np.cumsum(counts[wanted]) // _PAIRS_AT_ONCE
    for number in np.unique(bins):
        yield wanted[bins == number]


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def silhouette(surface: Surface, pose: Pose, camera: Camera) -> Mask:
    """Return the mask (H, W) of ``surface``, ignoring occluders."""
    local = pose.apply(surface.vertices)
    flat = project(camera, local)[surface.faces]
    drawn = np.zeros((camera.height, camera.width), dtype=np.uint8)
    # OpenCV's drawing wraps around far outside of the image.
    limit = 8 * max(camera.width, camera.height)
    with np.errstate(invalid="ignore"):
        near = (np.abs(flat) < limit).all(axis=(1, 2))
    bits = 4
    scaled = np.round((flat[near] - 0.5) * 2**bits).astype(np.int32)
    for triangle in scaled:
        cv2.fillConvexPoly(drawn, triangle, 1, lineType=cv2.LINE_8, shift=bits)
    return np.asarray(drawn > 0)


def facing(rest: Array, normals: Array, pose: Pose) -> Array:
    """Return (N,): cosine between the surface normal and the direction to the camera; negative from behind."""
    local = pose.apply(rest)
    return np.asarray(-((normals @ pose.rotation.T) * local).sum(axis=1) / np.linalg.norm(local, axis=1))
