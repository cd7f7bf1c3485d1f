# SPDX-License-Identifier: MIT
"""Features of a candidate for an object, measured on its mask, and their score."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...srgb import cielab
from .box_crop import edge_crest
from .mask_geometry import Mask, extent_of, outline_of, ring_around, shrunk, solidity_of

FEATURES = ("closed", "contrast", "contour", "cut", "agreement", "high", "solid", "size", "ground", "base", "shade")
"""Of a candidate: ``objectness``; distance of its colours from those around it; share of its outline on edges; share of
its outline on the photo's border; IoU of the candidate with what its box yields; height of its middle in the photo;
share of its convex hull; logarithm of its share of the photo; share of it that could be ground, lit or shaded; share of
the pixels below it that look like those beside it, as under something that stands on a floor; whether it may be nothing
but shade on what surrounds it."""
WEIGHTS = np.array([2.5, 1.2, 2.0, -5.0, 1.0, -2.0, 1.5, 0.35, -3.0, 1.5, -4.0])
OFFSET = -2.0
"""Logistic regression of ``FEATURES`` on whether a candidate is an object."""


def copy_of(pixels: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) with a longer side of ``longest`` pixels at most, and sides of 8 at least."""
    scale = min(1.0, longest / max(pixels.shape[:2]))
    size = (max(8, round(pixels.shape[1] * scale)), max(8, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def lab_of(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return CIELAB (H, W, 3) of a copy ``pixels`` (H, W, 3) sRGB, a little smoothed."""
    return cielab(np.asarray(cv2.GaussianBlur(pixels, (0, 0), 0.8), dtype=np.uint8))


def at_size_of(mask: Mask, picture: NDArray[np.uint8]) -> Mask:
    """Return ``mask``, of any size, at that of ``picture`` (H, W, 3)."""
    large = cv2.resize(mask.astype(np.float32), picture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 0.5)


def features_of(
    mask: Mask, start: Mask, judged: tuple[float, float], lab: NDArray[np.float32], edges: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the ``FEATURES`` of ``mask``.

    start: the candidate that ``mask`` was segmented from. judged: its objectness, and the share of it that may be
    ground. lab: (H, W, 3) CIELAB. edges: (H, W), as of ``edge_strength``.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    union = float((mask | start).sum())
    return np.array(
        [
            judged[0],
            min(1.5, contrast_of(mask, lab) / 30.0),
            share_on_edges(mask, edges),
            cut_share(mask),
            float((mask & start).sum()) / union,
            1.0 - float(rows.mean()) / mask.shape[0],
            solidity_of(mask),
            float(np.log(mask.mean())),
            judged[1],
            _ground_below(mask, lab),
            float(_is_like_shade(mask, lab)),
        ]
    )


def contrast_of(mask: Mask, lab: NDArray[np.float32]) -> float:
    """Distance of the mean colours of ``mask`` and of a ring around it, CIELAB."""
    around = ring_around(mask, max(3, round(0.12 * float(np.sqrt(mask.sum())))))
    if not around.any():
        return 0.0
    return float(np.linalg.norm(lab[mask].mean(axis=0) - lab[around].mean(axis=0)))


def share_on_edges(mask: Mask, edges: NDArray[np.float32]) -> float:
    """Return the share of the outline of ``mask`` that lies on ``edges``."""
    outline = outline_of(mask)
    # An outline may be a pixel beside its edge.
    crest = edge_crest(edges)
    return float((crest[outline] > 2.5).mean()) if outline.any() else 0.0


def cut_share(mask: Mask) -> float:
    """Share of the box' outline along which ``mask`` lies on the photo's border."""
    x0, y0, x1, y1 = extent_of(mask)
    touching = int(mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum())
    return min(1.0, touching / float(x1 - x0 + y1 - y0))


def _is_like_shade(mask: Mask, lab: NDArray[np.float32]) -> bool:
    """Whether ``mask`` may be nothing but shade: darker than the ring around it, of its hue, and as even."""
    size = float(np.sqrt(mask.sum()))
    around = ring_around(mask, max(4, round(0.2 * size)))
    inner = shrunk(mask)
    if around.sum() < 20 or inner.sum() < 20:
        return False
    own, near = np.median(lab[inner], axis=0), np.median(lab[around], axis=0)
    # CIELAB scales with the cube root of light but for the offset of L*.
    factor = (own[0] + 16.0) / (near[0] + 16.0)
    if not 0.5 < factor < 0.97:
        return False
    hue = float(np.linalg.norm(own[1:] - factor * near[1:]))
    own_spread, near_spread = (lab[part][:, 0].std() for part in (inner, around))
    return bool(hue < 6.0 + 0.12 * np.linalg.norm(near[1:]) and own_spread < 1.5 * near_spread + 5.0)


def _ground_below(mask: Mask, lab: NDArray[np.float32]) -> float:
    """Share of the pixels just below the lower outline whose colour, in light or shade, is that of pixels left and
    right of the object at its base: 1 on an even floor."""
    height, width = mask.shape
    x0, y0, x1, y1 = extent_of(mask)
    size = max(x1 - x0, y1 - y0)
    reach = max(2, round(0.06 * size))
    columns = np.flatnonzero(mask.any(axis=0))
    lowest = height - 1 - mask[::-1, columns].argmax(axis=0)
    below = lowest + reach
    good = below < height
    if good.sum() < 0.5 * len(columns):
        return 0.0
    under = lab[below[good], columns[good]]
    rows = slice(max(0, y1 - size // 4), min(height, y1 + reach))
    sides = np.concatenate(
        [
            lab[rows, max(0, x0 - size // 2) : max(0, x0 - reach)].reshape(-1, 3),
            lab[rows, min(width, x1 + reach) : min(width, x1 + size // 2)].reshape(-1, 3),
        ]
    )
    if len(sides) < 10:
        return 0.5
    typical = np.median(sides, axis=0)
    spread = max(6.0, 2.0 * float(np.median(np.linalg.norm(sides - typical, axis=1))))
    apart = under - typical
    # Shade changes lightness more than hue.
    apart[:, 0] = np.where(apart[:, 0] < 0, 0.35 * apart[:, 0], apart[:, 0])
    return float((np.linalg.norm(apart, axis=1) < spread).mean())


def score_of(features: NDArray[np.float64]) -> float:
    """Return the probability, 0 to 1, that a candidate with these ``features`` is an object."""
    return float(1.0 / (1.0 + np.exp(-(features @ WEIGHTS + OFFSET))))
