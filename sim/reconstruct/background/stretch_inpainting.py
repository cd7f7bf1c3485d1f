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
from ...robust_deviation import robust_deviation
from .relit_ground import smoothed
from .surface_inpainting import clamp_to_surroundings, fill_surface, logarithms
from .texture_prediction import Stretch, stretches

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

MOST = 10
"""Most stretches of one hole."""
LEVEL = 2.0
"""Cost of a stretch from other rows, over the photo's height: there blades are larger or smaller."""
SEAM_PIXELS = 60_000
"""Largest size of the copy on which seams are searched: of a million pixels it took 40 CPU seconds."""
COST = 100.0
"""Scale of logarithms in the search for seams, whose costs are rounded."""


FINE, COARSE = 0.05, 0.15
"""Blurs over the hole's size: below the first is detail, above the second level."""
FINEST, SHARP = 0.003, 0.4
"""Blur over the hole's size, at least a pixel, below which is the finest detail, and its least deviation over that of
all: seams of soft clouds would be seen. Grass and asphalt have 0.55 and 0.62, clouds of rendered concrete 0.18."""
GRAINY = 0.7
"""Robust over plain deviation of the detail above which it is grain, without edges. Grass and asphalt have 0.8 to 0.9,
a floor, tables and a rock 0.3 to 0.4."""
EVEN = 0.35
"""Deviation of the level along rows over that of the detail, below which the surface is the same all along. Grass and
asphalt have 0.1 to 0.2; grass with a tree behind it 0.5, a wall above a table 1.1."""
FEWEST = 100
"""Pixels of a row, or of all, that tell something."""


def is_irregular(picture: Picture, hole: Mask, barred: Mask) -> bool:
    """Return whether what is around ``hole`` (h, w) is grain all along, such as grass, of which any copy will do.

    picture: (h, w, 3), values 0 to 255. barred: (h, w) other pixels that tell nothing.
    """
    known, side = ~(hole | barred), float(np.sqrt(hole.sum()))
    logs = logarithms(picture)
    fine = max(1.0, FINE * side)
    inner = cv2.distanceTransform(known.astype(np.uint8), cv2.DIST_L2, 5) > fine
    if inner.sum() < FEWEST:
        return False
    detail = (logs - smoothed(logs, known, fine)).mean(axis=-1)[inner]
    spread = float(detail.std())
    grain = float(robust_deviation(detail - np.median(detail)))
    finest = float((logs - smoothed(logs, known, max(1.0, FINEST * side))).mean(axis=-1)[inner].std())
    return grain > GRAINY * spread and finest > SHARP * spread and is_even(logs, known, side, spread)


def is_even(values: Picture, known: Mask, side: float, spread: float) -> bool:
    """Return whether the level of ``values`` (h, w, 3), where ``known`` (h, w), is the same all along each row.

    side: of the hole, pixels. spread: deviation of the detail, with which that of the level is compared.
    """
    level = smoothed(values, known, max(1.0, COARSE * side)).mean(axis=-1)
    along = [float(row[seen].std()) for row, seen in zip(level, known, strict=True) if seen.sum() > FEWEST]
    return bool(along) and float(np.mean(along)) < EVEN * spread


def fill_stretches(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """Return ``picture`` (h, w, 3), values 0 to 255, with ``hole`` (h, w) inpainted from pixels in neither it nor
    ``barred`` (h, w); what no stretch covers, as a surface.

    Raises InputError when nothing is left to inpaint from, or the native library is missing.
    """
    known = ~(hole | barred)
    logs = logarithms(picture)
    # Pixels beside unknown ones are mixed with them.
    inner = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    found = list(stretches(hole, inner, most=MOST, level=LEVEL))
    laid, covered = logs.copy(), np.zeros_like(hole)
    for stretch, own in zip(found, _joined(found, logs, hole), strict=True):
        laid[own] = stretch.copied(logs)[own]
        covered |= own
    if covered.any():
        laid = clamp_to_surroundings(laid, covered, known)
    result = np.where(covered[..., None], np.exp(laid), picture).astype(np.float32)
    left = hole & ~covered
    return fill_surface(result, left, barred, options) if left.any() else result


def _joined(found: list[Stretch], logs: Picture, hole: Mask) -> list[Mask]:
    """The part (h, w) of the hole that each stretch gets, by cuts along which the copies of ``logs`` differ least."""
    if len(found) < 2:
        return [stretch.there for stretch in found]
    rows, columns = (slice(int(axis.min()), int(axis.max()) + 1) for axis in np.nonzero(hole))
    height, width = rows.stop - rows.start, columns.stop - columns.start
    scale = min(1.0, float(np.sqrt(SEAM_PIXELS / (height * width))))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    copies, masks = [], []
    for item in found:
        copy = np.where(item.there[..., None], item.copied(logs), 0.0)[rows, columns].astype(np.float32)
        share = cv2.resize(item.there[rows, columns].astype(np.float32), size, interpolation=cv2.INTER_AREA)
        copies.append(COST * cv2.resize(copy, size, interpolation=cv2.INTER_AREA))
        masks.append(255 * (share > 0.99).astype(np.uint8))
    # OpenCV's declared types know only its own matrices here.
    finder: Any = cv2.detail.GraphCutSeamFinder("COST_COLOR")
    cut = finder.find(copies, [(0, 0)] * len(found), masks)
    small = np.full(size[::-1], -1, dtype=np.int16)
    for index, item in enumerate(cut):
        small[np.asarray(item.get() if isinstance(item, cv2.UMat) else item) > 0] = index
    owner = np.full(hole.shape, -1, dtype=np.int16)
    owner[rows, columns] = cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)
    parts = [stretch.there & (owner == index) for index, stretch in enumerate(found)]
    # The border of a stretch lies within a cell of the copy: what is left there goes to the first that covers it.
    left = hole & ~np.logical_or.reduce(parts)
    for index, stretch in enumerate(found):
        parts[index] |= stretch.there & left
        left &= ~stretch.there
    return parts
