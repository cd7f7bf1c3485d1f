# SPDX-License-Identifier: MIT
"""Masks from a model's soft opacities, cleaned of what is not connected with the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..adapters.protocols import SoftSegmenter
from ..stage_cache import Notice
from .mask_cleanup import touching
from .mask_proposals import largest_part
from .matting import refine_alpha
from .strokes import Strokes

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

LEAST = 0.01
"""Share of the box below which a model is taken to have found nothing."""


def model_mask(
    cutter: SoftSegmenter,
    pixels: NDArray[np.uint8],
    box: Box,
    name: str,
    others: Mask,
    notice: Notice,
    *,
    strokes: Strokes | None = None,
) -> Mask | None:
    """Return the object in ``box`` as a mask (H, W) by the model ``cutter``; None, with a notice, if it found nothing.

    others: (H, W) pixels of other objects. strokes: certain pixels. Parts of the object beside specks are kept where
    others lie between them. Raises InputError where the model answers nonsense.
    """
    alpha = cutter.alpha(pixels, box)
    if strokes:
        alpha = refine_alpha(pixels, alpha, box=box, keep=strokes.keep, drop=strokes.drop, others=others)
    found = (alpha > 0.5) & ~others
    mask = largest_part(found, others)
    if strokes:
        mask |= touching(found, strokes.keep)
    if mask.sum() < max(64, LEAST * (box[2] - box[0]) * (box[3] - box[1])):
        notice(f"{name}: the model found nothing in its box; it is cut out by colour and texture instead")
        return None
    return mask
