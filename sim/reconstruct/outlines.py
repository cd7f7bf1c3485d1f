# SPDX-License-Identifier: MIT
"""The outlines of the objects: from their masks, from an adapter, or cut out of their boxes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .adapters.resolve import resolve
from .cut.given import read_mask
from .cut.propose import largest_part
from .cut.segment import Box, check_distinct, pixel_box, segment
from .options import ObjectRequest, ReconstructOptions
from .photo import Photo
from .stage_store import Arrays, Notice, StageStore
from .steps import Steps

Mask = NDArray[np.bool_]


def cut_out(
    picture: Photo,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    store: StageStore,
    steps: Steps,
) -> tuple[list[Mask], list[Box]]:
    """What the photo shows of each of the ``objects``, which have names, and the box to look for it in.

    Masks (H, W), without common pixels; boxes in working pixels. Raises InputError for a box or mask that cannot be
    used, and when two objects are the same.
    """
    names = [item.name or "" for item in objects]
    size = (picture.width, picture.height)
    given = {i: read_mask(item.mask, *size) for i, item in enumerate(objects) if item.mask is not None}
    boxes = [
        _box_of(given[i]) if item.box is None else pixel_box(item.box, picture.scale, *size, name)
        for i, (item, name) in enumerate(zip(objects, names, strict=True))
    ]
    wanted = [i for i in range(len(objects)) if i not in given]
    if options.segmenter is not None and wanted:
        cut = resolve("segmenter", options.segmenter, steps.cancelled)(picture.pixels, _corners(boxes, wanted))
        given |= dict(zip(wanted, cut, strict=True))
    masks: dict[int, Mask] = dict(given)
    # What lies within another one's box, a toy on a chair, is cut out first, so that the other can be told from it.
    for i in sorted(range(len(names)), key=lambda i: _area(boxes[i])):
        steps.begin(f"segment {names[i]}")
        if i in given:
            continue
        known = [mask for j, mask in masks.items() if j in given or _within(boxes[j], boxes[i])]
        others = _near(boxes[i], np.logical_or.reduce([np.zeros(size[::-1], dtype=bool), *known]))
        made = store.run(
            "segment",
            {"pixels": picture.pixels, "box": boxes[i], "name": names[i], "rounds": options.grabcut_iterations}
            | {"others": others},
            partial(_segmented, picture.pixels, boxes[i], names[i], options, others),
        )
        masks[i] = np.asarray(made["mask"], dtype=bool)
    ordered = [masks[i] for i in range(len(names))]
    return _distinct(ordered, names, [i in given for i in range(len(names))]), boxes


def _area(box: Box) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _near(box: Box, mask: Mask) -> Mask:
    """``mask`` (H, W) within one box' size around ``box``: what lies further away does not matter to what is in it."""
    width, height = box[2] - box[0], box[3] - box[1]
    window = (
        slice(max(0, box[1] - height), box[3] + height),
        slice(max(0, box[0] - width), box[2] + width),
    )
    result = np.zeros_like(mask)
    result[window] = mask[window]
    return result


def _within(inner: Box, outer: Box) -> bool:
    """Whether ``inner`` lies mostly within ``outer`` and is clearly smaller; two boxes around one thing are not."""
    width = min(inner[2], outer[2]) - max(inner[0], outer[0])
    height = min(inner[3], outer[3]) - max(inner[1], outer[1])
    common = max(width, 0) * max(height, 0)
    return common > 0.7 * _area(inner) and _area(inner) < 0.7 * _area(outer)


def _segmented(
    pixels: NDArray[np.uint8], box: Box, name: str, options: ReconstructOptions, others: Mask, notice: Notice
) -> Arrays:
    return {"mask": segment(pixels, box, name, options.grabcut_iterations, notice, others=others)}


def _box_of(mask: Mask) -> Box:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _corners(boxes: Sequence[Box], wanted: Sequence[int]) -> NDArray[np.float64]:
    return np.array([boxes[i] for i in wanted], dtype=np.float64)


def _mostly_in(mask: Mask, other: Mask) -> bool:
    area = int(mask.sum())
    return area < int(other.sum()) and int((mask & other).sum()) > 0.4 * area


def _distinct(masks: Sequence[Mask], names: Sequence[str], given: Sequence[bool]) -> list[Mask]:
    """``masks`` without common pixels: a given mask keeps them, else what lies mostly within the other (a toy on a
    chair), else the object that stands nearer, lower in the photo.

    Raises InputError when two show the same object, or nothing is left of one.
    """
    check_distinct(masks, names)
    result = list(masks)
    inside = [any(_mostly_in(mask, other) for other in masks if other is not mask) for mask in masks]
    order = sorted(
        range(len(masks)),
        key=lambda i: (not given[i], not inside[i], -int(np.flatnonzero(masks[i].any(axis=1))[-1])),
    )
    taken = np.zeros(masks[0].shape, dtype=bool)
    for index in order:
        rest = masks[index] & ~taken
        if not rest.any():
            raise InputError(f"{names[index]}: nothing is left of its mask beside the other objects; mark it again")
        result[index] = rest if given[index] else largest_part(rest, taken)
        taken |= result[index]
    return result
