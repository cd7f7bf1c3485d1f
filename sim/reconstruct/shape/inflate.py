# SPDX-License-Identifier: MIT
"""Inflate a silhouette: the thickness of the body behind each pixel.

A body is the union of all balls inside its outline, so that each of its parts, a head, a limb, an ear, is as thick as
it is wide, and parts are joined smoothly. Rectangular outlines become slabs with rounded edges instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

BALL_PIXELS = 60_000
"""Larger silhouettes are inflated on a coarser grid; the outline stays at full resolution."""
ROOM = 0.3
"""Pixels by which the largest ball is larger than its centre's measured distance from an outline that is curved or
slanted: of many pixels beyond it, one is always nearer than half a pixel."""
CREASE = 0.2
"""Width over which creases between parts are rounded, over the local half thickness."""
RECTANGULAR = 0.88
"""Area over that of the smallest rotated rectangle above which a mask is a box; an ellipse has 0.785."""
LONGEST_SLAB = 3.0
"""Length over width up to which a mask is a box; longer ones are bottles, pens and sticks, which are round."""
SLAB_THICKNESS = 0.2
"""Default thickness over width of a box: between a book and a carton."""
OUTSET = 2e-4
"""Distance by which bodies extend beyond their mask, over the photo's longer side (0.4 pixels at 1920). Triangles cut
the corners of an outline, where the background would show inside the mask as bright specks."""
MIN_HALF_THICKNESS = 1.0
"""Pixels; a thinner sheet has no interior for particles."""
SLAB_BEVEL = 0.5
"""Rounding of a slab's edges over its half thickness."""


@dataclass(frozen=True)
class Silhouette:
    """The silhouette of one object and its inflation, on a crop of the photo.

    mask: (h, w); distance: (h, w) signed distance to the outline in pixels, positive inside, smooth to sub-pixels;
    square_height: (h, w) h² in pixels², negative outside with the slope it has inside. left, top: position of the
    crop's first pixel in the photo; its centre is at (left + 0.5, top + 0.5). slab: whether the mask is a box'.
    roundness: 1 for an ellipse, 0 for anything far from one.
    """

    mask: Mask
    distance: Field
    square_height: Field
    left: int
    top: int
    slab: bool
    roundness: float

    @property
    def half_thickness(self) -> float:
        """Return the largest height of the surface over the mask's plane, pixels."""
        return float(np.sqrt(max(self.square_height.max(), 0.25)))


