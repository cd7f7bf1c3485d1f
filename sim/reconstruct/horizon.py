# SPDX-License-Identifier: MIT
"""Estimate the camera's pitch from straight lines on the ground, where they tell it.

Carried onto the ground with the right pitch, the edges of boards, tables and tiles run in one direction, or in two at
right angles; with a wrong one they fan out. Every pitch is tried, and the one with the sharpest histogram of
directions wins, if it wins clearly (after Coughlan & Yuille's Manhattan world, ICCV 1999).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

PITCHES_DEG = np.arange(4.0, 71.0, 1.0)
LINE_SIZE = 1000
"""Longest side in pixels of the copy in which lines are sought."""
CLEAR_WIN = 1.15
"""Score of the best pitch over that of pitches 10° away, below which the lines say nothing."""
MIN_SPREAD_DEG = 12.0
"""Angle in the photo between lines of one direction on the ground, below which they hardly converge."""


def estimate_pitch(pixels: NDArray[np.uint8], objects: NDArray[np.bool_], focal: float) -> float | None:
    """Pitch in radians, or None when the photo's lines do not agree on one.

    pixels: (H, W, 3) sRGB. objects: (H, W), lines on them are left out. focal: pixels.
    """
    segments = _segments(pixels, objects)
    if len(segments) < 12:
        return None
    height, width = objects.shape
    scores = np.array([_score(segments, width, height, focal, np.radians(p))[0] for p in PITCHES_DEG])
    best = int(np.argmax(scores))
    apart = np.abs(PITCHES_DEG - PITCHES_DEG[best]) >= 10.0
    if best in (0, len(scores) - 1) or scores[best] < CLEAR_WIN * scores[apart].max():
        return None
    spread = _score(segments, width, height, focal, np.radians(PITCHES_DEG[best]))[1]
    return float(np.radians(PITCHES_DEG[best])) if spread >= MIN_SPREAD_DEG else None


def _segments(pixels: NDArray[np.uint8], objects: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Straight segments (n, 4) as x0, y0, x1, y1 in photo pixels, at least 3 % of the photo long, off the objects."""
    height, width = objects.shape
    scale = min(1.0, LINE_SIZE / max(height, width))
    size = (round(width * scale), round(height * scale))
    grey = cv2.cvtColor(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    blocked = cv2.dilate(
        cv2.resize(objects.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), np.ones((9, 9), np.uint8)
    )
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    if found is None:
        return np.zeros((0, 4))
    lines = found.reshape(-1, 4).astype(np.float64)
    lengths = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    middle = np.clip((lines[:, :2] + lines[:, 2:]) / 2.0, 0, [size[0] - 1, size[1] - 1]).astype(int)
    keep = (lengths > 0.03 * max(size)) & (blocked[middle[:, 1], middle[:, 0]] == 0)
    return lines[keep] / scale


def _score(segments: NDArray[np.float64], width: int, height: int, focal: float, pitch: float) -> tuple[float, float]:
    """Sharpness of the directions on the ground modulo 90°, and the spread in degrees of the winners in the photo."""
    sine, cosine = np.sin(pitch), np.cos(pitch)
    x = (segments[:, [0, 2]] - width / 2.0) / focal
    y = (segments[:, [1, 3]] - height / 2.0) / focal
    down = y * cosine + sine
    usable = (down > 0.03).all(axis=1)
    if usable.sum() < 8:
        return 0.0, 0.0
    x, y, down = x[usable], y[usable], down[usable]
    ground_x, ground_y = x / down, (cosine - y * sine) / down
    angle = np.arctan2(ground_y[:, 1] - ground_y[:, 0], ground_x[:, 1] - ground_x[:, 0])
    ends = segments[usable]
    image_angle = np.arctan2(ends[:, 3] - ends[:, 1], ends[:, 2] - ends[:, 0])
    weight = np.hypot(ends[:, 3] - ends[:, 1], ends[:, 2] - ends[:, 0])
    # Lines across the photo lie across at any pitch: they would outvote those that know something.
    weight = weight * np.sin(image_angle) ** 2
    bins = 90
    position = (np.degrees(angle) % 90.0).astype(int) % bins
    histogram = np.bincount(position, weights=weight, minlength=bins)
    smooth = histogram + 0.5 * (np.roll(histogram, -1) + np.roll(histogram, 1))
    peak = int(np.argmax(smooth))
    off = np.abs((position - peak + 45) % 90 - 45)
    winners = off <= 2
    direction = np.degrees(image_angle[winners]) % 180.0
    share = weight[winners]
    if share.sum() <= 0:
        return 0.0, 0.0
    doubled = np.exp(2j * np.radians(direction))
    middle = np.angle((doubled * share).sum()) / 2.0
    away = np.abs((direction - np.degrees(middle) + 90.0) % 180.0 - 90.0)
    spread = 2.0 * float(np.average(away, weights=share))
    return float(smooth[peak] / max(float(weight.sum()), 1e-9)), spread
