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

from ...scene.model import Camera
from ...srgb import bytes_to_linear
from ..segmentation.mask_geometry import enclosed_holes
from .ground_pixels import GroundPixels
from .shadow_levels import FEWEST, PlaneLevels, plane_levels, standing_bodies
from .shadow_model import SHADOW_RATIO, darkening_sums, shadow_probability

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
GAP = 0.02
"""Distance over the largest object's size at which a shadow touches an object."""
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

    Shadows are looked for on the ground and on a wall behind the objects. pixels: (H, W, 3) sRGB. camera: above the
    ground z = 0; pixels above the horizon are not ground. stay: (H, W) things on the ground that are no objects; no
    shadow is looked for on them. All masks of a shadow are disjoint from all objects and from ``stay``. Shadows of
    several objects overlap where each of them alone darkens the ground; what they block together belongs to the one
    that blocks most. An object without a pixel, or above the horizon, has no shadow.
    """
    found = [CastShadow(*np.zeros((3, *pixels.shape[:2]), dtype=bool)) for _ in masks]
    bodies = standing_bodies(masks, camera)
    planes = list(plane_levels(pixels, masks, bodies, camera, stay))
    if not planes:
        return found
    outlines = [masks[index] for index in bodies]
    cast = [(plane.elsewhere, _shades(plane)) for plane in planes]
    # A shadow on a wall goes on from the one on the ground.
    whole = [_Shade.joined([shades[position] for _, shades in cast]) for position in range(len(bodies))]
    gap = max(1, round(GAP * max(int(np.ptp(at)) + 1 for mask in outlines for at in np.nonzero(mask))))
    dark = [_connected(shade.dark, mask, gap, shade.foreseen) for shade, mask in zip(whole, outlines, strict=True)]
    for position, index in enumerate(bodies):
        # A hard shadow goes on, but not into that of another object.
        others = [other & ~dark[position] for place, other in enumerate(dark) if place != position]
        parts = [
            extend_hard_shadow(pixels, dark[position] & ~elsewhere, np.logical_or.reduce([elsewhere, *others]))
            for elsewhere, _ in cast
        ]
        shadow, shade = np.logical_or.reduce(parts), whole[position]
        penumbra = shadow | _touching(shade.dim, shadow)
        found[index] = CastShadow(shadow=shadow, penumbra=penumbra, expected=shade.expected, missing=shade.missing)
    return found


@dataclass(frozen=True)
class _Shade:
    """What one object takes from the light of a plane.

    dark, dim: (H, W) where the photo shows it, and the same with the penumbra; foreseen: (H, W) where its body alone
    should. expected, missing: as of ``CastShadow``; contact: (H, W) what is expected of it where no shadow is seen.
    darkening: sums of ``darkening_sums``.
    """

    dark: Mask
    dim: Mask
    foreseen: Mask
    expected: Mask
    contact: Mask
    darkening: tuple[float, float]
    missing: float = 0.0

    @classmethod
    def joined(cls, parts: Sequence[_Shade]) -> _Shade:
        """Return those of an object on several planes as one, without shadow unless the photo is darker there;
        ``missing`` is that of the first: of the ground if it is seen."""
        layers = [(part.dark, part.dim, part.foreseen, part.expected, part.contact) for part in parts]
        dark, dim, foreseen, expected, contact = (np.logical_or.reduce(layer) for layer in zip(*layers, strict=True))
        both, told = (float(sum(values)) for values in zip(*(part.darkening for part in parts), strict=True))
        if both <= DARKENED * told:
            nothing = np.zeros_like(dark)
            return cls(nothing, nothing, nothing, contact, contact, (both, told))
        return cls(dark, dim, foreseen, expected, contact, (both, told), parts[0].missing)


def _shades(plane: PlaneLevels) -> list[_Shade]:
    """What each object takes from the light of ``plane``."""
    ground, shape = plane.ground, plane.elsewhere.shape
    owned = _owned(ground, plane.alone, plane.distances)
    parts = _parts(ground, plane.alone, plane.kept, owned)

    def shown(values: Values, above: float) -> Mask:
        return np.asarray((_full_size(ground, values, shape) > above) & ~plane.elsewhere)

    probable = [shadow_probability(ground, plane.levels, *each) for each in zip(parts, owned, strict=True)]
    past_all = np.prod([left for _, _, left in probable], axis=0)
    shades = []
    for (inner, outer, left), alone, hidden in zip(probable, plane.alone, plane.hidden, strict=True):
        cast = alone < FORESEEN
        foreseen = cast & (plane.light.share > 0.0)
        reach = cv2.resize(ground.picture(cast.astype(np.float32)), shape[::-1]) > 0.5
        contact = np.zeros_like(cast) if plane.upright else hidden > CONTACT_SKY
        shades.append(
            _Shade(
                dark=shown(1.0 - left, 1.0 - SHADOW_RATIO),
                dim=shown(outer, 0.5),
                foreseen=np.asarray(reach),
                expected=shown(contact | (foreseen & (outer > POSSIBLE)), 0.5),
                contact=shown(contact, 0.5),
                darkening=darkening_sums(ground, left, past_all / np.maximum(left, 0.01)),
                missing=float((foreseen & (inner < 0.5)).sum() / foreseen.sum()) if foreseen.sum() >= FEWEST else 0.0,
            )
        )
    return shades


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


def _connected(dark: Mask, mask: Mask, gap: int, foreseen: Mask) -> Mask:
    """The parts of ``dark`` within ``gap`` pixels of the object in ``mask``, or mostly where it is ``foreseen``."""
    near = cv2.dilate(mask.astype(np.uint8), np.ones((2 * gap + 1,) * 2, np.uint8)) > 0
    number, labels = _components(dark)
    sizes = np.bincount(labels.ravel(), minlength=number)
    keep = np.bincount(labels[near], minlength=number) > 0
    keep |= np.bincount(labels[foreseen], minlength=number) > 0.5 * sizes
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
