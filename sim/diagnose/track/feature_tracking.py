# SPDX-License-Identifier: MIT
"""Features in video frames: corners, pyramidal Lucas-Kanade, warped patch alignment, and a check of camera motion.

Patches are compared with a reference view instead of the last frame: errors do not accumulate, and occluders are
recognised."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .pose_estimation import Array, Mask


def image_noise(grey: NDArray[np.uint8]) -> float:
    """Return the pixel noise in grey levels (Immerkær, Computer Vision and Image Underst. 64, 1996).

    A median over the frame, so that texture has little influence.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = cv2.filter2D(grey.astype(np.float32), -1, kernel)[1:-1, 1:-1]
    return float(np.median(np.abs(response))) / 0.6745 / 6.0


def contrast(grey: NDArray[np.uint8], half: int) -> Array:
    """Return (H, W): RMS gradient in grey levels per pixel along the weakest direction of the surrounding patch."""
    block = 2 * half + 1
    least = cv2.cornerMinEigenVal(grey, block, ksize=3)
    # OpenCV scales Sobel's kernel by 1 / (4 · 255 · block) and sums over the block; its kernel gives 8 gradients.
    return np.asarray(np.sqrt(np.maximum(least, 0.0)) * 255.0 / 2.0, dtype=np.float64)


def find_corners(
    grey: NDArray[np.uint8], allowed: Mask, *, count: int, half: int, spacing: float, min_contrast: float
) -> Array:
    """Return up to ``count`` Shi–Tomasi corners (N, 2) in ``allowed`` (H, W), best first; pixel centres at halves."""
    if count <= 0:
        return np.empty((0, 2))
    # Noise of standard deviation s gives gradients of 0.43 s after Sobel smoothing; require more than twice that.
    least = max(min_contrast, 2 * 0.43 * image_noise(grey))
    good = allowed & (contrast(grey, half) >= least)
    if not good.any():
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(
        grey, count, 1e-4, spacing, mask=good.astype(np.uint8), blockSize=2 * half + 1, useHarrisDetector=False
    )
    return np.empty((0, 2)) if found is None else np.asarray(found[:, 0], dtype=np.float64) + 0.5


