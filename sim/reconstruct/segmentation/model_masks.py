# SPDX-License-Identifier: MIT
"""Masks from a model's soft opacities, corrected by the colours of object and background."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..adapters.protocols import SoftSegmenter
from ..stage_cache import Notice
from .mask_cleanup import touching
from .mask_proposals import largest_part
from .matting import refine_alpha
from .strokes import Strokes

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Box = tuple[int, int, int, int]

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
    grown = cv2.dilate(taken.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    result = pixels.copy()
    result[window][grown] = filled[grown]
    return result
