# SPDX-License-Identifier: MIT
"""Which of PhysGen3D's two poses of an object fits the photo.

``perception.py`` at 72d7b63 improves every object's pose by descent, but always against the mask of the first one, so
that the others may come out moved away. Its simulation does not use them. Where the object's own mask is there, it
decides.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 384
"""Pixels of the longer side of the picture in which silhouettes are compared."""
CLEARLY, LEAST = 0.05, 0.5
"""Overlap by which the first pose must be better, and what it must have, to be taken instead of the improved one."""

Mask = NDArray[np.bool_]


def silhouette(
    points: NDArray[np.float64], faces: NDArray[np.int64], view: tuple[float, float, float], width: int, height: int
) -> Mask:
    """Where a mesh is seen, (h, w), scaled so that the longer side has ``SIDE`` pixels at most.

    points: (V, 3) on the camera's axes; faces: (T, 3); view: f, cx, cy in pixels of ``width`` x ``height``. Triangles
    that reach behind the camera are left out.
    """
    scale = min(1.0, SIDE / max(width, height))
    picture = np.zeros((max(1, round(height * scale)), max(1, round(width * scale))), dtype=np.uint8)
    focal, cx, cy = view
    ahead = points[:, 2] > 1e-9
    depth = np.where(ahead, points[:, 2], 1.0)
    pixels = np.stack([focal * points[:, 0] / depth + cx, focal * points[:, 1] / depth + cy], axis=1) * scale
    # Sixteenths of a pixel, whose centres OpenCV has at whole numbers.
    fixed = np.clip(np.round((pixels - 0.5) * 16), -(2**24), 2**24).astype(np.int32)
    for triangle in faces[ahead[faces].all(axis=1)]:
        cv2.fillConvexPoly(picture, fixed[triangle], 255, shift=4)
    return np.asarray(picture > 0)


def overlap(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks of one size, 0 where both are empty."""
    union = np.count_nonzero(first | second)
    return float(np.count_nonzero(first & second) / union) if union else 0.0


def better_pose(
    mesh: tuple[NDArray[np.float64], NDArray[np.int64]],
    first: NDArray[np.float64],
    improved: NDArray[np.float64],
    mask: Mask | None,
    view: tuple[float, float, float],
) -> tuple[NDArray[np.float64], bool]:
    """``improved`` unless ``first``, both (4, 4), fits the photo clearly better; and whether it was taken.

    mesh: vertices (V, 3) and faces (T, 3); mask: (H, W) of the photo, or None; view: f, cx, cy. A pose that is not all
    before the camera, or further from ``first`` than the object is large, is no improvement: the descent takes small
    steps. Otherwise the overlap with the mask decides, and without a mask ``improved`` is taken.
    """
    vertices, faces = mesh
    before, after = (vertices @ matrix[:3, :3].T + matrix[:3, 3] for matrix in (first, improved))
    moved = float(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)))
    if not (after[:, 2] > 0).all() or moved > float(np.ptp(before, axis=0).max()):
        return first, False
    if mask is None:
        return improved, True
    height, width = mask.shape
    scores = []
    for points in (before, after):
        seen = silhouette(points, faces, view, width, height)
        small = cv2.resize(mask.astype(np.uint8), seen.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        scores.append(overlap(seen, small))
    taken = scores[0] < max(LEAST, scores[1] + CLEARLY)
    return (improved if taken else first), taken
