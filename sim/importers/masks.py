# SPDX-License-Identifier: MIT
"""Masks of objects from other programs' files, whatever form they have (docs/importing.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.names import fitting_names
from .coco import masks_from_json
from .found_mask import FoundMask
from .sam import masks_from_array_file, masks_from_folder
from .segments import masks_from_picture

Mask = NDArray[np.bool_]
MAX_MASKS = 256
MAX_BYTES = 2**30
"""Of all imported masks together."""
RATIO = 0.01
"""How far the proportions of a mask and its photo may differ, as a share: one pixel of a hundred."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedMask:
    """One object of a photo. name: fits a scene, each once; kind: what it is, where the file says so.

    mask: (H, W) of the photo's size; box: x0, y0, x1, y1 around it, x1 and y1 exclusive.
    """

    name: str
    kind: str | None
    mask: Mask
    box: tuple[int, int, int, int]


def read_masks(path: Path, width: int, height: int, photo_name: str, only: Sequence[str] = ()) -> list[ImportedMask]:
    """The masks in ``path`` for the upright photo called ``photo_name`` of ``width`` x ``height`` pixels, in its order.

    path: a folder of PNGs, as SAM's mask generator writes it; ``.npy`` or ``.npz`` arrays; JSON: a list of SAM's
    masks, or COCO's annotations, of which those of the photo's file name are taken; a picture with a number an object.
    only: names (or, in the file, labels) of those that are wanted; () for all.
    Masks of another size but equal proportions are scaled. Raises InputError.
    """
    found = _found(path, width, height, photo_name)
    names = fitting_names([item.name for item in found])
    pairs = list(zip(names, found, strict=True))
    for wanted in only:
        if not any(wanted in (name, item.name, item.kind) for name, item in pairs):
            some = ", ".join(names[:20]) + (", …" if len(names) > 20 else "")
            raise InputError(f"{path}: has no mask {wanted!r}; it has {some}")
    if only:
        pairs = [(name, item) for name, item in pairs if {name, item.name, item.kind} & set(only)]
    if len(pairs) > MAX_MASKS:
        raise InputError(f"{path}: has {len(pairs)} masks, more than the {MAX_MASKS} allowed; choose some by name")
    if len(pairs) * width * height > MAX_BYTES:
        raise InputError(f"{path}: {len(pairs)} masks of {width}x{height} take too much memory; choose some by name")
    return [_imported(path, name, item, width, height) for name, item in pairs]


def _found(path: Path, width: int, height: int, photo_name: str) -> list[FoundMask]:
    suffix = path.suffix.lower()
    if path.is_dir():
        found = masks_from_folder(path)
    elif not path.exists():
        raise InputError(f"{path}: there are no such masks; check the path")
    elif suffix in (".npy", ".npz"):
        found = masks_from_array_file(path)
    elif suffix == ".json":
        found = masks_from_json(path, width, height, photo_name)
    elif suffix in (".png", ".tif", ".tiff", ".bmp"):
        found = masks_from_picture(path)
    else:
        raise InputError(f"{path}: masks are a folder of PNGs, .npy, .npz, .json or one PNG with a number an object")
    if not found:
        raise InputError(f"{path}: holds no mask")
    return found


def _imported(path: Path, name: str, item: FoundMask, width: int, height: int) -> ImportedMask:
    mask = fitted(item.mask, width, height, f"{path}: mask {item.name}")
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        raise InputError(f"{path}: mask {item.name} is empty; leave it out")
    box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    return ImportedMask(name=name, kind=item.kind, mask=mask, box=box)


def fitted(mask: Mask, width: int, height: int, where: str) -> Mask:
    """``mask`` at ``width`` x ``height`` pixels; InputError where its proportions are others."""
    if mask.shape == (height, width):
        return mask
    ratio = mask.shape[1] * height / (mask.shape[0] * width)
    if not 1 - RATIO <= ratio <= 1 + RATIO:
        raise InputError(
            f"{where}: has {mask.shape[1]}x{mask.shape[0]} pixels, the photo {width}x{height}; "
            "give masks of this photo, upright"
        )
    # Area averages, so that a smaller mask keeps its area.
    way = cv2.INTER_AREA if mask.shape[0] > height else cv2.INTER_LINEAR
    sized = cv2.resize(mask.astype(np.float32), (width, height), interpolation=way)
    return np.asarray(sized > 0.5)
