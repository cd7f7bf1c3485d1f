# SPDX-License-Identifier: MIT
"""Which of the photo's pixels around an object stay valid as it moves, and the shaded ground it uncovers.

Two fades: the photo's own shadow goes when the object's contact has moved; the rim, a few pixels around the mask that
still show some of the object, goes once the outline there has moved by a pixel. Where the outline has moved away, the
clean plate continues in the shade that the photo shows nearby.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..smoothstep import smoothstep
from ..srgb import Linear

FADE_START = 0.004
FADE_END = 0.08
"""Displacement of the contact over the object's size between which the photo's shadow fades to the rendered one. Below
the first a body has merely settled; at the second its shadow has visibly moved."""

RIM_SHARE = 0.006
"""Width of the rim over the longer side of the image, about the spread of lenses and sharpening."""

INNER_RIM_PX = 2.0
"""Width of the outermost part of a mask, in pixels, that is treated like the rim: there a mesh covers pixels only in
part, and what shows beside it at rest is the photo. On a coin of 40 pixels this is a tenth of the mask."""

RIM_FADE_PX = (0.25, 1.5)
"""Movement of the outline in pixels between which the rim fades."""

CONTACT_HEIGHT = 0.15
"""Share of an object's height, from its lowest point, that counts as its contact."""


