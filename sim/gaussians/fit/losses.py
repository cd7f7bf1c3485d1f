# SPDX-License-Identifier: MIT
"""How far a rendered picture is from a true one, and which way it has to change.

Every loss gives its value together with its exact derivative with respect to the rendered picture, which
``Rasteriser.gradients`` takes on to the splats.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...composite.ssim import ssim_and_slope
from ...errors import InputError

Picture = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

SSIM_SHARE = 0.2
"""λ₁ of PhyCAGE and of 3D Gaussian Splatting."""
ALPHA_WEIGHT = 1.0
"""λ₂ of PhyCAGE."""


def l1_loss(rendered: Picture, target: Picture) -> tuple[float, Picture]:
    """Mean absolute difference of pictures (H, W, C), and its derivative (H, W, C), 0 where they are equal."""
    difference = rendered - target
    return float(np.abs(difference).mean(dtype=np.float64)), np.sign(difference) / difference.size


def ssim_loss(rendered: Picture, target: Picture) -> tuple[float, Picture]:
    """1 - mean SSIM of pictures (H, W, C) of values 0 to 1, and its derivative (H, W, C)."""
    similarity, slope = ssim_and_slope(rendered, target)
    return 1.0 - similarity, -slope


def image_loss(
    rendered: Picture, target: Picture, *, ssim_share: float = SSIM_SHARE, counted: Mask | None = None
) -> tuple[float, Picture]:
    """(1 - λ₁) L₁ + λ₁ L_SSIM, PhyCAGE equations 1 and 18, and its derivative (H, W, 3).

    rendered, target: (H, W, 3) sRGB, 0 to 1, in the precision to compute in. ssim_share: λ₁, 0 to 1. counted: (H, W)
    pixels that say something; the others are taken as met exactly, so they neither cost nor pull, and the rest weighs
    what it weighs in a whole picture. Raises InputError on pictures of different shapes.
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
    """PhyCAGE equations 1 and 2: ``image_loss`` + λ₂ mean(A (1 - A_true)), with its derivatives by colour and alpha.

    rendered, target: (H, W, 3), alpha, target_alpha: (H, W) share of each pixel that is covered, 0 to 1. The alpha term
    keeps splats out of where the object is not; nothing in it fills the object, which the colours do against the
    background that shines through. alpha_weight: λ₂, 0 or more. Returns the value, (H, W, 3) and (H, W). Raises
    InputError on pictures of different shapes.
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
        raise InputError(f"image loss: {what} has shape {found}: give that of the rendered picture, {wanted}")
