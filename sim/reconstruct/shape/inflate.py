# SPDX-License-Identifier: MIT
"""Inflate a silhouette: the thickness of the body behind each pixel.

The height of a soap film under even pressure, ∇²u = −4 with u = 0 on the outline, gives h = √u. A disc of radius R has
u = R² − r², so it becomes a sphere. Rectangular outlines become slabs with rounded edges instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

POISSON_UNKNOWNS = 40_000
"""Larger silhouettes are solved on a coarser grid; the outline stays at full resolution."""
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
        """Largest h in pixels."""
        return float(np.sqrt(max(self.square_height.max(), 0.25)))


def inflate(mask: Mask, thickness: float | None = None) -> Silhouette:
    """Inflate ``mask`` (H, W), which must not be empty.

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
    square = _slab_profile(distance, thickness) if slab else film_profile(crop, distance, thickness)
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
    """Return the signed distance in pixels of each pixel's centre to the outline of ``mask``, positive inside, without
    stair-steps."""
    inside, outside = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    exact = np.where(mask, inside - 0.5, 0.5 - outside)
    smooth = ndimage.gaussian_filter(exact, 1.0)
    # Smoothing flattens the ridge of a strap, so use it only near the outline.
    weight = np.clip(np.abs(exact) - 1.5, 0.0, 1.0)
    return np.asarray(weight * exact + (1.0 - weight) * smooth)


def is_box(mask: Mask) -> bool:
    """Return whether ``mask`` fills its smallest rotated rectangle, and is not elongated like a stick."""
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


def soap_film(mask: Mask) -> Field:
    """Return u (h, w) in pixels² with ∇²u = −4 inside ``mask`` and u = 0 outside, by the five-point Laplacian."""
    index = np.full(mask.shape, -1, dtype=np.int64)
    count = int(mask.sum())
    index[mask] = np.arange(count)
    padded = np.pad(index, 1, constant_values=-1)
    entries_row, entries_column = [np.arange(count)], [np.arange(count)]
    values = [np.full(count, 4.0)]
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        neighbour = padded[1 + dy : padded.shape[0] - 1 + dy, 1 + dx : padded.shape[1] - 1 + dx][mask]
        linked = neighbour >= 0
        entries_row.append(np.flatnonzero(linked))
        entries_column.append(neighbour[linked])
        values.append(np.full(int(linked.sum()), -1.0))
    matrix = sparse.csc_matrix(
        (np.concatenate(values), (np.concatenate(entries_row), np.concatenate(entries_column))), shape=(count, count)
    )
    film = np.zeros(mask.shape)
    if count:
        film[mask] = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
            np.full(count, 4.0)
        )
    return film


def film_profile(mask: Mask, distance: Field, thickness: float) -> Field:
    """Return h² (h, w) in pixels² of ``mask`` inflated, with its signed ``distance``; ``thickness`` as for
    ``inflate``."""
    scale = min(1.0, float(np.sqrt(POISSON_UNKNOWNS / max(1, int(mask.sum())))))
    height, width = mask.shape
    if scale < 1.0:
        size = (max(4, round(width * scale)), max(4, round(height * scale)))
        near = cv2.resize(distance, size, interpolation=cv2.INTER_LINEAR)
        film = soap_film(near > 0) / scale**2
        film = np.asarray(cv2.resize(film, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float64)
    else:
        film = soap_film(mask)
    # u over distance is smooth and positive up to the outline. Times the distance it vanishes exactly there, and
    # keeps its slope outside, where the surface extraction needs values too.
    cell = 1.5 / scale
    deep = distance > cell
    if not deep.any():
        deep = distance >= 0.5 * distance.max()
    ratio = film / np.maximum(distance, cell)
    nearest = ndimage.distance_transform_edt(~deep, return_distances=False, return_indices=True)
    ratio = ndimage.gaussian_filter(ratio[tuple(nearest)], 1.5 * cell) * ~deep + ratio * deep
    ratio = np.maximum(ratio, 1e-3 * max(float(ratio.max()), 1e-3))
    square = ratio * distance
    # A long strip has u = W²/2 at its middle, a disc W²/4: measure both by their widest inscribed circle.
    widest = float(distance.max())
    half = max(MIN_HALF_THICKNESS, thickness * widest)
    return np.asarray(square * half**2 / max(float(square.max()), 1e-9))


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
