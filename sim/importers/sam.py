# SPDX-License-Identifier: MIT
"""Masks as programs around Segment Anything leave them: folders of pictures, arrays.

``scripts/amg.py`` of segment-anything writes ``0.png``, ``1.png``, … of 0 and 255 and ``metadata.csv``, whose ``id`` is
the picture's name; SAM 2's predictors give arrays (N, H, W), as booleans or as logits, or (N, 1, H, W).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import read_npy, read_npz
from ..errors import InputError
from .found_mask import FoundMask
from .segments import bright, read_grey, segments

MAX_FILES = 4096
MAX_BYTES = 2**30
"""Of all masks of a file together."""


def masks_from_folder(folder: Path) -> list[FoundMask]:
    """A mask for each picture in ``folder``, by number, then by name. Raises InputError."""
    try:
        paths = [p for p in folder.iterdir() if p.suffix.lower() == ".png" and not p.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror or error}") from None
    # What segment-anything's forks write beside: the object's pixels, not its mask.
    paths = [p for p in paths if not p.stem.endswith("matting")]
    if not paths:
        raise InputError(f"{folder}: holds no PNG; give a folder with one for each mask")
    if len(paths) > MAX_FILES:
        raise InputError(f"{folder}: holds {len(paths)} pictures, more than the {MAX_FILES} allowed")
    result, used = [], 0
    for path in sorted(paths, key=_order):
        mask = bright(read_grey(path))
        used += mask.nbytes
        if used > MAX_BYTES:
            raise InputError(f"{folder}: its masks take more than {MAX_BYTES >> 20} MiB; leave in those you want")
        number = path.stem.isdigit()
        result.append(FoundMask(f"object_{path.stem}" if number else path.stem, _kind(path.stem), mask))
    return result


def _order(path: Path) -> tuple[bool, int, str]:
    number = path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 18
    return (not number, int(path.stem) if number else 0, path.stem)


def _kind(name: str) -> str | None:
    """What a picture called ``name`` shows, if somebody gave it a name: ``coffee_cup_2`` is a coffee cup."""
    words = " ".join(re.findall(r"[^\W\d_]+", name))
    return words if words.casefold() not in ("", "mask", "object", "segment", "masks", "seg") else None


def masks_from_array_file(path: Path) -> list[FoundMask]:
    """The masks of ``.npy`` or ``.npz``: (H, W), (N, H, W) or (N, 1, H, W). Raises InputError.

    Booleans as they are; whole numbers of (H, W) are a number an object unless they are 0 and 1, or 0 and 255; floats
    are logits (above 0) where some are negative, else probabilities (above 0.5). An archive's arrays are used if any is
    called ``masks``, else all of two and more dimensions, under their own names.
    """
    if path.suffix.lower() == ".npy":
        return _masks(read_npy(path, MAX_BYTES), "object", str(path))
    arrays = read_npz(path, MAX_BYTES)
    if "masks" in arrays:
        return _masks(arrays["masks"], "object", f"{path}: masks")
    result = []
    for name, array in arrays.items():
        if array.ndim >= 2 and min(array.shape) > 0 and not (array.ndim == 2 and array.shape[1] <= 4):
            # Boxes (N, 4) and points (N, 2) lie beside the masks.
            result += _masks(array, name, f"{path}: {name}")
    return result


def _masks(array: NDArray[Any], name: str, where: str) -> list[FoundMask]:
    if array.ndim == 4 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim not in (2, 3) or array.size == 0:
        raise InputError(f"{where}: has the shape {array.shape}, expected (H, W) or (N, H, W)")
    if array.ndim == 2 and array.dtype.kind in "ui" and not set(np.unique(array).tolist()) <= {0, 1, 255}:
        return [FoundMask(f"{name}_{i}", _kind(name), mask) for i, mask in segments(array, where).items()]
    stack = _seen(array if array.ndim == 3 else array[None], where)
    if len(stack) > MAX_FILES:
        raise InputError(f"{where}: holds {len(stack)} masks, more than the {MAX_FILES} allowed")
    single = len(stack) == 1 and name != "object"
    return [FoundMask(name if single else f"{name}_{i}", _kind(name), mask) for i, mask in enumerate(stack)]


def _seen(array: NDArray[Any], where: str) -> NDArray[np.bool_]:
    if array.dtype.kind != "f":
        return np.asarray(array != 0)
    if not np.isfinite(array).all():
        raise InputError(f"{where}: has values that are not finite; save booleans")
    return np.asarray(array > (0.0 if float(array.min()) < 0 else 0.5))
