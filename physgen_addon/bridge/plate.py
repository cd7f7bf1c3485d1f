# SPDX-License-Identifier: GPL-3.0-or-later
"""The plate: the photo's own images at the frames' size, and how much of them is still right. Needs no bpy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...sim.composite import rest, transfer
from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder


class Plate:
    """Photo and background in linear light, masks, and the weight of what is still at rest.

    photo, background: (H, W, 3) linear light. masks: (H, W) True where the photo shows an object; object_masks: of
    each object.
    """

    def __init__(
        self, folder: SceneFolder, size: tuple[int, int], rest_vertices: Sequence[NDArray[np.float32]]
    ) -> None:
        """``size`` (width, height) of the frames; ``rest_vertices`` (V, 3) of each object, world metres.

        Raises InputError for an image that is missing, unreadable, or not of the camera's size.
        """
        self._folder, self._scene, self._size, self._rest = folder, folder.scene, size, list(rest_vertices)
        self.photo, self.background = (self._image(name) for name in (self._scene.photo, self._scene.background))
        self.object_masks = masks = [self._mask(item.mask) for item in self._scene.objects]
        self.masks: NDArray[np.bool_] = np.logical_or.reduce(masks)
        self._shares = rest.influence(
            [mask | self._mask(item.shadow) for mask, item in zip(masks, self._scene.objects, strict=True)]
        )
        self._rims = [
            rest.Rim(mask, self.masks, self._pixels(start)) for mask, start in zip(masks, self._rest, strict=True)
        ]

    def at_rest(self, now: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """The weight w (H, W) with the objects' vertices at ``now`` (V, 3), 1 where nothing has moved."""
        normal = np.asarray(self._scene.ground.normal)
        weights = []
        for item, start, positions in zip(self._scene.objects, self._rest, now, strict=True):
            contact = rest.contact_vertices(start, normal)
            weights.append(rest.rest_weight(rest.contact_displacement(start, positions, contact, item.size_m)))
        at_rest = rest.rest_map(self._shares, weights)
        for rim, positions in zip(self._rims, now, strict=True):
            rim.apply(at_rest, self._pixels(positions))
        return at_rest

    def _image(self, name: str) -> transfer.Linear:
        pixels = transfer.read_rgb(self._folder.file(name))
        self._require_size(name, pixels)
        return transfer.resized(transfer.bytes_to_linear(pixels), *self._size)

    def _mask(self, name: str | None) -> NDArray[np.bool_]:
        if name is None:
            return np.zeros(self._size[::-1], dtype=bool)
        mask = transfer.read_mask(self._folder.file(name))
        self._require_size(name, mask)
        return np.asarray(transfer.resized(mask.astype(np.float32), *self._size) > 0.5)

    def _require_size(self, name: str, image: NDArray[np.generic]) -> None:
        height, width = image.shape[:2]
        camera = self._scene.camera
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{self._folder.file(name)}: is {width}×{height}, the camera's image is "
                f"{camera.width}×{camera.height}; reconstruct the scene again"
            )

    def _pixels(self, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where world ``positions`` (V, 3) are on the photo at the frames' size (V, 2)."""
        camera = self._scene.camera
        scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        return camera.project(positions)[:, :2] * scale
