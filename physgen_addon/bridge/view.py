# SPDX-License-Identifier: GPL-3.0-or-later
"""What one frame's camera sees of the photo's images. Needs no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.scene.model import Camera


@dataclass(frozen=True)
class View:
    """The camera of a frame, and where each of its pixels is on the photo.

    The photo's own camera: every pixel is where it is.
    """

    camera: Camera

    def warp(self, image: NDArray[np.generic]) -> NDArray[np.generic]:
        """``image`` (H, W, …), drawn over the photo, as this camera sees it."""
        return image
