# SPDX-License-Identifier: MIT
"""Bodies as φ over the pixels of a crop and the depth along the camera's rays, before marching cubes."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import ground_depth
from .inflate import Crop

Points = NDArray[np.float64]


class RayField(ABC):
    """φ in pixels, positive inside, at points (x, y, t): x and y are pixels of the crop, t pixels of depth behind the
    body's middle, each of ``unit`` metres."""

    _camera: Camera
    _crop: Crop
    _middle: float
    unit: float

    @abstractmethod
    def value(self, points: Points) -> Points:
        """Return φ (n) at ``points`` (n, 3)."""

    def world(self, places: Points, t: Points, shift: Points | None = None) -> Points:
        """Return ``places`` (n, 2), moved by ``shift`` (n, 2), at depths ``t`` (n) in the world (n, 3)."""
        pixels, depth = self._pixels(places), self._depth(t)
        if shift is not None:
            pixels = pixels + shift
        return np.asarray(self._camera.position + depth[:, None] * self._camera.rays(pixels))

    def _pixels(self, places: Points) -> Points:
        return np.asarray(places + np.array([self._crop.left + 0.5, self._crop.top + 0.5]))

    def _depth(self, t: Points) -> Points:
        return np.asarray(np.maximum(self._middle + t * self.unit, 0.02 * self._middle))

    def sampled(self, first: Points, steps: Points, counts: tuple[int, int, int]) -> NDArray[np.float32]:
        """Return φ on the grid of ``counts`` nodes from ``first`` (3,) in ``steps`` (3,), negative at its border.

        Away from the crop's outline φ is only known to be negative.
        """
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], indexing="ij"), axis=-1).reshape(-1, 2)
        outline = ndimage.map_coordinates(self._crop.distance, flat[:, ::-1].T, order=1, mode="nearest")
        near = outline > -2.0 * steps[0]
        points = np.column_stack([np.repeat(flat[near], counts[2], axis=0), np.tile(axes[2], int(near.sum()))])
        columns = np.repeat(np.minimum(outline, -1.0)[:, None], counts[2], axis=1)
        columns[near] = self.value(points).reshape(-1, counts[2])
        field = columns.reshape(counts)
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32)

    def depths(self, points: Points) -> tuple[Points, Points, Points]:
        """Return photo pixels (n, 2), depth (n) and depth of the ground (n) of ``points`` (n, 3)."""
        pixels = self._pixels(points[:, :2])
        return pixels, self._depth(points[:, 2]), ground_depth(self._camera, self._camera.rays(pixels))
