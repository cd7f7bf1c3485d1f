# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of a proxy's vertices under a light at the viewer's shoulder. Plain numpy: no window is needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TINT = (0.22, 0.62, 1.0)
OPACITY = 0.72
AMBIENT = 0.35
LIGHT = np.array((0.35, -0.45, 0.82), dtype=np.float32)
"""Unit vector towards the light, in world axes."""


def colours(points: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """RGBA (V, 4) of vertices (V, 3) of triangles (T, 3) in plain sRGB."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    corners = faces.T.ravel()
    sums = np.stack(
        [np.bincount(corners, weights=np.tile(normals[:, i], 3), minlength=len(points)) for i in range(3)], axis=1
    )
    lengths = np.maximum(np.linalg.norm(sums, axis=1), 1e-30)
    light = AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * (sums @ LIGHT) / lengths)
    result = np.empty((len(points), 4), dtype=np.float32)
    result[:, :3] = light[:, None] * np.asarray(TINT)
    result[:, 3] = OPACITY
    return result
