# SPDX-License-Identifier: MIT
"""What a user's own model must be like to take a stage's place: one function a stage.

Pictures are (H, W, 3) uint8 sRGB, masks (H, W) bool; the centre of the top left pixel is (0.5, 0.5). Functions must not
change what they are given, and must give equal answers to equal questions if the reconstruction is to be repeatable.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

STAGES = ("segmenter", "inpainter", "depth_estimator", "mesher")
"""Named as the options of the reconstruction are."""
MEANINGS = ("metric", "relative", "inverse")


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth along the camera's axis.

    values: (H, W) float; NaN or infinite where nothing is known, as in the sky.
    meaning: ``metric`` metres; ``relative`` depth of no known unit; ``inverse`` one over depth, of no known scale and
        zero, as Depth Anything and MiDaS give it.
    focal_px: focal length in pixels of the picture, or None.
    """

    values: NDArray[np.float32]
    meaning: str = "relative"
    focal_px: float | None = None


class Segmenter(Protocol):
    """Masks of what boxes hold."""

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Masks (N, H, W) bool of the things in ``boxes`` (N, 4): x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""


class Inpainter(Protocol):
    """Holes filled with what might be behind."""

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """``pixels`` with ``hole`` filled; outside it they stay as they are."""


class DepthEstimator(Protocol):
    """Depth of a photo."""

    def __call__(self, pixels: Pixels) -> Depth:
        """The depth of each pixel."""


class Mesher(Protocol):
    """A mesh of one thing in the photo."""

    def __call__(self, pixels: Pixels, mask: Mask, folder: Path) -> Path:
        """A mesh file (.glb, .gltf, .obj, .ply, .stl), written into ``folder``, of what ``mask`` shows.

        Its scale and axes are its own; ``object_crop`` makes the picture that most models take.
        """
