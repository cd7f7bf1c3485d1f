# SPDX-License-Identifier: MIT
"""A box in a photo with its surroundings, and the copies of it on which outlines are searched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...srgb import cielab
from .mask_geometry import Mask, shrunk

Box = tuple[int, int, int, int]

TEXTURE = 0.8
"""Weight of the local standard deviation of lightness relative to lightness."""
FINE = 560
"""Longest side in pixels of the copy on which gaps, rods and the ends of limbs are searched."""
SMOOTHER, LEAST_TEXTURE, LEAST_SEEN = 0.7, 0.03, 10
"""Texture of a part over nearly the smoothest of the ground, below which it is no ground, and pixels from which that is
known; texture over lightness from which ground is rough enough to tell. A shoe's lining on asphalt has 0.55."""
PADDING = 0.35
"""Margin of background to learn from, over the box' longer side."""
EDGE = 3.0
"""Gradient of an edge, in CIELAB units per pixel."""


@dataclass(frozen=True)
class BoxCrop:
    """A small copy of the box and its surroundings.

    pixels: (h, w, 3) uint8 sRGB. lab: (h, w, 3) CIELAB, slightly smoothed. texture: (h, w). box: x0, y0, x1, y1.
    others: (h, w) pixels of other objects: neither this one nor its background. keep, drop: (h, w) pixels that the user
    says belong to the object, or to its background.
    """

    pixels: NDArray[np.uint8]
    lab: NDArray[np.float32]
    texture: NDArray[np.float32]
    box: Box
    others: Mask
    keep: Mask
    drop: Mask

    @property
    def inside(self) -> Mask:
        """Pixels (h, w) that may belong to the object."""
        x0, y0, x1, y1 = self.box
        result = np.zeros(self.others.shape, dtype=bool)
        result[y0:y1, x0:x1] = True
        return result & ~self.others & ~self.drop

    @property
    def outside(self) -> Mask:
        """Pixels (h, w) that are certainly background."""
        x0, y0, x1, y1 = self.box
        result = ~self.others
        result[y0:y1, x0:x1] = False
        return result | self.drop


def crop_around_box(
    pixels: NDArray[np.uint8], box: Box, others: Mask, *, keep: Mask | None = None, drop: Mask | None = None
) -> BoxCrop:
    """Return the ``BoxCrop`` of a small copy ``pixels`` (h, w, 3)."""
    empty = np.zeros(pixels.shape[:2], dtype=bool)
    return BoxCrop(
        pixels,
        cielab(pixels, blur=0.8),
        np.asarray(TEXTURE * texture_of(cielab(pixels)[..., 0]), dtype=np.float32),
        box,
        others,
        empty if keep is None else keep,
        empty if drop is None else drop,
    )


def padded(box: Box, shape: tuple[int, ...], whole: Callable[[float], int] = round) -> tuple[tuple[slice, slice], Box]:
    """Return the rows and columns of ``box`` and its surroundings in a picture of ``shape``, and ``box`` in them.

    whole: makes whole pixels of the margin.
    """
    x0, y0, x1, y1 = box
    pad = whole(PADDING * max(x1 - x0, y1 - y0)) + 2
    left, top = max(0, x0 - pad), max(0, y0 - pad)
    window = slice(top, min(shape[0], y1 + pad)), slice(left, min(shape[1], x1 + pad))
    return window, (x0 - left, y0 - top, x1 - left, y1 - top)


def texture_of(lightness: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the local deviation (h, w) of ``lightness`` (h, w), CIELAB, in the calmest window around each pixel: an
    edge between two plain surfaces is not texture."""
    mean = cv2.GaussianBlur(lightness, (0, 0), 2.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(lightness**2, (0, 0), 2.0) - mean**2, 0.0))
    return np.asarray(cv2.erode(spread, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))), dtype=np.float32)


def is_smoother(lightness: NDArray[np.float32], part: Mask, ground: Mask) -> bool:
    """Return whether ``part`` (h, w) has less texture than nearly all of the ``ground`` (h, w), lit as it is.

    lightness: (h, w) CIELAB. False for parts too small to tell, and on smooth ground.
    """
    inner = shrunk(part, 2)
    if inner.sum() < LEAST_SEEN or not ground.any():
        return False
    texture = texture_of(lightness) / (lightness + 16.0)
    least = float(np.quantile(texture[ground], 0.1))
    return least > LEAST_TEXTURE and float(np.median(texture[inner])) < SMOOTHER * least


def edge_strength(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the colour gradient (h, w) in CIELAB units per pixel."""
    across, down = (cv2.Sobel(lab, cv2.CV_32F, *direction, scale=1.0 / 8.0) for direction in ((1, 0), (0, 1)))
    return np.asarray(np.sqrt((across**2 + down**2).sum(axis=2)), dtype=np.float32)


def edge_crest(edges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest of ``edges`` (h, w), gradients, within a pixel: an outline one pixel off still lies on one."""
    return np.asarray(cv2.dilate(edges, np.ones((3, 3), np.uint8)), dtype=np.float32)


@dataclass(frozen=True)
class SmallCopy:
    """The way from a crop to a smaller copy of it and back. size, whole: width and height of copy and crop."""

    size: tuple[int, int]
    whole: tuple[int, int]
    scale: float

    def pixels(self, crop: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The copy (h, w, 3) of ``crop`` (H, W, 3)."""
        return np.asarray(cv2.resize(crop, self.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def share(self, mask: Mask) -> NDArray[np.float32]:
        """The share (h, w) of each pixel of the copy that ``mask`` (H, W) covers."""
        covered = cv2.resize(mask.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)
        return np.asarray(covered, dtype=np.float32)

    def mask(self, mask: Mask) -> Mask:
        """The pixels (h, w) of the copy that ``mask`` (H, W) covers by more than half."""
        return self.share(mask) > 0.5

    def box(self, box: Box) -> Box:
        """``box`` of the crop in pixels of the copy, one wide and high at least."""
        x0, y0, x1, y1 = (round(v * self.scale) for v in box)
        return x0, y0, max(x1, x0 + 1), max(y1, y0 + 1)

    def enlarged(self, mask: Mask) -> Mask:
        """``mask`` (h, w) of the copy at the crop's size (H, W), its outline interpolated."""
        return np.asarray(cv2.resize(mask.astype(np.float32), self.whole, interpolation=cv2.INTER_LINEAR) > 0.5)


def small_copy(shape: tuple[int, ...], longest: int) -> SmallCopy:
    """Return the way to a copy of a crop of ``shape`` whose longer side has ``longest`` pixels at most."""
    height, width = shape[:2]
    scale = min(1.0, longest / max(height, width))
    return SmallCopy((max(1, round(width * scale)), max(1, round(height * scale))), (width, height), scale)
