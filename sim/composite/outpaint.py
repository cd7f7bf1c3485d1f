# SPDX-License-Identifier: MIT
"""Borders outpainted around the photo for a moving camera, and resampling on that canvas."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import srgb
from ..errors import InputError
from ..smoothstep import smoothstep
from .inpaint import FillOptions, inpaint

MAX_SHARE = 0.35
"""Widest border over width or height; beyond, an image would be more invention than photo."""
BORDER_STEP = 0.02
"""Borders are multiples of this share, so that a slightly changed path needs the same image."""
SOLVED_PX = 150_000
"""Pixels on which PatchMatch solves a border; finer detail is added from the photo."""
BAND, MIN_BAND_PX = 1.5, 64
"""Width of the source band over the border's width, and its least pixels."""
NEAR, NEAR_AGREES = 0.3, 4.0
"""Sources farther than this share of the border's width cost more, up to this much at the end of the band."""
ROWS_AGREE, COLUMNS_AGREE = 2.5, 0.3
"""Weight of sources at the same row (left and right borders) or column (top and bottom)."""
SPARE_PX = 3
"""Margin for interpolation beyond the last pixel."""


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
        """Return the rows and columns of an image of ``size`` (width, height) on its canvas."""
        return slice(self.top, self.top + size[1]), slice(self.left, self.left + size[0])

    def padded(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return ``image`` (H, W, …) with its edge pixels repeated outwards."""
        sides = [(self.top, self.bottom), (self.left, self.right), *[(0, 0)] * (image.ndim - 2)]
        return np.pad(image, sides, mode="edge") if self else image

    def faded(self, ratio: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return ``ratio`` (H, W, 3), above 0, continued outwards and fading to 1."""
        if not self:
            return ratio
        height, width = ratio.shape[:2]
        beyond = []
        for count, low, high in ((height, self.top, self.bottom), (width, self.left, self.right)):
            at = np.arange(count + low + high)
            share = np.maximum((low - at) / max(low, 1), (at - low - count + 1) / max(high, 1))
            beyond.append(np.clip(1.0 - share, 0.0, 1.0))
        weight = np.minimum(beyond[0][:, None], beyond[1][None, :])[..., None]
        # Perception is logarithmic, so a shadow fades as a power of itself.
        return np.asarray(self.padded(ratio) ** smoothstep(weight), dtype=np.float32)


def needed_borders(
    maps: Iterable[tuple[str, NDArray[np.floating]]], size: tuple[int, int], share: float = MAX_SHARE
) -> Borders:
    """Return borders that contain all ``maps``: a view's name, and its pixels (..., 2) on the photo of ``size``.

    Raises InputError with the view's name if it needs more than ``share`` of a side.
    """
    width, height = size
    wanted = np.zeros(4)
    for where, points in maps:
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not np.isfinite(flat).all():
            raise InputError(f"{where}: the view includes points behind the photo's camera; give a smaller move")
        low, high = flat.min(axis=0), flat.max(axis=0)
        beyond = np.array([-low[0] / width, -low[1] / height, high[0] / width - 1.0, high[1] / height - 1.0])
        if beyond.max() > share:
            side = ("left", "top", "right", "bottom")[int(np.argmax(beyond))]
            percent = math.ceil(100 * beyond.max())
            raise InputError(
                f"{where}: the camera sees {percent} % beyond the photo's {side} border, of which at "
                f"most {100 * share:.0f} % can be outpainted: give a smaller move, a zoom above 1, or a nearer "
                "backdrop_m"
            )
        wanted = np.maximum(wanted, beyond)
    # Reaching over the edge by rounding alone needs no border.
    steps = [math.ceil(value / BORDER_STEP) if value > 1e-6 else 0 for value in wanted]
    sides = (width, height, width, height)
    return Borders(*(round(n * BORDER_STEP * s) + SPARE_PX if n else 0 for n, s in zip(steps, sides, strict=True)))


def outpaint(image: srgb.Linear, borders: Borders, seed: int = 0) -> srgb.Linear:
    """Return ``image`` (H, W, 3) outpainted into ``borders`` by PatchMatch; inside, equal bit for bit.

    One side after the other, top and bottom over the whole width. Each is painted from a band along it, preferably from
    the outermost pixels, so that a wall continues and objects further in are not repeated. Raises InputError when the
    inpainting library is missing.
    """
    pixels = srgb.linear_to_bytes(image)
    # Each side is rotated to the left, painted, and rotated back.
    for turns, width, along in (
        (0, borders.left, ROWS_AGREE),
        (2, borders.right, ROWS_AGREE),
        (1, borders.top, COLUMNS_AGREE),
        (3, borders.bottom, COLUMNS_AGREE),
    ):
        if width:
            pixels = np.rot90(_outpainted_left(np.rot90(pixels, turns), width, along, seed), -turns)
    canvas = srgb.bytes_to_linear(np.ascontiguousarray(pixels))
    canvas[borders.inner((image.shape[1], image.shape[0]))] = image
    return canvas


def _outpainted_left(pixels: NDArray[np.uint8], width: int, along: float, seed: int) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) outpainted by ``width`` columns on the left."""
    band = min(pixels.shape[1], max(round(BAND * width), MIN_BAND_PX))
    height = len(pixels)
    strip = np.ascontiguousarray(np.pad(pixels[:, :band], ((0, 0), (width, 0), (0, 0)), mode="edge"))
    hole = np.zeros(strip.shape[:2], dtype=bool)
    hole[:, :width] = True
    guide = np.zeros((*hole.shape, 2), dtype=np.float32)
    guide[..., 0] = along * np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    inward = np.maximum(np.arange(band) - NEAR * width, 0.0) / band
    guide[:, width:, 1] = NEAR_AGREES * inward
    filled = _inpainted(strip, hole, FillOptions(seed=seed, limit=SOLVED_PX), guide)
    return np.concatenate([filled[:, :width], pixels], axis=1)


def inpaint_hole(image: srgb.Linear, hole: NDArray[np.bool_], seed: int = 0) -> srgb.Linear:
    """Return ``image`` (H, W, 3) with ``hole`` (H, W) inpainted. Raises InputError as ``outpaint``."""
    if not hole.any():
        return image
    pixels = _inpainted(srgb.linear_to_bytes(image), hole, FillOptions(by_row=True, seed=seed), None)
    return np.where(hole[..., None], srgb.bytes_to_linear(pixels), image)


def _inpainted(
    pixels: NDArray[np.uint8], hole: NDArray[np.bool_], options: FillOptions, guide: NDArray[np.float32] | None
) -> NDArray[np.uint8]:
    try:
        return inpaint(pixels, hole, np.zeros_like(hole), options, guide)
    except ImportError as error:
        raise InputError(
            f"the inpainting library pypatchmatch is not installed ({error}); a moving camera needs it beyond the "
            "photo's borders: install it, or render without a camera path"
        ) from error


def resample(image: NDArray[Any], at: NDArray[np.float32]) -> NDArray[Any]:
    """Return ``image`` (H, W, …) sampled at pixels ``at`` (h, w, 2), the centre of the top left pixel being 0.5, 0.5.

    Colours by cubic convolution, never below 0; a boolean is True where any pixel around is.
    """
    x, y = at[..., 0] - np.float32(0.5), at[..., 1] - np.float32(0.5)
    if image.dtype == np.bool_:
        found = cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found > 0)
    if image.ndim == 2:
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    found = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(found, 0.0)


def pixel_grid(size: tuple[int, int], steps: int | None = None) -> NDArray[np.float64]:
    """Return pixel centres (h, w, 2) of an image of ``size``; with ``steps``, that many points per side with edges."""
    axes: Sequence[NDArray[Any]]
    if steps is None:
        axes = [np.arange(count) + 0.5 for count in size]
    else:
        axes = [np.linspace(0.0, count, steps) for count in size]
    return np.stack(np.meshgrid(*axes), axis=-1)
