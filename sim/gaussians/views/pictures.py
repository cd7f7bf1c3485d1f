# SPDX-License-Identifier: MIT
"""Picture files of other programs as arrays, within bounds."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ...errors import InputError

MAX_PIXELS = 2**26
"""Of all the pictures of an object together: 1 GiB of colours and masks as float32."""

FORMATS = ("PNG", "JPEG", "WEBP", "BMP")
_DAMAGED = (OSError, UnidentifiedImageError, ValueError, SyntaxError, struct.error, Image.DecompressionBombError)
"""What Pillow raises for garbage."""

Colours = NDArray[np.float32]


class Budget:
    """How many pixels may still be read."""

    def __init__(self) -> None:
        self._left = MAX_PIXELS

    def take(self, width: int, height: int, path: Path) -> None:
        """Raise InputError when ``path`` is more than what is left."""
        self._left -= width * height
        if self._left < 0:
            raise InputError(
                f"{path}: with its {width}x{height} pixels the views have more than {MAX_PIXELS >> 20} Mi pixels: give "
                "fewer views, or smaller ones"
            )


def read_colours(path: Path, budget: Budget) -> tuple[Colours, Colours | None]:
    """Colours (H, W, 3) and opacity (H, W), both 0 to 1; None for pictures that are opaque all over.

    Raises InputError when the file is missing, no picture, or too large.
    """
    image = _opened(path, budget)
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        pixels = _shares(image.convert("RGBA"), 255)
        # Many programs write opacity without having any.
        if pixels[..., 3].min() < 1:
            return pixels[..., :3], pixels[..., 3]
        return pixels[..., :3], None
    return _shares(image.convert("RGB"), 255), None


def read_share(path: Path, size: tuple[int, int], budget: Budget) -> Colours:
    """(H, W) a mask file as shares of 0 to 1: its brightness, or its opacity where it has one.

    size: (H, W) that it must have. Raises InputError.
    """
    image = _opened(path, budget)
    _require_size(path, image, size)
    if image.mode.startswith("I"):
        return _shares(image, 65535)
    if image.mode in ("RGBA", "LA"):
        alpha = _shares(image.getchannel("A"), 255)
        if alpha.min(initial=1) < 1:
            return alpha
    return _shares(image.convert("L"), 255)


def _shares(image: Image.Image, most: int) -> Colours:
    return np.clip(np.asarray(image, dtype=np.float32) / np.float32(most), 0, 1, dtype=np.float32)


def read_numbers(path: Path, size: tuple[int, int], budget: Budget) -> NDArray[np.int64]:
    """(H, W) the numbers that a file of labels keeps: brightness as it stands, or places in its palette.

    size: (H, W) that it must have. Raises InputError.
    """
    image = _opened(path, budget)
    _require_size(path, image, size)
    if image.mode not in ("1", "L", "P") and not image.mode.startswith("I"):
        raise InputError(f"{path}: labels are kept as colours ({image.mode}): write one channel, 0 outside, 1, 2 …")
    return np.asarray(image, dtype=np.int64)


def _require_size(path: Path, image: Image.Image, size: tuple[int, int]) -> None:
    if (image.height, image.width) != size:
        raise InputError(
            f"{path}: has {image.width}x{image.height} pixels, its picture {size[1]}x{size[0]}: make them the same size"
        )


def _opened(path: Path, budget: Budget) -> Image.Image:
    try:
        with Image.open(path, formats=FORMATS) as image:
            budget.take(image.width, image.height, path)
            image.load()
            return image
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such picture") from None
    except _DAMAGED as error:
        raise InputError(f"{path}: not a readable picture ({str(error)[:120]}): write it again as PNG") from None
