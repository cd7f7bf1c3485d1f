# SPDX-License-Identifier: MIT
"""Where a fit starts: splats all over a surface, or a little under it, in the colours of the views that look at it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ...mpm.colliders import Surface
from ...scene.model import Camera
from ..sample import splats_on_mesh
from ..splats import Splats
from .target import Target

Array = NDArray[np.float64]

UNSEEN = 0.5
"""Grey of a place that no view looks at."""
LITTLE = 1e-6
"""Weight of that grey where one does."""


def start_on_surface(
    surface: Surface, count: int, targets: Sequence[Target], *, inset: float = 0.0, seed: int = 0
) -> Splats:
    """``count`` splats spread evenly over ``surface``, flat along it, in the mean colours that ``targets`` show there.

    A view counts the more the straighter it looks at a place; what stands in between is not looked at, which the fit
    makes good. inset: metres by which the centres lie under the surface, see ``pixel_size``. Raises InputError on a
    surface without area.
    """
    grey = np.full((len(surface.vertices), 3), UNSEEN)
    splats = splats_on_mesh(surface.vertices, surface.faces, grey, count, seed=seed)
    normals = splats.axes()[:, :, 2]
    # A step of zero length would still move the centres by a rounding error.
    centres = splats.centres - inset * normals if inset else splats.centres
    return splats.changed(centres=centres, colours=_seen_colours(splats.centres, normals, targets))


def pixel_size(cameras: Sequence[Camera], surface: Surface) -> float:
    """Metres that a pixel of ``cameras`` (the median of them) is wide at the middle of ``surface``.

    The rasteriser widens every splat by half a pixel, and at an outline many lie behind each other: splats with their
    centres right on a surface are seen about one pixel beyond it, and look best one pixel under it.
    """
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    return float(np.median([camera.project(middle)[2] / max(camera.fx, camera.fy) for camera in cameras]))


def _seen_colours(points: Array, normals: Array, targets: Sequence[Target]) -> Array:
    total, weight = np.full((len(points), 3), LITTLE * UNSEEN), np.full(len(points), LITTLE)
    for target in targets:
        x, y, depth = target.camera.project(points).T
        toward = target.camera.position - points
        facing = np.sum(normals * toward, axis=1) / np.linalg.norm(toward, axis=1)
        places = np.where(depth > 0, [y - 0.5, x - 0.5], -9.0)
        share = np.where(depth > 0, np.clip(facing, 0, 1) ** 2, 0) * _at(places, target.alpha) ** 2
        total += share[:, None] * _at(places, target.pixels)
        weight += share
    return total / weight[:, None]


def _at(places: Array, picture: NDArray[np.floating[Any]]) -> Array:
    """``picture`` (H, W, …) at ``places`` (2, N), row and column from the top left pixel's centre; 0 beyond it."""
    channels = picture.reshape(*picture.shape[:2], -1)
    values = [map_coordinates(channels[..., k], places, order=1) for k in range(channels.shape[2])]
    return np.asarray(np.stack(values, axis=-1), dtype=np.float64).reshape(places.shape[1], *picture.shape[2:])
