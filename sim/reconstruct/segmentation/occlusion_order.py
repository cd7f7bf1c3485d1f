# SPDX-License-Identifier: MIT
"""Occlusion order of objects, from their outlines, ground contacts and a depth map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

SIDE = 320
"""Longest side in pixels of the copy in which masks are compared."""
TOUCH = 3
"""Gap in pixels of that copy up to which two masks share a border."""
WEIGHTS = {"depth": 4.0, "junctions": 2.8, "within": 2.6, "contact": 1.6}
"""Weight of each cue (-1 to 1): logistic regression on drawn solids, in a row and on top of each other."""
REASONS = {
    "depth": "the depth map shows it nearer",
    "junctions": "its outline continues smoothly where the two part",
    "within": "it lies within the other's outline",
    "contact": "it meets the ground lower in the picture",
}


@dataclass(frozen=True)
class Occlusion:
    """``front`` is in front of ``behind`` (indices of masks).

    confidence: 0 (a guess) to 1. reason: the strongest cue, in words. touching: whether they share a border, so that
    ``front`` may hide a part of ``behind``.
    """

    front: int
    behind: int
    confidence: float
    reason: str
    touching: bool


@dataclass(frozen=True)
class Order:
    """front_to_back: indices of masks. pairs: one entry for every two objects, most certain first."""

    front_to_back: tuple[int, ...]
    pairs: tuple[Occlusion, ...]


def occlusion_order(
    masks: Sequence[Mask],
    *,
    depth: NDArray[np.floating] | None = None,
    contacts: Sequence[float] | None = None,
) -> Order:
    """Return the order of objects from front to back.

    masks: (H, W) each, visible pixels; none empty. depth: (H, W) metres, NaN where unknown. contacts: the row in which
    each object meets the ground; None uses the lowest row of its mask. In a cycle the least certain pair is dropped
    (Tideman's ranked pairs, Social Choice and Welfare 1987).
    """
    rows = [float(np.flatnonzero(mask.any(axis=1))[-1]) for mask in masks] if contacts is None else list(contacts)
    scale = min(1.0, SIDE / max(masks[0].shape)) if len(masks) else 1.0
    small = [_shrunk(mask, scale) for mask in masks]
    pairs = [
        _compare(i, j, (small[i], small[j]), (masks[i], masks[j]), depth, (rows[i] * scale, rows[j] * scale))
        for i in range(len(masks))
        for j in range(i + 1, len(masks))
    ]
    pairs.sort(key=lambda pair: (-pair.confidence, pair.front, pair.behind))
    return Order(_ranked(len(masks), pairs), tuple(pairs))


def _ranked(count: int, pairs: Sequence[Occlusion]) -> tuple[int, ...]:
    """The order that follows from ``pairs``, most certain first, skipping pairs that would close a cycle."""
    before = np.zeros((count, count), dtype=bool)
    for pair in pairs:
        if before[pair.behind, pair.front]:
            continue
        nearer = before[:, pair.front].copy()
        nearer[pair.front] = True
        farther = before[pair.behind].copy()
        farther[pair.behind] = True
        before |= nearer[:, None] & farther[None, :]
    # Every two objects are compared, so each has a distinct number of predecessors.
    return tuple(int(index) for index in np.argsort(before.sum(axis=0), kind="stable"))


def _compare(
    i: int,
    j: int,
    small: tuple[Mask, Mask],
    masks: tuple[Mask, Mask],
    depth: NDArray[np.floating] | None,
    rows: tuple[float, float],
) -> Occlusion:
    findings: dict[str, float] = {}
    heights = [float(np.ptp(np.flatnonzero(mask.any(axis=1)))) + 1.0 for mask in small]
    findings["contact"] = float(np.tanh((rows[0] - rows[1]) / (0.15 * min(heights))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * TOUCH + 1, 2 * TOUCH + 1))
    grown = [cv2.dilate(mask.astype(np.uint8), kernel) > 0 for mask in small]
    touching = bool((grown[0] & grown[1]).any())
    if depth is not None:
        findings["depth"] = _nearer(masks, depth)
    if touching:
        findings["within"] = _within(*small)
        findings["junctions"] = _junctions(small, grown)
    total = sum(WEIGHTS[name] * value for name, value in findings.items())
    if total == 0.0:
        # No evidence: keep the given order.
        return Occlusion(i, j, 0.0, "no evidence; kept in the given order", touching)
    sign = 1.0 if total > 0.0 else -1.0
    reason = max(findings, key=lambda name: sign * WEIGHTS[name] * findings[name])
    confidence = float(np.tanh(abs(total) / 2.0))
    front, behind = (i, j) if total > 0.0 else (j, i)
    return Occlusion(front, behind, confidence, REASONS[reason], touching)


def _within(first: Mask, second: Mask) -> float:
    """1 if ``first`` lies within the convex hull of ``second``, -1 the other way round: a toy on a chair."""
    inside_second = float((_hull(second) & first).sum()) / float(first.sum())
    inside_first = float((_hull(first) & second).sum()) / float(second.sum())
    return inside_second - inside_first


def _junctions(masks: tuple[Mask, Mask], grown: Sequence[Mask]) -> float:
    """1 if, at the ends of the shared border, the first outline continues straight and the second bends; -1 vice versa.

    The outline of an occluder does not change where the other outline ends at it (T-junction).
    """
    turns = [_turning(own, other) for own, other in ((masks[0], grown[1]), (masks[1], grown[0]))]
    if turns[0] is None or turns[1] is None:
        return 0.0
    return float(np.clip((turns[1] - turns[0]) / 1.0, -1.0, 1.0))


def _turning(mask: Mask, other: Mask) -> float | None:
    """Mean angle in radians by which the outline of ``mask`` turns where it leaves ``other``; None if it never does."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=len)[:, 0, :].astype(np.float64)
    count = len(contour)
    shared = other[contour[:, 1].astype(int), contour[:, 0].astype(int)]
    reach = max(4, round(0.05 * count))
    angles = []
    for end in np.flatnonzero(shared != np.roll(shared, -1)):
        # The change is detected up to TOUCH pixels early or late: skip these on both sides.
        gap = TOUCH + 1
        behind = contour[(end - gap - np.arange(reach)) % count]
        ahead = contour[(end + 1 + gap + np.arange(reach)) % count]
        arriving, leaving = behind[0] - behind[-1], ahead[-1] - ahead[0]
        norm = float(np.linalg.norm(arriving) * np.linalg.norm(leaving))
        if norm > 0.0:
            angles.append(float(np.arccos(np.clip(arriving @ leaving / norm, -1.0, 1.0))))
    return float(np.mean(angles)) if angles else None


def _nearer(masks: tuple[Mask, Mask], depth: NDArray[np.floating]) -> float:
    """1 if the first is clearly nearer in ``depth`` (metres), -1 if the second is; 0 where it is unknown."""
    medians = []
    for mask in masks:
        known = depth[mask & np.isfinite(depth)]
        if len(known) < 10:
            return 0.0
        medians.append(float(np.median(known)))
    return float(np.tanh((medians[1] - medians[0]) / (0.05 * max(1e-9, abs(min(medians))))))


def _shrunk(mask: Mask, scale: float) -> Mask:
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    small = np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)
    if small.any() or not mask.any():
        return small
    # Thinner than a pixel of the copy: keep every pixel that it touches.
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.0)


def _hull(mask: Mask) -> Mask:
    points = np.argwhere(mask)[:, ::-1].astype(np.int32)
    drawn = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(points), 1)
    return np.asarray(drawn > 0)
