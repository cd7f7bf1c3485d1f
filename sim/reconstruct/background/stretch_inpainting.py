# SPDX-License-Identifier: MIT
"""Inpaint an irregular surface, such as grass or gravel, with stretches of it: large copies from the same height.

Nothing foretells where a blade of grass is. Whether blades are as long, as sharp and as bright as beside the hole is
seen at once, and copies that are large and come from about the same distance are all of that. They overlap, and meet
where they differ least (Kwatra et al., "Graphcut textures", SIGGRAPH 2003).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.inpaint import FillOptions
from .surface_inpainting import clamp_to_surroundings, fill_surface, light_field, logarithms
from .texture_prediction import Stretch, stretches

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

MOST = 10
"""Most stretches of one hole."""
LEVEL = 2.0
"""Cost of a stretch from other rows, over the photo's height: there blades are larger or smaller."""
COST = 100.0
"""Scale of logarithms in the search for seams, whose costs are rounded."""


def fill_stretches(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """Return ``picture`` (h, w, 3), values 0 to 255, with ``hole`` (h, w) inpainted from pixels in neither it nor
    ``barred`` (h, w); what no stretch covers, as a surface.

    Raises InputError when nothing is left to inpaint from, or the native library is missing.
    """
    known = ~(hole | barred)
    logs = logarithms(picture)
    slow, lack = light_field(logs, known, hole)
    detail = np.where(known[..., None], logs - slow - lack, 0.0).astype(np.float32)
    # Pixels beside unknown ones are mixed with them.
    inner = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    found = list(stretches(hole, inner, most=MOST, level=LEVEL))
    covered = np.zeros_like(hole)
    for stretch, own in zip(found, _joined(found, detail, hole), strict=True):
        detail[own] = stretch.copied(detail)[own]
        covered |= own
    new = np.where(covered[..., None], detail + slow, logs).astype(np.float32)
    filled = np.exp(clamp_to_surroundings(new, covered, known)) if covered.any() else picture
    result = np.where(covered[..., None], filled, picture).astype(np.float32)
    left = hole & ~covered
    return fill_surface(result, left, barred, options) if left.any() else result


def _joined(found: list[Stretch], detail: Picture, hole: Mask) -> list[Mask]:
    """The part (h, w) of the hole that each stretch gets, by cuts along which the copies of ``detail`` differ least."""
    if len(found) < 2:
        return [stretch.there for stretch in found]
    rows, columns = (slice(int(axis.min()), int(axis.max()) + 1) for axis in np.nonzero(hole))
    copies = [np.ascontiguousarray(COST * item.copied(detail)[rows, columns], np.float32) for item in found]
    masks = [255 * np.ascontiguousarray(item.there[rows, columns], np.uint8) for item in found]
    # OpenCV's declared types know only its own matrices here.
    finder: Any = cv2.detail.GraphCutSeamFinder("COST_COLOR")
    cut = finder.find(copies, [(0, 0)] * len(found), masks)
    parts = []
    left = hole.copy()
    for item in cut:
        own = np.zeros_like(hole)
        own[rows, columns] = np.asarray(item.get() if isinstance(item, cv2.UMat) else item) > 0
        parts.append(own & left)
        left &= ~own
    return parts
