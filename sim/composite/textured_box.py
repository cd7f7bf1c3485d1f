# SPDX-License-Identifier: MIT
"""The faces of a box from the frames of a video, and the box drawn with them in another pose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

FACE = 96
"""Pixels along a face's edges."""
LEAST_VIEW = 0.2
"""Cosine between a face's normal and the view from which the face counts as seen."""
BEST_VIEWS = 5
"""Views of a face, the largest ones, whose median is its picture: it hides glare and blur of single frames."""
UNSEEN = 0.6
"""Brightness of a face that was never seen, over the mean of the others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxPose:
    """Where a box is in a picture. corners: (8, 2) px, z changing fastest, then y. facing: (6,) cosine between the
    outward normals (-x, x, -y, y, -z, z) and the direction to the camera; positive for what is in view."""

    corners: Array
    facing: Array


_CORNERS = (
    (0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5),
)  # fmt: skip
"""Corners of the faces -x, x, -y, y, -z, z, around each of them."""
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * FACE


def box_pose(centre: Array, turn: Array, edges: Array, pixels: Callable[[Array], Array], camera: Array) -> BoxPose:
    """Return where a box appears. centre: (3,) m. turn: (3, 3) box to world. edges: (3,) m. pixels: px (..., 2) of
    world points (..., 3). camera: (3,) m."""
    local = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * edges
    normals = np.concatenate([[-turn[:, i], turn[:, i]] for i in range(3)])
    middles = centre + normals * np.repeat(edges / 2, 2)[:, None]
    towards = camera - middles
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return BoxPose(corners=pixels(centre + local @ turn.T), facing=(normals * towards).sum(axis=1))


def box_faces(views: Iterable[tuple[Picture, BoxPose]]) -> NDArray[np.uint8]:
    """Return the faces (6, FACE, FACE, 3) BGR of a box seen in ``views``: the median of the largest views of each; one
    that is never seen gets the mean colour of the others, darker."""
    kept: list[list[tuple[float, Picture]]] = [[] for _ in range(6)]
    for picture, pose in views:
        for k in range(6):
            if pose.facing[k] < LEAST_VIEW or not np.isfinite(pose.corners).all():
                continue
            outline = pose.corners[list(_CORNERS[k])].astype(np.float32)
            if (outline < 0).any() or (outline >= (picture.shape[1], picture.shape[0])).any():
                continue
            area = float(cv2.contourArea(outline))
            if len(kept[k]) < BEST_VIEWS or area > min(v[0] for v in kept[k]):
                # Pixel centres lie at halves.
                map_ = cv2.getPerspectiveTransform(outline - 0.5, _SQUARE - 0.5)
                face = cv2.warpPerspective(picture, map_, (FACE, FACE), flags=cv2.INTER_LINEAR)
                kept[k].append((area, np.asarray(face, np.uint8)))
                kept[k] = sorted(kept[k], key=lambda v: -v[0])[:BEST_VIEWS]
    faces = np.zeros((6, FACE, FACE, 3), np.uint8)
    seen = [k for k in range(6) if kept[k]]
    for k in seen:
        faces[k] = np.median([face for _, face in kept[k]], axis=0).astype(np.uint8)
    rest = UNSEEN * faces[seen].reshape(-1, 3).mean(axis=0) if seen else np.full(3, 110.0)
    for k in set(range(6)) - set(seen):
        faces[k] = rest.astype(np.uint8)
    return faces


def with_box(background: Picture, faces: NDArray[np.uint8], pose: BoxPose) -> Picture:
    """Return ``background`` with the box drawn at ``pose``; as it is where the pose is not finite."""
    out = background.copy()
    if not np.isfinite(pose.corners).all():
        return out
    low = np.clip(np.floor(pose.corners.min(axis=0)).astype(int) - 2, 0, (out.shape[1], out.shape[0]))
    high = np.clip(np.ceil(pose.corners.max(axis=0)).astype(int) + 3, 0, (out.shape[1], out.shape[0]))
    if (high <= low).any():
        return out
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    part = out[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    for k in range(6):  # a box is convex: faces in view do not cover each other
        if pose.facing[k] <= 0:
            continue
        outline = (pose.corners[list(_CORNERS[k])] - low).astype(np.float32)
        map_ = cv2.getPerspectiveTransform(_SQUARE - 0.5, outline - 0.5)
        face = cv2.warpPerspective(faces[k], map_, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
        mask = np.zeros((size[1], size[0]), np.uint8)
        cv2.fillConvexPoly(mask, np.round((outline - 0.5) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        cover = (mask / 255.0).astype(np.float32)[..., None]
        part += cover * (face - part)
    out[low[1] : high[1], low[0] : high[0]] = part.round().astype(np.uint8)
    return out
