# SPDX-License-Identifier: MIT
"""Sharpness of outlines: who photographs a thing focuses on it, and what is out of focus is its background.

The width of an edge is the step of colour across it over its steepest slope, as in edge-based measures of defocus
(Elder & Zucker, "Local scale control for edge detection and blur estimation", PAMI 1998).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...srgb import cielab
from .proposal_features import at_size_of, copy_of

Mask = NDArray[np.bool_]

REACH = 8
"""Distance in pixels of the copy to which the colours across an outline are followed, inwards and outwards."""

LEAST_STEP = 10.0
"""Step of colour in CIELAB across an outline below which a point of it tells nothing."""

LEAST_POINTS = 10
"""Points of an outline from which its width is known."""

OUT_OF_FOCUS = (4.0, 2.5)
"""Width in pixels, and over that of the sharpest thing, from which a thing is out of focus. A disc of uniform blur, of
radius r, makes an edge 1.6 r wide; sharp photos have 1 to 2.5 on the copy, fur up to 3."""

FINE = 640
"""Longest side in pixels of the copy on which what is beside the best thing is compared with it: a house behind a can
had 3 times the can's width there, and on the copy of half that size, where a sharp edge is not sharper, twice."""


def outline_width(mask: Mask, lab: NDArray[np.float32]) -> float | None:
    """Return the median width in pixels of the edge along the outline of ``mask`` (h, w); None where nothing tells it.

    lab: (h, w, 3) CIELAB.
    """
    if not mask.any() or mask.all():
        return None
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    down, right = np.gradient(cv2.GaussianBlur(inside - outside, (0, 0), 1.5))
    rows, columns = np.nonzero(mask & (inside < 1.5))
    height, width = mask.shape
    whole = (np.minimum(rows, height - 1 - rows) > REACH) & (np.minimum(columns, width - 1 - columns) > REACH)
    rows, columns = rows[whole], columns[whole]
    normal = np.stack([right[rows, columns], down[rows, columns]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    offsets = np.arange(-REACH, REACH + 0.25, 0.5)
    if len(rows) < LEAST_POINTS:
        return None
    across = columns[:, None] + normal[:, :1] * offsets
    along = rows[:, None] + normal[:, 1:] * offsets
    profile = cv2.remap(lab, across.astype(np.float32), along.astype(np.float32), cv2.INTER_LINEAR)
    step = profile[:, -3:].mean(axis=1) - profile[:, :3].mean(axis=1)
    size = np.linalg.norm(step, axis=1)
    told = size > LEAST_STEP
    if int(told.sum()) < LEAST_POINTS:
        return None
    profile, step, size = profile[told], step[told], size[told]
    value = ((profile - profile[:, :1]) * (step / size[:, None])[:, None]).sum(axis=2)
    slope = np.abs(np.diff(value, axis=1)).max(axis=1) / 0.5
    return float(np.median(size / np.maximum(slope, 1e-6)))


def in_focus(masks: Sequence[Mask], pixels: NDArray[np.uint8]) -> list[bool]:
    """Return for each of ``masks`` (h, w) whether its outline in ``pixels`` (h, w, 3) is about the sharpest.

    Where nothing is sharp, as in a shaken photo, everything is in focus.
    """
    lab = cielab(pixels)
    widths = [outline_width(mask, lab) for mask in masks]
    least, more = OUT_OF_FOCUS
    limit = max(least, more * min((width for width in widths if width is not None), default=0.0))
    return [width is None or width <= limit for width in widths]


def sharp_as(best: int, masks: Sequence[Mask], pixels: NDArray[np.uint8]) -> list[bool]:
    """Return for each of ``masks`` (h, w), of any size, whether its outline in ``pixels`` (H, W, 3) is about as sharp
    as that of the one with the number ``best``.

    Sharp prints say nothing about a round fruit's soft outline, so it is the thing itself that is compared.
    """
    fine = copy_of(pixels, FINE)
    lab = cielab(fine)
    widths = [outline_width(at_size_of(mask, fine), lab) for mask in masks]
    least, more = OUT_OF_FOCUS
    own = widths[best]
    return [own is None or width is None or width <= max(least, more * own) for width in widths]
