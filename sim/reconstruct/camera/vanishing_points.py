# SPDX-License-Identifier: MIT
"""Straight line segments of a photo, and the likelihood of a camera pose given them.

The world has one vertical, and on the ground one or more frames of two perpendicular directions, each turned by its
own azimuth (Coughlan & Yuille, ICCV 1999, for one frame; Schindler & Dellaert, CVPR 2004, for several). Each segment
points to one of their vanishing points up to a normal error of its direction in the photo, or to none.

A state is (log f, pitch, roll, azimuth, azimuth, …), in radians and log of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from .ground_camera import camera_from_world

Array = NDArray[np.float64]

LINE_SIZE = 1000
"""Longest side in pixels of the copy in which segments are detected."""
MIN_LENGTH = 0.022
"""Shortest segment over the photo's longer side."""
MOST = 260
"""Number of longest segments that are used: short ones of a rich texture cost time and add little."""
END_SIGMA_PX = 0.5
"""Error of a detected end across its line, in pixels of the copy (measured on rendered edges)."""
BEND_SIGMA_DEG = 0.2
"""Deviation of real edges from straightness: lens distortion and the objects themselves."""
TWIN_DEG, TWIN_GAP = 3.0, 0.012
"""Segments this close to collinear, over the photo's longer side, are parts of one edge and count as one
observation."""
STRAY_LENGTH, STRAY_POWER = 0.05, 2.0
"""Length over the photo's longer side at which the outlier share applies, and how it falls with length."""
ON_OBJECT = 0.4
"""Weight of segments on objects: edges of boxes and sides of bottles are good evidence, prints on them less."""


@dataclass(frozen=True)
class Segments:
    """Segments in pixels from the middle of the photo.

    middle: (N, 2). direction: (N, 2) unit vectors. length: (N,) pixels. sigma: (N,) standard deviation of the direction
    in radians. weight: (N,) share of one independent observation. relative_length: (N,) length over the photo's longer
    side.
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
        """Return the probability (N,) that a segment is an outlier, if ``share`` of those of STRAY_LENGTH are.

        Textures are full of short segments; long straight ones are mostly structure.
        """
        odds = share * (STRAY_LENGTH / self.relative_length) ** STRAY_POWER
        return odds / (odds + 1.0 - share)


def straight_lines(pixels: NDArray[np.uint8]) -> Array:
    """Return the straight lines x0, y0, x1, y1 (n, 4) of ``pixels`` (H, W, 3) sRGB (LSD: Grompone von Gioi et al.,
    TPAMI 2010)."""
    found = cv2.createLineSegmentDetector().detect(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))[0]
    return np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)


def find_segments(pixels: NDArray[np.uint8], objects: NDArray[np.bool_]) -> Segments:
    """Return straight segments of ``pixels`` (H, W, 3) sRGB, the longest first.

    objects: (H, W) mask of all objects. Segments along the photo's own border are dropped: they are picture frames.
    """
    height, width = objects.shape
    scale = min(1.0, LINE_SIZE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    lines = straight_lines(np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    small = cv2.resize(objects.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return _weighed(lines + 0.5, np.asarray(small, dtype=np.uint8), scale)


def _weighed(lines: Array, objects: NDArray[np.uint8], scale: float) -> Segments:
    """``lines`` (n, 4) in pixels of a copy with the objects (h, w), as segments of the photo 1 / ``scale`` times as
    large."""
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
    """Number (N,) of segments, including itself, on the same edge as each."""
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    gap = np.abs(((middle[None] - middle[:, None]) * normal[:, None]).sum(axis=-1))
    apart = np.abs(direction @ normal.T)
    twins = (np.maximum(gap, gap.T) < TWIN_GAP * size) & (apart < np.sin(np.radians(TWIN_DEG)))
    return np.maximum(twins.sum(axis=1), 1).astype(np.float64)


STRAY = (0.25, 0.5, 0.75, 0.92, 1.0)
"""Hypotheses for the share of outliers; 1 is a photo without informative lines."""
UPRIGHT = 0.35
"""Share of vertical segments among the inliers."""
CHUNK = 2_000_000
"""Memory limit for a table of states × segments × directions."""
HATCH_DEG = 6.0
"""Smoothing of the outliers' direction histogram: strokes and grain run in one direction of the photo, about this
exactly, and say nothing about the camera."""


def world_directions(states: Array) -> Array:
    """Return up, and two directions for each frame, in the camera's axes: (S, 1 + 2 F, 3) for ``states`` (S, 3 + F)."""
    axes = camera_from_world(states[:, 1], states[:, 2])
    right, away, up = axes[..., 0], axes[..., 1], axes[..., 2]
    found = [up]
    for azimuth in states[:, 3:].T:
        c, s = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
        found += [c * right + s * away, c * away - s * right]
    return np.stack(found, axis=1)