LEVELS = 4
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def track_points(
    before: NDArray[np.uint8], now: NDArray[np.uint8], places: Array, guesses: Array, half: int
) -> tuple[Array, Array]:
    """Return pixels (N, 2) in ``now`` of ``places`` (N, 2) in ``before``, and forward-backward errors (N,) in px.

    guesses: (N, 2) initial pixels. The error is infinite where a point was lost. Pyramidal Lucas–Kanade (Bouguet 2000).
    """
    if len(places) == 0:
        return places.copy(), np.empty(0)
    start = (places - 0.5).astype(np.float32).reshape(-1, 1, 2)
    first = (guesses - 0.5).astype(np.float32).reshape(-1, 1, 2)
    size = (2 * half + 1, 2 * half + 1)
    flag = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, now, start, first.copy(), winSize=size, maxLevel=LEVELS, criteria=_STOP, flags=flag
    )
    # The backward pass starts as far off as the forward one: started at the answer it would confirm any error.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        now, before, there, there - (first - start), winSize=size, maxLevel=LEVELS, criteria=_STOP, flags=flag
    )
    miss = np.linalg.norm((back - start)[:, 0].astype(np.float64), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & np.isfinite(miss)
    return there[:, 0].astype(np.float64) + 0.5, np.where(good, miss, np.inf)


STILL_PX = 1.0
"""Median background shift in px up to which the camera counts as fixed."""
EVERY = 5
"""Frames between two checks."""


class CameraMotionCheck:
    """Compares the background with the first frame. ``moved``: largest median shift so far, px."""

    def __init__(self, grey: NDArray[np.uint8], objects: Mask) -> None:
        margin = max(5, min(grey.shape) // 20)
        covered = cv2.dilate(objects.astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0
        spacing = max(8.0, min(grey.shape) / 20)
        self._first = grey
        self._corners = find_corners(grey, ~covered, count=80, half=7, spacing=spacing, min_contrast=2.0)
        self.moved = 0.0

    def look(self, grey: NDArray[np.uint8]) -> None:
        """Check a frame (H, W)."""
        if len(self._corners) < 8:
            return
        ends, miss = track_points(self._first, grey, self._corners, self._corners, 7)
        good = miss < 1.0
        if good.sum() >= 8:
            self.moved = max(self.moved, float(np.median(np.linalg.norm((ends - self._corners)[good], axis=1))))

    @property
    def warning(self) -> str | None:
        """Return a warning for the user, or None."""
        if len(self._corners) < 8:
            return "the background has too few points to check whether the camera was fixed"
        if self.moved > STILL_PX:
            return (
                f"the background moves by {self.moved:.1f} pixels: the camera was not fixed, and its motion counts as "
                "motion of the objects. Film from a tripod, with stabilisation off"
            )
        return None


Image = NDArray[np.float32]

REACH = 2.2
"""Half size of the stored reference crop over that of the compared patch: allows zooming out."""


_STREAK_STEP_PX = 1.5


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Predicted patches (N, n, n) with zero mean and unit norm, and their gradients per pixel."""

    values: Array
    along_x: Array
    along_y: Array


def smoothed(grey: NDArray[np.uint8]) -> Image:
    """Return ``grey`` as float, low-pass filtered for interpolation."""
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.8))


def extract_patches(image: Image, pixels: Array, half: int) -> Image:
    """Return crops (N, S, S) around ``pixels`` (N, 2; pixel centres at halves) for patches of 2 half + 1 pixels."""
    reach = int(np.ceil(REACH * half))
    offsets = np.arange(-reach, reach + 1, dtype=np.float32)
    side = len(offsets)
    out = np.empty((len(pixels), side, side), dtype=np.float32)
    for i, (x, y) in enumerate(pixels - 0.5):
        columns, rows = np.meshgrid(np.float32(x) + offsets, np.float32(y) + offsets)
        out[i] = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return out


def grid_offsets(half: int) -> Array:
    """Return offsets (25, 2) px over a patch, where the surface is sampled to compute the warp."""
    steps = np.linspace(-1.2, 1.2, 5) * half
    columns, rows = np.meshgrid(steps, steps)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def identity_maps(count: int) -> Array:
    """Return identity maps (N, 2, 5) for ``warp``."""
    return np.broadcast_to(np.eye(2, 5), (count, 2, 5))


def view_maps(now: Array, half: int) -> Array:
    """Return maps (N, 2, 5) for ``warp`` from the current pixels ``now`` (N, 25, 2) of the ``grid_offsets``.

    now is relative to the point, NaN off the surface. Quadratic least squares: on a sphere a linear map would err by
    the patch's depth times the sine of the rotation, a quarter of a pixel after 30 degrees.
    """
    known = np.isfinite(now).all(axis=2)
    terms = _terms(np.where(known[:, :, None], now, 0.0) / half) * known[:, :, None]
    normal = np.einsum("nka,nkb->nab", terms, terms)
    normal += 1e-6 * np.eye(5) * np.trace(normal, axis1=1, axis2=2)[:, None, None]
    right = np.einsum("nka,kc->nac", terms, grid_offsets(half))
    scale = np.array([1, 1, half, half, half]) * float(half)
    return np.asarray(np.linalg.solve(normal, right).transpose(0, 2, 1) / scale)


def _terms(offsets: Array) -> Array:
    x, y = offsets[..., 0], offsets[..., 1]
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def warp(crops: Image, maps: Array, half: int, streaks: Array | None = None) -> Patches:
    """Return ``crops`` (N, S, S) warped to the view from which ``maps`` (N, 2, 5) lead back to them.

    A map's columns multiply x, y, x², xy, y² in pixels from the point in the view; it gives pixels in the crop.
    streaks: (N, 2) px, centred motion of each point during the exposure (motion blur); None for none.
    """
    wide = np.arange(-half - 1, half + 2, dtype=np.float64)
    columns, rows = np.meshgrid(wide, wide)
    offsets = np.stack([columns.ravel(), rows.ravel()], axis=1)
    side = len(wide)
    centre = crops.shape[1] // 2
    out = np.empty((len(crops), side, side), dtype=np.float64)
    for i, crop in enumerate(crops):
        streak = np.zeros(2) if streaks is None else streaks[i]
        count = int(np.clip(np.ceil(np.linalg.norm(streak) / _STREAK_STEP_PX), 0, 12)) + 1
        moments = (np.arange(count) + 0.5) / count - 0.5
        total = np.zeros((side, side))
        for moment in moments:
            x, y = (maps[i] @ _terms(offsets - moment * streak).T + centre).astype(np.float32).reshape(2, side, side)
            total += cv2.remap(crop, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        out[i] = total / count
    inner = out[:, 1:-1, 1:-1]
    values, norm = _standardised(inner)
    scale = 0.5 / norm[:, None, None]
    return Patches(
        values=values,
        along_x=(out[:, 1:-1, 2:] - out[:, 1:-1, :-2]) * scale,
        along_y=(out[:, 2:, 1:-1] - out[:, :-2, 1:-1]) * scale,
    )


def _standardised(patches: Array) -> tuple[Array, Array]:
    centred = patches - patches.mean(axis=(1, 2), keepdims=True)
    norm = np.maximum(np.sqrt((centred**2).sum(axis=(1, 2))), 1e-6)
    return centred / norm[:, None, None], norm


def sample(image: Image, pixels: Array, half: int) -> Array:
    """Return patches (N, n, n) of ``image`` around ``pixels`` (N, 2; pixel centres at halves)."""
    offsets = np.arange(-half, half + 1)
    side = len(offsets)
    out = np.empty((len(pixels), side, side))
    rows_at_once = 32000 // side
    for start in range(0, len(pixels), rows_at_once):
        part = pixels[start : start + rows_at_once] - 0.5
        x = np.broadcast_to(part[:, 0, None, None] + offsets[None, None, :], (len(part), side, side))
        y = np.broadcast_to(part[:, 1, None, None] + offsets[None, :, None], (len(part), side, side))
        found = cv2.remap(
            image,
            x.reshape(-1, side).astype(np.float32),
            y.reshape(-1, side).astype(np.float32),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
        out[start : start + rows_at_once] = found.reshape(len(part), side, side)
    return out


def align(image: Image, patches: Patches, guesses: Array, half: int, *, iterations: int = 15) -> tuple[Array, Array]:
    """Return pixels (N, 2) of ``patches`` in ``image``, from ``guesses`` (N, 2), and correlations (N,) in [-1, 1].

    Inverse compositional Gauss–Newton on the translation (Baker and Matthews, Int. J. Computer Vision 56, 2004),
    invariant to brightness and contrast.
    """
    places = guesses.copy()
    gx, gy = patches.along_x, patches.along_y
    a, b, c = ((p * q).sum(axis=(1, 2)) for p, q in ((gx, gx), (gx, gy), (gy, gy)))
    determinant = a * c - b * b
    solvable = determinant > 1e-9
    determinant = np.where(solvable, determinant, 1.0)
    score = np.full(len(places), -1.0)
    active = np.flatnonzero(solvable)
    for _ in range(iterations):
        if len(active) == 0:
            break
        values, _ = _standardised(sample(image, places[active], half))
        error = values - patches.values[active]
        ex, ey = (error * gx[active]).sum(axis=(1, 2)), (error * gy[active]).sum(axis=(1, 2))
        d = determinant[active]
        shift = np.stack([c[active] * ex - b[active] * ey, a[active] * ey - b[active] * ex], axis=1) / d[:, None]
        size = np.linalg.norm(shift, axis=1, keepdims=True)
        places[active] -= shift * np.minimum(1.0, 1.0 / np.maximum(size, 1e-9))
        active = active[size[:, 0] > 0.005]
    values, _ = _standardised(sample(image, places, half))
    score[solvable] = (values * patches.values).sum(axis=(1, 2))[solvable]
    return places, score
