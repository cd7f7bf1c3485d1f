# SPDX-License-Identifier: MIT
"""Masks of the objects: from the user's pictures, from an adapter, or segmented from boxes.

A model's soft opacities are corrected by the colours of object and background.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from ...errors import InputError
from ...files import MAX_PICTURE_BYTES, PICTURE_FORMATS, open_file
from ...trust import trusted_spec
from ..adapters.adapter_registry import adapter_content
from ..adapters.protocols import SoftSegmenter
from ..adapters.resolve import resolve
from ..photo import Photo
from ..reconstruct_options import ObjectRequest, ReconstructOptions
from ..stage_cache import Arrays, Notice, StageCache, Steps
from .box_crop import Box
from .box_segmentation import check_distinct, pixel_box, segment
from .mask_geometry import extent_of, grown, largest_part, touching
from .matting import refine_alpha
from .strokes import Strokes, drawn_strokes, require_apart

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

LEAST = 0.01
"""Share of the box below which a model is taken to have found nothing."""
LEAST_OWN = 0.3
"""Share of the model's answer that must be no other object's."""


def model_mask(
    cutter: SoftSegmenter,
    pixels: Pixels,
    box: Box,
    name: str,
    others: Mask,
    notice: Notice,
    *,
    strokes: Strokes | None = None,
) -> Mask | None:
    """Return the object in ``box`` as a mask (H, W) by the model ``cutter``; None, with a notice, if it found nothing.

    others: (H, W) pixels of other objects, which the model is not shown. strokes: certain pixels. Where model and
    colours disagree, ``refine_alpha`` decides. Parts of the object beside specks are kept where others lie between
    them. Raises InputError where the model answers nonsense.
    """
    keep, drop = (None, None) if not strokes else (strokes.keep, strokes.drop)
    answer = cutter.alpha(_painted_over(pixels, box, others), box)
    alpha = refine_alpha(pixels, answer, box=box, keep=keep, drop=drop, others=others)
    found = (alpha > 0.5) & ~others
    mask = largest_part(found, others)
    if strokes:
        mask |= touching(found, strokes.keep)
    asked = max(64.0, LEAST * (box[2] - box[0]) * (box[3] - box[1]), LEAST_OWN * float((answer > 0.5).sum()))
    if mask.sum() < asked:
        notice(f"{name}: the model found nothing of its own in its box; it is cut out by colour and texture instead")
        return None
    return mask


def _painted_over(pixels: Pixels, box: Box, others: Mask) -> Pixels:
    """``pixels`` with ``others`` in the colours around them, so that they do not stand out; coarse, near the box."""
    if not others.any():
        return pixels
    reach = max(box[2] - box[0], box[3] - box[1]) // 2
    window = np.s_[max(0, box[1] - reach) : box[3] + reach, max(0, box[0] - reach) : box[2] + reach]
    part, taken = pixels[window], others[window]
    if not taken.any() or taken.all():
        return pixels
    scale = min(1.0, 160.0 / max(taken.shape))
    size = (max(2, round(taken.shape[1] * scale)), max(2, round(taken.shape[0] * scale)))
    small = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    # Pixels that are partly another's have its colours, too.
    share = cv2.resize(taken.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    hole = cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    filled = cv2.resize(
        cv2.inpaint(small, hole, 3, cv2.INPAINT_TELEA), taken.shape[::-1], interpolation=cv2.INTER_LINEAR
    )
    near = grown(taken, 2)
    result = pixels.copy()
    result[window][near] = filled[near]
    return result


MAX_PIXELS = 200_000_000
"""Above this a file is treated as a decompression bomb, as for photos."""
PROPORTIONS = 0.02
"""Largest relative difference between its aspect ratio and the photo's; rounding of small masks stays below it."""
NOISE = 16
"""Grey values by which JPEG makes a uniform picture uneven."""
_SIXTEEN_BITS = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")