def angular_residuals(states: Array, segments: Segments) -> Array:
    """Return the sine of the angle (S, N, 1 + 2 F) between each segment and the line from its middle to each vanishing
    point."""
    directions = world_directions(states)
    focal = np.exp(states[:, 0])[:, None]
    x, y = segments.middle.T
    u, v = segments.direction.T
    depth = directions[..., 2]
    # Towards the vanishing point: (f dx − x dz, f dy − y dz), for each state, segment and direction.
    tx = (focal * directions[..., 0])[:, None, :] - x[None, :, None] * depth[:, None, :]
    ty = (focal * directions[..., 1])[:, None, :] - y[None, :, None] * depth[:, None, :]
    return (u[None, :, None] * ty - v[None, :, None] * tx) / np.maximum(np.hypot(tx, ty), 1e-9)


def _shares(frames: int) -> Array:
    """Prior probability (1 + 2 F,) of each direction for an inlier."""
    return np.array([1.0]) if frames == 0 else np.array([UPRIGHT] + [(1.0 - UPRIGHT) / (2 * frames)] * (2 * frames))


def background_density(segments: Segments) -> Array:
    """Return the density (N,) per radian of each segment's direction if it is an outlier.

    Half uniform, half distributed as the photo's other segments, smoothed by HATCH_DEG: that already explains hatching,
    and only lines that converge correctly are explained better by a vanishing point.
    """
    if not len(segments):
        return np.zeros(0)
    angle = np.arctan2(segments.direction[:, 1], segments.direction[:, 0])
    apart = np.angle(np.exp(2j * (angle[:, None] - angle[None, :]))) / 2.0
    sigma = np.radians(HATCH_DEG)
    kernel = np.exp(-0.5 * (apart / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    np.fill_diagonal(kernel, 0.0)
    weight = segments.weight
    rest = np.maximum(weight.sum() - weight, 1e-9)
    return 0.5 / np.pi + 0.5 * (kernel @ weight) / rest


def log_gain(states: Array, segments: Segments, background: Array, widen: float = 1.0) -> Array:
    """Return the log likelihood ratio (S,) of ``states`` over all segments being outliers.

    background: from ``background_density``. widen: factor on the errors, for a coarse first pass.
    """
    frames = states.shape[1] - 3
    total = np.zeros(len(states))
    step = max(1, CHUNK // max(1, len(segments) * (1 + 2 * frames)))
    for start in range(0, len(states), step):
        part = slice(start, start + step)
        total[part] = logsumexp(_gains(angular_residuals(states[part], segments), segments, background, widen), axis=0)
    return total - np.log(len(STRAY))


def _densities(sine: Array, segments: Segments, background: Array, widen: float) -> Array:
    """Density (S, N, K) of each segment's direction under each vanishing point, over that of an outlier."""
    sigma = (segments.sigma * widen)[:, None]
    scale = _shares((sine.shape[-1] - 1) // 2) / (np.sqrt(2.0 * np.pi) * sigma * background[:, None])
    return np.exp(-0.5 * (sine / sigma) ** 2) * scale


def _gains(sine: Array, segments: Segments, background: Array, widen: float) -> Array:
    ratio = _densities(sine, segments, background, widen).sum(axis=-1)
    return np.stack([np.log(part + (1.0 - part) * ratio) @ segments.weight for part in map(segments.stray, STRAY)])


def responsibilities(state: Array, segments: Segments, background: Array, widen: float = 1.0) -> Array:
    """Return the probability (N, 1 + 2 F) that each segment points to each direction of ``state`` (3 + F,); the rest is
    outlier."""
    sine = angular_residuals(state[None], segments)
    stray = segments.stray(STRAY[int(np.argmax(_gains(sine, segments, background, widen)[:-1, 0]))])[:, None]
    density = (1.0 - stray) * _densities(sine, segments, background, widen)[0]
    return density / (stray + density.sum(axis=1, keepdims=True))
