# SPDX-License-Identifier: MIT
"""The planes that shadows fall on: the ground, and a wall that stands on it behind the objects.

A shadow on any plane is a parallel projection, so the wall is treated as a second ground: bodies and lamps are turned
into its own frame, in which it is the plane z = 0 and the room lies above it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ...srgb import bytes_to_linear
from ..background.surface_edges import Edge, edges_behind
from ..background.surface_inpainting import logarithms
from ..camera.ground_camera import depth_below, on_ground

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShadowPlane:
    """A plane in the photo.

    origin: (3,) a point on it. axes: (3, 3) rows are its x, y and normal in world axes; y of a wall points up. region:
    (H, W) the pixels that may show it.
    """

    origin: Values
    axes: Values
    region: Mask

    def places(self, camera: Camera, pixels: Values) -> Values:
        """Return the points (..., 3) in the plane's frame at ``pixels`` (..., 2) of the photo; inf where a ray does not
        meet its front."""
        rays = camera.rays(pixels)
        height = float((camera.position - self.origin) @ self.axes[2])
        if height <= 0.0:
            return np.full(rays.shape, np.inf)
        depth = depth_below(height, -rays @ self.axes[2])[..., None]
        with np.errstate(invalid="ignore"):
            found = self.in_frame(camera.position + depth * rays)
        return np.where(np.isfinite(depth), found, np.inf)

    def in_frame(self, points: Values) -> Values:
        """Return world ``points`` (..., 3) in the plane's frame."""
        return np.asarray((points - self.origin) @ self.axes.T)


def ground_plane(shape: tuple[int, int], wall: ShadowPlane | None = None) -> ShadowPlane:
    """Return the ground z = 0 in a photo of ``shape`` (H, W), as far as it does not show ``wall``."""
    region = np.ones(shape, dtype=bool) if wall is None else ~wall.region
    return ShadowPlane(origin=np.zeros(3), axes=np.eye(3), region=region)


SEAM = 6.0
"""Pixels at 1024 beside the objects whose colours are mixed with theirs."""
BAND = 0.04
"""Height of the bands above and below an edge that are compared, over the photo's longer side."""
OTHER_TINT = 0.03
"""Difference of their median log chromas, natural, above which they are two surfaces. Joints, cracks and stripes have
the same on both sides, and so, nearly, has a shadow's border: light changes brightness, and hardly the tint."""
DARKEST = 2e-3
"""Linear light below which tints are unknown."""
STRAIGHT = 2.0
"""Pixels at 1024 by which a wall's foot may be bent."""
BESIDE = 0.35
"""Range beside what hides the edge in which it was traced, over the width of that."""


def wall_behind(
    pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera, stay: Mask | None = None
) -> ShadowPlane | None:
    """Return the wall that stands on the ground behind the objects in ``masks`` (H, W) of the photo ``pixels``
    (H, W, 3), or None if no straight edge between two surfaces passes behind one of them.

    camera: above the ground z = 0. stay: (H, W) things on the ground that are no objects, whose edges are no wall's
    foot. Everything above such an edge is taken for an upright wall: whether a shadow falls on it is for the colours
    there to say.
    """
    shape, size = pixels.shape[:2], max(pixels.shape[:2])
    covered = np.logical_or.reduce(masks)
    if not covered.any():
        return None
    side = 2 * max(1, round(SEAM * size / 1024.0)) + 1
    seam = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    objects = cv2.dilate(covered.astype(np.uint8), seam)
    hidden = (objects if stay is None else cv2.dilate((covered | stay).astype(np.uint8), seam)) > 0
    logs = logarithms(pixels.astype(np.float32))
    number, labels, stats, _ = cv2.connectedComponentsWithStats(objects, connectivity=8)
    # The largest thing hides most of an edge, and needs it most.
    for label in 1 + np.argsort(-stats[1:number, cv2.CC_STAT_AREA], kind="stable"):
        part = np.asarray(labels == label)
        edges = edges_behind(logs, part, hidden)
        if not edges:
            continue
        # A skirting has several; the ground ends at the lowest.
        columns = np.flatnonzero(part.any(axis=0))
        middle = (columns[0] + columns[-1] + 1.0) / 2.0
        lowest = max(edges, key=lambda edge: (edge.c - edge.a * middle) / edge.b)
        line = _straight(lowest, columns, shape, STRAIGHT * size / 1024.0)
        if line is not None and _two_surfaces(pixels, hidden, line, max(2, round(BAND * size))):
            return _upright(line, shape, camera)
    return None


def _straight(edge: Edge, columns: NDArray[np.intp], shape: tuple[int, int], most: float) -> tuple[float, float] | None:
    """Row at column 0 and slope of ``edge`` behind the ``columns`` and beside them; None if it is bent there by more
    than ``most`` pixels."""
    reach = round(BESIDE * len(columns))
    x = np.arange(max(0, columns[0] - reach), min(shape[1], columns[-1] + 1 + reach))
    y = (edge.c - edge.a * (x + 0.5)) / edge.b + (0.0 if edge.bend is None else edge.bend[x])
    slope, start = np.polyfit(x + 0.5, y, 1)
    return (float(start), float(slope)) if np.abs(y - start - slope * (x + 0.5)).max() <= most else None


def _two_surfaces(pixels: NDArray[np.uint8], hidden: Mask, line: tuple[float, float], band: int) -> bool:
    """Whether the tints of ``pixels`` (H, W, 3) on both sides of ``line`` differ, not only those along it."""
    y, x = np.ogrid[: hidden.shape[0], : hidden.shape[1]]
    below = y + 0.5 - line[0] - line[1] * (x + 0.5)
    sides = [~hidden & (side > 0.25 * band) & (side < 1.25 * band) for side in (-below, below)]
    if min(int(side.sum()) for side in sides) < band * band:
        return False
    logs = [np.median(np.log(np.maximum(bytes_to_linear(pixels[side]), DARKEST)), axis=0) for side in sides]
    step = logs[0] - logs[1]
    return bool(np.abs(step - step.mean()).max() > OTHER_TINT)


def _upright(line: tuple[float, float], shape: tuple[int, int], camera: Camera) -> ShadowPlane | None:
    """The wall on ``line``; None if that does not lie on the ground before the camera."""
    ends = np.array([[x, line[0] + line[1] * x] for x in (0.0, float(shape[1]))])
    left, right = on_ground(camera, ends)
    if not np.isfinite([left, right]).all():
        return None
    along = (right - left) / max(float(np.linalg.norm(right - left)), 1e-12)
    up = np.array([0.0, 0.0, 1.0])
    # Its front faces the camera: x runs to the right there.
    axes = np.stack([along, up, np.cross(along, up)])
    y, x = np.ogrid[: shape[0], : shape[1]]
    region = np.asarray(y + 0.5 < line[0] + line[1] * (x + 0.5))
    return ShadowPlane(origin=left, axes=axes, region=region)
