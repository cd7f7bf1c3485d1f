# SPDX-License-Identifier: MIT
"""One frame from its layers, in linear light (derivation: docs/rendering.md).

    frame = T·R + (1 − A)·K        K = B·S            inside the objects' masks
                                   K = lerp(B, P / S₀, w)·S   elsewhere

A coverage of the objects; T their photo colours, premultiplied by A; R their light now over their light at rest;
P photo; B clean plate (photo without the objects); S light on the ground with the objects over light without; S₀ the
same at rest; w how much everything is still at rest there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene.equirectangular import LUMINANCE
from ..srgb import Linear
from .pull_push import fill_gaps

MAX_RATIO = 8.0
"""Largest ratio of light now to light at rest; beyond three stops it is division by noise."""

MIN_SHADOW = 0.05
"""Darkest shadow that the photo is divided by: darker pixels hold no colour worth brightening 20 times."""


@dataclass(frozen=True, kw_only=True)
class ObjectLayer:
    """The objects of one frame, full image size.

    texture: (H, W, 3), photo colours averaged over each pixel, premultiplied by ``alpha``.
    alpha: (H, W), coverage 0 to 1.
    light: (H, W, 3), light over reference lighting, not premultiplied.
    """

    texture: Linear
    alpha: NDArray[np.float32]
    light: Linear


@dataclass(frozen=True, kw_only=True)
class FrameLayers:
    """One frame and its layers, full image size, in linear light.

    ground: (H, W, 3), background without objects, also behind them.
    shadow: (H, W, 3), light on the ground with the objects over light without.
    objects: the objects, with light and colours apart.
    beauty: (H, W, 3), the finished frame.
    """

    ground: Linear
    shadow: Linear
    objects: ObjectLayer
    beauty: Linear


def empty_layer(width: int, height: int) -> ObjectLayer:
    """Return a layer without any object in view."""
    return ObjectLayer(
        texture=np.zeros((height, width, 3), np.float32),
        alpha=np.zeros((height, width), np.float32),
        light=np.ones((height, width, 3), np.float32),
    )


SOFT_BEYOND = 2.0
"""Distance from the silhouette, over the reach of soft outlines, at which a texture's alpha counts no more."""


