# SPDX-License-Identifier: MIT
"""Straight segments of a photo, and how far each can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LINE_SIZE = 1000
"""Longest side in pixels of the copy in which segments are sought."""
MIN_LENGTH = 0.022
"""Shortest segment over the photo's longer side."""
MOST = 260
"""The longest ones are kept: the short ones of a rich texture cost time and say little."""
END_SIGMA_PX = 0.5
"""How far an end found by the detector lies beside its line, in pixels of the copy (measured on rendered edges)."""
BEND_SIGMA_DEG = 0.2
"""What straight things are not straight by: lens, and the things themselves."""
TWIN_DEG, TWIN_GAP = 3.0, 0.012
"""Segments so nearly in line, over the photo's longer side, are pieces or sides of one edge, and are one
observation."""
STRAY_LENGTH, STRAY_POWER = 0.05, 2.0
"""Length, over the photo's longer side, at which a segment points nowhere as often as the rest, and how that falls."""
ON_OBJECT = 0.4
"""Weight of segments on objects: edges of boxes and sides of bottles are good evidence, what is printed on them
less."""


@dataclass(frozen=True)
class Segments:
    """Segments in pixels from the middle of the photo.

    middle: (N, 2). direction: (N, 2) unit vectors. length: (N,) pixels. sigma: (N,) standard deviation of the direction
    in radians. weight: (N,) share of one independent observation.
    relative_length: (N,) length over the photo's longer side.
    """

    middle: Array
    direction: Array
    length: Array
    sigma: Array
    weight: Array
    relative_length: Array

    def __len__(self) -> int:
        return len(self.length)

    def stray(self, share: float) -> Array:
        """Probability (N,) that a segment points nowhere, if of those of STRAY_LENGTH ``share`` do.

        Textures are full of short ones; what is long and straight was made so.
        """
        odds = share * (STRAY_LENGTH / self.relative_length) ** STRAY_POWER
        return odds / (odds + 1.0 - share)


def find_segments(pixels: NDArray[np.uint8], objects: NDArray[np.bool_]) -> Segments:
    """Segments (LSD: Grompone von Gioi et al., TPAMI 2010) of ``pixels`` (H, W, 3) sRGB, the longest first.

    objects: (H, W), where the photo shows objects. Segments along the photo's own border are left out: they are frames.
    """
    height, width = objects.shape
    scale = min(1.0, LINE_SIZE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = cv2.cvtColor(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    lines = np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)
    small = cv2.resize(objects.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return _weighed(lines + 0.5, np.asarray(small, dtype=np.uint8), scale)


def _weighed(lines: Array, objects: NDArray[np.uint8], scale: float) -> Segments:
    """``lines`` (n, 4) in pixels of a copy with the objects (h, w), as segments of the photo ``scale`` times larger."""
    height, width = objects.shape
    along = lines[:, 2:] - lines[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    edge = 0.004 * max(width, height)
    far = np.array([width, height] * 2) - lines
    framed = np.zeros(len(lines), bool)
    for side in (lines, far):
        framed |= (side[:, 0::2] < edge).all(axis=1) | (side[:, 1::2] < edge).all(axis=1)
    keep = np.flatnonzero((length > MIN_LENGTH * max(width, height)) & ~framed)
    keep = keep[np.argsort(-length[keep], kind="stable")][:MOST]
    lines, along, length = lines[keep], along[keep], length[keep]
    middle = (lines[:, :2] + lines[:, 2:]) / 2.0
    near = cv2.dilate(objects, np.ones((9, 9), np.uint8))
    column = np.clip(middle[:, 0].astype(int), 0, width - 1)
    row = np.clip(middle[:, 1].astype(int), 0, height - 1)
    on_object = near[row, column] > 0
    size = max(width, height)
    return Segments(
        middle=(middle - np.array([width, height]) / 2.0) / scale,
        direction=along / np.maximum(length, 1e-9)[:, None],
        length=length / scale,
        sigma=np.hypot(END_SIGMA_PX * np.sqrt(2.0) / np.maximum(length, 1.0), np.radians(BEND_SIGMA_DEG)),
        weight=np.where(on_object, ON_OBJECT, 1.0) / _twins(middle, along / np.maximum(length, 1e-9)[:, None], size),
        relative_length=length / size,
    )


def _twins(middle: Array, direction: Array, size: int) -> Array:
    """How many of the segments (N,), itself included, are of one edge with each."""
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    gap = np.abs(((middle[None] - middle[:, None]) * normal[:, None]).sum(axis=-1))
    apart = np.abs(direction @ normal.T)
    twins = (np.maximum(gap, gap.T) < TWIN_GAP * size) & (apart < np.sin(np.radians(TWIN_DEG)))
    return np.maximum(twins.sum(axis=1), 1).astype(np.float64)
