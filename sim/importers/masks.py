# SPDX-License-Identifier: MIT
"""Masks of objects from other programs' files, in any supported form (docs/reconstruction.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..validation import valid_names
from .coco_masks import masks_from_json
from .image_masks import MAX_BYTES, FileMask, masks_from_array_file, masks_from_folder, masks_from_image

Mask = NDArray[np.bool_]
MAX_MASKS = 256
ASPECT_TOLERANCE = 0.01
"""Relative difference allowed between the aspect ratios of a mask and its photo: one pixel in a hundred."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedMask:
    """One object of a photo. name: unique and valid in a scene; kind: of object, or None.

    mask: (H, W) of the photo's size; box: its bounding box x0, y0, x1, y1 in pixels, x1 and y1 exclusive.
    """

    name: str
    kind: str | None
    mask: Mask
    box: tuple[int, int, int, int]


def read_masks(path: Path, width: int, height: int, photo_name: str, only: Sequence[str] = ()) -> list[ImportedMask]:
    """Return the masks in ``path``, in file order, for the upright photo ``photo_name``; width, height: its pixels.

    path: a folder of PNGs, as SAM's mask generator writes it; ``.npy`` or ``.npz`` arrays; JSON: a list of SAM's
    masks, or COCO's annotations, of which those with the photo's file name are used; an image with a number for each
    object. only: names (or labels in the file) to import; () for all. Masks of another size but equal aspect ratio are
    scaled. Raises InputError.
    """
    found = _file_masks(path, width, height, photo_name)
    names = valid_names([item.name for item in found])
    pairs = list(zip(names, found, strict=True))
    for wanted in only:
        if not any(wanted in (name, item.name, item.kind) for name, item in pairs):
            some = ", ".join(names[:20]) + (", …" if len(names) > 20 else "")
            raise InputError(f"{path}: has no mask {wanted!r}; it has {some}")
    if only:
        pairs = [(name, item) for name, item in pairs if {name, item.name, item.kind} & set(only)]
    if len(pairs) > MAX_MASKS:
        raise InputError(f"{path}: has {len(pairs)} masks, more than the {MAX_MASKS} allowed; select some by name")
    if len(pairs) * width * height > MAX_BYTES:
        raise InputError(f"{path}: {len(pairs)} masks of {width}x{height} take too much memory; select some by name")
    return [_imported_mask(path, name, item, width, height) for name, item in pairs]


def _file_masks(path: Path, width: int, height: int, photo_name: str) -> list[FileMask]:
    suffix = path.suffix.lower()
    if path.is_dir():
        found = masks_from_folder(path)
    elif not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    elif suffix in (".npy", ".npz"):
        found = masks_from_array_file(path)
    elif suffix == ".json":
        found = masks_from_json(path, width, height, photo_name)
    elif suffix in (".png", ".tif", ".tiff", ".bmp"):
        found = masks_from_image(path)
    else:
        raise InputError(
            f"{path}: unknown kind of masks; give a folder of PNGs, .npy, .npz, .json or one PNG with a number for "
            "each object"
        )
    if not found:
        raise InputError(f"{path}: contains no mask")
    return found


def _imported_mask(path: Path, name: str, item: FileMask, width: int, height: int) -> ImportedMask:
    mask = resized_mask(item.mask, width, height, f"{path}: mask {item.name}")
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        raise InputError(f"{path}: mask {item.name} is empty; leave it out")
    box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    return ImportedMask(name=name, kind=item.kind, mask=mask, box=box)


def resized_mask(mask: Mask, width: int, height: int, where: str) -> Mask:
    """Return ``mask`` resized to (height, width) pixels. Raises InputError where its aspect ratio differs."""
    if mask.shape == (height, width):
        return mask
    ratio = mask.shape[1] * height / (mask.shape[0] * width)
    if not 1 - ASPECT_TOLERANCE <= ratio <= 1 + ASPECT_TOLERANCE:
        raise InputError(
            f"{where}: has {mask.shape[1]}x{mask.shape[0]} pixels, the photo {width}x{height}; "
            "give masks of this photo, upright"
        )
    # Area averaging, so that a downscaled mask keeps its area.
    way = cv2.INTER_AREA if mask.shape[0] > height else cv2.INTER_LINEAR
    sized = cv2.resize(mask.astype(np.float32), (width, height), interpolation=way)
    return np.asarray(sized > 0.5)
