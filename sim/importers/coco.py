# SPDX-License-Identifier: MIT
"""Masks in JSON: COCO's annotations and results, lists of SAM's masks, SA-1B's and Grounded SAM's files.

COCO's data format (cocodataset.org, "Data format"): ``images`` with ``id`` and ``file_name``, ``categories`` with
``id`` and ``name``, ``annotations`` with ``image_id``, ``category_id`` and ``segmentation``: polygons or runs. SAM's
masks have ``segmentation`` as runs and no category; Grounded SAM adds ``class_name``, others ``label``.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import InputError
from ..scene.json_fields import read_json
from .found_mask import FoundMask
from .rle import mask_from_polygons, mask_from_rle

MAX_ANNOTATIONS = 4096
MAX_BYTES = 2**30


def masks_from_json(path: Path, width: int, height: int, photo_name: str) -> list[FoundMask]:
    """The masks of the photo ``photo_name`` in the file ``path``; polygons are those of ``width`` x ``height`` pixels.

    Where the file names pictures, that of the photo's file name is taken, or its only one. Raises InputError.
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
    result, used = [], 0
    for index, annotation in enumerate(annotations):
        if "segmentation" not in annotation:
            raise InputError(f"{path}: annotations[{index}] has no segmentation; a box alone is given with --box")
        where = f"{path}: annotations[{index}].segmentation"
        segmentation = annotation["segmentation"]
        if isinstance(segmentation, list):
            mask = mask_from_polygons(segmentation, *size, where)
        else:
            mask = mask_from_rle(segmentation, where)
        used += mask.nbytes
        if used > MAX_BYTES:
            raise InputError(f"{path}: its masks take more than {MAX_BYTES >> 20} MiB; leave in those you want")
        kind = _kind(annotation, names)
        result.append(FoundMask(kind or f"object_{_id(annotation, index)}", kind, mask))
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
    """What the file says of the photo; None where it says nothing of pictures."""
    if isinstance(data.get("image"), dict):
        return dict(data["image"])
    if "images" not in data:
        named = {"width": data.get("img_width"), "height": data.get("img_height")}
        return named if None not in named.values() else None
    images = data["images"]
    if not isinstance(images, list) or not images or not all(isinstance(i, dict) for i in images):
        raise InputError(f"{path}: images: expected a list of at least one picture")
    matching = [i for i in images if PurePosixPath(str(i.get("file_name")).replace("\\", "/")).name == photo_name]
    if len(matching) == 1:
        return dict(matching[0])
    if len(images) == 1 and not matching:
        return dict(images[0])
    found = "several" if matching else "none"
    raise InputError(f"{path}: {found} of its {len(images)} images has the file name {photo_name!r}; name it there so")


def _size(image: dict[str, Any], usual: tuple[int, int], path: Path) -> tuple[int, int]:
    if "width" not in image and "height" not in image:
        return usual
    sides = (image.get("width"), image.get("height"))
    if not all(type(side) is int and 0 < side <= 20_000 for side in sides):
        raise InputError(f"{path}: the picture's width and height are {sides!r}, expected pixels")
    return sides  # type: ignore[return-value]
