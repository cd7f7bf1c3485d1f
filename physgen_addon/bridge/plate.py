# SPDX-License-Identifier: GPL-3.0-or-later
"""The plate: the photo's own images at the frames' size, and how much of them is still right. Needs no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.composite import rest, revealed, transfer
from ...sim.composite.canvas import Borders, outpainted
from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder
from .view import View


@dataclass(frozen=True)
class Seen:
    """What a view shows of the plate: photo and background (H, W, 3), the weight w (H, W), masks (H, W)."""

    photo: transfer.Linear
    background: transfer.Linear
    at_rest: NDArray[np.float32]
    masks: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Extended:
    """The background on a canvas (H, W, 3) with ``borders``, and ``revealed``: the same in the photo's own shadows.

    halos: what of the photo around each object belongs to the view that it had of it.
    """

    borders: Borders
    background: transfer.Linear
    revealed: transfer.Linear
    halos: list[rest.Rim]


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
        self._extended: Extended | None = None
        self.photo, self.background = (self._image(name) for name in (self._scene.photo, self._scene.background))
        self.object_masks = masks = [self._mask(item.mask) for item in self._scene.objects]
        self.masks: NDArray[np.bool_] = np.logical_or.reduce(masks)
        self._shares = rest.influence(
            [mask | self._mask(item.shadow) for mask, item in zip(masks, self._scene.objects, strict=True)]
        )
        self._rims = self._around([rest.rim_strength(mask, self.masks) for mask in masks])

    def seen(self, view: View, now: Sequence[NDArray[np.float32]]) -> Seen:
        """The plate as ``view`` shows it with the objects' vertices at ``now`` (V, 3)."""
        at_rest = self._contacts_at_rest(now)
        if view.relief is None:
            for rim, positions in zip(self._rims, now, strict=True):
                rim.apply(at_rest, self._pixels(positions))
            return Seen(self.photo, self.background, at_rest, self.masks)
        extended = self.extended(view.relief.borders)
        keep = np.where(self.masks, np.float32(0.0), np.float32(1.0))
        for halo, positions in zip(extended.halos, now, strict=True):
            halo.apply(keep, view.on_photo(positions))
        inner = view.relief.borders.inner(self._size)
        photo = extended.revealed.copy()
        photo[inner] += (self.photo - photo[inner]) * keep[..., None]
        return Seen(
            photo=view.colours(photo),
            background=view.colours(extended.background),
            at_rest=view.warp(at_rest),
            masks=np.zeros(self.masks.shape, dtype=bool),
        )

    def extended(self, borders: Borders) -> Extended:
        """What a moved camera needs on a canvas with ``borders``; painted once."""
        if self._extended is None or self._extended.borders != borders:
            background = outpainted(self.background, borders)
            shadow = np.logical_or.reduce([self._mask(item.shadow) for item in self._scene.objects])
            rims = np.maximum.reduce([rest.rim_strength(mask, self.masks) for mask in self.object_masks])
            unknown = self.masks | (rims > 0)
            if all(item.shadow is None for item in self._scene.objects):
                shadow = revealed.found_shadow(self.photo, self.background, unknown)
            found = revealed.halos(self.photo, self.background, self.object_masks, shadow)
            ratio = revealed.shade(self.photo, self.background, shadow=shadow, unknown=unknown)
            self._extended = Extended(
                borders=borders,
                background=background,
                revealed=background * borders.faded(ratio),
                halos=self._around(found),
            )
        return self._extended

    def _contacts_at_rest(self, now: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """The weight w (H, W) by what the objects stand on, with their vertices at ``now`` (V, 3)."""
        normal = np.asarray(self._scene.ground.normal)
        weights = []
        for item, start, positions in zip(self._scene.objects, self._rest, now, strict=True):
            contact = rest.contact_vertices(start, normal)
            weights.append(rest.rest_weight(rest.contact_displacement(start, positions, contact, item.size_m)))
        return rest.rest_map(self._shares, weights)

    def _around(self, strengths: Sequence[NDArray[np.float32]]) -> list[rest.Rim]:
        """One rim of ``strengths`` (H, W) an object."""
        return [rest.Rim(s, self._pixels(start)) for s, start in zip(strengths, self._rest, strict=True)]

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
