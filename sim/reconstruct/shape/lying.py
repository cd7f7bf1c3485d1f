# SPDX-License-Identifier: MIT
"""Bodies that lie: rings, sticks and wires with their middle line on the ground, instead of standing on a thin edge.

An ellipse of a thin ring is a ring that lies, if it is nearer to a circle on the ground than upright. Other thin things
lie if they would topple, and nothing is there to lean on.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import skeletonize

from ...scene.model import Camera
from .inflate import Silhouette, roundness
from .legs import outline_size
from .reference_surfaces import MeasuredSurface, ReferenceSurface, reference_surfaces

Points = NDArray[np.float64]

THIN = 0.15
"""Largest thickness of a thin thing over its outline's longer side."""
HOLE = 0.3
"""Least share of a ring's hole in what its outline surrounds."""
SUNK = 0.85
"""Height of the middle line over the half thickness: a strip of the underside touches the ground."""
LONGEST = 1.5
"""Largest extent of a lying thing away from the camera over that across: longer ones rather stand or lean."""
STEEPEST = 3.0
"""Largest factor of the thickness along the ray where a thing leads away from the camera."""


def lying_surface(camera: Camera, silhouette: Silhouette) -> ReferenceSurface | None:
    """Return the reference surface of a thin thing that lies on the ground; None if it is not thin or reaches too far.

    camera: 1 unit above the ground z = 0. Each pixel is as far away as the nearest point of the middle line, which lies
    as high as the thing is thick there.
    """
    if silhouette.slab or 2.0 * silhouette.half_thickness > THIN * outline_size(silhouette.mask):
        return None
    rows, columns = np.nonzero(skeletonize(silhouette.mask))
    distance = _on_ground(camera, silhouette, rows, columns)
    places = camera.position + distance[:, None] * camera.rays(_pixels(silhouette, rows, columns))
    across, away = np.ptp(places[:, :2], axis=0)
    if not (distance > 0.0).all() or away > LONGEST * across:
        return None
    depth = np.zeros(silhouette.mask.shape)
    depth[rows, columns] = distance
    line = np.ones(depth.shape, dtype=bool)
    line[rows, columns] = False
    nearest = ndimage.distance_transform_edt(line, return_distances=False, return_indices=True)
    depth = ndimage.gaussian_filter(depth[tuple(nearest)], max(1.0, 0.5 * silhouette.half_thickness), mode="nearest")
    # The ray passes through more of what leads away from the camera.
    slope = np.hypot(*np.gradient(depth)) * camera.fx / depth
    longer = np.minimum(np.sqrt(1.0 + slope**2), STEEPEST)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    middle = MeasuredSurface(depth, inflated * longer, silhouette.left, silhouette.top, longer)
    return replace(next(reference_surfaces(camera, silhouette)), middle=middle, back=1.0)


def ring_lies(camera: Camera, silhouette: Silhouette) -> bool:
    """Return whether ``silhouette`` is a ring whose middle line is nearer to a circle on the ground than upright."""
    filled = ndimage.binary_fill_holes(silhouette.mask)
    if (filled & ~silhouette.mask).sum() < HOLE * filled.sum() or roundness(filled) <= 0.0:
        return False
    rows, columns = np.nonzero(skeletonize(silhouette.mask))
    distance = _on_ground(camera, silhouette, rows, columns)
    if not (distance > 0.0).all():
        return False
    pixels = _pixels(silhouette, rows, columns)
    ground = camera.position + distance[:, None] * camera.rays(pixels)
    return _narrowness(ground[:, :2]) > _narrowness(pixels)


def _on_ground(
    camera: Camera, silhouette: Silhouette, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Depth (n,) along the optical axis at which a thing's middle line lies on the ground; not positive beyond the
    horizon. rows, columns: (n,) of its pixels on the crop."""
    pixels = _pixels(silhouette, rows, columns)
    thick = np.sqrt(np.maximum(silhouette.square_height[rows, columns], 0.0))
    down = -camera.rays(pixels)[:, 2] + SUNK * thick / camera.fx
    return np.where(down > 1e-3, camera.position[2] / np.maximum(down, 1e-3), -1.0)


def _pixels(silhouette: Silhouette, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Points:
    return np.column_stack([columns + silhouette.left + 0.5, rows + silhouette.top + 0.5])


def _narrowness(points: Points) -> float:
    """Minor over major axis of the ellipse through ``points`` (n, 2): 1 for a circle."""
    extent = float(np.ptp(points, axis=0).max())
    if len(points) < 5 or extent <= 0.0:
        return 0.0
    _, axes, _ = cv2.fitEllipse(((points - points.mean(axis=0)) / extent).astype(np.float32))
    return float(min(axes) / max(max(axes), 1e-9))
