# SPDX-License-Identifier: MIT
"""What a moved camera sees of the ground behind and beside an object that the photo shows standing there.

The photo knows the object's shadow on the ground around it, the background does not: where the outline has moved away,
the background goes on in the shade that the photo shows nearby.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .rest import rim_strength
from .transfer import Linear

Mask = NDArray[np.bool_]

SMOOTH = 0.004
"""Blur of the shade over the longer side of the image: finer than that it is texture."""
DARKEST, BRIGHTEST = 0.02, 1.3
"""Bounds of photo over background in a shadow; above 1 are reflections."""

SHADED = 0.95
"""Photo over background below which it is taken for a shadow where the scene names none."""


def shade(photo: Linear, background: Linear, *, shadow: Mask, unknown: Mask) -> Linear:
    """Photo over background (H, W, 3), smooth, where ``shadow`` (H, W) is; 1 elsewhere, continued through ``unknown``.

    unknown: (H, W) where the photo shows the objects, with their rims.
    """
    known = shadow & ~unknown
    if not known.any():
        return np.ones_like(photo)
    weight = known.astype(np.float32)[..., None]
    sigma = max(1.0, SMOOTH * max(known.shape))
    over, under = (cv2.GaussianBlur(image * weight, (0, 0), sigma) for image in (photo, background))
    ratio = np.clip(over / np.maximum(under, 1e-6), DARKEST, BRIGHTEST)
    values = np.where(weight > 0, ratio, np.float32(1.0)).astype(np.float32)
    return push_pull(values, ~unknown)


def found_shadow(photo: Linear, background: Linear, unknown: Mask) -> Mask:
    """Where (H, W) the photo is darker than the background over more than its texture; for scenes that do not say."""
    weight = (~unknown).astype(np.float32)
    sigma = max(1.0, SMOOTH * max(unknown.shape))
    over, under = (cv2.GaussianBlur(image.mean(axis=-1) * weight, (0, 0), sigma) for image in (photo, background))
    return np.asarray((over < SHADED * under) & ~unknown)


def push_pull(values: Linear, known: Mask) -> Linear:
    """``values`` (H, W, 3) where ``known`` (H, W), smoothly continued elsewhere (Gortler et al., SIGGRAPH 1996)."""
    weight = known.astype(np.float32)
    if known.all() or min(known.shape) < 2:
        return values if known.any() else np.ones_like(values)
    sums = cv2.pyrDown(values * weight[..., None])
    weights = cv2.pyrDown(weight)
    coarse = np.where(weights[..., None] > 1e-3, sums / np.maximum(weights[..., None], 1e-3), np.float32(1.0))
    coarse = push_pull(coarse.astype(np.float32), np.asarray(weights > 1e-3))
    size = (known.shape[1], known.shape[0])
    return np.where(known[..., None], values, cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR))


def halos(photo: Linear, background: Linear, masks: Sequence[Mask], shadow: Mask) -> list[NDArray[np.float32]]:
    """How much of each object's surroundings (H, W) belongs to the view that the photo had of it, 0 to 1.

    That is its rim, and wherever the background is not the photo and no ``shadow`` (H, W) says why.
    """
    together = np.logical_or.reduce(list(masks))
    changed = (photo != background).any(axis=-1) & ~together
    sigma = max(1.0, SMOOTH * max(shadow.shape))
    shaded = cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), sigma)
    loose = np.where(changed, 1.0 - shaded, 0.0).astype(np.float32)
    distances = [cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) for mask in masks]
    nearest = np.argmin(np.stack(distances), axis=0)
    return [
        np.maximum(rim_strength(mask, together), np.where(nearest == i, loose, np.float32(0.0)))
        for i, mask in enumerate(masks)
    ]
