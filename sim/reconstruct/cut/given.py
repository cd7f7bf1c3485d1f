# SPDX-License-Identifier: MIT
"""A user's own mask: any picture that is bright, or opaque, where the object is seen."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from ...errors import InputError

Mask = NDArray[np.bool_]

MAX_PIXELS = 200_000_000
"""As for photos: a file that claims more is taken for a decompression bomb."""
PROPORTIONS = 0.02
"""By how much width over height may differ from the photo's; rounding of small masks stays below it."""
NOISE = 16
"""Grey values by which JPEG makes a plain picture uneven."""
_SIXTEEN_BITS = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")


def read_mask(path: Path, width: int, height: int) -> Mask:
    """The mask (height, width) in the picture ``path``, brought to the size of the working photo.

    Any mode: transparency decides where it varies, else brightness, cut half way between the darkest and the brightest.
    EXIF rotation is applied. Raises InputError when the file is missing, damaged, too large, of other proportions than
    the photo, or shows no object, or nothing else.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                return _decode(path, image, width, height)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such mask; check the path") from None
    except UnidentifiedImageError:
        raise InputError(f"{path}: is not an image; give the mask as a PNG or JPEG file") from None
    except (Image.DecompressionBombError, MemoryError):
        raise InputError(f"{path}: is too large for a mask; save it in the photo's size") from None
    # Decoders of damaged files fail in whatever way the garbage leads them to (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(
            f"{path}: cannot be read as a mask ({type(error).__name__}: {error}); it may be damaged, save it again"
        ) from error


def _decode(path: Path, image: Image.Image, width: int, height: int) -> Mask:
    if image.width * image.height > MAX_PIXELS:
        raise InputError(f"{path}: has {image.width}x{image.height} pixels; save the mask in the photo's size")
    upright = ImageOps.exif_transpose(image)
    across = upright.width * height / (upright.height * width)
    # One pixel of rounding is no difference of proportions.
    slack = 1.0 / min(upright.width, upright.height, width, height)
    if abs(across - 1.0) > PROPORTIONS + slack:
        raise InputError(
            f"{path}: is {upright.width}x{upright.height} pixels, of other proportions than the photo "
            f"({width}x{height}); give a mask of the whole photo"
        )
    values = _values(upright)
    low, high = float(values.min()), float(values.max())
    lossy = image.format in ("JPEG", "MPO", "WEBP")
    if high <= low or (lossy and high - low < NOISE):
        found = "full" if high > 127.0 else "empty"
        raise InputError(f"{path}: the mask is {found}; make it bright where the object is and dark elsewhere")
    mask = (values > (low + high) / 2.0).astype(np.float32)
    method = cv2.INTER_AREA if upright.width > width else cv2.INTER_LINEAR
    resized = cv2.resize(mask, (width, height), interpolation=method) > 0.5
    if not resized.any():
        raise InputError(
            f"{path}: nothing of the mask is left at the photo's size of {width}x{height}; paint it larger"
        )
    if resized.all():
        raise InputError(f"{path}: the mask covers the whole photo; leave what is not the object dark")
    return np.asarray(resized)


def _values(image: Image.Image) -> NDArray[np.float32]:
    """One number (H, W) for each pixel: opacity where it varies, else the brightest channel."""
    if image.mode in _SIXTEEN_BITS:
        return np.nan_to_num(np.asarray(image, dtype=np.float32))
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"))
        if rgba[..., 3].min() < rgba[..., 3].max():
            return np.asarray(rgba[..., 3], dtype=np.float32)
        return np.asarray(rgba[..., :3].max(axis=2), dtype=np.float32)
    # Colours of a palette stand for objects: the brightest channel, or a dark blue one would count as background.
    return np.asarray(np.asarray(image.convert("RGB")).max(axis=2), dtype=np.float32)
