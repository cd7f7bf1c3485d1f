# SPDX-License-Identifier: MIT
"""What a rendered view is compared with: the object's part of a view, on any background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from ..views.view import View

Picture = NDArray[np.floating[Any]]
RGB = tuple[float, float, float]

WHITE: RGB = (1.0, 1.0, 1.0)
"""Before which views show what their masks cover."""

CLEAR = 0.01
"""Coverage below which a pixel counts as free: masks of renderers and of 8-bit files are hardly ever exactly 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """What one camera should see of one object."""

    camera: Camera

    pixels: Picture
    """(H, W, 3) float32 sRGB, 0 to 1, before white."""

    alpha: Picture
    """(H, W) float32 share of each pixel that the object covers."""

    counted: NDArray[np.bool_] | None
    """(H, W) pixels that say something about the object; None: all."""

    others: Target | None = None
    """The whole view, of which the pixels count that show another object; None where there are no labels."""

    def before(self, background: RGB) -> Picture:
        """(H, W, 3) the same before another colour."""
        change = np.subtract(background, WHITE).astype(np.float32)
        return np.asarray(self.pixels + (1 - self.alpha[..., None]) * change)


def target_of(view: View, *, label: int | None = None) -> Target:
    """What ``view`` says of all that its mask covers, or of the object of its labels that ``label`` names.

    Where another object is seen, the one that is asked for may go on behind it or not: such pixels do not count, and
    neither do those of the outline of all objects that nobody's label owns. That it does not stand before the other one
    there is said by ``Target.others``. Raises InputError when the view lacks the mask or the labels that are needed.
    """
    if label is None:
        if view.mask is None:
            raise InputError(f"view {view.name!r} has no mask: give pictures with opacity, masks, or a plain backdrop")
        return Target(camera=view.camera, pixels=view.pixels, alpha=view.mask, counted=None)
    if view.labels is None:
        raise InputError(f"view {view.name!r} has no labels: give them, or fit without a label")
    own = view.labels == label
    covered = (view.labels > 0).astype(np.float32) if view.mask is None else view.mask
    return Target(
        camera=view.camera,
        pixels=np.where(own[..., None], view.pixels, np.float32(1)),
        alpha=np.where(own, covered, np.float32(0)),
        counted=own | ((view.labels < 1) & (covered < CLEAR)),
        others=Target(camera=view.camera, pixels=view.pixels, alpha=covered, counted=(view.labels > 0) & ~own),
    )
