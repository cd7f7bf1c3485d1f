# SPDX-License-Identifier: GPL-3.0-or-later
"""What one frame's camera sees of the photo's images. Needs no bpy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim.composite.relief import Relief, Warp
from ...sim.composite.transfer import Linear
from ...sim.scene.camera_move import at_size
from ...sim.scene.model import Camera


@dataclass(frozen=True)
class View:
    """The camera of a frame, and where each of its pixels is on the photo.

    camera: in pixels of the photo. size: (width, height) of the frames.
    relief: the background as geometry; None for the photo's own camera: every pixel is where it is, bit for bit.
    """

    camera: Camera
    size: tuple[int, int]
    relief: Relief | None = None

    @property
    def moved(self) -> bool:
        """Whether it is not the photo's own camera."""
        return self.relief is not None

    def warp(self, image: NDArray[Any]) -> NDArray[Any]:
        """``image`` (H, W, …) of weights, light or truth, over the photo or its canvas, as this camera sees it."""
        return image if self._warp is None else self._warp.values(self._canvas(image))

    def colours(self, image: Linear) -> Linear:
        """``image`` (H, W, 3) in the photo's colours; also what things of the background have hidden comes to light."""
        return image if self._warp is None else self._warp.colours(self._canvas(image))

    def on_photo(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where on the photo (V, 2), in the frames' pixels, the background is that this camera sees behind ``points``.

        points: (V, 3) world metres.
        """
        pixels = at_size(self.camera, self.size).project(points)[:, :2]
        return pixels if self._warp is None else self._warp.photo_pixels(pixels)

    @cached_property
    def _warp(self) -> Warp | None:
        return None if self.relief is None else self.relief.warp(at_size(self.camera, self.size))

    def _canvas(self, image: NDArray[Any]) -> NDArray[Any]:
        assert self.relief is not None
        return self.relief.borders.padded(image) if image.shape[1::-1] == self.size else image
