# SPDX-License-Identifier: MIT
"""Whether the camera stood still: corners beside the objects must not move."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .corners import find_corners
from .flow import follow
from .pose import Mask

STILL_PX = 1.0
"""Median shift of the background up to which the camera counts as fixed."""
EVERY = 5
"""Frames between two looks."""


class BackgroundWatch:
    """Compares frames with the first one. ``moved``: largest median shift of the background so far, px."""

    def __init__(self, grey: NDArray[np.uint8], objects: Mask) -> None:
        margin = max(5, min(grey.shape) // 20)
        covered = cv2.dilate(objects.astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0
        spacing = max(8.0, min(grey.shape) / 20)
        self._first = grey
        self._corners = find_corners(grey, ~covered, count=80, half=7, spacing=spacing, min_contrast=2.0)
        self.moved = 0.0

    def look(self, grey: NDArray[np.uint8]) -> None:
        """Take a frame (H, W) into account."""
        if len(self._corners) < 8:
            return
        ends, miss = follow(self._first, grey, self._corners, self._corners, 7)
        good = miss < 1.0
        if good.sum() >= 8:
            self.moved = max(self.moved, float(np.median(np.linalg.norm((ends - self._corners)[good], axis=1))))

    @property
    def warning(self) -> str | None:
        """What to tell the user, or None."""
        if len(self._corners) < 8:
            return "the background has too few points to tell whether the camera stood still"
        if self.moved > STILL_PX:
            return (
                f"the background moves by {self.moved:.1f} pixels: the camera was not fixed; what it did counts as "
                "motion of the objects. Film from a tripod, with stabilisation off"
            )
        return None
