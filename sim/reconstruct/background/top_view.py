# SPDX-License-Identifier: MIT
"""Rectified top views of the ground: homographies to the photo, and resampling both ways.

In a top view tiles are equal tiles and boards run parallel, so that visible ground can replace hidden ground. A view
has one resolution, while the photo shows near ground finer than far: a deep hole is split into several views, each over
a range of depth in which the resolution differs little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera

Mask = NDArray[np.bool_]

SPAN = 2.2
"""Ratio of far to near depth in a view's hole. The resolution along the ground goes with the square of the depth."""
FARTHEST = 14.0
"""Depth over that of the hole's nearest ground beyond which ground is treated like a wall: at a grazing angle a pixel
row spans metres."""
ANISOTROPY = 3.0
"""Largest ratio of the two axes' resolutions."""
MORE = 2.5
"""Largest ratio of a view's pixels to the hole's pixels in the photo."""
MARGIN = 0.7
"""Margin of ground around the hole, over the extent of the hole."""


@dataclass(frozen=True)
class TopView:
    """A picture of the ground from above.

    image_from_view: (3, 3) homography from its pixels to the photo's, centres of pixels at (x + 0.5, y + 0.5) in both.
    size: width, height in pixels; x runs across, y away from the camera.
    """

    image_from_view: NDArray[np.float64]
    size: tuple[int, int]

    def positions(self) -> NDArray[np.float64]:
        """Return positions (h, w, 2) in the photo of the view's pixels; not finite behind the camera."""
        x, y = np.meshgrid(np.arange(self.size[0]) + 0.5, np.arange(self.size[1]) + 0.5)
        return _carried(self.image_from_view, x, y)

    def inverse_positions(self, rows: slice, columns: slice, times: int) -> NDArray[np.float64]:
        """Return positions (h·times, w·times, 2) in the view of the photo's pixels, with ``times`` by ``times`` samples
        in each."""
        x, y = np.meshgrid(
            columns.start + (np.arange((columns.stop - columns.start) * times) + 0.5) / times,
            rows.start + (np.arange((rows.stop - rows.start) * times) + 0.5) / times,
        )
        return _carried(np.linalg.inv(self.image_from_view), x, y)


