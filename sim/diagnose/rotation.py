# SPDX-License-Identifier: MIT
"""The rotation nearest to what was measured: one place for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest_rotation(moment: Array, *, hand: float = 1.0) -> Array:
    """Rotation (3, 3) nearest to ``moment`` (3, 3), such as the sum of seen times rest points about their middles.

    hand: 1 for a rotation, -1 for one that mirrors. Kabsch, Acta Cryst. A 32 (1976).
    """
    u, _, vt = np.linalg.svd(moment)
    return np.asarray((u * np.array([1.0, 1.0, hand * np.sign(np.linalg.det(u @ vt))])) @ vt)


def nearest_pose(rest: Array, seen: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) that carry ``rest`` (K, 3) nearest to ``seen`` (K, 3)."""
    here, there = rest.mean(axis=0), seen.mean(axis=0)
    turn = nearest_rotation((seen - there).T @ (rest - here))
    return turn, there - turn @ here
