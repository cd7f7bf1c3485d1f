# SPDX-License-Identifier: MIT
"""The cheapest division of a picture in object and rest: a graph cut with any costs of single pixels.

OpenCV's grabCut holds a fast max-flow solver for pixel grids (Boykov & Kolmogorov, PAMI 2004), but computes the pixels'
costs from its own colour models. With models frozen to one Gaussian each, alike but for their means along the first
channel, the difference of the two costs is linear in that channel: so any costs can be given through it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

LEVELS = 60.0
"""Grey values over which the costs are spread; few, for differences in them count as contrast too."""
LIMIT = 10.0
"""Log likelihood ratios are cut off here."""


def graph_cut(ratio: NDArray[np.float32], contrast: NDArray[np.uint8], smoothness: float, *, barred: Mask) -> Mask:
    """Where (H, W) the object is.

    ratio: (H, W) log likelihood ratio of object to rest. contrast: (H, W, 2) two channels in whose differences the
    outline prefers to run. smoothness: cost of a pixel of outline across equal colours, at least 1, in units of
    ``ratio``. barred: certainly not the object.
    """
    level = (np.clip(ratio, -LIMIT, LIMIT) + LIMIT) / (2.0 * LIMIT) * LEVELS
    image = np.dstack([np.round(level).astype(np.uint8), contrast])
    # grabCut's smoothness is 50: costs are made as large as that asks. Between the two ends lies LEVELS² / variance.
    variance = LEVELS**2 / (2.0 * LIMIT * 50.0 / smoothness)
    rest, own = _single_gaussian(0.0, variance), _single_gaussian(LEVELS, variance)
    labels = np.where(ratio > 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[barred] = cv2.GC_BGD
    cv2.grabCut(np.ascontiguousarray(image), labels, (0, 0, 1, 1), rest, own, 1, cv2.GC_EVAL_FREEZE_MODEL)
    return np.asarray((labels & 1).astype(bool))


def _single_gaussian(mean: float, variance: float) -> NDArray[np.float64]:
    """grabCut's model: 5 weights, 5 means of 3 numbers, 5 covariances of 9; only the first is used."""
    model = np.zeros((1, 65))
    model[0, 0] = 1.0
    model[0, 5] = mean
    # The other two channels shall not count: equal means and a wide spread in both models.
    model[0, 20:29] = np.diag([variance, 1e8, 1e8]).ravel()
    return model
