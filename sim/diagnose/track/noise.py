# SPDX-License-Identifier: MIT
"""How far tracked pixels scatter."""

from __future__ import annotations

import numpy as np

from .pose import Array

FLOOR_PX = 0.05
"""Nobody tracks better than this in compressed video, whatever a short still take seems to show."""


def pose_scatter(residual: Array) -> float | None:
    """Standard deviation in px of one coordinate of ``residual`` (T, K, 2) about fitted poses; None with too few.

    Robust (median absolute deviation), with the six numbers that each frame's pose takes away from its scatter.
    """
    seen = np.isfinite(residual).all(axis=2)
    per_frame = seen.sum(axis=1)
    rows = per_frame >= 5
    if not rows.any():
        return None
    values = residual[rows][seen[rows]]
    share = (2 * per_frame[rows] - 6).sum() / (2 * per_frame[rows]).sum()
    return 1.4826 * float(np.median(np.abs(values))) / float(np.sqrt(share))


def jitter(residual: Array) -> float | None:
    """Standard deviation in px of what changes from frame to frame in ``residual`` (T, K, 2); None with too few.

    Third differences over time, which smooth motion and a wrong mesh leave small; white noise of standard deviation s
    gives them one of sqrt(20) s.
    """
    if len(residual) < 4:
        return None
    differences = np.diff(residual, n=3, axis=0)
    values = differences[np.isfinite(differences)]
    return None if len(values) < 20 else 1.4826 * float(np.median(np.abs(values))) / float(np.sqrt(20.0))
