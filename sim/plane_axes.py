# SPDX-License-Identifier: MIT
"""Axes in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def plane_axes(normal: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two unit vectors (3,) that span the plane with the unit vector ``normal`` (3,), right-handed with it."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
