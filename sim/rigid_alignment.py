# SPDX-License-Identifier: MIT
"""The rigid motion that best aligns two sets of points (Kabsch, Acta Crystallographica A 32, 1976)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest_rotation(moment: Array, *, hand: float = 1.0) -> Array:
    """Return the rotation (3, 3) nearest to ``moment`` (3, 3), the sum of seen times rest points about their means.

    hand: 1 for a rotation, -1 for a reflection.
    """
    u, _, vt = np.linalg.svd(moment)
    return np.asarray((u * np.array([1.0, 1.0, hand * np.sign(np.linalg.det(u @ vt))])) @ vt)


def nearest_pose(rest: Array, seen: Array, *, weights: Array | None = None) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) that best align ``rest`` (K, 3) with ``seen`` (K, 3).

    weights: (K,) of the squared distances, such as masses; None: all equal.
    """
    here, there = (np.average(points, axis=0, weights=weights) for points in (rest, seen))
    away = seen - there if weights is None else (seen - there) * weights[:, None]
    turn = nearest_rotation(away.T @ (rest - here))
    return turn, there - turn @ here
