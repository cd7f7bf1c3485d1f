# SPDX-License-Identifier: MIT
"""What a doubtful mask gives notice of: a second object, the ground's colours, a box or photo that cuts the object."""

from __future__ import annotations

import cv2
import numpy as np

from .box_crop import Box, BoxCrop
from .colour_models import ground_likelihood
from .mask_geometry import Mask, shrunk

SECOND = 0.35
"""Area over the larger object's above which a second object in the box gives a notice."""


def mask_warnings(view: BoxCrop, raw: Mask, kept: Mask) -> list[str]:
    """Return notices about ``kept`` (h, w), the part of the proposal ``raw`` that is used for the object."""
    if kept.sum() < 20:
        return []
    messages = []
    count, _, stats, _ = cv2.connectedComponentsWithStats((raw & ~kept).astype(np.uint8), connectivity=8)
    second = int(stats[1:count, cv2.CC_STAT_AREA].max(initial=0))
    if second > SECOND * int(kept.sum()):
        messages.append(
            "its box seems to hold two separate objects; the larger one is used: draw a box around each, "
            "or give a painted mask that contains both"
        )
    if _like_surroundings(view, kept):
        messages.append(
            "looks much like its surroundings, as glass, mirrors and objects of the ground's colour do; "
            "its mask may be wrong: check it, and give a painted mask if it is"
        )
    return messages


def _like_surroundings(view: BoxCrop, kept: Mask, share: float = 0.5) -> bool:
    """Return whether more than ``share`` of the object's interior could be ground, by colour, texture and position."""
    inner = shrunk(kept, 2)
    outside = view.outside
    if inner.sum() < 50 or outside.sum() < 200:
        return False
    usual = float(np.quantile(ground_likelihood(view, outside, outside, ()), 0.1))
    return float((ground_likelihood(view, outside, inner, ()) > usual).mean()) > share


def continued_sides(view: BoxCrop, kept: Mask, share: float = 0.2) -> list[str]:
    """Return sides of the box, inside the photo, beyond which ``kept`` (h, w) seems to continue for ``share`` of the
    side.

    The mask comes close to the side there, and the colour just beyond equals that at its edge.
    """
    x0, y0, x1, y1 = view.box
    result = []
    for name, turns in (("top", 0), ("right", 1), ("bottom", 2), ("left", 3)):
        # Rotated so that the side in question is the upper one.
        mask, lab = np.rot90(kept, turns), np.rot90(view.lab, turns)
        inside = np.zeros(kept.shape, dtype=bool)
        inside[y0:y1, x0:x1] = True
        rows, columns = (np.flatnonzero(np.rot90(inside, turns).any(axis=axis)) for axis in (1, 0))
        upper, near = int(rows[0]), max(3, round(0.1 * len(rows)))
        if upper < 3:
            continue
        strip = mask[upper : upper + near, columns]
        edge = np.where(strip.any(axis=0), strip.argmax(axis=0), 0) + upper
        # Two pixels inside the edge, where colours are not mixed.
        own, beyond = lab[np.minimum(edge + 2, len(lab) - 1), columns], lab[upper - 3, columns]
        alike = strip.any(axis=0) & (np.linalg.norm(own - beyond, axis=1) < 9.0)
        if alike.sum() > share * len(columns):
            result.append(name)
    return result


def photo_sides(mask: Mask, share: float = 0.1) -> list[str]:
    """Return photo borders along which ``mask`` runs for more than ``share`` of its own extent in that direction."""
    if not mask.any():
        return []
    wide, high = (float(mask.any(axis=axis).sum()) for axis in (0, 1))
    edges = (
        ("left", mask[:, 0], high),
        ("top", mask[0], wide),
        ("right", mask[:, -1], high),
        ("bottom", mask[-1], wide),
    )
    return [name for name, edge, extent in edges if edge.sum() > share * extent]


def touched_sides(mask: Mask, box: Box, share: float = 0.2) -> list[str]:
    """Return sides of ``box``, inside the photo, of which ``mask`` (H, W) touches more than ``share``."""
    height, width = mask.shape
    x0, y0, x1, y1 = box
    sides = (
        ("left", x0 > 0, mask[y0:y1, x0]),
        ("top", y0 > 0, mask[y0, x0:x1]),
        ("right", x1 < width, mask[y0:y1, x1 - 1]),
        ("bottom", y1 < height, mask[y1 - 1, x0:x1]),
    )
    return [name for name, inside, edge in sides if inside and edge.mean() > share]