def inflate(mask: Mask, thickness: float | None = None) -> Silhouette:
    """Return ``mask`` (H, W), which must not be empty, inflated.

    thickness: depth over width of the body; None uses 1 for round masks and 0.2 for boxes.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    pad = 8 + round(0.05 * max(np.ptp(rows), np.ptp(columns)))
    # Assume that the object ends at the photo's border: pad with background.
    padded = np.pad(mask, pad)
    crop = padded[rows[0] : rows[-1] + 1 + 2 * pad, columns[0] : columns[-1] + 1 + 2 * pad]
    distance = signed_distance(crop) + OUTSET * max(mask.shape)
    slab = is_box(crop)
    if thickness is None:
        thickness = SLAB_THICKNESS if slab else 1.0
    square = _slab_profile(distance, thickness) if slab else limb_profile(distance, thickness)
    return Silhouette(
        mask=crop,
        distance=distance,
        square_height=square,
        left=int(columns[0]) - pad,
        top=int(rows[0]) - pad,
        slab=slab,
        roundness=0.0 if slab else roundness(crop),
    )


def signed_distance(mask: Mask) -> Field:
    """Return the signed distance (H, W) in pixels of each pixel's centre to the outline of ``mask`` (H, W), positive
    inside, without stair-steps."""
    inside, outside = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    exact = np.where(mask, inside - 0.5, 0.5 - outside)
    smooth = ndimage.gaussian_filter(exact, 1.0)
    # Smoothing flattens the ridge of a strap, so use it only near the outline.
    weight = np.clip(np.abs(exact) - 1.5, 0.0, 1.0)
    return np.asarray(weight * exact + (1.0 - weight) * smooth)


def is_box(mask: Mask) -> bool:
    """Return whether ``mask`` (H, W) fills its smallest rotated rectangle, and is not elongated like a stick."""
    points = cv2.findNonZero(mask.astype(np.uint8))
    if points is None:
        return False
    _, size, _ = cv2.minAreaRect(points)
    width, length = sorted((size[0] + 1.0, size[1] + 1.0))
    return bool(mask.sum() > RECTANGULAR * width * length and length < LONGEST_SLAB * width)


def roundness(mask: Mask) -> float:
    """Return 1 if ``mask`` is an ellipse (overlap of 0.96 with the ellipse of the same moments), falling to 0 at
    0.9."""
    rows, columns = np.nonzero(mask)
    points = np.column_stack([columns, rows]).astype(np.float64)
    centre = points.mean(axis=0)
    covariance = np.cov(points.T) + 1e-6 * np.eye(2)
    grid = np.stack(np.meshgrid(np.arange(mask.shape[1]), np.arange(mask.shape[0])), axis=-1) - centre
    # A solid ellipse has variance (semi-axis)² / 4 along each axis.
    ellipse = np.einsum("...i,ij,...j->...", grid, np.linalg.inv(4.0 * covariance), grid) <= 1.0
    overlap = (ellipse & mask).sum() / max(1, int((ellipse | mask).sum()))
    return float(np.clip((overlap - 0.9) / 0.06, 0.0, 1.0))


def covering_balls(distance: Field) -> Field:
    """Return h² (h, w) in pixels² of the union of all balls that lie within a silhouette, centred in one plane.

    distance: (h, w) to the outline, positive inside. h²(p) = max_c d(c)² − |p − c|²: a dilation of d² by a paraboloid,
    which separates into rows and columns (van den Boomgaard, Mathematical Morphology: Extensions Towards Computer
    Vision, 1992). A disc becomes a sphere, a strip a round rod, and a limb on a body keeps its own radius.
    """
    square = np.where(distance > 0, distance, 0.0) ** 2
    reach = int(np.ceil(float(distance.max())))
    for axis in (0, 1):
        source = np.moveaxis(square, axis, 0)
        best = source.copy()
        for step in range(1, min(reach, len(source) - 1) + 1):
            np.maximum(best[step:], source[:-step] - step**2, out=best[step:])
            np.maximum(best[:-step], source[step:] - step**2, out=best[:-step])
        square = np.moveaxis(best, 0, axis)
    return square


def limb_profile(distance: Field, thickness: float) -> Field:
    """Return h² (h, w) in pixels² of a silhouette inflated, from its signed ``distance`` in pixels; negative outside.

    Each part is as thick as its own width: ``covering_balls``, with the creases between parts rounded. ``thickness``:
    depth over width.
    """
    height, width = distance.shape
    scale = min(1.0, float(np.sqrt(BALL_PIXELS / max(1, int((distance > 0).sum())))))
    size = (max(4, round(width * scale)), max(4, round(height * scale)))
    room = np.where(distance > 0, distance + ROOM, distance)
    coarse = room if scale == 1.0 else np.asarray(cv2.resize(room, size), dtype=np.float64) * scale
    balls = _rounded(covering_balls(coarse))
    if scale < 1.0:
        balls = np.asarray(cv2.resize(balls, (width, height)), dtype=np.float64) / scale**2
    balls = np.maximum(balls, np.where(distance > 0, distance, 0.0) ** 2)
    # The ball of radius R that touches the outline has h² = d (2 R − d) along its radius there: solved for R where the
    # distance is large enough, carried to the outline and beyond, it gives h² to sub-pixels.
    cell = 1.5 / scale
    ridge = distance > 0.7 * ndimage.maximum_filter(distance, size=2 * int(np.ceil(cell)) + 1)
    deep = (distance > 0) & ((distance > cell) | ridge)
    radius = (balls + distance**2) / (2.0 * np.maximum(distance, 1e-3))
    nearest = ndimage.distance_transform_edt(~deep, return_distances=False, return_indices=True)
    radius = np.maximum(ndimage.gaussian_filter(radius[tuple(nearest)], cell), 0.5)
    weight = np.clip(distance / cell - 1.0, 0.0, 1.0)
    square = weight * balls + (1.0 - weight) * distance * np.maximum(2.0 * radius - distance, radius)
    least = MIN_HALF_THICKNESS / max(float(np.sqrt(max(square.max(), 0.25))), 1e-9)
    return np.asarray(square * max(thickness, least) ** 2)


def _rounded(balls: Field) -> Field:
    """``balls`` with the valleys between parts filled: averaged over ``CREASE`` of the local half thickness."""
    wanted = CREASE * np.sqrt(balls)
    levels = 0.5 * 2.0 ** np.arange(0, int(np.ceil(np.log2(max(2.0, 2.0 * float(wanted.max()))))) + 1)
    # A mean over σ lowers r² − ρ² by 2 σ², w² − x² by σ².
    stack = [balls, *(ndimage.gaussian_filter(balls, level) + 1.5 * level**2 for level in levels)]
    at = np.clip(np.log2(np.maximum(wanted, 1e-6) / 0.5) + 1.0, 0.0, len(stack) - 1.001)
    lower = at.astype(np.int64)
    rows, columns = np.mgrid[: balls.shape[0], : balls.shape[1]]
    levels_of = np.stack(stack)
    share = at - lower
    return np.asarray((1.0 - share) * levels_of[lower, rows, columns] + share * levels_of[lower + 1, rows, columns])


def _slab_profile(distance: Field, thickness: float) -> Field:
    half = max(MIN_HALF_THICKNESS, thickness * float(distance.max()))
    bevel = max(2.0, min(SLAB_BEVEL * half, 0.5 * float(distance.max())))
    rise = np.minimum(distance / bevel, 1.0)
    # A quarter circle from the outline up to the flat; outside it continues with the slope at the outline.
    return np.asarray(half**2 * np.where(rise > 0, 1.0 - (1.0 - rise) ** 2, 2.0 * rise))


@dataclass(frozen=True)
class Crop:
    """The mask of one object on a crop.

    mask: (h, w); photo: (h, w) pixels inside the photo; distance: (h, w) pixels to the outline, positive inside, with
    ``outset`` added. left, top: photo pixels of the first pixel's corner; may be negative. outset: distance by which
    the body extends beyond the mask.
    """

    mask: Mask
    photo: Mask
    distance: Field
    left: int
    top: int
    outset: float

    def pixels(self) -> Field:
        """Return photo pixels (h w, 2) of all pixel centres, row by row."""
        height, width = self.mask.shape
        rows, columns = np.mgrid[:height, :width]
        return np.stack([self.left + columns + 0.5, self.top + rows + 0.5], axis=-1).reshape(-1, 2)


def crop_mask(mask: Mask) -> Crop:
    """Return the part of ``mask`` (H, W), not empty, that holds the object, with a border of background."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    pad = 8 + round(0.08 * max(np.ptp(rows), np.ptp(columns)))
    padded = np.pad(mask, pad)
    window = (slice(rows[0], rows[-1] + 1 + 2 * pad), slice(columns[0], columns[-1] + 1 + 2 * pad))
    part = padded[window]
    outset = OUTSET * max(mask.shape)
    photo = np.pad(np.ones(mask.shape, dtype=bool), pad)[window]
    return Crop(part, photo, signed_distance(part) + outset, int(columns[0]) - pad, int(rows[0]) - pad, outset)
