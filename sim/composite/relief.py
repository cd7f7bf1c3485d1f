# SPDX-License-Identifier: MIT
"""The photo's background as geometry, and where the pixels of a moved camera are on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera
from .canvas import Borders, grid, needed_borders, remapped
from .depth_layers import ROUNDS, Seen, Thing
from .stage import Stage
from .transfer import Linear

COARSE = 33
"""Points a side at which it is asked how far a view reaches beyond the photo."""


@dataclass(frozen=True, kw_only=True)
class Relief:
    """What the photo's ``camera`` (of the frames' size) sees: a stage, before it things, painted on over ``borders``.

    hidden: (H, W) on the canvas, where the things are; behind: (H, W, 3), what is seen there without them. None
        without things.
    ratio: (H, W) on the canvas, distance of the background behind things over that of the stage; None: it is the stage.
    """

    camera: Camera
    stage: Stage
    borders: Borders
    things: tuple[Thing, ...] = ()
    hidden: NDArray[np.bool_] | None = None
    behind: Linear | None = None
    ratio: NDArray[np.float32] | None = None

    def warp(self, camera: Camera) -> Warp:
        """How ``camera`` (of the frames' size as well) sees it."""
        pixels = grid((camera.width, camera.height))
        shift = np.array([self.borders.left, self.borders.top], dtype=np.float64)
        at = on_photo(self.stage, self.camera, camera, pixels)
        if self.ratio is not None:
            at = self._corrected(camera, pixels, at, self.ratio, shift)
        base = (at + shift).astype(np.float32)
        layers = [thing.seen(self.camera, camera, pixels, shift) for thing in self.things]
        return Warp(relief=self, camera=camera, base=base, layers=tuple(sorted(layers, key=lambda s: -s.depth)))

    def _corrected(
        self,
        camera: Camera,
        pixels: NDArray[np.float64],
        at: NDArray[np.float64],
        ratio: NDArray[np.float32],
        shift: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Where on the photo ``pixels`` (h, w, 2) of ``camera`` are, from ``at`` on the stage by ``ratio``.

        By iteration, as for things. Where the ratio is 1 the first guess is right, and stays to the last digit.
        """
        eye = self.camera.position
        for _ in range(ROUNDS):
            away = self.stage.hits(eye, self.camera.rays(at)) - eye
            scale = remapped(ratio, (at + shift).astype(np.float32))[..., None]
            back = camera.project(eye + scale * away)
            at = at + np.clip(pixels - back[..., :2], -100.0, 100.0)
        return at


@dataclass(frozen=True)
class Warp:
    """One camera's view of a relief."""

    relief: Relief
    camera: Camera
    base: NDArray[np.float32]
    layers: Sequence[Seen]

    def colours(self, image: Linear) -> Linear:
        """``image`` (H, W, 3) on the canvas, in the colours of the photo, as the camera sees it (h, w, 3)."""
        hidden, behind = self.relief.hidden, self.relief.behind
        if hidden is None or behind is None:
            return self._layered(image, image)
        return self._layered(image, np.where(hidden[..., None], behind, image))

    def values(self, image: NDArray[Any]) -> NDArray[Any]:
        """``image`` (H, W, …) of weights, light or truth on the canvas, as the camera sees it (h, w, …)."""
        return self._layered(image, image)

    def _layered(self, image: NDArray[Any], behind: NDArray[Any]) -> NDArray[Any]:
        seen = remapped(behind, self.base)
        for layer in self.layers:
            found = remapped(image, layer.at)
            if seen.dtype == np.bool_:
                seen = np.where(layer.cover > 0.5, found, seen)
            else:
                cover = layer.cover if seen.ndim == 2 else layer.cover[..., None]
                seen = (seen + (found - seen) * cover).astype(np.float32)
        return seen

    def photo_pixels(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where on the photo the stage is that the camera sees at ``pixels`` (..., 2); NaN stays NaN."""
        return on_photo(self.relief.stage, self.relief.camera, self.camera, pixels)


def on_photo(stage: Stage, photo: Camera, camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Where on the picture of ``photo`` the stage is that ``camera`` sees at ``pixels`` (..., 2); NaN behind it."""
    found = photo.project(stage.hits(camera.position, camera.rays(pixels)))
    return np.where(found[..., 2:] > 1e-6, found[..., :2], np.nan)


def borders_of(stage: Stage, photo: Camera, views: Sequence[tuple[str, Camera]]) -> Borders:
    """Borders that hold all named ``views``, of the frames' size. Raises InputError for one that needs too much."""
    edge = grid((photo.width, photo.height), COARSE)
    return needed_borders(
        ((name, on_photo(stage, photo, camera, edge)) for name, camera in views), (photo.width, photo.height)
    )
