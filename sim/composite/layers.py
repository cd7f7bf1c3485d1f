# SPDX-License-Identifier: MIT
"""One frame from its layers, in linear light (docs/rendering.md has the reasoning).

    frame = T·R + (1 − A)·K        K = B·S            inside the objects' masks
                                   K = lerp(B, P / S₀, w)·S   elsewhere

A coverage of the objects; T their photo colours, premultiplied by A; R their light now over their light at rest;
P photo; B photo without the objects; S light on the ground with the objects over light without; S₀ the same at
rest; w how much everything is still at rest there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .transfer import Linear

MAX_RATIO = 8.0
"""Light now over light at rest; more than three stops are a division by next to nothing, not light."""

MIN_SHADOW = 0.05
"""Darkest ground that a photo is divided by: what is darker holds no colour worth brightening 20 times."""


@dataclass(frozen=True, kw_only=True)
class ObjectLayer:
    """The objects of one frame, whole image size.

    texture: (H, W, 3) photo colours averaged over each pixel, premultiplied by ``alpha``.
    alpha: (H, W) coverage 0 to 1.
    light: (H, W, 3) light over rest light, not premultiplied.
    """

    texture: Linear
    alpha: NDArray[np.float32]
    light: Linear


@dataclass(frozen=True, kw_only=True)
class FrameLayers:
    """One frame and what it was made of, whole image size, in linear light.

    ground: (H, W, 3) what is seen where no object is, also behind objects.
    shadow: (H, W, 3) light on the ground with the objects over light without.
    objects: the objects, their light apart from their colours.
    beauty: (H, W, 3) the finished picture.
    """

    ground: Linear
    shadow: Linear
    objects: ObjectLayer
    beauty: Linear


def empty_layer(width: int, height: int) -> ObjectLayer:
    """No object in view."""
    return ObjectLayer(
        texture=np.zeros((height, width, 3), np.float32),
        alpha=np.zeros((height, width), np.float32),
        light=np.ones((height, width, 3), np.float32),
    )


def light_ratio(premultiplied: Linear, alpha: NDArray[np.float32]) -> Linear:
    """Light over rest light (H, W, 3) from the same times coverage, and the coverage (H, W); 1 far from objects.

    Where an object covers little of a pixel, the quotient of two small noisy numbers would sparkle along the
    outline; there, and for two pixels around, it comes from the neighbourhood.
    """
    near_light = cv2.GaussianBlur(premultiplied, (5, 5), 1.0)
    near_alpha = cv2.GaussianBlur(alpha, (5, 5), 1.0)[..., None]
    near = np.where(near_alpha > 1e-3, near_light / np.maximum(near_alpha, 1e-3), 1.0)
    own = np.where(alpha[..., None] > 1e-3, premultiplied / np.maximum(alpha[..., None], 1e-3), near)
    weight = np.clip((alpha[..., None] - 0.25) / 0.5, 0.0, 1.0)
    return np.asarray(np.clip(near + (own - near) * weight, 0.0, MAX_RATIO), dtype=np.float32)


def ground_layer(
    *,
    photo: Linear,
    background: Linear,
    shadow: Linear,
    rest_shadow: Linear,
    at_rest: NDArray[np.float32],
    masks: NDArray[np.bool_],
) -> Linear:
    """What is seen where no object is (H, W, 3).

    shadow, rest_shadow: light on the ground over light on the empty ground, now and at rest.
    at_rest: (H, W) weight w, 1 where nothing has moved.
    masks: (H, W) True where the photo shows an object; the photo is never used there.
    """
    weight = np.where(masks, 0.0, at_rest).astype(np.float32)[..., None]
    now, rest = np.maximum(shadow, MIN_SHADOW), np.maximum(rest_shadow, MIN_SHADOW)
    revealed = background * shadow
    # Exactly the photo where the light is the same. Elsewhere P·S/S₀ overshoots when the rendered shadow is deeper
    # than the photo's; what is under the shadow is neither brighter nor darker than both that are known.
    kept = np.where(now == rest, photo, photo * (now / rest))
    kept = np.clip(kept, np.minimum(photo, revealed), np.maximum(photo, revealed))
    return np.where(weight == 1.0, kept, revealed + (kept - revealed) * weight).astype(np.float32)


def compose(layer: ObjectLayer, ground: Linear) -> Linear:
    """The frame (H, W, 3): objects over ground."""
    return layer.texture * layer.light + (1.0 - layer.alpha[..., None]) * ground
