# SPDX-License-Identifier: MIT
"""Masks in JSON: COCO's annotations and results, lists of SAM's masks, SA-1B's and Grounded SAM's files.

COCO's data format (cocodataset.org, "Data format"): ``images`` with ``id`` and ``file_name``, ``categories`` with
``id`` and ``name``, ``annotations`` with ``image_id``, ``category_id`` and ``segmentation``: polygons or runs. SAM's
masks have ``segmentation`` as runs and no category; Grounded SAM adds ``class_name``, others ``label``.

Runs are of pixels down the columns, as numbers or packed into text. The packed form, as COCO's mask API documents it:
characters from code 48 on carry 6 bits each, 5 of the number, lowest first, and one continuation bit; the last one's
highest data bit is the sign. From the fourth run on, a number is the difference to the run two before it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.draw import polygon

from ..errors import InputError
from ..validation import read_json
from .image_masks import MAX_BYTES, MAX_PIXELS, FileMask

Mask = NDArray[np.bool_]
MAX_RUNS = 20_000_000
MAX_POLYGONS = 10_000
MAX_POLYGON_WORK = 2 * 10**10
"""Corners times pixels of the box around them, over all polygons of a file: filling them takes so many steps."""
_MAX_CHARACTERS = 13
"""Of one number: 64 bits. A longer one is damaged."""


def mask_from_rle(value: Any, where: str) -> Mask:
    """Return the mask (H, W) of ``{"size": [H, W], "counts": …}``, counts as text or list. Raises InputError."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected size and counts of a mask")
    size, counts = value.get("size"), value.get("counts")
    good = isinstance(size, list) and len(size) == 2 and all(type(side) is int and side > 0 for side in size)
    if not good or size[0] * size[1] > MAX_PIXELS:  # type: ignore[index]
        raise InputError(f"{where}: size is {str(size)[:60]}, expected height and width in pixels")
    height, width = size  # type: ignore[misc]
    if isinstance(counts, str):
        runs = _unpacked_runs(counts, where)
    elif isinstance(counts, list) and all(type(run) is int and 0 <= run <= MAX_PIXELS for run in counts):
        runs = np.array(counts, dtype=np.int64)
    else:
        raise InputError(f"{where}: counts are neither text nor a list of non-negative integers")
    if (runs < 0).any() or (runs > MAX_PIXELS).any() or int(runs.sum()) != height * width:
        raise InputError(f"{where}: its runs do not add up to {height}x{width} pixels; the mask is damaged")
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(flat.reshape(width, height).T)


def _unpacked_runs(text: str, where: str) -> NDArray[np.int64]:
    if len(text) > MAX_RUNS:
        raise InputError(f"{where}: counts have {len(text)} characters; the mask is damaged")
    runs: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64 or shift >= 5 * _MAX_CHARACTERS:
            raise InputError(f"{where}: counts contain an unexpected {character!r}; the mask is damaged")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            continue
        if code & 16:
            value -= 1 << shift
        run = value + (runs[-2] if len(runs) > 2 else 0)
        if not 0 <= run <= MAX_PIXELS:
            raise InputError(f"{where}: has a run of {run} pixels; the mask is damaged")
        runs.append(run)
        value = shift = 0
    if shift:
        raise InputError(f"{where}: counts end in the middle of a number; the mask is damaged")
    return np.array(runs, dtype=np.int64)


def mask_from_polygons(value: list[Any], width: int, height: int, where: str) -> Mask:
    """Return the mask (H, W) of COCO polygons, lists x0, y0, x1, y1, …: pixels with centres in any of them.

    Raises InputError for damaged polygons.
    """
    if len(value) > MAX_POLYGONS:
        raise InputError(f"{where}: has {len(value)} polygons, more than the {MAX_POLYGONS} allowed")
    mask = np.zeros((height, width), dtype=bool)
    for corners in _polygons(value, where):
        rows, columns = polygon(corners[:, 1], corners[:, 0], shape=mask.shape)
        mask[rows, columns] = True
    return mask


def _polygons(value: list[Any], where: str) -> Iterator[NDArray[np.float64]]:
    """Yield the corners (K, 2) of each polygon. Raises InputError."""
    for points in value:
        numeric = isinstance(points, list) and all(
            isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e6 for x in points
        )
        if not numeric or len(points) < 6 or len(points) % 2:
            raise InputError(f"{where}: a polygon needs at least three points x, y as one list of numbers")
        yield np.array(points, dtype=np.float64).reshape(-1, 2) - 0.5


