# SPDX-License-Identifier: MIT
"""Masks from a model's soft opacities, cleaned of what is not connected with the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..adapters.protocols import SoftSegmenter
from ..stage_cache import Notice
from .mask_proposals import largest_part

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

LEAST = 0.01
"""Share of the box below which a model is taken to have found nothing."""


def model_mask(
    cutter: SoftSegmenter, pixels: NDArray[np.uint8], box: Box, name: str, others: Mask, notice: Notice
) -> Mask | None:
    """Return the object in ``box`` as a mask (H, W) by the model ``cutter``; None, with a notice, if it found nothing.

    others: (H, W) pixels of other objects. Parts of the object beside specks are kept where others lie between them.
    Raises InputError where the model answers nonsense.
    """
    found = (cutter.alpha(pixels, box) > 0.5) & ~others
    mask = largest_part(found, others)
    if mask.sum() < max(64, LEAST * (box[2] - box[0]) * (box[3] - box[1])):
        notice(f"{name}: the model found nothing in its box; it is cut out by colour and texture instead")
        return None
    return mask
