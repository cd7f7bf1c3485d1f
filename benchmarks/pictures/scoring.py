# SPDX-License-Identifier: GPL-3.0-or-later
"""How close what was found is to what is true. Arrays in, numbers out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.metrics import psnr
from physgen.sim.scene.model import Camera

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

MOST_DB = 60.0
"""Equal pictures count as this: no median is infinite."""
_FINER, _BITS = 8, 4


def iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks (H, W), 0 to 1; 1 for two empty ones."""
    union = int((first | second).sum())
    return 1.0 if union == 0 else int((first & second).sum()) / union


def psnr_within(found: Pixels, true: Pixels, where: Mask) -> float:
    """PSNR in dB of (H, W, 3) pictures among the pixels ``where`` (H, W), at most ``MOST_DB``."""
    return min(MOST_DB, psnr(found, true, where))


def grown(mask: Mask, pixels: int) -> Mask:
    """``mask`` (H, W) and what lies up to so many pixels from it."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def plain_inpainting(photo: Pixels, hole: Mask) -> dict[str, Pixels]:
    """What OpenCV fills into ``hole``: by Telea's method and by Navier-Stokes."""
    filled = hole.astype(np.uint8)
    return {
        "telea": np.asarray(cv2.inpaint(photo, filled, 5, cv2.INPAINT_TELEA), np.uint8),
        "navier_stokes": np.asarray(cv2.inpaint(photo, filled, 5, cv2.INPAINT_NS), np.uint8),
    }


def silhouette(camera: Camera, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Mask:
    """(H, W) the pixels that a mesh covers by more than half. vertices: (V, 3) world metres; faces: (T, 3).

    Triangles that reach behind the camera are left out.
    """
    seen = camera.project(vertices)
    ahead = seen[:, 2] > 1e-6
    canvas = np.zeros((camera.height * _FINER, camera.width * _FINER), np.uint8)
    # OpenCV counts from the middle of the top left pixel, cameras from its corner.
    reach = 1 << 26
    fine = np.clip((seen[:, :2] * _FINER - 0.5) * (1 << _BITS), -reach, reach)
    points = np.rint(np.where(np.isfinite(fine), fine, 0.0)).astype(np.int32)
    for triangle in np.asarray(faces)[ahead[faces].all(axis=1)]:
        cv2.fillConvexPoly(canvas, points[triangle], 255, lineType=cv2.LINE_8, shift=_BITS)
    return np.asarray(cv2.resize(canvas, (camera.width, camera.height), interpolation=cv2.INTER_AREA) > 127)


def fov_deg(camera: Camera) -> float:
    """Angle of view along the longer side."""
    along = (camera.width, camera.fx) if camera.width >= camera.height else (camera.height, camera.fy)
    return math.degrees(2.0 * math.atan(along[0] / 2.0 / along[1]))


def up_in_camera(camera: Camera, normal: Sequence[float]) -> NDArray[np.float64]:
    """The ground's unit normal (3,) in the camera's axes: right, down, ahead."""
    turned = np.asarray(camera.world_from_camera)[:3, :3].T @ np.asarray(normal, dtype=np.float64)
    return np.asarray(turned / np.linalg.norm(turned))


def angle_deg(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Between two vectors (3,)."""
    cross = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(cross, float(np.dot(first, second))))


def volume(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> float:
    """Inside a closed mesh, cubic units; by the divergence theorem."""
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    return abs(float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) / 6.0


def pairs_in_order(covers: dict[str, Mask], order: Sequence[str], found: dict[str, int]) -> list[bool]:
    """For each pair of which one hides more than a hundredth of the other, whether ``found`` says so too.

    covers: whole outlines (H, W); order: names from the front to the back; found: places, 0 in front.
    """
    said = []
    for i, front in enumerate(order):
        for back in order[i + 1 :]:
            shared = int((covers[front] & covers[back]).sum())
            if shared > 0.01 * int(covers[back].sum()):
                said.append(found[front] < found[back])
    return said


def median(values: Sequence[float]) -> float | None:
    """None of nothing."""
    return float(np.median(values)) if values else None
