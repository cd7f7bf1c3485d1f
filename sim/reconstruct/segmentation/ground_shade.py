# SPDX-License-Identifier: MIT
"""Ground that a mask has taken with the object: cast shadows, mirror images, and what is lit between them.

A box that reaches to the end of a hard shadow teaches its colours as the object's own. Ground is told from the object
by how it darkens. In logarithms of linear light a shadow moves every ground colour along one line, and not
only towards black: what light there is has been reflected by the ground before, so shaded wood is redder than lit wood.
The line's slope is read off the photo. Polish adds light that the ground has not coloured: between the shadows of a
white toy the floor is neither its own colour nor that in shade. A cut between this class and the object's own colours
follows the edges, and a part is only given back to the ground if it borders on it, and an edge parts it from the
object.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .box_crop import EDGE, BoxCrop, edge_crest, edge_strength
from .colour_models import OBJECT_PARTS, SMOOTHNESS, graph_cut, learn, principal_contrast
from .mask_geometry import Mask, grown, hull_of, largest_component, shrunk

Light = NDArray[np.float32]

DARKEST = 0.002
"""Linear light that is added before the logarithm: below it there is only noise."""
REDDER = 0.5
"""Slope where the photo shows too little shade to tell: per unit of darkening, the share of the ground's own colour
that is added. 0 to 0.9 was measured beside things on wood."""
LOCAL = 0.25
"""Standard deviation over which the ground's colour is averaged, over the object's size."""
NOISE, DARK_NOISE, SLOPE_NOISE = 0.12, 0.006, 0.08
"""Standard deviation of ground colours from the line, in natural logarithms; of linear light; and per unit of
darkening."""
MIRRORED, MIRROR_STEPS = 0.18, (0.3, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95)
"""Largest share of what is seen that is mirrored, over the mean of the channels: 0.12 to 0.25 part a white toy's image
from the toy, whose underside shows the floor's colour as well. Shares of the darkest channel that are tried."""
POLISHED = 0.01
"""Share of the ground beside the object that nothing but its polish explains, from which there is any."""
BRIGHTEST = 0.5
"""Natural logarithm of ground over the local mean above which it is none."""
LEAST_OWN, MOST_GROUND = 0.3, 0.45
"""Share of a mask that must be unlike any ground, and the largest share that may be given back."""
GROUND_RIM, OBJECT_RIM = 0.25, 0.5
"""Share of a part's rim that must border on ground, and of its rim at the object that must lie on edges."""
GAP_RIM = 0.95
"""Share of the rim on edges of a part that the object encloses."""
LIKE = 6.0
"""Squared distance from the line, in standard deviations, below which a pixel may be ground: 11 % of it lie beyond."""
MIDDLE = 2.5
"""The same for the median of a part: 1.4 for ground, 3 and more were measured for clay of nearly the wood's colour."""
STRANDED, SPECK = 0.05, 10
"""Area of pieces of the object that a part alone joins to it, over its own, above which it belongs to it: hubs in black
wheels. Nothing lies in a shadow. Pixels below which a piece is a speck."""
ROUGHER, SMOOTH, DARK_SHARE = 3.5, 0.03, 0.1
"""Fine texture, in natural logarithms of light, over the ground's above which a part is none in shade: shade keeps the
ratios of lights, so it keeps texture. 1.8 to 2.2 was measured in shadows of two photos, 6 on granite before ice, 20 on
a toy's wheels. Least texture of a ground; and the share of ``DARK_NOISE`` that is texture of what is nearly black."""
LARGE, LARGE_ROUGHER = 0.25, 3.0
"""Area of a part over the mask's from which the second holds in place of ``ROUGHER`` within it: 1.2 was measured in the
shadow of a shoe on grass, 2.5 in a plush's on wood, up to 2.9 in smaller ones of drawn chairs, 3.5 on the shaded
panels, grilles and tyres of a car."""
BESIDE = 2.0
"""Standard deviation in pixels over which the light on both sides of an outline is averaged."""
BRIGHTER, MOST_BRIGHTER = 0.25, 0.15
"""Natural logarithm of a part's light over that beside it outside of the mask, above which no shade ends there; and the
share of its rim there above which it is none."""
SUNNY = -1.0
"""Natural logarithm of a part's light over the lit ground's below which only a sun or lamp leaves so hard a shadow that
its edge with lit ground outdoes any other: -2.8 was measured on rock by the sea."""
ASIDE, SUNK = 0.7, 0.05
"""Share of such a part that must lie beside the rest of the object, outside of its convex hull: a cast shadow lies flat
on the ground, from where the object stands away from it. How much lower than the rest it may reach, and how far above
the rest's foot may begin, over the rest's height: soles and wheels, as dark, lie below."""
SHADED, DEEP = -0.15, -0.4
"""Natural logarithm of a pixel's light over the lit ground's below which ground is in shade; and for the median of a
part: fainter shadows do not deceive a cut, but a bear of the floor's brown does."""