def _polygon_work(value: list[Any], size: tuple[int, int], where: str) -> int:
    work = 0
    for corners in _polygons(value, where):
        low, high = (np.clip(end, 0, size) for end in (corners.min(axis=0), corners.max(axis=0)))
        work += len(corners) * math.ceil(math.prod(high - low + 1.0))
    return work


MAX_ANNOTATIONS = 4096


def masks_from_json(path: Path, width: int, height: int, photo_name: str) -> list[FileMask]:
    """Return the masks of the photo ``photo_name`` in the file ``path``; width, height: pixels, for polygons.

    Where the file lists images, the one with the photo's file name is used, or the only one. Raises InputError.
    """
    data = read_json(path)
    size, names = (width, height), {}
    if isinstance(data, dict):
        names = _categories(data, path)
        image = _image(data, photo_name, path)
        annotations = data.get("annotations")
        if image is not None:
            size = _size(image, size, path)
            if isinstance(annotations, list) and "images" in data:
                annotations = [a for a in annotations if isinstance(a, dict) and a.get("image_id") == image.get("id")]
    else:
        annotations = data
    if not isinstance(annotations, list) or not all(isinstance(a, dict) for a in annotations):
        raise InputError(f"{path}: expected a list of masks, or an object with annotations as COCO has them")
    if len(annotations) > MAX_ANNOTATIONS:
        raise InputError(f"{path}: has {len(annotations)} masks, more than the {MAX_ANNOTATIONS} allowed")
    result, used, work = [], 0, 0
    for index, annotation in enumerate(annotations):
        if "segmentation" not in annotation:
            raise InputError(f"{path}: annotations[{index}] has no segmentation; give boxes with --box")
        where = f"{path}: annotations[{index}].segmentation"
        segmentation = annotation["segmentation"]
        if isinstance(segmentation, list):
            work += _polygon_work(segmentation, size, where)
            if work > MAX_POLYGON_WORK:
                raise InputError(f"{path}: its polygons have too many corners for their size; give masks as runs")
            mask = mask_from_polygons(segmentation, *size, where)
        else:
            mask = mask_from_rle(segmentation, where)
        used += mask.nbytes
        if used > MAX_BYTES:
            raise InputError(f"{path}: its masks take more than {MAX_BYTES >> 20} MiB; keep only those you need")
        kind = _kind(annotation, names)
        result.append(FileMask(kind or f"object_{_id(annotation, index)}", kind, mask))
    return result


def _id(annotation: dict[str, Any], index: int) -> int:
    number = annotation.get("id")
    return number if type(number) is int and 0 <= number < 10**12 else index


def _kind(annotation: dict[str, Any], names: dict[int, str]) -> str | None:
    category = annotation.get("category_id")
    known = names.get(category) if type(category) is int else None
    for value in (known, annotation.get("class_name"), annotation.get("label")):
        if isinstance(value, str) and value.strip():
            return value.strip()[:64]
    return None


def _categories(data: dict[str, Any], path: Path) -> dict[int, str]:
    entries = data.get("categories", [])
    if not isinstance(entries, list) or len(entries) > 100_000:
        raise InputError(f"{path}: categories: expected a list")
    return {
        e["id"]: e["name"]
        for e in entries
        if isinstance(e, dict) and type(e.get("id")) is int and isinstance(e.get("name"), str)
    }


def _image(data: dict[str, Any], photo_name: str, path: Path) -> dict[str, Any] | None:
    """Return the file's entry for the photo, or None where it has no image entries. Raises InputError."""
    if isinstance(data.get("image"), dict):
        return dict(data["image"])
    if "images" not in data:
        named = {"width": data.get("img_width"), "height": data.get("img_height")}
        return named if None not in named.values() else None
    images = data["images"]
    if not isinstance(images, list) or not images or not all(isinstance(i, dict) for i in images):
        raise InputError(f"{path}: images: expected a list of at least one image")
    matching = [i for i in images if PurePosixPath(str(i.get("file_name")).replace("\\", "/")).name == photo_name]
    if len(matching) == 1:
        return dict(matching[0])
    if len(images) == 1 and not matching:
        return dict(images[0])
    found = "several" if matching else "none"
    raise InputError(f"{path}: {found} of its {len(images)} images has the file name {photo_name!r}; correct file_name")


def _size(image: dict[str, Any], usual: tuple[int, int], path: Path) -> tuple[int, int]:
    if "width" not in image and "height" not in image:
        return usual
    sides = (image.get("width"), image.get("height"))
    if not all(type(side) is int and 0 < side <= 20_000 for side in sides):
        raise InputError(f"{path}: the image's width and height are {sides!r}, expected pixels")
    return sides  # type: ignore[return-value]
