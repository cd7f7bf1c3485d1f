# SPDX-License-Identifier: MIT
"""Points from one frame to the next by pyramidal Lucas–Kanade (Bouguet 2000, cv2.calcOpticalFlowPyrLK), both ways."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .pose import Array

LEVELS = 4
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def follow(
    before: NDArray[np.uint8], now: NDArray[np.uint8], places: Array, guesses: Array, half: int
) -> tuple[Array, Array]:
    """Where ``places`` (N, 2) of ``before`` are ``now``, and by how many pixels the way back misses: (N, 2), (N,).

    guesses: (N, 2) where they may be. The miss is infinite where a point was lost.
    """
    if len(places) == 0:
        return places.copy(), np.empty(0)
    start = (places - 0.5).astype(np.float32).reshape(-1, 1, 2)
    first = (guesses - 0.5).astype(np.float32).reshape(-1, 1, 2)
    size = (2 * half + 1, 2 * half + 1)
    flag = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, now, start, first.copy(), winSize=size, maxLevel=LEVELS, criteria=_STOP, flags=flag
    )
    # The way back begins as far off as the way there did: begun at the answer it would agree with any wrong turn.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        now, before, there, there - (first - start), winSize=size, maxLevel=LEVELS, criteria=_STOP, flags=flag
    )
    miss = np.linalg.norm((back - start)[:, 0].astype(np.float64), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & np.isfinite(miss)
    return there[:, 0].astype(np.float64) + 0.5, np.where(good, miss, np.inf)