def without_ground(view: BoxCrop, mask: Mask, *, polished: bool = False) -> Mask:
    """Return ``mask`` (h, w) without parts that are ground beside the object, shaded or lit.

    polished: also ground that mirrors, where there is some beside the object. What the user keeps stays. Where most of
    the mask could be ground, as with grey objects on grey, colour does not separate them, and ``mask`` is returned
    unchanged. Cost: a tenth of a second, twice that where there is polish.
    """
    if mask.sum() < 200:
        return mask
    unlike, brighter = _unlike_ground(view, mask, polished=polished)
    cut = _cut(view, mask, unlike, brighter)
    if cut is None:
        return mask
    back = _given_back(view, mask & ~cut & ~view.keep, mask, cut, (unlike, brighter))
    rest = largest_component(mask & ~back) | (mask & view.keep)
    return rest if rest.sum() >= (1.0 - MOST_GROUND) * mask.sum() else mask


def shaded_ground(view: BoxCrop, mask: Mask) -> Mask:
    """Return the pixels (h, w) whose colour is that of the ground around ``mask`` (h, w), not empty, in shade, also
    under a mirror image."""
    unlike, brighter = _unlike_ground(view, mask, polished=True)
    return np.asarray((unlike < LIKE) & (brighter < SHADED))


def log_light(pixels: NDArray[np.uint8]) -> Light:
    """Natural logarithm (h, w, 3) of linear light, slightly smoothed."""
    smooth = cv2.GaussianBlur(pixels.astype(np.float32) / 255.0, (0, 0), 0.8)
    linear = np.where(smooth <= 0.04045, smooth / 12.92, ((smooth + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.log(linear + DARKEST), dtype=np.float32)


def _unlike_ground(view: BoxCrop, mask: Mask, *, polished: bool = False) -> tuple[Light, Light]:
    """Return how unlike the ground each pixel (h, w) is, lit or shaded: squared distance from the line in standard
    deviations; and how much brighter than the ground around it, as a natural logarithm. polished: also under mirror
    images, where the ground beside ``mask`` shows some, too."""
    light = log_light(view.pixels)
    size = float(np.sqrt(mask.sum()))
    free = ~grown(mask, 2) & ~view.others
    ground = lit_ground(light, free, LOCAL * size)
    reach = max(2, round(0.2 * size))
    near = grown(mask, reach) & free
    # Along the line all channels change at these rates, whose mean is 1.
    rates = 1.0 + _slope(light - ground, near, np.median((ground - ground.mean(axis=2, keepdims=True))[mask], axis=0))
    apart, along = _from_line(light, ground, rates)
    if not polished:
        return apart, along
    linear = np.exp(light) - np.float32(DARKEST)
    darkest, most = np.maximum(linear.min(axis=2), 0.0), MIRRORED * linear.mean(axis=2)
    best, best_along = apart, along
    for step in MIRROR_STEPS:
        mirrored = np.minimum(step * darkest, most)[..., None]
        under, under_along = _from_line(np.log(linear - mirrored + np.float32(DARKEST)), ground, rates)
        best, best_along = np.minimum(best, under), np.where(under < best, under_along, best_along)
    mirroring = (apart > LIKE) & (best < LIKE)
    if mirroring[near].sum() < POLISHED * near.sum():
        return apart, along
    return np.where(mirroring, best, apart), np.where(mirroring, best_along, along)


def _from_line(light: Light, ground: Light, rates: NDArray[np.floating]) -> tuple[Light, Light]:
    """Return the squared distance (h, w) of ``light`` from the line through ``ground``, both (h, w, 3), in standard
    deviations, and the place along it. rates: (3,), the line's direction."""
    variance = NOISE**2 + np.square(DARK_NOISE / np.exp(light))
    away = light - ground
    along = (rates * away / variance).sum(axis=2) / (rates**2 / variance).sum(axis=2)
    spread = variance + np.square(SLOPE_NOISE * along)[..., None]
    apart = (np.square(away - rates * along[..., None]) / spread).sum(axis=2)
    return np.asarray(apart, dtype=np.float32), np.asarray(along, dtype=np.float32)


def lit_ground(light: Light, free: Mask, sigma: float) -> Light:
    """Local mean (h, w, 3) of the lit ground's ``light``, from the pixels ``free`` (h, w) of objects."""
    weight = free.astype(np.float32)
    mean = light
    for _ in range(4):
        total = np.full(free.shape, 1e-9, dtype=np.float32)
        mean = np.zeros_like(light)
        # Far from any ground the wider mean counts.
        for share, width in ((1.0, sigma), (1e-4, 4.0 * sigma)):
            total += share * cv2.GaussianBlur(weight, (0, 0), width)
            mean += share * cv2.GaussianBlur(light * weight[..., None], (0, 0), width)
        mean /= total[..., None]
        away = light - mean
        darker = away.mean(axis=2)
        colour = np.linalg.norm(away - darker[..., None], axis=2)
        lit = free & (darker > -0.2) & (darker < 0.6) & (colour < 0.5)
        following = (lit if lit.sum() > 50 else free).astype(np.float32)
        if np.array_equal(following, weight):
            break
        weight = following
    return mean


def _slope(away: Light, near: Mask, colour: NDArray[np.floating]) -> NDArray[np.float64]:
    """Change (3,) of the logarithms' differences from their mean per unit of brightening, from dark pixels ``near``.

    away: (h, w, 3) from the lit ground, whose own ``colour`` (3,) is the difference of its logarithms from their mean.
    The densest slope between neutral and twice ``REDDER``; that itself where too few pixels agree.
    """
    darker = away.mean(axis=2)
    shaded = near & (darker < -0.3) & (darker > -3.5)
    slopes = ((away - darker[..., None])[shaded] / darker[shaded][:, None]).astype(np.float64)
    weights = np.minimum(-darker[shaded].astype(np.float64), 1.0)
    usual = np.asarray(-REDDER * colour, dtype=np.float64)
    best, most = usual, 30.0
    for share in np.linspace(0.0, 2.0, 11):
        mean = share * usual
        for _ in range(6):
            likeness = weights * np.exp(-np.square(slopes - mean).sum(axis=1) / (2.0 * 0.15**2))
            if likeness.sum() < 1.0:
                break
            mean = (slopes * likeness[:, None]).sum(axis=0) / likeness.sum()
        near_mean = weights * np.exp(-np.square(slopes - mean).sum(axis=1) / (2.0 * 0.15**2))
        if near_mean.sum() > most and np.linalg.norm(mean) < 1.5:
            best, most = mean, float(near_mean.sum())
    return best


def _cut(view: BoxCrop, mask: Mask, unlike: Light, brighter: Light) -> Mask | None:
    """The object (h, w) in ``mask`` by a cut between ground and the object's own colours; None if it has none."""
    features = np.dstack([view.lab, view.texture])
    contrast = principal_contrast(view.lab)
    ground = mask & (unlike < LIKE) & (brighter < BRIGHTEST) & ~view.keep
    cut = mask
    # The second time what the first has given back is no longer among the object's colours.
    for _ in range(2):
        own = mask & ~grown(ground)
        if own.sum() < max(50.0, LEAST_OWN * float(mask.sum())) or not ground.any():
            return None
        likely = learn(features[own], OBJECT_PARTS).log_likelihood(features[mask])
        usual = np.quantile(likely[own[mask]], 0.1)
        ratio = np.full(mask.shape, -4.0, dtype=np.float32)
        ratio[mask] = np.clip(0.5 * unlike[mask] - 3.5, -2.5, 3.0) + np.clip(0.5 * (likely - usual), -3.0, 1.0)
        ratio[mask & (brighter > BRIGHTEST)] = 1.0
        cut = graph_cut(ratio, contrast, SMOOTHNESS, barred=~mask, certain=view.keep & mask)
        ground = mask & ~cut
    return cut


def _texture(light: Light, where: Mask) -> Light:
    """Return how far each pixel (h, w) of ``where`` lies from the mean of those around it, natural logarithm of
    ``light``."""
    weight = where.astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(weight, (0, 0), 2.0), 1e-3)[..., None]
    mean = cv2.GaussianBlur(light * weight[..., None], (0, 0), 2.0) / total
    return np.asarray(np.abs((light - mean).mean(axis=2)), dtype=np.float32)


def _rougher(view: BoxCrop, mask: Mask, parts: Mask, labels: NDArray[np.int32]) -> set[int]:
    """The ``labels`` of those of ``parts`` whose fine texture is more than the ground's beside ``mask``, all (h, w)."""
    kernel = np.ones((3, 3), np.uint8)
    light = log_light(view.pixels)
    near = grown(mask, max(2, round(0.2 * float(np.sqrt(mask.sum())))))
    free = ~grown(mask, 2) & ~view.others
    beside = cv2.erode((near & free).astype(np.uint8), kernel) > 0
    usual = max(SMOOTH, float(np.quantile(_texture(light, free)[beside], 0.75)) if beside.any() else 0.0)
    own, noise = _texture(light, parts), DARK_SHARE * DARK_NOISE / np.exp(light.mean(axis=2))
    inner = cv2.erode(parts.astype(np.uint8), kernel) > 0
    rougher = {
        int(index)
        for index in np.unique(labels[inner])
        if (where := inner & (labels == index)).sum() >= SPECK
        and np.quantile(own[where], 0.75) > ROUGHER * (usual + float(np.median(noise[where])))
    }
    # Far from its rim and from black more is known of a large part.
    lit = shrunk(parts, 3) & (noise < 0.3 * SMOOTH)
    for index in np.unique(labels[lit]):
        where = lit & (labels == index)
        large = (labels == index).sum() > LARGE * mask.sum() and where.sum() >= SPECK
        if large and np.quantile(own[where], 0.75) > LARGE_ROUGHER * usual:
            rougher.add(int(index))
    return rougher


def _pieces(own: Mask) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Numbers (h, w) of the connected pieces of ``own``, and the area of each but the largest and specks, else 0."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(own.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int32)
    areas[0] = 0
    areas[[int(areas.argmax()), *np.flatnonzero(areas < SPECK)]] = 0
    return np.asarray(labels, dtype=np.int32), areas


def _brighter_than_beyond(light: Light, part: Mask, mask: Mask, free: Mask, outer: Mask) -> Light:
    """Return how much brighter (n,) ``part`` is at pixels of its ``outer`` rim than what lies beyond, outside of
    ``mask`` and ``free`` of others, all (h, w), by the natural logarithm ``light``; only where both are seen. Pixels of
    mixed colours along the outline do not count."""
    kernel = np.ones((3, 3), np.uint8)
    inside = part & (cv2.erode(mask.astype(np.uint8), kernel) > 0)
    beyond = free & ~grown(mask)
    means, seen = [], outer
    for side in (inside, beyond):
        weight = side.astype(np.float32)
        total = cv2.GaussianBlur(weight, (0, 0), BESIDE)
        means.append(cv2.GaussianBlur(light * weight, (0, 0), BESIDE) / np.maximum(total, 1e-6))
        seen = seen & (total > 0.02)
    return np.asarray((means[0] - means[1])[seen], dtype=np.float32)


def _cast_aside(part: Mask, border: Mask, own: Mask) -> bool:
    """Whether ``part`` (h, w) leaves the object ``own`` (h, w) at its foot, as low as it stands, and goes away from it.
    border: (h, w) pixels of ``own`` along it."""
    body = largest_component(own)
    rows = np.flatnonzero(body.any(axis=1))
    foot, room = int(rows[-1]), SUNK * len(rows)
    if np.nonzero(part)[0].max() > foot + room or np.nonzero(border)[0].max(initial=0) < foot - room:
        return False
    return bool((~hull_of(body)[part]).mean() > ASIDE)


def _given_back(view: BoxCrop, parts: Mask, mask: Mask, own: Mask, judged: tuple[Light, Light]) -> Mask:
    """Those of ``parts`` (h, w) that are like ground and no rougher, border on ground outside of ``mask``, strand
    nothing of the object ``own``, and that an edge parts from it, no weaker than their edge with the ground. judged:
    see ``_unlike_ground``."""
    unlike, brighter = judged
    crest = edge_crest(edge_strength(view.lab))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(parts.astype(np.uint8), connectivity=4)
    result = np.zeros_like(mask)
    pieces, rougher = _pieces(own), _rougher(view, mask, parts, np.asarray(labels, dtype=np.int32))
    light = log_light(view.pixels).mean(axis=2)
    for index in range(1, count):
        if stats[index, cv2.CC_STAT_AREA] < SPECK or index in rougher:
            continue
        part = labels == index
        if np.median(unlike[part]) > MIDDLE:
            continue
        rim = grown(part) & ~part
        if (rim & view.keep).any():
            # What a stroke runs through is the user's.
            continue
        if sum(pieces[1][number] for number in np.unique(pieces[0][rim])) > STRANDED * float(part.sum()):
            continue
        inner, outer = rim & own, rim & ~mask
        on_edges = float((crest[inner] > EDGE).mean()) if inner.any() else 1.0
        if outer.sum() > GROUND_RIM * rim.sum():
            stronger = not inner.any() or bool(np.median(crest[inner]) > np.median(crest[outer]))
            depth = float(np.median(brighter[part]))
            stronger = stronger or (depth < SUNNY and _cast_aside(part, inner, own))
            parted = on_edges > OBJECT_RIM and stronger and depth < DEEP
        else:
            # The object encloses it: a gap, unless it is filled again as a print.
            parted = on_edges > GAP_RIM and bool(np.median(unlike[part]) < 0.5 * MIDDLE)
        if parted:
            # Shade ends where lit ground begins, or goes on as it is.
            step = _brighter_than_beyond(light, part, mask, ~view.others, outer)
            parted = len(step) < SPECK or bool((step > BRIGHTER).mean() < MOST_BRIGHTER)
        if parted:
            result |= part
    return result
