# SPDX-License-Identifier: MIT
"""Small pictures of the surface around a point: warped to another view, and found again in a frame.

Comparing with the first sight, instead of with the last frame, keeps errors from adding up, and tells an occluder from
the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .pose import Array

Image = NDArray[np.float32]

REACH = 2.2
"""Half size of what is kept of the first sight, over that of the patch that is compared: how far views may zoom out."""


_STREAK_STEP_PX = 1.5


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Patches (N, n, n) as they should look in a frame, with zero mean and unit norm, and their gradients per pixel."""

    values: Array
    along_x: Array
    along_y: Array


def smoothed(grey: NDArray[np.uint8]) -> Image:
    """``grey`` as float, without the finest detail, which interpolation between pixels cannot carry."""
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.8))


def cut(image: Image, pixels: Array, half: int) -> Image:
    """(N, S, S): surroundings of ``pixels`` (N, 2; pixel centres at halves) for patches of 2 half + 1 pixels."""
    reach = int(np.ceil(REACH * half))
    offsets = np.arange(-reach, reach + 1, dtype=np.float32)
    side = len(offsets)
    out = np.empty((len(pixels), side, side), dtype=np.float32)
    for i, (x, y) in enumerate(pixels - 0.5):
        columns, rows = np.meshgrid(np.float32(x) + offsets, np.float32(y) + offsets)
        out[i] = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return out


def grid_offsets(half: int) -> Array:
    """(25, 2) px around a point, over its patch: where the surface is sampled, to tell how views of it differ."""
    steps = np.linspace(-1.2, 1.2, 5) * half
    columns, rows = np.meshgrid(steps, steps)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def same(count: int) -> Array:
    """The map (N, 2, 5) of ``warp`` that changes nothing."""
    return np.broadcast_to(np.eye(2, 5), (count, 2, 5))


def view_maps(now: Array, half: int) -> Array:
    """Maps (N, 2, 5) for ``warp``, given where the present view has the ``grid_offsets``: ``now`` (N, 25, 2) px.

    now is relative to the point itself, NaN off the surface. Quadratic by least squares: on a ball a linear map would
    be off by the patch's depth times the sine of the turn, a quarter of a pixel after 30 degrees.
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
    """``crops`` (N, S, S) as a view shows them that the ``maps`` (N, 2, 5) lead back from.

    A map's columns count x, y, x², xy, y² of pixels from the point in the view; it gives pixels in the crop.
    streaks: (N, 2) px, the way of each point in the view while the frame was exposed, centred; None: none.
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
    """Patches (N, n, n) of ``image`` around ``pixels`` (N, 2; pixel centres at halves)."""
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
    """Where ``patches`` are in ``image``, from ``guesses`` (N, 2): places (N, 2), correlations (N,) from -1 to 1.

    Inverse compositional Gauss–Newton on the shift alone (Baker and Matthews, Int. J. Computer Vision 56, 2004);
    brightness and contrast are normalised away, so that a body that turns in the light stays the same.
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