def _carried(matrix: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack(
            [
                (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / depth,
                (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / depth,
            ],
            axis=-1,
        )


def ground_frame(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (3, 3) homography from the ground to the photo, and the unit vector (2,) away from the camera in the
    world.

    Ground coordinates: across to the right of that direction, and along it, from below the camera, over the camera's
    height.
    """
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    ahead = pose[:2, 2] if np.linalg.norm(pose[:2, 2]) > 0.2 else -pose[:2, 1]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
    right = np.array([ahead[1], -ahead[0]])
    rotation = pose[:3, :3].T
    below = np.array([*camera.position[:2], 0.0])
    height = float(camera.position[2])
    columns = np.stack(
        [
            rotation @ np.array([*right, 0.0]),
            rotation @ np.array([*ahead, 0.0]),
            rotation @ (below - camera.position) / height,
        ],
        axis=1,
    )
    return lens_matrix(camera) @ columns, ahead


def lens_matrix(camera: Camera) -> NDArray[np.float64]:
    """Return the (3, 3) matrix from directions in the frame of ``camera`` to its pixels."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def ground_positions(camera: Camera, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return ground coordinates (H, W, 2) of the photo's pixels; NaN where there is no ground."""
    matrix, _ = ground_frame(camera)
    x, y = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    inverse = np.linalg.inv(matrix)
    # The sign of the depth separates ground ahead from sky, which meets the plane behind the camera.
    depth = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
    at = _carried(inverse, x, y)
    at[depth <= 1e-9] = np.nan
    return at


def top_views(camera: Camera, hole: Mask, most_pixels: int) -> list[tuple[TopView, Mask]]:
    """Return views that together cover the ground in ``hole`` (H, W), nearest first, each with its part of the hole.

    Ground beyond ``FARTHEST`` belongs to no part. most_pixels: of one view.
    """
    at = ground_positions(camera, hole.shape)
    along = at[..., 1]
    seen = hole & np.isfinite(along)
    if not seen.any():
        return []
    # Distance from the camera, not from below it: it determines the resolution.
    away = np.sqrt(1.0 + np.square(np.where(seen[..., None], at, 0.0)).sum(axis=-1))
    near = float(np.quantile(away[seen], 0.002))
    far = min(float(away[seen].max()), FARTHEST * near)
    count = max(1, math.ceil(math.log(max(far / near, 1.0)) / math.log(SPAN) - 1e-6))
    edges = near * (far / near) ** (np.arange(count + 1) / count)
    edges[0] = 0.0
    views = []
    for low, high in pairwise(edges):
        part = seen & (away >= low) & (away <= high)
        if part.sum() >= 4:
            views.append((_view(camera, part, at, most_pixels), np.asarray(part)))
    return views


def _view(camera: Camera, part: Mask, at: NDArray[np.float64], most_pixels: int) -> TopView:
    matrix, _ = ground_frame(camera)
    inside = at[part]
    low, high = inside.min(axis=0), inside.max(axis=0)
    extent = high - low
    # As fine as the photo where it shows the hole finest, so that resampling loses nothing.
    fine = np.quantile(_resolution(matrix, inside[:: max(1, len(inside) // 4000)]), 0.9, axis=0)
    fine = np.maximum(fine, fine.max() / ANISOTROPY)
    # Far ground needs less: not many more pixels than the hole has in the photo.
    fine *= min(1.0, math.sqrt(MORE * part.sum() / max(float((extent * fine).prod()), 1.0)))
    distance = float(np.sqrt(1.0 + np.square((low + high) / 2.0).sum()))
    margin = MARGIN * np.maximum(extent, 0.5 * extent.max()) + 24.0 / fine
    margin = np.minimum(margin, 1.5 * distance)
    start, stop = low - margin, high + margin
    corners = at[np.isfinite(at[..., 1])]
    start, stop = np.maximum(start, corners.min(axis=0)), np.minimum(stop, corners.max(axis=0))
    size = (stop - start) * fine
    scale = min(1.0, math.sqrt(most_pixels / float(size.prod())))
    width, height = (max(16, math.ceil(float(value))) for value in size * scale)
    step = (stop - start) / (width, height)
    to_ground = np.array([[step[0], 0.0, start[0]], [0.0, step[1], start[1]], [0.0, 0.0, 1.0]])
    return TopView(image_from_view=matrix @ to_ground, size=(width, height))


def _resolution(matrix: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of the photo per unit of ground, across and along (n, 2), at ground coordinates (n, 2)."""
    steps = []
    for axis in (0, 1):
        shift = np.zeros(2)
        shift[axis] = 1e-4
        first, second = (_carried(matrix, (at + s)[:, 0], (at + s)[:, 1]) for s in (-shift, shift))
        steps.append(np.linalg.norm(second - first, axis=-1) / 2e-4)
    return np.stack(steps, axis=-1)


def to_top_view(image: NDArray[np.float32], view: TopView) -> NDArray[np.float32]:
    """Return ``image`` (H, W) or (H, W, C) resampled to ``view``, (h, w, …); the photo's border is repeated outside."""
    at = np.nan_to_num(view.positions(), nan=-1e6, posinf=-1e6, neginf=-1e6)
    # Where the view is coarser than the photo, average the photo's pixels.
    across, down = np.diff(at[:-1, :, 0], axis=1), np.diff(at[:, :-1, 1], axis=0)
    coarse = max(1, min(4, round(float(np.median(np.hypot(across, down))) / 1.2)))
    source = image if coarse == 1 else cv2.blur(image, (coarse, coarse))
    x, y = (np.clip(at[..., i] - 0.5, -1e4, 3e4).astype(np.float32) for i in (0, 1))
    return np.asarray(cv2.remap(source, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def visible_in_photo(view: TopView, closed: Mask) -> Mask:
    """Return the pixels (h, w) of ``view`` that show photo pixels outside of ``closed`` (H, W)."""
    at = np.nan_to_num(view.positions(), nan=-1e6, posinf=-1e6, neginf=-1e6)
    x, y = (np.clip(at[..., i] - 0.5, -1e4, 3e4).astype(np.float32) for i in (0, 1))
    barred = cv2.remap(closed.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(barred < 1e-3)


def to_photo(
    picture: NDArray[np.float32], view: TopView, rows: slice, columns: slice, times: int = 2
) -> NDArray[np.float32]:
    """Return ``picture`` (h, w, C) of ``view`` resampled to ``rows`` and ``columns`` of the photo."""
    at = np.nan_to_num(view.inverse_positions(rows, columns, times), nan=-1e6, posinf=-1e6, neginf=-1e6)
    x, y = (np.clip(at[..., i] - 0.5, -1e4, 3e4).astype(np.float32) for i in (0, 1))
    fine = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA))
