# SPDX-License-Identifier: MIT
"""Parts, surroundings and extent of masks."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def grown(mask: Mask, reach: int = 1) -> Mask:
    """Return ``mask`` (h, w) with the pixels no more than ``reach`` rows and columns from it."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0)


def shrunk(mask: Mask, reach: int = 1) -> Mask:
    """Return ``mask`` (h, w) without pixels no more than ``reach`` rows and columns from its outside or the border."""
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8), borderValue=0) > 0)


def outline_of(mask: Mask) -> Mask:
    """Return the pixels (h, w) on both sides of the outline of ``mask``."""
    return grown(mask) & ~shrunk(mask)


def ring_around(mask: Mask, reach: int) -> Mask:
    """Return the pixels (h, w) outside of ``mask`` and no farther from it than ``reach`` pixels."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray((cv2.dilate(mask.astype(np.uint8), kernel) > 0) & ~mask)


def largest_component(mask: Mask) -> Mask:
    """Return the largest 8-connected part of ``mask``; an empty mask stays empty."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count <= 1:
        return mask.copy()
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def largest_part(mask: Mask, others: Mask) -> Mask:
    """Return the largest connected part of ``mask``; parts separated only by ``others`` stay together."""
    if not others.any():
        return largest_component(mask)
    _, labels = cv2.connectedComponents((mask | others).astype(np.uint8), connectivity=8)
    sizes = np.bincount(labels[mask].astype(np.int64), minlength=2)
    kept = mask & (labels == int(np.argmax(sizes)))
    # Parts separated by the others count if they are more than specks.
    _, parts, stats, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return np.asarray(np.isin(parts, np.flatnonzero(areas >= 0.05 * areas.max()))) & kept


def touching(parts: Mask, target: Mask) -> Mask:
    """Return the 8-connected components of ``parts`` that overlap ``target``."""
    _, labels = cv2.connectedComponents(parts.astype(np.uint8), connectivity=8)
    reached = np.unique(labels[target & parts])
    return np.asarray(np.isin(labels, reached[reached > 0]))


def enclosed_holes(mask: Mask) -> Mask:
    """Return background that is not connected to the image border (4-connected)."""
    padded = np.pad((~mask).astype(np.uint8), 1, constant_values=1)
    _, labels = cv2.connectedComponents(padded, connectivity=4)
    return np.asarray((labels != labels[0, 0]) & (padded > 0))[1:-1, 1:-1]


def extent_of(mask: Mask) -> tuple[int, int, int, int]:
    """Return the box x0, y0, x1, y1 of ``mask`` (H, W), the last pixel exclusive."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def hull_of(mask: Mask) -> Mask:
    """Return the convex hull (H, W) of ``mask``."""
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return hull > 0


def solidity_of(mask: Mask) -> float:
    """Return the share of its convex hull that ``mask`` fills."""
    return float(mask.sum()) / max(1.0, float(hull_of(mask).sum()))
