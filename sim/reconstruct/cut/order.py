# SPDX-License-Identifier: MIT
"""Who stands in front of whom, by outlines, feet on the ground and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

SIDE = 320
"""Longest side in pixels of the copy in which outlines are compared."""
TOUCH = 3
"""Pixels of that copy by which two masks may be apart and still share a border."""
WEIGHTS = {"depth": 4.0, "junctions": 2.8, "within": 2.6, "contact": 1.6}
"""How much each finding (-1 to 1) counts: logistic regression on drawn solids, in a row and one on top of another."""
REASONS = {
    "depth": "the depth map shows it nearer",
    "junctions": "its outline runs on smoothly where the two part",
    "within": "it lies within the other's outline",
    "contact": "it meets the ground lower in the picture",
}


@dataclass(frozen=True)
class Occlusion:
    """``front`` stands before ``behind`` (positions in the list of masks).

    confidence: 0 (a guess) to 1. reason: the finding that counted most, in words. touching: whether they share a
    border, so that ``front`` may hide a part of ``behind``.
    """

    front: int
    behind: int
    confidence: float
    reason: str
    touching: bool


@dataclass(frozen=True)
class Order:
    """front_to_back: positions in the list of masks. pairs: one finding for every two objects, surest first."""

    front_to_back: tuple[int, ...]
    pairs: tuple[Occlusion, ...]

    def in_front_of(self, index: int) -> tuple[int, ...]:
        """The objects that come before ``index`` and share a border with it: what may hide a part of it."""
        before = set(self.front_to_back[: self.front_to_back.index(index)])
        touching = {frozenset((pair.front, pair.behind)) for pair in self.pairs if pair.touching}
        return tuple(other for other in self.front_to_back if other in before and frozenset((other, index)) in touching)


def occlusion_order(
    masks: Sequence[Mask],
    *,
    depth: NDArray[np.floating] | None = None,
    contacts: Sequence[float] | None = None,
) -> Order:
    """Put objects in order from the front to the back.

    masks: (H, W) each, what is seen of the objects; none empty. depth: (H, W) metres, NaN where unknown. contacts:
    the row in which each object meets the ground; None takes the lowest row of its mask. Where findings contradict
    each other in a circle the weakest gives way (Tideman's ranked pairs, Social Choice and Welfare 1987).
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
    """The order that follows from ``pairs``, surest first, leaving out those that would close a circle."""
    before = np.zeros((count, count), dtype=bool)
    for pair in pairs:
        if before[pair.behind, pair.front]:
            continue
        nearer = before[:, pair.front].copy()
        nearer[pair.front] = True
        farther = before[pair.behind].copy()
        farther[pair.behind] = True
        before |= nearer[:, None] & farther[None, :]
    # Every two objects are compared, so each has its own number of objects before it.
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
        # Nothing tells them apart: as they were given.
        return Occlusion(i, j, 0.0, "nothing tells; taken as given", touching)
    sign = 1.0 if total > 0.0 else -1.0
    reason = max(findings, key=lambda name: sign * WEIGHTS[name] * findings[name])
    confidence = float(np.tanh(abs(total) / 2.0))
    front, behind = (i, j) if total > 0.0 else (j, i)
    return Occlusion(front, behind, confidence, REASONS[reason], touching)


def _within(first: Mask, second: Mask) -> float:
    """1 where ``first`` lies within the convex hull of ``second``, -1 the other way round: a toy on a chair."""
    inside_second = float((_hull(second) & first).sum()) / float(first.sum())
    inside_first = float((_hull(first) & second).sum()) / float(second.sum())
    return inside_second - inside_first


def _junctions(masks: tuple[Mask, Mask], grown: Sequence[Mask]) -> float:
    """1 where, at the ends of the shared border, the first outline runs on straight and the second bends off.

    The outline of what stands in front does not change where the other thing's outline ends at it (T-junction).
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
        # The change is read off TOUCH pixels early or late: leave these out on both sides.
        gap = TOUCH + 1
        behind = contour[(end - gap - np.arange(reach)) % count]
        ahead = contour[(end + 1 + gap + np.arange(reach)) % count]
        arriving, leaving = behind[0] - behind[-1], ahead[-1] - ahead[0]
        norm = float(np.linalg.norm(arriving) * np.linalg.norm(leaving))
        if norm > 0.0:
            angles.append(float(np.arccos(np.clip(arriving @ leaving / norm, -1.0, 1.0))))
    return float(np.mean(angles)) if angles else None


def _nearer(masks: tuple[Mask, Mask], depth: NDArray[np.floating]) -> float:
    """1 where the first is clearly nearer in ``depth`` (metres), -1 where the second is; 0 where it is unknown."""
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
    # Thinner than a pixel of the copy: keep where it is.
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.0)


def _hull(mask: Mask) -> Mask:
    points = np.argwhere(mask)[:, ::-1].astype(np.int32)
    drawn = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(points), 1)
    return np.asarray(drawn > 0)
