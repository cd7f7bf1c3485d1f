# SPDX-License-Identifier: MIT
"""Inpainting from a picture of the scene without its objects, edited or photographed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...errors import InputError
from ..photo import load_photo
from .protocols import Mask, Pixels, checked_pixels

MAX_SIDE = 8192
RATIO = 0.01
"""Largest relative difference between its aspect ratio and the photo's."""


@dataclass(frozen=True, eq=False)
class PictureInpainter:
    """``protocols.Inpainter`` from a picture of the photo's aspect ratio."""

    picture: Pixels
    where: str

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """As the protocol says. Raises InputError for a picture of another aspect ratio than the photo's."""
        height, width = pixels.shape[:2]
        found = self.picture.shape[:2]
        if abs(found[1] * height / (found[0] * width) - 1) > RATIO:
            raise InputError(
                f"{self.where}: has {found[1]}x{found[0]} pixels, the photo {width}x{height}; give a picture of the "
                "same view and aspect ratio"
            )
        picture = self.picture
        if found != (height, width):
            way = cv2.INTER_AREA if found[0] > height else cv2.INTER_CUBIC
            picture = np.asarray(cv2.resize(picture, (width, height), interpolation=way), dtype=np.uint8)
        return checked_pixels(picture, pixels, hole, self.where)


def load_picture(path: Path, where: str) -> PictureInpainter:
    """Return an inpainter from the picture ``path``, upright. Raises InputError."""
    try:
        return PictureInpainter(load_photo(path, MAX_SIDE).pixels, where)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
