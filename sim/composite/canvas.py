# SPDX-License-Identifier: MIT
"""A picture with room around it: what a moved camera sees beyond the photo's borders is painted on from within."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import transfer
from .inpaint import FillOptions, inpaint

MAX_SHARE = 0.35
"""Of width or height, the widest border; beyond, a picture would show more invention than photo."""
STEP = 0.02
"""Borders are whole multiples of this share, so that a path that changes a little asks for the same picture."""
SOLVED_PX = 150_000
"""Pixels on which a border is searched for; finer detail comes from the photo afterwards."""
BAND, MIN_BAND_PX = 1.5, 64
"""Width of the band that a border is painted from, over the border's own, and the least in pixels."""
NEAR, NEAR_AGREES = 0.3, 4.0
"""Sources beyond this share of the border's width cost more, by this much at the end of the band."""
ROWS_AGREE, COLUMNS_AGREE = 2.5, 0.3
"""How much sources should lie at the same height beside, or at the same place across above and below."""
SPARE_PX = 3
"""What interpolation looks at beyond the last pixel."""


@dataclass(frozen=True)
class Borders:
    """Pixels added at each side."""

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0

    def __bool__(self) -> bool:
        return any((self.left, self.top, self.right, self.bottom))

    def inner(self, size: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the picture of ``size`` (width, height) on its canvas."""
        return slice(self.top, self.top + size[1]), slice(self.left, self.left + size[0])

    def padded(self, image: NDArray[Any]) -> NDArray[Any]:
        """``image`` (H, W, …) with its outermost pixels repeated outwards."""
        sides = [(self.top, self.bottom), (self.left, self.right), *[(0, 0)] * (image.ndim - 2)]
        return np.pad(image, sides, mode="edge") if self else image

    def faded(self, ratio: NDArray[np.float32]) -> NDArray[np.float32]:
        """``ratio`` (H, W, 3), above 0, continued outwards, where it goes to 1."""
        if not self:
            return ratio
        height, width = ratio.shape[:2]
        beyond = []
        for count, low, high in ((height, self.top, self.bottom), (width, self.left, self.right)):
            at = np.arange(count + low + high)
            share = np.maximum((low - at) / max(low, 1), (at - low - count + 1) / max(high, 1))
            beyond.append(np.clip(1.0 - share, 0.0, 1.0))
        weight = np.minimum(beyond[0][:, None], beyond[1][None, :])[..., None]
        # Eyes take light by ratios, so a shadow that ends softly does so as a power of itself.
        return np.asarray(self.padded(ratio) ** (weight * weight * (3.0 - 2.0 * weight)), dtype=np.float32)


def needed_borders(
    maps: Iterable[tuple[str, NDArray[np.floating]]], size: tuple[int, int], share: float = MAX_SHARE
) -> Borders:
    """Borders that hold all ``maps``: a name of the view, and where its pixels (..., 2) are on the picture of ``size``.

    Raises InputError, with the name, for a view that needs more than ``share`` of a side.
    """
    width, height = size
    wanted = np.zeros(4)
    for where, points in maps:
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not np.isfinite(flat).all():
            raise InputError(f"{where}: the camera sees what lies behind the photo's camera; give a smaller move")
        low, high = flat.min(axis=0), flat.max(axis=0)
        beyond = np.array([-low[0] / width, -low[1] / height, high[0] / width - 1.0, high[1] / height - 1.0])
        if beyond.max() > share:
            side = ("left", "top", "right", "bottom")[int(np.argmax(beyond))]
            percent = math.ceil(100 * beyond.max())
            raise InputError(
                f"{where}: the camera sees {percent} % beyond the photo's {side} border, of which at "
                f"most {100 * share:.0f} % can be painted on: give a smaller move, a zoom above 1, or a nearer "
                "backdrop_m"
            )
        wanted = np.maximum(wanted, beyond)
    # A view that reaches over the edge by less than rounding needs no border.
    steps = [math.ceil(value / STEP) if value > 1e-6 else 0 for value in wanted]
    sides = (width, height, width, height)
    return Borders(*(round(n * STEP * s) + SPARE_PX if n else 0 for n, s in zip(steps, sides, strict=True)))


def outpainted(image: transfer.Linear, borders: Borders, seed: int = 0) -> transfer.Linear:
    """``image`` (H, W, 3) continued into ``borders`` by PatchMatch; within, equal bit for bit.

    One side after the other, the upper and lower ones over the whole width. Each is painted from a band along it, and
    rather from the outermost pixels: a wall goes on as a wall, and what stands further in is not seen twice.
    Raises InputError when the inpainting library is missing.
    """
    pixels = transfer.linear_to_bytes(image)
    # Each side is turned to the left, painted there, and turned back.
    for turns, width, along in (
        (0, borders.left, ROWS_AGREE),
        (2, borders.right, ROWS_AGREE),
        (1, borders.top, COLUMNS_AGREE),
        (3, borders.bottom, COLUMNS_AGREE),
    ):
        if width:
            pixels = np.rot90(_outpainted_left(np.rot90(pixels, turns), width, along, seed), -turns)
    canvas = transfer.bytes_to_linear(np.ascontiguousarray(pixels))
    canvas[borders.inner((image.shape[1], image.shape[0]))] = image
    return canvas


def _outpainted_left(pixels: NDArray[np.uint8], width: int, along: float, seed: int) -> NDArray[np.uint8]:
    """``pixels`` (H, W, 3) continued by ``width`` columns on the left."""
    band = min(pixels.shape[1], max(round(BAND * width), MIN_BAND_PX))
    height = len(pixels)
    strip = np.ascontiguousarray(np.pad(pixels[:, :band], ((0, 0), (width, 0), (0, 0)), mode="edge"))
    hole = np.zeros(strip.shape[:2], dtype=bool)
    hole[:, :width] = True
    guide = np.zeros((*hole.shape, 2), dtype=np.float32)
    guide[..., 0] = along * np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    inward = np.maximum(np.arange(band) - NEAR * width, 0.0) / band
    guide[:, width:, 1] = NEAR_AGREES * inward
    filled = _filled(strip, hole, FillOptions(seed=seed, limit=SOLVED_PX), guide)
    return np.concatenate([filled[:, :width], pixels], axis=1)


def filled(image: transfer.Linear, hole: NDArray[np.bool_], seed: int = 0) -> transfer.Linear:
    """``image`` (H, W, 3) with ``hole`` (H, W) painted over from around it. Raises InputError as ``outpainted``."""
    if not hole.any():
        return image
    pixels = _filled(transfer.linear_to_bytes(image), hole, FillOptions(by_row=True, seed=seed), None)
    return np.where(hole[..., None], transfer.bytes_to_linear(pixels), image)


def _filled(
    pixels: NDArray[np.uint8], hole: NDArray[np.bool_], options: FillOptions, guide: NDArray[np.float32] | None
) -> NDArray[np.uint8]:
    try:
        return inpaint(pixels, hole, np.zeros_like(hole), options, guide)
    except ImportError as error:
        raise InputError(
            f"the inpainting library pypatchmatch is not installed ({error}); a camera that moves needs it to paint "
            "beyond the photo's borders: install it, or render without a camera path"
        ) from error


def remapped(image: NDArray[Any], at: NDArray[np.float32]) -> NDArray[Any]:
    """``image`` (H, W, …) at pixel positions ``at`` (h, w, 2), the centre of the top left pixel being 0.5, 0.5.

    Light and colours by cubic convolution, never below 0; a bool is True where any of the pixels around is.
    """
    x, y = at[..., 0] - np.float32(0.5), at[..., 1] - np.float32(0.5)
    if image.dtype == np.bool_:
        found = cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found > 0)
    if image.ndim == 2:
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    found = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(found, 0.0)


def grid(size: tuple[int, int], steps: int | None = None) -> NDArray[np.float64]:
    """Centres (h, w, 2) of the pixels of an image of ``size``; with ``steps``, as many points a side, edges too."""
    axes: Sequence[NDArray[Any]]
    if steps is None:
        axes = [np.arange(count) + 0.5 for count in size]
    else:
        axes = [np.linspace(0.0, count, steps) for count in size]
    return np.stack(np.meshgrid(*axes), axis=-1)
