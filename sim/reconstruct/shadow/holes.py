# SPDX-License-Identifier: MIT
"""The hole that an object and its shadow leave together (PhysGen3D, supplement A.2)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cut.mask_cleanup import enclosed_holes

Mask = NDArray[np.bool_]

PENUMBRA_DILATION = 20.0
"""Side of the kernel in a photo of 1024 pixels where shadows come with their soft borders (``find.cast_shadows``).
With the paper's 50 around the shadow alone the hole is as large, but more darkness stays outside it."""


def object_holes(masks: Sequence[Mask], shadows: Sequence[Mask], dilation: float) -> list[Mask]:
    """What each object leaves behind: mask and shadow, dilated, but never over another object.

    shadows: (H, W), best with their soft borders. dilation: side of the kernel in pixels of this photo; half of it is
    what an outline is covered by. An object's hole may reach another object's shadow.
    """
    side = max(1, round(dilation)) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    holes = []
    for index, (mask, shadow) in enumerate(zip(masks, shadows, strict=True)):
        hole = cv2.dilate((mask | shadow).astype(np.uint8), kernel) > 0
        # What is left of the photo inside a strap would stand there as an island.
        hole |= enclosed_holes(hole)
        for other, blocked in enumerate(masks):
            if other != index:
                hole &= ~(blocked & ~mask)
        holes.append(np.asarray(hole))
    return holes
