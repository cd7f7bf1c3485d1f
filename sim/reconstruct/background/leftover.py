# SPDX-License-Identifier: MIT
"""Darkness that an object leaves around its hole: shadow that was not taken for one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

NEAR = 0.15
"""How far from the hole such darkness reaches, over the hole's size."""
DARKER = 0.15
"""Logarithm by which it is darker than nearly all of the surroundings farther away."""
NEARLY_ALL = 8.0
"""Percentile of the surroundings that stands for their darkest: beyond it, darkness is usual there."""
LEAST, MOST = 0.1, 0.8
"""Share of a hole's lower rim that such darkness takes up: less is a joint between tiles, more the surface itself."""


def left_over(logs: Picture, part: Mask, closed: Mask) -> Mask:
    """Pixels (H, W) beside ``part`` of the hole that are in shadow still, and so are no source for its filling.

    logs: (H, W, 3) logarithms of the photo's values, true where not ``closed``.
    """
    result = np.zeros_like(part)
    rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    side = float(np.sqrt(part.sum()))
    room = round(0.8 * side) + 8
    window = (
        slice(max(0, int(rows[0]) - room), int(rows[-1]) + 1 + room),
        slice(max(0, int(columns[0]) - room), int(columns[-1]) + 1 + room),
    )
    inside, known = part[window], ~closed[window]
    light = cv2.blur(np.ascontiguousarray(logs[window].mean(axis=-1)), (3, 3))
    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    # The foot of what stood there, where shadow lies, is in the lower half of its hole.
    lower = np.arange(inside.shape[0])[:, None] > float(np.nonzero(inside)[0].mean())
    reach = max(NEAR * side, 3.0)
    near, far = known & (away <= reach) & lower, known & (away > 1.5 * reach) & lower
    if near.sum() < 16 or far.sum() < 100:
        return result
    dark = near & (light < np.percentile(light[far], NEARLY_ALL) - DARKER)
    if not LEAST * near.sum() < dark.sum() < MOST * near.sum():
        return result
    # Only what hangs together with the hole.
    count, labels = cv2.connectedComponents((dark | inside).astype(np.uint8), connectivity=8)
    joined = np.isin(labels, np.unique(labels[inside])) if count > 2 else np.ones_like(inside)
    dark = cv2.dilate((dark & joined).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    result[window] = dark & near
    return result
