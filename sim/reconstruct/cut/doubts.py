# SPDX-License-Identifier: MIT
"""What is doubtful about a mask, in words for the user."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .propose import View, edge_strength, ground_likelihood

Mask = NDArray[np.bool_]

SECOND = 0.35
"""A second thing in the box is told of when it is at least this large against the larger one."""


def doubts(view: View, raw: Mask, kept: Mask) -> list[str]:
    """Notices about ``kept`` (h, w), the part of the guess ``raw`` that is taken for the object."""
    if kept.sum() < 20:
        return []
    told = []
    count, _, stats, _ = cv2.connectedComponentsWithStats((raw & ~kept).astype(np.uint8), connectivity=8)
    second = int(stats[1:count, cv2.CC_STAT_AREA].max(initial=0))
    if second > SECOND * int(kept.sum()):
        told.append(
            "its box seems to hold two separate things; the larger one is kept: draw a box around each, "
            "or give a painted mask that holds both"
        )
    if _like_surroundings(view, kept):
        told.append(
            "looks inside its outline much like its surroundings, as glass, mirrors and things of the ground's "
            "colour do; its mask may be wrong: look at it, and give a painted mask if it is"
        )
    return told


def _like_surroundings(view: View, kept: Mask, share: float = 0.5) -> bool:
    """Whether more than ``share`` of the object's inside could as well be ground, by colour, texture and place."""
    inner = cv2.erode(kept.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    outside = view.outside
    if inner.sum() < 50 or outside.sum() < 200:
        return False
    usual = float(np.quantile(ground_likelihood(view, outside, outside, ()), 0.1))
    return float((ground_likelihood(view, outside, inner, ()) > usual).mean()) > share


def cut_sides(view: View, kept: Mask, share: float = 0.2) -> list[str]:
    """Sides of the box, inside the photo, beyond which ``kept`` (h, w) seems to go on for ``share`` of the side.

    It comes close to the side there, and what lies just beyond has the colour it has at its edge.
    """
    x0, y0, x1, y1 = view.box
    result = []
    for name, turns in (("top", 0), ("right", 1), ("bottom", 2), ("left", 3)):
        # Turned so that the side in question is the upper one.
        mask, lab = np.rot90(kept, turns), np.rot90(view.lab, turns)
        inside = np.zeros(kept.shape, dtype=bool)
        inside[y0:y1, x0:x1] = True
        rows, columns = (np.flatnonzero(np.rot90(inside, turns).any(axis=axis)) for axis in (1, 0))
        upper, near = int(rows[0]), max(3, round(0.1 * len(rows)))
        if upper < 3:
            continue
        strip = mask[upper : upper + near, columns]
        edge = np.where(strip.any(axis=0), strip.argmax(axis=0), 0) + upper
        # Two pixels within the edge, where colours are not mixed any more.
        own, beyond = lab[np.minimum(edge + 2, len(lab) - 1), columns], lab[upper - 3, columns]
        alike = strip.any(axis=0) & (np.linalg.norm(own - beyond, axis=1) < 9.0)
        if alike.sum() > share * len(columns):
            result.append(name)
    return result


def outline_strength(view: View, kept: Mask) -> float:
    """Median change of colour across the outline, in CIELAB units per pixel."""
    kernel = np.ones((3, 3), np.uint8)
    binary = kept.astype(np.uint8)
    outline = (cv2.dilate(binary, kernel) > 0) & ~(cv2.erode(binary, kernel, borderValue=0) > 0)
    return float(np.median(edge_strength(view.lab)[outline])) if outline.any() else 0.0
