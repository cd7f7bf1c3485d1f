# SPDX-License-Identifier: MIT
"""Masks in images and arrays, as programs around Segment Anything and PhysGen write them.

An image is bright where the object is, or holds a number for each object. ``scripts/amg.py`` of segment-anything
writes ``0.png``, ``1.png``, … of 0 and 255 and ``metadata.csv``, whose ``id`` is the image's name; SAM 2's predictors
give arrays (N, H, W), as booleans or as logits, or (N, 1, H, W)."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from ..files import MAX_PICTURE_BYTES, PICTURE_FORMATS, open_file
from ..npz import read_npy, read_npz


@dataclass(frozen=True, eq=False)
class FileMask:
    """A mask as found in a file. name: the file's, any text; kind: of object, or None; mask: (h, w), any size."""

    name: str
    kind: str | None
    mask: NDArray[np.bool_]


MAX_PIXELS = 100_000_000
MAX_SEGMENTS = 4096


def read_grey_image(path: Path) -> NDArray[Any]:
    """Return the raw image (H, W), without gamma or palette: 8 or 16 bits, or booleans; of colours the red channel.

    Raises InputError for files that are not images, damaged or too large.
    """
    try:
        with warnings.catch_warnings():
            # Pillow only warns between its limit and twice that; our own check below has the better message.
            warnings.simplefilter("ignore")
            with (
                open_file(path, MAX_PICTURE_BYTES, what="picture") as file,
                Image.open(file, formats=PICTURE_FORMATS) as image,
            ):
                if image.width * image.height > MAX_PIXELS:
                    raise InputError(f"{path}: has {image.width}x{image.height} pixels, too many for a mask")
                image.load()
                values = np.asarray(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such image; restore it") from None
    # Decoders of damaged files raise anything (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(f"{path}: not a readable image ({type(error).__name__}: {error}); save it again") from error
    if values.ndim == 3:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "bui":
        raise InputError(f"{path}: is not an image of integers; save it as a grey PNG")
    return values


def binary_mask(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the mask (H, W) in an image of zeros and ones, or of black and white with JPEG artefacts."""
    if values.dtype == bool or values.max(initial=0) <= 1:
        return np.asarray(values != 0)
    return np.asarray(values > np.iinfo(values.dtype).max // 2 if values.dtype.kind == "u" else values > 127)


def masks_by_number(values: NDArray[Any], where: str) -> dict[int, NDArray[np.bool_]]:
    """Return the mask (H, W) of each number except 0. Raises InputError for more than ``MAX_SEGMENTS``."""
    ids = [int(i) for i in np.unique(values) if i != 0]
    if len(ids) > MAX_SEGMENTS:
        raise InputError(f"{where}: has {len(ids)} numbers; a segment image has one for each object")
    return {i: np.asarray(values == i) for i in ids}


def masks_from_image(path: Path) -> list[FileMask]:
    """Return the masks in an image with a number for each object, as PhysGen's ``mask.png``, or in a binary one.

    An image of more than 256 values, or of 0 and 255 only, is treated as binary. Raises InputError.
    """
    values = read_grey_image(path)
    ids = np.unique(values)
    if values.dtype == bool or set(ids.tolist()) <= {0, 255} or len(ids) > 256:
        return [FileMask(path.stem, None, binary_mask(values))]
    return [FileMask(f"object_{i}", None, mask) for i, mask in masks_by_number(values, str(path)).items()]


MAX_FILES = 4096
MAX_BYTES = 2**30
"""Of all masks of a file."""


def masks_from_folder(folder: Path) -> list[FileMask]:
    """Return a mask for each PNG in ``folder``, sorted by number, then by name. Raises InputError."""
    try:
        paths = [p for p in folder.iterdir() if p.suffix.lower() == ".png" and not p.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror or error}") from None
    # Forks of segment-anything also write the object's pixels, which are not masks.
    paths = [p for p in paths if not p.stem.endswith("matting")]
    if not paths:
        raise InputError(f"{folder}: contains no PNG; give a folder with one for each mask")
    if len(paths) > MAX_FILES:
        raise InputError(f"{folder}: contains {len(paths)} images, more than the {MAX_FILES} allowed")
    result, used = [], 0
    for path in sorted(paths, key=_sort_key):
        mask = binary_mask(read_grey_image(path))
        used += mask.nbytes
        if used > MAX_BYTES:
            raise InputError(f"{folder}: its masks take more than {MAX_BYTES >> 20} MiB; keep only those you need")
        number = path.stem.isdigit()
        result.append(FileMask(f"object_{path.stem}" if number else path.stem, _kind_from_name(path.stem), mask))
    return result


def _sort_key(path: Path) -> tuple[bool, int, str]:
    number = path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 18
    return (not number, int(path.stem) if number else 0, path.stem)


def _kind_from_name(name: str) -> str | None:
    """Return the kind of object in a descriptive file name (``coffee_cup_2`` is a coffee cup), or None."""
    words = " ".join(re.findall(r"[^\W\d_]+", name))
    return words if words.casefold() not in ("", "mask", "object", "segment", "masks", "seg") else None


def masks_from_array_file(path: Path) -> list[FileMask]:
    """Return the masks in ``.npy`` or ``.npz``: (H, W), (N, H, W) or (N, 1, H, W). Raises InputError.

    Booleans are used as they are; integers (H, W) hold a number for each object unless they are 0 and 1, or 0 and 255;
    floats are logits (above 0) if any is negative, else probabilities (above 0.5). Of an archive, the array ``masks``
    is used, else all with at least two dimensions, under their own names.
    """
    if path.suffix.lower() == ".npy":
        return _array_masks(read_npy(path, MAX_BYTES), "object", str(path))
    arrays = read_npz(path, MAX_BYTES)
    if "masks" in arrays:
        return _array_masks(arrays["masks"], "object", f"{path}: masks")
    result = []
    for name, array in arrays.items():
        if array.ndim >= 2 and min(array.shape) > 0 and not (array.ndim == 2 and array.shape[1] <= 4):
            # Skips boxes (N, 4) and points (N, 2) stored with the masks.
            result += _array_masks(array, name, f"{path}: {name}")
    return result


def _array_masks(array: NDArray[Any], name: str, where: str) -> list[FileMask]:
    if array.ndim == 4 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim not in (2, 3) or array.size == 0:
        raise InputError(f"{where}: has shape {array.shape}, expected (H, W) or (N, H, W)")
    if array.ndim == 2 and array.dtype.kind in "ui" and not set(np.unique(array).tolist()) <= {0, 1, 255}:
        return [
            FileMask(f"{name}_{i}", _kind_from_name(name), mask) for i, mask in masks_by_number(array, where).items()
        ]
    stack = _thresholded(array if array.ndim == 3 else array[None], where)
    if len(stack) > MAX_FILES:
        raise InputError(f"{where}: contains {len(stack)} masks, more than the {MAX_FILES} allowed")
    single = len(stack) == 1 and name != "object"
    return [FileMask(name if single else f"{name}_{i}", _kind_from_name(name), mask) for i, mask in enumerate(stack)]


def _thresholded(array: NDArray[Any], where: str) -> NDArray[np.bool_]:
    if array.dtype.kind != "f":
        return np.asarray(array != 0)
    if not np.isfinite(array).all():
        raise InputError(f"{where}: has values that are not finite; save booleans")
    return np.asarray(array > (0.0 if float(array.min()) < 0 else 0.5))