def matted(layer: ObjectLayer, lack: NDArray[np.float32], reach: float) -> ObjectLayer:
    """Return ``layer`` with the photo's soft outline, where its silhouette is.

    lack: (H, W) what the texture's alpha leaves of each pixel's coverage uncovered, premultiplied by coverage. reach:
    pixels inside the silhouette within which that counts. Further inside, and where something else of the body lies
    between, its former outline lies before its own other side, since it has turned: nothing shines through there.
    """
    if not lack.any() or reach <= 0.0:
        return layer
    depth = np.asarray(cv2.distanceTransform((layer.alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    weight = np.clip((SOFT_BEYOND - depth / np.float32(reach)) / (SOFT_BEYOND - 1.0), 0.0, 1.0)
    lack = _open_to_outside(layer.alpha, lack, depth, math.ceil(SOFT_BEYOND * reach))
    alpha = np.clip(layer.alpha - lack * weight, 0.0, 1.0).astype(np.float32)
    share = np.where(layer.alpha > 1e-6, alpha / np.maximum(layer.alpha, 1e-6), np.float32(1.0))
    return replace(layer, texture=(layer.texture * share[..., None]).astype(np.float32), alpha=alpha)


def _open_to_outside(
    alpha: NDArray[np.float32], lack: NDArray[np.float32], depth: NDArray[np.float32], steps: int
) -> NDArray[np.float32]:
    """``lack`` (H, W), no larger a share of coverage than what lies on the shortest way to the outside.

    Between the former outline of a body that has turned and its silhouette lies its other side, which covers all.
    Gaps of two pixels are bridged, as between hairs. depth: (H, W) distance from the outside in pixels. steps: pixels
    that are looked at.
    """
    rows, columns = np.flatnonzero(lack.any(axis=1)), np.flatnonzero(lack.any(axis=0))
    window = (
        slice(max(0, rows[0] - steps - 2), rows[-1] + steps + 3),
        slice(max(0, columns[0] - steps - 2), columns[-1] + steps + 3),
    )
    cover, inside = alpha[window], depth[window]
    share = np.where(cover > 1e-3, lack[window] / np.maximum(cover, 1e-3), np.float32(1.0)).astype(np.float32)
    share = np.where(inside > 0.0, cv2.dilate(share, np.ones((3, 3), np.uint8)), np.float32(1.0))
    smooth = cv2.GaussianBlur(inside, (0, 0), 1.0)
    way = [-cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0)]
    length = np.maximum(np.hypot(*way), np.float32(1e-6))
    y, x = np.mgrid[: cover.shape[0], : cover.shape[1]].astype(np.float32)
    outwards = x + way[0] / length, y + way[1] / length
    seen = share
    for _ in range(steps):
        seen = np.minimum(share, cv2.remap(seen, *outwards, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    found = lack.copy()
    # What interpolation leaves of nothing is nothing.
    found[window] = np.where(seen > 1e-3, np.minimum(lack[window], seen * cover), np.float32(0.0))
    return found


def soft_reach(alpha: NDArray[np.float32], lack: NDArray[np.float32]) -> float:
    """Return how many pixels inside the silhouette of ``alpha`` (H, W) at rest outlines are soft; see ``matted``."""
    soft = lack > SOFT * np.maximum(alpha, 1e-3)
    if not soft.any():
        return 0.0
    depth = cv2.distanceTransform((alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    return float(np.percentile(depth[soft], 95.0)) + 1.0


SOFT = 0.02
"""Uncovered share of a pixel from which it shows what is behind an object."""


def behind(photo: Linear, layer: ObjectLayer) -> Linear:
    """Return the colours (H, W, 3) that the ``photo`` shows behind the objects, ``layer`` at rest, where their outline
    is soft: photo = T + (1 − A)·K solved for K, within 0 and 1. Elsewhere the photo."""
    rest = 1.0 - layer.alpha[..., None]
    found = np.clip((photo - layer.texture) / np.maximum(rest, SOFT), 0.0, 1.0)
    return np.where((rest > SOFT) & (layer.alpha[..., None] > 0.0), found, photo).astype(np.float32)


def light_ratio(premultiplied: Linear, alpha: NDArray[np.float32]) -> Linear:
    """Return light over reference lighting (H, W, 3) from its premultiplied form and coverage (H, W); 1 far away.

    Where an object barely covers a pixel, the quotient of two small noisy numbers would sparkle along the outline;
    there, and for two pixels around, it is taken from the neighbourhood.
    """
    near_light = cv2.GaussianBlur(premultiplied, (5, 5), 1.0)
    near_alpha = cv2.GaussianBlur(alpha, (5, 5), 1.0)[..., None]
    near = np.where(near_alpha > 1e-3, near_light / np.maximum(near_alpha, 1e-3), 1.0)
    own = np.where(alpha[..., None] > 1e-3, premultiplied / np.maximum(alpha[..., None], 1e-3), near)
    weight = np.clip((alpha[..., None] - 0.25) / 0.5, 0.0, 1.0)
    return np.asarray(np.clip(near + (own - near) * weight, 0.0, MAX_RATIO), dtype=np.float32)


def rolled_off(layer: ObjectLayer, brightest: NDArray[np.float32]) -> ObjectLayer:
    """Return ``layer`` with its gains of light bounded: what turns to a lamp becomes no brighter than ``brightest``.

    brightest: (H, W) luminance of the brightest that the photo shows of the object there; infinite where it is not
    known. How much brighter than the rest of the light a lamp is cannot be read off sides that are not lit by it. Half
    of the way to the bound gains are as rendered; from there they approach it exponentially, as film does. Light of at
    most 1, as at rest, stays as it is.
    """
    colour = layer.texture / np.maximum(layer.alpha[..., None], 1e-6)
    own = np.maximum(colour @ np.asarray(LUMINANCE, dtype=np.float32), 1e-4)
    half = 0.5 * np.clip(brightest / own - 1.0, 1e-3, 2.0 * MAX_RATIO)[..., None]
    gain = layer.light - 1.0
    light = np.where(gain > half, 1.0 + half - half * np.expm1(-np.maximum(gain - half, 0.0) / half), layer.light)
    return replace(layer, light=light.astype(np.float32))


def with_highlights(layer: ObjectLayer, gloss: NDArray[np.float32]) -> ObjectLayer:
    """Return ``layer`` with highlights ``gloss`` (H, W), linear and premultiplied by coverage, besides its light.

    They are images of lamps: more light than at rest on the surface that mirrors them makes them no brighter. With
    less they fade, since their lamp lights it as well.
    """
    if not gloss.any():
        return layer
    added = gloss[..., None] / np.maximum(layer.light, np.float32(1.0))
    return replace(layer, texture=(layer.texture + added).astype(np.float32))


def continued_light(ratio: Linear, alpha: NDArray[np.float32]) -> Linear:
    """Return the light ``ratio`` (H, W, 3) with that of its surroundings where the lit surface, of coverage ``alpha``
    (H, W), does not reach: grains fly about beyond the shell that stands for them. Unchanged where there is no surface.
    """
    known = (alpha > 0.5).astype(np.float32)
    if not known.any():
        return ratio
    return np.stack([fill_gaps(np.ascontiguousarray(ratio[..., c]), known) for c in range(3)], axis=-1)


def ground_layer(
    *,
    photo: Linear,
    background: Linear,
    shadow: Linear,
    rest_shadow: Linear,
    at_rest: NDArray[np.float32],
    masks: NDArray[np.bool_],
) -> Linear:
    """Return the background (H, W, 3) that is seen where no object is.

    shadow, rest_shadow: (H, W, 3), light on the ground over light on the empty ground, now and at rest.
    at_rest: (H, W), weight w, 1 where nothing has moved.
    masks: (H, W), True where the photo shows an object; the photo is never used there.
    """
    weight = np.where(masks, 0.0, at_rest).astype(np.float32)[..., None]
    now, rest = np.maximum(shadow, MIN_SHADOW), np.maximum(rest_shadow, MIN_SHADOW)
    revealed = background * shadow
    # Exactly the photo where the light is the same. Elsewhere P·S/S₀ overshoots when the rendered shadow is deeper
    # than the photo's, so it is clipped to the range of the photo and the clean plate in shadow.
    kept = np.where(now == rest, photo, photo * (now / rest))
    kept = np.clip(kept, np.minimum(photo, revealed), np.maximum(photo, revealed))
    return np.where(weight == 1.0, kept, revealed + (kept - revealed) * weight).astype(np.float32)


FEWEST_SHADED = 100
"""Fewest pixels of a photo's shadow from which its colour is estimated."""
FAINT = 0.05
"""Darkening, as a natural logarithm of luminance, below which a photo's shadow tells no colour."""
DEPTHS, TINTS = (0.6, 1.5), (0.3, 3.0)
"""Limits of a rendered shadow's depth over the photo's, and of one channel's over that of luminance, in logarithms."""
BLACK = 0.004
"""Linear light below which a photo's value is mostly noise: a 255th in sRGB is 0.0003, ten of them are 0.003."""
OUTSKIRTS = 0.9
"""Share of the light above which a shadow is in no mask of a photo's shadows, and so not in its depth either."""


def shadow_exponents(
    photo: Linear, background: Linear, rest_shadow: Linear, *, shaded: NDArray[np.bool_], known: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the exponents (3,) that give a rendered shadow the colour and depth of the ``photo``'s own.

    What light reaches a shadow has mostly been reflected by the ground and the things around before, so it has their
    colour; the light of the scene knows nothing of that. The photo's shadow over the clean plate says it per channel.
    rest_shadow: (H, W, 3) rendered at rest. shaded, known: (H, W) the photo's shadow, and pixels that show ground.
    Depths are compared as totals, because both shadows need not lie on the same pixels, of what is darker than
    ``OUTSKIRTS``: a soft light's shadow reaches far beyond the mask. Ones where the photo has no shadow that could
    tell.
    """
    ones = np.ones(3, np.float32)
    shaded = shaded & known
    if shaded.sum() < FEWEST_SHADED:
        return ones

    luminance = np.asarray(LUMINANCE, dtype=np.float32)
    total = float(_darkening(background[shaded] @ luminance, photo[shaded] @ luminance))
    if total < FAINT * shaded.sum():
        return ones
    depth = float(np.clip(total / max(_rendered_depth(rest_shadow, known), 1e-6), *DEPTHS))
    tint = np.clip(_darkening(background[shaded], photo[shaded]) / total, *TINTS)
    return np.asarray(depth * tint, dtype=np.float32)


def _darkening(lit: Linear, dark: Linear) -> NDArray[np.float64]:
    """Sum of how much darker (N, …) ``dark`` is than ``lit``, as natural logarithms."""
    values = np.log(np.maximum(lit, BLACK)) - np.log(np.maximum(dark, BLACK))
    return np.asarray(values.astype(np.float64).sum(axis=0))


def _rendered_depth(rest_shadow: Linear, known: NDArray[np.bool_]) -> float:
    levels = rest_shadow[known] @ np.asarray(LUMINANCE, dtype=np.float32)
    return float(-np.log(np.maximum(levels[levels < OUTSKIRTS], MIN_SHADOW)).astype(np.float64).sum())


LEAST_SHOWN = 0.1
"""Share of a rendered shadow's depth, in total, below which the photo shows none."""


def shows_shadow(
    photo: Linear, background: Linear, rest_shadow: Linear, *, shaded: NDArray[np.bool_], known: NDArray[np.bool_]
) -> bool:
    """Return whether the ``photo`` shows the shadow that is rendered at rest, or at least some of it.

    It does not where a thing was cut out and put on white, or stands in a light that leaves no shadow. Arguments as of
    ``shadow_exponents``.
    """
    shaded = shaded & known
    luminance = np.asarray(LUMINANCE, dtype=np.float32)
    total = float(_darkening(background[shaded] @ luminance, photo[shaded] @ luminance))
    return total >= LEAST_SHOWN * _rendered_depth(rest_shadow, known)


def appearing(shadow: Linear, at_rest: NDArray[np.float32]) -> Linear:
    """Return the rendered ``shadow`` (H, W, 3) of things without one in the photo: none at rest; it comes as they move.

    ``ground_layer`` would divide the photo by a shadow that is not in it. Beside things that have landed where they
    stood, the clean plate would then be in a shadow that ends where the photo begins. at_rest: (H, W), weight of their
    contacts alone, without an edge around their outlines.
    """
    return np.asarray(1.0 + (shadow - 1.0) * (1.0 - at_rest[..., None]), dtype=np.float32)


UMBRA = (0.1, 0.5)
"""Limits of the light left in full shadow of the sun: with less or more of it the shadow would have one colour."""


def tinted_shadow(shadow: Linear, exponents: NDArray[np.float32], umbra: float) -> Linear:
    """Return a rendered ``shadow`` (H, W, 3) in the photo's colour, by ``shadow_exponents`` (3,).

    A power down to the light ``umbra`` that is left without the sun. Below, towards a contact, the body takes reflected
    light as it takes the sky's: colours stay and all channels go to 0 alike, where a power below 1 would leave a red
    glow and one above 1 none of the colour.
    """
    full = np.float32(np.clip(umbra, *UMBRA))
    return np.asarray(np.maximum(shadow, full) ** exponents * np.minimum(shadow / full, 1.0), dtype=np.float32)


def compose(layer: ObjectLayer, ground: Linear) -> Linear:
    """Return the frame (H, W, 3): objects over ground."""
    return layer.texture * layer.light + (1.0 - layer.alpha[..., None]) * ground
