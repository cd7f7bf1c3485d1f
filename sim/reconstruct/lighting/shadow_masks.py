# SPDX-License-Identifier: MIT
"""Shadow masks of the objects, and the holes to inpaint (PhysGen3D, supplement A.2).

The paper's threshold takes everything darker than a fixed grey value that is connected to the object; that value fits
one ground under one light. By default a shadow is where both agree: proxy bodies may cast one there
(``shadow_model``), and the ground has the colour of its own texture with less light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...composite.srgb import bytes_to_linear
from ...scene.model import Camera
from ..segmentation.mask_geometry import enclosed_holes
from .ground_pixels import GroundPixels, ground_pixels, proxy_body
from .shadow_lamps import fit_light, light_shares
from .shadow_model import SHADOW_RATIO, light_level_posterior, observed_darkening, shadow_probability

Mask = NDArray[np.bool_]


def threshold_shadows(pixels: NDArray[np.uint8], masks: Sequence[Mask], threshold: float) -> list[Mask]:
    """Return shadows (H, W) of the objects in ``masks`` (H, W) by a grey threshold (PhysGen3D, supplement A.2).

    Per object, the largest connected component of dark pixels and the object, without any object. pixels: (H, W, 3)
    sRGB. threshold: grey value 0 to 255; darker pixels count (PhysGen3D's code uses 50). Where components of several
    objects meet, each pixel belongs to the nearest object.
    """
    dark = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY) < threshold
    covered = np.logical_or.reduce(masks)
    found = []
    for mask in masks:
        number, labels = cv2.connectedComponents(((dark & ~covered) | mask).astype(np.uint8), connectivity=8)
        sizes = np.bincount(labels.ravel(), minlength=number)
        own = np.unique(labels[mask])
        largest = own[np.argmax(sizes[own])] if len(own) else -1
        found.append((labels == largest) & ~covered)
    shared = np.sum(found, axis=0) > 1
    if shared.any():
        distances = np.stack(
            [
                np.where(shadow, ndimage.distance_transform_edt(~mask), np.inf)
                for shadow, mask in zip(found, masks, strict=True)
            ]
        )
        nearest = distances.argmin(axis=0)
        found = [shadow & (~shared | (nearest == index)) for index, shadow in enumerate(found)]
    return [np.asarray(shadow) for shadow in found]


DEEPEST_KEPT = 0.65
"""Largest share of light in a hard shadow, to distinguish it from uneven ground."""
EVEN = 0.4
"""Spread of the ground's log brightness over the shadow's depth above which the ground is too uneven."""
ALIKE, TINT = 0.3, 0.12
"""Tolerances of the extension: share of the shadow's depth in log brightness, and log chroma."""
MOST = 2.0
"""Largest added area over that of the shadow; more is another object."""


def extend_hard_shadow(pixels: NDArray[np.uint8], shadow: Mask, closed: Mask) -> Mask:
    """Return ``shadow`` (H, W) extended over adjacent pixels of the same darkness and tint in ``pixels`` (H, W, 3)
    sRGB.

    Completes a hard shadow whose light was estimated slightly wrong, if the case is clear: even ground, a deep shadow.
    closed: (H, W) excluded pixels. Otherwise returns ``shadow`` unchanged.
    """
    area = int(shadow.sum())
    if area < 60:
        return shadow
    reach = max(4, round(0.8 * np.sqrt(area)))
    rows, columns = np.flatnonzero(shadow.any(axis=1)), np.flatnonzero(shadow.any(axis=0))
    window = (
        slice(max(0, rows[0] - 2 * reach), rows[-1] + 1 + 2 * reach),
        slice(max(0, columns[0] - 2 * reach), columns[-1] + 1 + 2 * reach),
    )
    own, barred = shadow[window], closed[window]
    logs = np.log(bytes_to_linear(np.ascontiguousarray(cv2.blur(pixels[window], (3, 3)))) + 0.01)
    core = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # By distances: a dilation takes time by the area of its kernel.
    near = cv2.distanceTransform((~own).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach
    lit = near & ~(cv2.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & ~barred
    if core.sum() < 40 or lit.sum() < 40:
        return shadow
    inside = np.median(logs[core], axis=0)
    brightness = logs.mean(axis=-1)
    depth = float(np.median(brightness[lit]) - inside.mean())
    spread = 1.48 * float(np.median(np.abs(brightness[lit] - np.median(brightness[lit]))))
    if depth < -np.log(DEEPEST_KEPT) or spread > EVEN * depth:
        return shadow
    difference = logs - inside
    level = difference.mean(axis=-1)
    tint = np.abs(difference - level[..., None]).max(axis=-1)
    alike = (np.abs(level) < ALIKE * depth) & (tint < TINT) & ~barred
    _, labels = cv2.connectedComponents((alike | own).astype(np.uint8), connectivity=4)
    grown = np.isin(labels, np.unique(labels[own])) & alike & ~own
    added = int(grown.sum())
    edge = np.zeros_like(grown)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    if added > MOST * area or (grown & edge).any():
        return shadow
    result = shadow.copy()
    result[window] |= cv2.morphologyEx((own | grown).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    return result & (~closed | shadow)


PENUMBRA_DILATION = 20.0
"""Side of the kernel in a photo of 1024 pixels if shadows come with penumbras (``cast_shadows``). With the paper's 50
around the shadow alone the hole is as large, but more darkness stays outside it."""


RIM = 5.0
"""Pixels at 1024 beside an object's outline that are mixed with it: they leave with it even where a thing without a box
touches it."""


def object_holes(
    masks: Sequence[Mask], shadows: Sequence[Mask], dilation: float, stay: Mask | None = None
) -> list[Mask]:
    """Return the hole of each object: mask and shadow, dilated, but never over another object or what must ``stay``.

    shadows: (H, W), best with their penumbras. dilation: side of the kernel in pixels of this photo; half of it covers
    an outline. stay: (H, W) things without a box. An object's hole may cover another object's shadow.
    """
    side = max(1, round(dilation)) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    rim = 2 * max(1, round(RIM * max(masks[0].shape) / 1024.0)) + 1 if masks else 1
    beside = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (min(rim, side), min(rim, side)))
    holes = []
    for index, (mask, shadow) in enumerate(zip(masks, shadows, strict=True)):
        hole = cv2.dilate((mask | shadow).astype(np.uint8), kernel) > 0
        # A rest of the photo inside a strap would remain as an island.
        hole |= enclosed_holes(hole)
        if stay is not None:
            hole &= ~stay | (cv2.dilate(mask.astype(np.uint8), beside) > 0)
        for other, blocked in enumerate(masks):
            if other != index:
                hole &= ~(blocked & ~mask)
        holes.append(np.asarray(hole))
    return holes


Values = NDArray[np.float64]

FEWEST = 50
"""Fewest ground pixels for an estimate."""
FAR = 0.25
"""Weight of a distance of one object side against the log of the blocked light, where shadows meet."""


UNFORESEEN = 0.02
"""Lost light, as a logarithm, below which a shadow is its owner's."""
FORESEEN, POSSIBLE = 0.8, 0.15
"""Share of light below which an object is expected to shade the ground; probability below which the photo says that it
does not."""
DARKENED = 0.3
"""Share of the darkening along its border that the photo must show of a shadow, else it is another surface. True ones
in 15 photos and rendered pictures had 0.8 to 2; leaves below a log −0.2."""
CONTACT_SKY = 0.4
"""Share of the sky that an object hides around its contact, where the ground is darker under any light."""


@dataclass(frozen=True)
class CastShadow:
    """shadow: (H, W) where the object blocks a tenth of the ground's light or more. penumbra: (H, W) the same with its
    soft border, which must leave the photo with the object too. expected: (H, W) ground around the contact, and where
    the light that explains the other shadows casts one that the photo does not exclude; a missed shadow would stay
    there as a stain. missing: share of the foreseen shadow that was not found, 0 to 1."""

    shadow: Mask
    penumbra: Mask
    expected: Mask
    missing: float = 0.0


def cast_shadows(
    pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera, stay: Mask | None = None
) -> list[CastShadow]:
    """Return the shadow of each of ``masks`` (H, W), visible pixels of the objects, with its penumbra.

    pixels: (H, W, 3) sRGB. camera: above the ground z = 0; pixels above the horizon are not ground. stay: (H, W) things
    on the ground that are no objects; no shadow is looked for on them. All masks of a shadow are disjoint from all
    objects and from ``stay``. Shadows of several objects overlap where each of them alone darkens the ground; what they
    block together belongs to the one that blocks most. An object without a pixel, or above the horizon, has no shadow.
    """
    found = [CastShadow(*np.zeros((3, *pixels.shape[:2]), dtype=bool)) for _ in masks]
    standing = [(index, body) for index, mask in enumerate(masks) if (body := proxy_body(mask, camera)) is not None]
    if not standing:
        return found
    bodies = [body for _, body in standing]
    ground = ground_pixels(pixels, masks, camera, bodies, stay)
    if ground is None or len(ground.rows) < FEWEST:
        return found
    light = fit_light(ground, bodies)
    total, alone, hidden = light_shares(ground, bodies, light)
    distances = np.stack([_distance(ground, masks[index]) for index, _ in standing])
    owned = _owned(ground, alone, distances)
    parts = _parts(ground, alone, total, owned)
    posterior = light_level_posterior(ground, total, np.minimum(hidden.sum(axis=0), 1.0), distances.min(axis=0))
    probable = [shadow_probability(ground, posterior, *each) for each in zip(parts, owned, strict=True)]
    closed = np.logical_or.reduce(masks if stay is None else [*masks, stay])
    nothing = np.zeros_like(closed)
    shown = [observed_darkening(ground, left) > DARKENED for _, _, left in probable]
    dark = []
    for (_, _, left), (index, _), kept, seen in zip(probable, standing, alone, shown, strict=True):
        if not seen:
            dark.append(nothing)
            continue
        darkened = (_full_size(ground, 1.0 - left, closed.shape) > 1.0 - SHADOW_RATIO) & ~closed
        dark.append(_connected(darkened, masks[index], ground, kept))
    for position, (index, _) in enumerate(standing):
        if not shown[position]:
            contact = (_full_size(ground, hidden[position] > CONTACT_SKY, closed.shape) > 0.5) & ~closed
            found[index] = CastShadow(shadow=nothing, penumbra=nothing, expected=contact)
            continue
        inner, outer, _ = probable[position]
        dim = (_full_size(ground, outer, closed.shape) > 0.5) & ~closed
        # A hard shadow goes on, but not into that of another object.
        others = [other & ~dark[position] for place, other in enumerate(dark) if place != position]
        shadow = extend_hard_shadow(pixels, dark[position], np.logical_or.reduce([closed, *others]))
        penumbra = shadow | _touching(dim, shadow)
        foreseen = (alone[position] < FORESEEN) & (light.share > 0.0)
        wanted = (hidden[position] > CONTACT_SKY) | (foreseen & (outer > POSSIBLE))
        expected = (_full_size(ground, wanted, closed.shape) > 0.5) & ~closed
        missing = float((foreseen & (inner < 0.5)).sum() / foreseen.sum()) if foreseen.sum() >= FEWEST else 0.0
        found[index] = CastShadow(shadow=shadow, penumbra=penumbra, expected=expected, missing=missing)
    return found


def _distance(ground: GroundPixels, mask: Mask) -> Values:
    """Distance (N,) from the object in ``mask`` (H, W), over the objects' size."""
    small = cv2.resize(mask.astype(np.uint8), ground.known.shape[::-1], interpolation=cv2.INTER_AREA)
    pixels = cv2.distanceTransform((small == 0).astype(np.uint8), cv2.DIST_L2, 5)[ground.rows, ground.columns]
    return np.asarray(pixels / ground.object_side)


def _owned(ground: GroundPixels, alone: Values, distances: Values) -> Mask:
    """Whether (objects, N) an object is the one that blocks most of a pixel's light, nearer ones preferred.

    alone: (objects, N) ratio of the light with to without each object. distances: (objects, N) of ``_distance``.
    """
    costs = [ground.blurred(np.log(kept), 1.5) + FAR * far for kept, far in zip(alone, distances, strict=True)]
    return np.asarray(np.argmin(costs, axis=0) == np.arange(len(costs))[:, None])


def _parts(ground: GroundPixels, alone: Values, total: Values, owned: Mask) -> Values:
    """Share (objects, N) of each object in the lost light, as a logarithm: what comes back if it alone is taken away.

    Arguments (objects, N) as of ``_owned``, and its answer; total: (N,) share that is left past all. At least half is
    the owner's, and all where no object is expected to shade the ground: what several block together has to leave
    with one of them.
    """
    lost = np.stack([ground.blurred(-np.log(kept), 1.5) for kept in alone])
    everything = ground.blurred(-np.log(total), 1.5)
    parts = (lost + UNFORESEEN * owned) / (everything + UNFORESEEN)
    return np.asarray(np.clip(parts, 0.5 * owned, 1.0))


def _full_size(ground: GroundPixels, values: Values, shape: tuple[int, int]) -> NDArray[np.float32]:
    """``values`` (N,) at the photo's size; the seam along the objects is filled from the ground beside it."""
    picture = ground.picture(values)
    beside = cv2.GaussianBlur(picture, (0, 0), 1.5)
    weight = cv2.GaussianBlur(ground.known, (0, 0), 1.5)
    filled = np.where(ground.known > 0, picture, np.where(weight > 0.05, beside / np.maximum(weight, 1e-3), 0.0))
    return np.asarray(cv2.resize(filled.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR))


def _connected(dark: Mask, mask: Mask, ground: GroundPixels, kept: Values) -> Mask:
    """The parts of ``dark`` that touch the object in ``mask``, or lie mostly in its cast shadow."""
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
    """The connected components of ``region`` that contain some of ``seed``."""
    number, labels = _components(region)
    keep = np.bincount(labels[seed], minlength=number) > 0
    keep[0] = False
    return np.asarray(keep[labels])
