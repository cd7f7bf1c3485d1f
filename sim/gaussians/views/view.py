# SPDX-License-Identifier: MIT
"""What one camera sees of the object: colours, the outline, and whose each pixel is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera

Picture = NDArray[np.float32]
Labels = NDArray[np.int8]

OUTSIDE, BACKGROUND, FOREGROUND = -1, 1, 2
"""Labels of pixels and vertices: nothing; the object O1 that is partly covered; the object O2 that covers it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A picture with its camera. Raises InputError on bad shapes or numbers; the arrays are copied and read-only."""

    name: str
    """Of the picture, for messages and files; unique among the views of an object."""

    camera: Camera
    """Of the picture's own size, world metres."""

    pixels: Picture
    """(H, W, 3) sRGB as files keep it, 0 to 1. Where there is a mask, the object stands before white."""

    mask: Picture | None = None
    """(H, W) share of each pixel that the objects cover, 0 to 1; None: not known."""

    labels: Labels | None = None
    """(H, W) whose each pixel is: -1 nobody's, 1 the background object O1, 2 the foreground object O2, then others;
    None: not known (PhyCAGE, section 4.1: S)."""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        object.__setattr__(self, "pixels", self._checked("pixels", self.pixels, (*size, 3)))
        if self.mask is not None:
            object.__setattr__(self, "mask", self._checked("mask", self.mask, size))
        if self.labels is not None:
            given = np.asarray(self.labels)
            if given.shape != size or not np.isin(given, (OUTSIDE, *range(1, 128))).all():
                raise InputError(
                    f"view {self.name!r}: labels have shape {given.shape} and values {_some(given)}: give {size} of -1 "
                    "outside, 1, 2 and so on for objects"
                )
            labels = given.astype(np.int8)
            labels.flags.writeable = False
            object.__setattr__(self, "labels", labels)

    def _checked(self, what: str, value: Picture, shape: tuple[int, ...]) -> Picture:
        array = np.array(value, dtype=np.float32)
        if array.shape != shape:
            raise InputError(f"view {self.name!r}: {what} have shape {array.shape}, its camera sees {shape}")
        # A comparison with NaN is false.
        if not (array.min(initial=0.0) >= 0 and array.max(initial=0.0) <= 1):
            raise InputError(f"view {self.name!r}: {what} go beyond 0 to 1, or are no numbers: divide bytes by 255")
        array.flags.writeable = False
        return array


def _some(values: NDArray[np.generic]) -> str:
    found = np.unique(values)
    return ", ".join(str(value) for value in found[:6]) + (" …" if len(found) > 6 else "")


def before_white(colours: Picture, mask: Picture) -> Picture:
    """(H, W, 3) what ``mask`` (H, W) covers in ``colours`` (H, W, 3), white where it covers nothing."""
    return colours * mask[..., None] + (1 - mask[..., None])
