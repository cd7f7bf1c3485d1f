# SPDX-License-Identifier: MIT
"""Pictures that are masks: bright where the object is, or with a number for each object."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from .found_mask import FoundMask

MAX_PIXELS = 100_000_000
MAX_SEGMENTS = 4096


def read_grey(path: Path) -> NDArray[Any]:
    """The picture (H, W) as it is, without gamma or palette: 8 or 16 bits, or booleans; of colours the red channel.

    Raises InputError for what is no picture, is damaged or too large.
    """
    try:
        with warnings.catch_warnings():
            # Pillow only warns between its limit and twice that; our own check below has the better message.
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise InputError(f"{path}: is {image.width}x{image.height} pixels, more than a mask may have")
                image.load()
                values = np.asarray(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such picture; restore it") from None
    # Decoders of damaged files fail in whatever way the garbage leads them to (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(f"{path}: no readable picture ({type(error).__name__}: {error}); save it again") from error
    if values.ndim == 3:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "bui":
        raise InputError(f"{path}: is no picture of whole numbers; save it as a grey PNG")
    return values


def bright(values: NDArray[Any]) -> NDArray[np.bool_]:
    """The mask (H, W) in a picture of zeros and ones, or of black and white with what a JPEG makes of it."""
    if values.dtype == bool or values.max(initial=0) <= 1:
        return np.asarray(values != 0)
    return np.asarray(values > np.iinfo(values.dtype).max // 2 if values.dtype.kind == "u" else values > 127)


def segments(values: NDArray[Any], where: str) -> dict[int, NDArray[np.bool_]]:
    """The mask of each number but 0. Raises InputError for more than ``MAX_SEGMENTS``."""
    ids = [int(i) for i in np.unique(values) if i != 0]
    if len(ids) > MAX_SEGMENTS:
        raise InputError(f"{where}: has {len(ids)} numbers; a picture of segments has one for each object")
    return {i: np.asarray(values == i) for i in ids}


def masks_from_picture(path: Path) -> list[FoundMask]:
    """The objects of a picture with a number an object, as PhysGen's ``mask.png``; or the one of a black and white one.

    A picture of more than 256 numbers, or of two greys with 255, is taken for black and white. Raises InputError.
    """
    values = read_grey(path)
    ids = np.unique(values)
    if values.dtype == bool or set(ids.tolist()) <= {0, 255} or len(ids) > 256:
        return [FoundMask(path.stem, None, bright(values))]
    return [FoundMask(f"object_{i}", None, mask) for i, mask in segments(values, str(path)).items()]
