# SPDX-License-Identifier: MIT
"""Cut an object out of the photo from a loose box: GrabCut (Rother, Kolmogorov & Blake, SIGGRAPH 2004).

A first pass on a small copy of the box and its surroundings finds the object; a second pass at full resolution
may only move the outline within a narrow band, which is fast and cannot leak.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .mask_cleanup import (
    drop_ground_shadow,
    fill_holes,
    largest_component,
    open_holes,
    settle_outline,
    smooth_outline,
)

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

COARSE_SIZE = 400
"""Longest side in pixels of the copy that the first pass works on."""
FINE_PIXELS = 1_200_000
"""The second pass is left out on larger crops; the first pass' outline is then only smoothed."""
PADDING = 0.35
"""Surroundings that GrabCut learns the background from, as a fraction of the box' longer side."""
MIN_AREA = 64
"""Pixels; anything smaller has no shape worth inflating."""


def pixel_box(box: Sequence[float], scale: float, width: int, height: int, where: str) -> Box:
    """``box`` of the upright original, cut to the working photo of ``width`` x ``height`` pixels.

    Raises InputError when the box has no area, or lies outside the photo.
    """
    x0, y0, x1, y1 = (float(v) * scale for v in box)
    shown = ",".join(f"{v:g}" for v in box)
    if x1 <= x0 or y1 <= y0:
        raise InputError(f"{where}: box {shown} has no area; give x0,y0,x1,y1 with x0 < x1 and y0 < y1")
    left, top = max(0, int(np.floor(x0))), max(0, int(np.floor(y0)))
    right, bottom = min(width, int(np.ceil(x1))), min(height, int(np.ceil(y1)))
    if right <= left or bottom <= top:
        size = f"{width / scale:.0f}x{height / scale:.0f}"
        raise InputError(f"{where}: box {shown} lies outside the photo of {size} pixels; draw it around the object")
    if min(right - left, bottom - top) < 6:
        raise InputError(f"{where}: box {shown} is too thin to hold an object; draw it around the whole object")
    return left, top, right, bottom


def segment(
    pixels: NDArray[np.uint8], box: Box, where: str, iterations: int = 6, warn: Callable[[str], None] = lambda _: None
) -> Mask:
    """The object in ``box`` as a mask (H, W).

    pixels: (H, W, 3) sRGB. where: names the object in messages. warn: told when the mask is a guess.
    Holes stay where the background shows through. Raises InputError when nothing or everything is cut out.
    """
    height, width = pixels.shape[:2]
    x0, y0, x1, y1 = box
    margin = int(np.ceil(PADDING * max(x1 - x0, y1 - y0))) + 2
    left, top = max(0, x0 - margin), max(0, y0 - margin)
    right, bottom = min(width, x1 + margin), min(height, y1 + margin)
    crop = np.ascontiguousarray(pixels[top:bottom, left:right])
    inner = (x0 - left, y0 - top, x1 - left, y1 - top)
    if (x1 - x0) * (y1 - y0) > 0.98 * width * height:
        raise InputError(f"{where}: the box covers the whole photo; leave background around the object")
    found = _coarse(crop, inner, iterations)
    if found.sum() < max(MIN_AREA, 0.01 * (x1 - x0) * (y1 - y0)):
        warn(f"{where}: colour does not tell the object from the background; an ellipse in the box is used instead")
        found = _ellipse(crop.shape[:2], inner)
    else:
        found = open_holes(crop, found)
        if crop.shape[0] * crop.shape[1] <= FINE_PIXELS:
            found = _fine(crop, found)
        found = settle_outline(crop, drop_ground_shadow(crop, largest_component(found)))
    found = fill_holes(crop, largest_component(found))
    found = largest_component(smooth_outline(found))
    found[:, : inner[0]] = found[: inner[1]] = False
    found[:, inner[2] :] = found[inner[3] :] = False
    mask = np.zeros((height, width), dtype=bool)
    mask[top:bottom, left:right] = found
    if mask.sum() < MIN_AREA:
        raise InputError(f"{where}: nothing was found in the box; draw it closer around the object")
    for side in _cut_sides(mask, box):
        warn(f"{where}: reaches the {side} edge of its box and may be cut there; draw the box larger")
    return mask


def _cut_sides(mask: Mask, box: Box, share: float = 0.2) -> list[str]:
    """Sides of ``box``, inside the photo, along which ``mask`` touches more than ``share`` of the side."""
    height, width = mask.shape
    x0, y0, x1, y1 = box
    sides = (
        ("left", x0 > 0, mask[y0:y1, x0]),
        ("top", y0 > 0, mask[y0, x0:x1]),
        ("right", x1 < width, mask[y0:y1, x1 - 1]),
        ("bottom", y1 < height, mask[y1 - 1, x0:x1]),
    )
    return [name for name, inside, edge in sides if inside and edge.mean() > share]


def check_distinct(masks: Sequence[Mask], names: Sequence[str]) -> None:
    """Raise InputError when two masks show the same object, or one lies within another."""
    for first in range(len(masks)):
        for second in range(first + 1, len(masks)):
            common = int((masks[first] & masks[second]).sum())
            smaller = min(int(masks[first].sum()), int(masks[second].sum()))
            if common > 0.5 * smaller:
                raise InputError(
                    f"boxes of {names[first]} and {names[second]}: both hold the same object "
                    f"({100 * common / smaller:.0f} % in common); draw one box around each object"
                )


def _grabcut(crop: NDArray[np.uint8], labels: NDArray[np.uint8], iterations: int) -> Mask:
    cv2.setRNGSeed(0)  # k-means starts from random centres; the same photo must give the same mask
    models: tuple[Any, Any] = (np.zeros((1, 65)), np.zeros((1, 65)))
    try:
        cv2.grabCut(crop, labels, (0, 0, 1, 1), models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        # A crop of one colour, or without background: the caller falls back.
        return np.zeros(labels.shape, dtype=bool)
    return (labels & 1).astype(bool)


def _coarse(crop: NDArray[np.uint8], inner: Box, iterations: int) -> Mask:
    height, width = crop.shape[:2]
    scale = min(1.0, COARSE_SIZE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
    labels = np.full(small.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    x0, y0, x1, y1 = (round(v * scale) for v in inner)
    labels[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_BGD).any():
        labels[[0, -1]] = labels[:, [0, -1]] = cv2.GC_BGD
    found = _grabcut(np.ascontiguousarray(small), labels, iterations)
    full = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(full > 0.5)


def _fine(crop: NDArray[np.uint8], found: Mask) -> Mask:
    """``found`` with its outline decided at full resolution, within a band of a few pixels."""
    band = max(3, round(2.0 * max(crop.shape[:2]) / COARSE_SIZE))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    binary = found.astype(np.uint8)
    labels = np.where(found, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[cv2.erode(binary, kernel, borderValue=0) > 0] = cv2.GC_FGD
    labels[cv2.dilate(binary, kernel) == 0] = cv2.GC_BGD
    refined = _grabcut(crop, labels, 2)
    # Colours that both sides share can make the band collapse: keep the first outline then.
    return refined if 0.9 * found.sum() < refined.sum() < 1.1 * found.sum() else found


def _ellipse(shape: tuple[int, ...], inner: Box) -> Mask:
    x0, y0, x1, y1 = inner
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    across = (columns - (x0 + x1) / 2) / ((x1 - x0) / 2)
    down = (rows - (y0 + y1) / 2) / ((y1 - y0) / 2)
    return np.asarray(across**2 + down**2 < 0.96)
