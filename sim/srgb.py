# SPDX-License-Identifier: MIT
"""The sRGB transfer function (IEC 61966-2-1), image files, and resampling in linear light.

Everything that mixes or scales pixels does so in linear light, as lenses and shadows do.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from .errors import InputError
from .files import MAX_PICTURE_BYTES, PICTURE_FORMATS, open_file

Linear = NDArray[np.float32]
"""(H, W, 3) linear light, Rec. 709 primaries, 1 is the white of an 8-bit image."""


def srgb_to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return linear light of sRGB values in 0…1, any shape."""
    value = np.asarray(encoded, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return sRGB values of linear light, clipped to 0…1, any shape."""
    value = np.clip(np.asarray(linear, dtype=np.float32), 0.0, 1.0)
    curved = 1.055 * np.power(np.maximum(value, 0.0031308), 1 / 2.4) - 0.055
    return np.where(value <= 0.0031308, value * 12.92, curved).astype(np.float32)


_LINEAR_OF_BYTE = srgb_to_linear(np.arange(256) / 255.0)


def bytes_to_linear(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return linear light of 8-bit sRGB, any shape."""
    return _LINEAR_OF_BYTE[pixels]


def linear_to_bytes(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return 8-bit sRGB, rounded to nearest; inverts ``bytes_to_linear`` exactly."""
    return np.rint(linear_to_srgb(linear) * 255.0).astype(np.uint8)


def cielab(pixels: NDArray[np.uint8], *, blur: float = 0.0) -> NDArray[np.float32]:
    """Return 8-bit sRGB (h, w, 3) in CIELAB under D65, L* from 0 to 100.

    blur: standard deviation in pixels of a Gaussian filter of the encoded values before; 0 for none.
    """
    values = pixels.astype(np.float32) / 255.0
    if blur > 0.0:
        values = np.asarray(cv2.GaussianBlur(values, (0, 0), blur), dtype=np.float32)
    return np.asarray(cv2.cvtColor(values, cv2.COLOR_RGB2LAB), dtype=np.float32)


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Return an image file as (H, W, 3) 8-bit sRGB. Raises InputError when it is missing or unreadable."""
    return _read(path, "RGB")


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Return a mask file as (H, W), True where brighter than half. Raises InputError as ``read_rgb`` does."""
    return np.asarray(_read(path, "L") > 127)


def _read(path: Path, mode: str) -> NDArray[np.uint8]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with (
                open_file(path, MAX_PICTURE_BYTES, what="picture") as file,
                Image.open(file, formats=PICTURE_FORMATS) as image,
            ):
                return np.asarray(image.convert(mode))
    except InputError:
        raise
    # Decoders of damaged files raise arbitrary exceptions (SyntaxError, struct.error, …).
    except Exception as error:
        # Pillow names the open file by its address in memory.
        reason = "of no kind that is read" if isinstance(error, UnidentifiedImageError) else str(error)
        raise InputError(
            f"{path}: not a readable image ({reason}); restore it, or give another as PNG or JPEG"
        ) from error


def resized(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return ``image`` (H, W, …) in linear light resized: averaged over pixel areas down, cubic up."""
    if image.shape[:2] == (height, width):
        return image
    shrinking = width * height < image.shape[0] * image.shape[1]
    method = cv2.INTER_AREA if shrinking else cv2.INTER_CUBIC
    return np.maximum(cv2.resize(image, (width, height), interpolation=method), 0.0)


def nearest(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return ``image`` (H, W, …) resized by nearest neighbour, for values that must not be mixed, such as depth."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST))
