# SPDX-License-Identifier: MIT
"""Photometric losses between a rendered and a target image with their exact gradients, and the targets views define.

Every loss returns its value and its derivative with respect to the rendered image, which ``Rasteriser.gradients``
propagates to the splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..composite.image_metrics import ssim_and_slope
from ..errors import InputError
from ..scene.model import Camera
from .views.posed_images import View

Picture = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

SSIM_SHARE = 0.2
"""λ₁ of PhyCAGE and of 3D Gaussian Splatting."""
ALPHA_WEIGHT = 1.0
"""λ₂ of PhyCAGE."""


def l1_loss(rendered: Picture, target: Picture) -> tuple[float, Picture]:
    """Return the mean absolute difference of images (H, W, C), and its derivative (H, W, C), 0 where they are equal."""
    difference = rendered - target
    return float(np.abs(difference).mean(dtype=np.float64)), np.sign(difference) / difference.size


def ssim_loss(rendered: Picture, target: Picture) -> tuple[float, Picture]:
    """Return 1 - mean SSIM of images (H, W, C) with values 0 to 1, and its derivative (H, W, C)."""
    similarity, slope = ssim_and_slope(rendered, target)
    return 1.0 - similarity, -slope


def image_loss(
    rendered: Picture, target: Picture, *, ssim_share: float = SSIM_SHARE, counted: Mask | None = None
) -> tuple[float, Picture]:
    """Return (1 - λ₁) L₁ + λ₁ L_SSIM (PhyCAGE equations 1 and 18) and its derivative (H, W, 3).

    rendered, target: (H, W, 3) sRGB, 0 to 1, in the precision to compute in. ssim_share: λ₁, 0 to 1. counted: (H, W)
    pixels that count; the others are treated as equal, so their loss and gradient are 0 and the rest has the weight it
    has in a whole image. Raises InputError on images of different shapes.
    """
    rendered, target = np.asarray(rendered), np.asarray(target)
    _same_shape("the target", target.shape, rendered.shape)
    target = target.astype(rendered.dtype, copy=False)
    if counted is not None:
        _same_shape("the mask of counted pixels", np.shape(counted), rendered.shape[:2])
        rendered = np.where(counted[..., None], rendered, target)
    far, pull = l1_loss(rendered, target)
    unlike, turn = ssim_loss(rendered, target)
    slope = (1 - ssim_share) * pull + ssim_share * turn
    if counted is not None:
        slope *= counted[..., None]
    return (1 - ssim_share) * far + ssim_share * unlike, slope


def fit_loss(
    rendered: Picture,
    alpha: Picture,
    target: Picture,
    target_alpha: Picture,
    *,
    ssim_share: float = SSIM_SHARE,
    alpha_weight: float = ALPHA_WEIGHT,
    counted: Mask | None = None,
) -> tuple[float, Picture, Picture]:
    """Return ``image_loss`` + λ₂ mean(A (1 - A_true)), its derivative by colour (H, W, 3) and by alpha (H, W).

    PhyCAGE equations 1 and 2. rendered, target: (H, W, 3); alpha, target_alpha: (H, W) coverage, 0 to 1. The alpha term
    keeps splats out of the area outside the object; it does not fill the object, which the colour term does against the
    background that shows through. alpha_weight: λ₂, at least 0. Raises InputError on images of different shapes.
    """
    value, d_colour = image_loss(rendered, target, ssim_share=ssim_share, counted=counted)
    _same_shape("alpha", np.shape(alpha), rendered.shape[:2])
    _same_shape("the true alpha", np.shape(target_alpha), rendered.shape[:2])
    outside = 1 - np.asarray(target_alpha, dtype=np.asarray(alpha).dtype)
    if counted is not None:
        outside = outside * counted
    value += alpha_weight * float((alpha * outside).mean(dtype=np.float64))
    return value, d_colour, alpha_weight * outside / outside.size


def _same_shape(what: str, found: tuple[int, ...], wanted: tuple[int, ...]) -> None:
    if found != wanted:
        raise InputError(f"image loss: {what} has shape {found}: give that of the rendered image, {wanted}")


RGB = tuple[float, float, float]

WHITE: RGB = (1.0, 1.0, 1.0)
"""Background of views with a mask."""

MAX_FREE_COVERAGE = 0.01
"""Coverage below which a pixel counts as free: masks of renderers and 8-bit files are rarely exactly 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """The image of one object that one camera should see."""

    camera: Camera

    pixels: Picture
    """(H, W, 3) float32 sRGB, 0 to 1, over white."""

    alpha: Picture
    """(H, W) float32 coverage of each pixel by the object."""

    counted: NDArray[np.bool_] | None
    """(H, W) pixels that constrain the object; None: all."""

    others: Target | None = None
    """The whole view, where only pixels that show another object count; None where there are no labels."""

    def over(self, background: RGB) -> Picture:
        """Return (H, W, 3) the image over the colour ``background``."""
        change = np.subtract(background, WHITE).astype(np.float32)
        return np.asarray(self.pixels + (1 - self.alpha[..., None]) * change)


def view_target(view: View, *, label: int | None = None) -> Target:
    """Return the target that ``view`` defines for all that its mask covers, or for the object ``label``.

    Where another object is visible, the labelled one may or may not continue behind it: such pixels do not count, nor
    do unlabelled pixels along the objects' outline. That it is not in front of the other object there is a constraint
    of ``Target.others``. Raises InputError when the view lacks the mask or labels that are needed.
    """
    if label is None:
        if view.mask is None:
            raise InputError(f"view {view.name!r} has no mask: give images with opacity, masks, or a plain background")
        return Target(camera=view.camera, pixels=view.pixels, alpha=view.mask, counted=None)
    if view.labels is None:
        raise InputError(f"view {view.name!r} has no labels: give them, or fit without a label")
    own = view.labels == label
    covered = (view.labels > 0).astype(np.float32) if view.mask is None else view.mask
    return Target(
        camera=view.camera,
        pixels=np.where(own[..., None], view.pixels, np.float32(1)),
        alpha=np.where(own, covered, np.float32(0)),
        counted=own | ((view.labels < 1) & (covered < MAX_FREE_COVERAGE)),
        others=Target(camera=view.camera, pixels=view.pixels, alpha=covered, counted=(view.labels > 0) & ~own),
    )