def read_mask(path: Path, width: int, height: int) -> Mask:
    """Return the mask (height, width) in the picture ``path``, at the size of the working photo.

    Any mode: opacity where it varies, else brightness, thresholded halfway between the darkest and the brightest value.
    EXIF rotation is applied. Raises InputError when the file is missing, damaged, too large, of another aspect ratio
    than the photo, or empty or full.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with (
                open_file(path, MAX_PICTURE_BYTES, what="picture") as file,
                Image.open(file, formats=PICTURE_FORMATS) as image,
            ):
                return _decode(path, image, width, height)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such mask; check the path") from None
    except UnidentifiedImageError:
        raise InputError(f"{path}: is not an image; give the mask as a PNG or JPEG file") from None
    except (Image.DecompressionBombError, MemoryError):
        raise InputError(f"{path}: is too large for a mask; save it in the photo's size") from None
    # Decoders of damaged files raise arbitrary exceptions (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(
            f"{path}: cannot be read as a mask ({type(error).__name__}: {error}); it may be damaged, save it again"
        ) from error


def _decode(path: Path, image: Image.Image, width: int, height: int) -> Mask:
    if image.width * image.height > MAX_PIXELS:
        raise InputError(f"{path}: has {image.width}x{image.height} pixels; save the mask in the photo's size")
    upright = ImageOps.exif_transpose(image)
    across = upright.width * height / (upright.height * width)
    # Allow for one pixel of rounding.
    slack = 1.0 / min(upright.width, upright.height, width, height)
    if abs(across - 1.0) > PROPORTIONS + slack:
        raise InputError(
            f"{path}: is {upright.width}x{upright.height} pixels, of another aspect ratio than the photo "
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
    """One value (H, W) for each pixel: opacity where it varies, else the brightest channel."""
    if image.mode in _SIXTEEN_BITS:
        return np.nan_to_num(np.asarray(image, dtype=np.float32))
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"))
        if rgba[..., 3].min() < rgba[..., 3].max():
            return np.asarray(rgba[..., 3], dtype=np.float32)
        return np.asarray(rgba[..., :3].max(axis=2), dtype=np.float32)
    # Palette colours stand for objects: use the brightest channel, or a dark blue one would count as background.
    return np.asarray(np.asarray(image.convert("RGB")).max(axis=2), dtype=np.float32)


def segment_objects(
    picture: Photo,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    store: StageCache,
    steps: Steps,
) -> tuple[list[Mask], list[Box]]:
    """Return the visible mask (H, W) of each of the ``objects``, which have names, and the box to search it in.

    Masks are disjoint; boxes are in working pixels. Raises InputError for a box or mask that cannot be used, and when
    two objects are the same.
    """
    names = [item.name or "" for item in objects]
    size = (picture.width, picture.height)
    given = {i: read_mask(item.mask, *size) for i, item in enumerate(objects) if item.mask is not None}
    boxes = [
        extent_of(given[i]) if item.box is None else pixel_box(item.box, picture.scale, *size, name)
        for i, (item, name) in enumerate(zip(objects, names, strict=True))
    ]
    strokes = [drawn_strokes(item, picture, box, steps.notice) for item, box in zip(objects, boxes, strict=True)]
    require_apart(strokes, names, picture.scale)
    wanted = [i for i in range(len(objects)) if i not in given]
    soft: SoftSegmenter | None = None
    if options.segmenter is not None and wanted:
        cutter = resolve("segmenter", trusted_spec(options.segmenter), steps.cancelled)
        steps.notice(f"cut-outs: by {options.segmenter}; --segmenter none cuts out by colour and texture instead")
        if isinstance(cutter, SoftSegmenter):
            soft = cutter
        else:
            cut_out = zip(wanted, cutter(picture.pixels, _corners(boxes, wanted)), strict=True)
            given |= {i: (mask | strokes[i].keep) & ~strokes[i].drop for i, mask in cut_out}
    masks: dict[int, Mask] = dict(given)
    # Objects within another one's box, a toy on a chair, come first, so that the other can exclude their pixels.
    for i in sorted(range(len(names)), key=lambda i: _area(boxes[i])):
        steps.begin(f"segment {names[i]}")
        if i in given:
            continue
        known = [mask for j, mask in masks.items() if j in given or _within(boxes[j], boxes[i])]
        others = _near(boxes[i], np.logical_or.reduce([np.zeros(size[::-1], dtype=bool), *known]))
        if soft is not None:
            # A model takes what stands out most: all that is known of others is kept from it.
            taken = _near(boxes[i], np.logical_or.reduce([np.zeros(size[::-1], dtype=bool), *masks.values()]))
            by_model = partial(_cut_out, soft, picture.pixels, boxes[i], names[i], taken, strokes[i])
            inputs = {"pixels": picture.pixels, "box": boxes[i], "name": names[i], "others": taken}
            inputs |= {"keep": strokes[i].keep, "drop": strokes[i].drop}
            model = {"model": adapter_content("segmenter", options.segmenter)}
            cut = np.asarray(store.run("cut-out", inputs | model, by_model)["mask"], dtype=bool)
            if cut.any():
                masks[i] = cut
                continue
        made = store.run(
            "segment",
            {"pixels": picture.pixels, "box": boxes[i], "name": names[i], "rounds": options.grabcut_iterations}
            | {"others": others, "keep": strokes[i].keep, "drop": strokes[i].drop},
            partial(_segmented, picture.pixels, boxes[i], names[i], options, others, strokes[i]),
        )
        masks[i] = np.asarray(made["mask"], dtype=bool)
    ordered = [masks[i] for i in range(len(names))]
    return _distinct(ordered, names, [i in given for i in range(len(names))]), boxes


def _area(box: Box) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _near(box: Box, mask: Mask) -> Mask:
    """``mask`` (H, W) restricted to one box size around ``box``: pixels further away do not affect the segmentation."""
    width, height = box[2] - box[0], box[3] - box[1]
    window = (
        slice(max(0, box[1] - height), box[3] + height),
        slice(max(0, box[0] - width), box[2] + width),
    )
    result = np.zeros_like(mask)
    result[window] = mask[window]
    return result


def _within(inner: Box, outer: Box) -> bool:
    """Return whether ``inner`` lies mostly within ``outer`` and is clearly smaller; two boxes around one object are
    not."""
    width = min(inner[2], outer[2]) - max(inner[0], outer[0])
    height = min(inner[3], outer[3]) - max(inner[1], outer[1])
    common = max(width, 0) * max(height, 0)
    return common > 0.7 * _area(inner) and _area(inner) < 0.7 * _area(outer)


def _segmented(
    pixels: NDArray[np.uint8],
    box: Box,
    name: str,
    options: ReconstructOptions,
    others: Mask,
    strokes: Strokes,
    notice: Notice,
) -> Arrays:
    return {"mask": segment(pixels, box, name, options.grabcut_iterations, notice, others=others, strokes=strokes)}


def _cut_out(
    soft: SoftSegmenter,
    pixels: NDArray[np.uint8],
    box: Box,
    name: str,
    others: Mask,
    strokes: Strokes,
    notice: Notice,
) -> Arrays:
    found = model_mask(soft, pixels, box, name, others, notice, strokes=strokes)
    return {"mask": np.zeros(pixels.shape[:2], dtype=bool) if found is None else found}


def _corners(boxes: Sequence[Box], wanted: Sequence[int]) -> NDArray[np.float64]:
    return np.array([boxes[i] for i in wanted], dtype=np.float64)


def _mostly_in(mask: Mask, other: Mask) -> bool:
    area = int(mask.sum())
    return area < int(other.sum()) and int((mask & other).sum()) > 0.4 * area


def _distinct(masks: Sequence[Mask], names: Sequence[str], given: Sequence[bool]) -> list[Mask]:
    """``masks`` made disjoint: a user's mask keeps its pixels, then an object mostly within the other (a toy on a
    chair), then the object that is lower in the photo, hence nearer.

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
