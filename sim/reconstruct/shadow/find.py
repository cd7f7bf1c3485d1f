# SPDX-License-Identifier: MIT
"""Shadows that objects cast on the ground, one mask for each (PhysGen3D, supplement A.2).

The paper takes all that is darker than a fixed grey value and hangs together with the object. That value fits one
ground under one light, and takes every dark thing that touches. Here the objects' own outlines say what may be shadow:
rough bodies stand behind them, the light is looked for whose shadows explain the ground's colours best, and a pixel is
shadow as far as both agree: the bodies may cast one there, and the ground has the colour of its own texture with less
light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from .ground_pixels import GroundPixels, ground_pixels
from .kept_share import kept_levels, shadow_probability
from .light_fit import fit_light, kept_light
from .relief import relief
from .rest import with_rest
from .threshold import threshold_shadows

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

FEWEST = 50
"""Pixels of ground that say something."""
FAR = 0.25
"""What a distance of the object's side counts against the logarithm of the light that it takes, where shadows meet."""


@dataclass(frozen=True)
class CastShadow:
    """shadow: (H, W) where the object takes a tenth of the ground's light or more. penumbra: (H, W) that and the soft
    border around it, which must leave the photo with the object too.
    """

    shadow: Mask
    penumbra: Mask


def find_shadows(
    pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera, *, fixed_threshold: float | None = None
) -> list[Mask]:
    """The shadow (H, W) of each of ``masks`` (H, W), what is seen of the objects: disjoint, without any object.

    pixels: (H, W, 3) sRGB. camera: that of the photo, above the ground z = 0; what it sees above the horizon is no
    ground. A pixel in several shadows goes to the object that takes most of its light. fixed_threshold: grey value
    0 to 255; takes the paper's way (``threshold``), which needs no ground. An object without a pixel, or that stands
    above the horizon, has no shadow.
    """
    if fixed_threshold is not None:
        return threshold_shadows(pixels, masks, fixed_threshold)
    return [cast.shadow for cast in cast_shadows(pixels, masks, camera)]


def cast_shadows(pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera) -> list[CastShadow]:
    """Shadows of ``masks`` with their soft borders; arguments as for ``find_shadows``. Both are disjoint from all
    objects, and from those of other objects.
    """
    found = [CastShadow(*np.zeros((2, *pixels.shape[:2]), dtype=bool)) for _ in masks]
    standing = [(index, body) for index, mask in enumerate(masks) if (body := relief(mask, camera)) is not None]
    if not standing:
        return found
    bodies = [body for _, body in standing]
    ground = ground_pixels(pixels, masks, camera, bodies)
    if ground is None or len(ground.rows) < FEWEST:
        return found
    total, alone, hidden = kept_light(ground, bodies, fit_light(ground, bodies))
    owner = _owner(ground, alone, [masks[index] for index, _ in standing])
    inner, outer = shadow_probability(ground, kept_levels(ground, total, hidden), _part(ground, alone, owner))
    taken = np.logical_or.reduce(masks)
    for position, (index, _) in enumerate(standing):
        own = owner == position
        dark = (_full_size(ground, np.where(own, inner, 0.0), taken.shape) > 0.5) & ~taken
        dim = (_full_size(ground, np.where(own, outer, 0.0), taken.shape) > 0.5) & ~taken
        shadow = with_rest(pixels, _connected(dark, masks[index], ground, alone[position]), taken)
        penumbra = shadow | _touching(dim, shadow)
        found[index] = CastShadow(shadow=shadow, penumbra=penumbra)
        taken |= penumbra
    return found


def _owner(ground: GroundPixels, alone: Values, masks: Sequence[Mask]) -> NDArray[np.int64]:
    """Which object (N,) takes most of each pixel's light; the nearest one where none is known to take any."""
    size = ground.known.shape[::-1]
    costs = []
    for kept, mask in zip(alone, masks, strict=True):
        small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
        distance = cv2.distanceTransform((small == 0).astype(np.uint8), cv2.DIST_L2, 5)
        far = distance[ground.rows, ground.columns] / ground.object_side
        costs.append(ground.blurred(np.log(kept), 1.5) + FAR * far)
    return np.asarray(np.argmin(costs, axis=0))


def _part(ground: GroundPixels, alone: Values, owner: NDArray[np.int64]) -> Values:
    """How much (N,) of the lost light, as a logarithm, the ``owner`` (N,) takes: at least half, or it were none."""
    lost = np.stack([ground.blurred(-np.log(kept), 1.5) for kept in alone])
    own = np.take_along_axis(lost, owner[None], axis=0)[0]
    return np.clip((own + 1e-3) / (lost.sum(axis=0) + 1e-3), 0.5, 1.0)


def _full_size(ground: GroundPixels, values: Values, shape: tuple[int, int]) -> NDArray[np.float32]:
    """``values`` (N,) in the photo; the seam along the objects has that of the ground beside it."""
    picture = ground.picture(values)
    beside = cv2.GaussianBlur(picture, (0, 0), 1.5)
    weight = cv2.GaussianBlur(ground.known, (0, 0), 1.5)
    filled = np.where(ground.known > 0, picture, np.where(weight > 0.05, beside / np.maximum(weight, 1e-3), 0.0))
    return np.asarray(cv2.resize(filled.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR))


def _connected(dark: Mask, mask: Mask, ground: GroundPixels, kept: Values) -> Mask:
    """The parts of ``dark`` that touch the object in ``mask``, or lie where it casts its shadow for the most part."""
    shape = dark.shape
    gap = max(1, round(0.02 * ground.object_side * shape[1] / ground.known.shape[1]))
    near = cv2.dilate(mask.astype(np.uint8), np.ones((2 * gap + 1,) * 2, np.uint8)) > 0
    cast = cv2.resize(ground.picture((kept < 0.8).astype(np.float32)), shape[::-1]) > 0.5
    number, labels = _components(dark)
    sizes = np.bincount(labels.ravel(), minlength=number)
    keep = np.bincount(labels[near], minlength=number) > 0
    keep |= np.bincount(labels[cast], minlength=number) > 0.5 * sizes
    keep[0] = False
    return np.asarray(keep[labels])


def _components(region: Mask) -> tuple[int, NDArray[np.int64]]:
    number, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=8)
    return number, np.asarray(labels, dtype=np.int64)


def _touching(region: Mask, seed: Mask) -> Mask:
    """The connected components of ``region`` that hold some of ``seed``."""
    number, labels = _components(region)
    keep = np.bincount(labels[seed], minlength=number) > 0
    keep[0] = False
    return np.asarray(keep[labels])