def contact_vertices(rest: NDArray[np.floating], up: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which of the vertices ``rest`` (V, 3) lie at the foot of the object, along the unit vector ``up``."""
    heights = np.asarray(rest) @ np.asarray(up)
    low = heights.min()
    return np.asarray(heights <= low + CONTACT_HEIGHT * max(float(np.ptp(heights)), 1e-9))


def contact_displacement(
    rest: NDArray[np.floating], now: NDArray[np.floating], contact: NDArray[np.bool_], size: float
) -> float:
    """Return the mean displacement of the contact over ``size``, both in metres: 0 at rest, 1 one object size away."""
    return float(np.linalg.norm(np.asarray(now)[contact] - np.asarray(rest)[contact], axis=1).mean()) / size


def rest_weight(displacement: float) -> float:
    """Return 1 at rest, 0 when gone, smooth in between; ``displacement`` is that of ``contact_displacement``."""
    return float(1.0 - smoothstep(np.asarray(displacement, dtype=np.float64), FADE_START, FADE_END))


def influence(places: Sequence[NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Return each object's share (N, H, W) of a pixel's shadow, by nearness to its ``places`` (H, W); the sum is 1.

    An object without pixels counts nowhere, unless none has any.
    """
    nearness = []
    for place in places:
        if not place.any():
            nearness.append(np.zeros(place.shape, np.float32))
            continue
        distance = cv2.distanceTransform((~place).astype(np.uint8), cv2.DIST_L2, 5)
        nearness.append(1.0 / (1.0 + distance.astype(np.float32)) ** 2)
    stack = np.stack(nearness)
    total = stack.sum(axis=0, keepdims=True)
    even = np.full_like(stack, 1.0 / len(places))
    return np.where(total > 0, stack / np.maximum(total, 1e-12), even).astype(np.float32)


def rest_map(shares: NDArray[np.float32], weights: Sequence[float]) -> NDArray[np.float32]:
    """Return the weight w (H, W) from ``influence`` (N, H, W) and the objects' ``rest_weight`` (N).

    Exactly 1 when all are at rest, which a sum of rounded shares need not be.
    """
    moved = 1.0 - np.asarray(weights, dtype=np.float32)
    return np.clip(1.0 - np.tensordot(moved, shares, axes=1), 0.0, 1.0).astype(np.float32)


def rim_strength(mask: NDArray[np.bool_], others: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the rim strength (H, W), 0 to 1, around ``mask``; ``others`` (H, W) are never rim."""
    strength = np.zeros(mask.shape, np.float32)
    if mask.any():
        width = max(2.0, RIM_SHARE * max(mask.shape))
        distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        rim = (distance <= width) & ~mask & ~others
        strength[rim] = 1.0 - smoothstep(np.asarray(distance[rim], dtype=np.float64), width / 2, width)
    return strength


def inner_rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the outermost pixels (H, W) of ``mask`` (H, W), ``INNER_RIM_PX`` wide."""
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(mask & (depth <= INNER_RIM_PX))


class Rim:
    """The rim of one object's mask: its pixels, and the nearest vertex of each."""

    def __init__(self, strength: NDArray[np.float32], rest_px: NDArray[np.floating]) -> None:
        """``strength`` (H, W): share of the object in a pixel; ``rest_px`` (V, 2): its vertices at rest in pixels."""
        self._rest_px = np.asarray(rest_px, dtype=np.float64)
        self._pixels = np.nonzero(strength > 0)
        rows, columns = self._pixels
        self._strength = strength[self._pixels].astype(np.float64)
        known = np.isfinite(self._rest_px).all(axis=1)
        self._known = np.nonzero(known)[0]
        if len(self._known):
            _, nearest = KDTree(self._rest_px[known]).query(np.stack([columns + 0.5, rows + 0.5], axis=1))
            self._vertex = self._known[nearest]

    def apply(self, at_rest: NDArray[np.float32], now_px: NDArray[np.floating]) -> None:
        """Reduce ``at_rest`` (H, W) in place where vertices, now at ``now_px`` (V, 2), have moved."""
        if not len(self._known):
            return
        moved = np.linalg.norm(np.asarray(now_px) - self._rest_px, axis=1)[self._vertex]
        weight = 1.0 - smoothstep(np.nan_to_num(moved, nan=np.inf, posinf=1e9), *RIM_FADE_PX)
        at_rest[self._pixels] *= (1.0 - self._strength * (1.0 - weight)).astype(np.float32)


Mask = NDArray[np.bool_]

SMOOTH = 0.004
"""Blur of the shade over the longer side of the image; finer structure is texture."""
DARKEST, BRIGHTEST = 0.02, 1.3
"""Bounds of photo over background in a shadow; above 1 are reflections."""

SHADED = 0.95
"""Ratio of photo to clean plate below which it counts as shadow where the scene has no shadow mask."""


def shade(photo: Linear, background: Linear, *, shadow: Mask, unknown: Mask) -> Linear:
    """Return photo over clean plate (H, W, 3), smooth, inside ``shadow`` (H, W), 1 elsewhere, filled in ``unknown``.

    unknown: (H, W), where the photo shows the objects with their rims.
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
    """Return where (H, W) the photo is darker than the clean plate beyond texture, for scenes without shadow masks."""
    weight = (~unknown).astype(np.float32)
    sigma = max(1.0, SMOOTH * max(unknown.shape))
    over, under = (cv2.GaussianBlur(image.mean(axis=-1) * weight, (0, 0), sigma) for image in (photo, background))
    return np.asarray((over < SHADED * under) & ~unknown)


def push_pull(values: Linear, known: Mask) -> Linear:
    """Return ``values`` (H, W, 3) where ``known`` (H, W), continued smoothly elsewhere (Gortler et al. 1996)."""
    weight = known.astype(np.float32)
    if known.all() or min(known.shape) < 2:
        return values if known.any() else np.ones_like(values)
    sums = cv2.pyrDown(values * weight[..., None])
    weights = cv2.pyrDown(weight)
    coarse = np.where(weights[..., None] > 1e-3, sums / np.maximum(weights[..., None], 1e-3), np.float32(1.0))
    coarse = push_pull(coarse.astype(np.float32), np.asarray(weights > 1e-3))
    size = (known.shape[1], known.shape[0])
    return np.where(known[..., None], values, cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR))


BRIGHTER, DEEPEST = 1.1, 0.5
"""Luminance of photo over clean plate above which it shows no shadow, and below which what is in no shadow's mask shows
none either."""


def remains(photo: Linear, background: Linear, masks: Sequence[Mask], shadow: Mask) -> list[NDArray[np.float32]]:
    """Return per object where (H, W), 1 or 0, the photo shows a part of it that its mask lacks, such as fur or a stem.

    There the clean plate differs from the photo by what is no ``shadow`` (H, W), and it must leave with the object.
    """
    together = np.logical_or.reduce(list(masks))
    # A pixel of noise tells nothing; the offset is the noise of black.
    over, under = (cv2.blur(np.ascontiguousarray(image.mean(axis=-1)), (3, 3)) + 0.005 for image in (photo, background))
    unlike = (over > BRIGHTER * under) | ((over < DEEPEST * under) & ~shadow)
    left = cv2.dilate((unlike & (photo != background).any(axis=-1)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    distances = [cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) for mask in masks]
    nearest = np.argmin(np.stack(distances), axis=0)
    return [(left & ~together & (nearest == index)).astype(np.float32) for index in range(len(masks))]


def object_halos(photo: Linear, background: Linear, masks: Sequence[Mask], shadow: Mask) -> list[NDArray[np.float32]]:
    """Return per object the share (H, W), 0 to 1, of its surroundings that belongs to its appearance in the photo.

    That is its rim, and pixels where clean plate and photo differ without a ``shadow`` (H, W).
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
