# SPDX-License-Identifier: MIT
"""Gaps in a mask made by colours, thin rods beside it, and legs below it.

Gaps between slats are ground by colour and place, and edges surround them; rods are thin, unlike the ground, and join
the object; legs are thin and upright, and carry it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .box_crop import BoxCrop, edge_crest, edge_strength
from .colour_models import GROUND_PARTS, OBJECT_PARTS, graph_cut, ground_likelihood, learn, principal_contrast
from .mask_geometry import Mask, enclosed_holes, grown, ring_around, shrunk, touching
from .part_contour import CREST, SHADE_SHARE, shows_ground

LONG = 0.12
"""Least length of a gap over the object's size: letters printed on a cover are shorter."""
USUAL = 0.08
"""Share of the ground that is less likely by its own model than what counts as typical ground."""
OWN_SHARE, OWN_PIXELS = 0.12, 60
"""Share of a mask, and pixels, that must not be typical ground: less of it cannot be told from camouflage."""
ON_EDGES = 0.6
"""Least share on edges of the contour of a gap, a rod or a leg."""
THIN = 0.05
"""Largest width of a rod over the object's size."""
LEG, UPRIGHT = 0.12, 1.8
"""Largest width of a leg over the object's size, and least height over its width."""
SHORT = 0.06
"""Least length of a rod or leg over the object's size."""
HANDLE, FEET = 0.25, 0.4
"""Least length of a handle, a rod that is joined at two places, over the object's size; and share of the object's
height from its foot in which there is none: a leg's shadow ends at another leg."""
SEAM = 4
"""Pixels between a leg and what it carries, whose colours are mixed."""
UNKNOWN = 3.0
"""Log likelihood of colours that the object has nowhere else, below that of unusual ground: those of legs."""
SOLID, SOLID_SHARE = 0.16, 0.25
"""Width over the object's size from which a part of it is no slat or post, and the share of such parts around a gap
above which it is none: the inside of a cup and a shade on it have the ground's colours, too.
"""


@dataclass(frozen=True)
class _Likeness:
    """How a mask and what surrounds it look. mask: (h, w). size: the root of its area, pixels.

    ground: (h, w) log likelihood of ground, -inf far from box and mask; usual: that of unusual ground. ratio: (h, w)
    that of the object over it. cut: (h, w) the object by that ratio, with little smoothness. crest: (h, w) gradients,
    see ``edge_crest``.
    """

    view: BoxCrop
    mask: Mask
    size: float
    ground: NDArray[np.float32]
    usual: float
    ratio: NDArray[np.float32]
    cut: Mask
    crest: NDArray[np.float32]

    def on_edges(self, contour: Mask) -> float:
        """The share of ``contour`` (h, w), not empty, that lies on edges."""
        return float((self.crest[contour] > CREST).mean())


def gaps_and_rods(view: BoxCrop, mask: Mask, *, shade: Callable[[], Mask] | None = None) -> tuple[Mask, Mask, Mask]:
    """Return gaps (h, w) in the filled ``mask`` through which the ground shows, and rods and handles (h, w) beside it.

    A gap is typical ground by colour, texture and place, long, and surrounded by edges; a rod is unlike the ground, lit
    or shaded, thin, on edges, and joined to the object; a handle is joined to it at both ends. shade: returns (h, w)
    pixels of which no rod consists, as they look like shaded ground; asked once a candidate is left.
    """
    nothing = np.zeros_like(mask)
    seen = _likeness(view, mask)
    if seen is None:
        return nothing, nothing, nothing
    strange = _strange_cut(seen)
    gaps, rods, handles, legs = _gaps(seen), _rods(seen), _handles(seen, strange), _legs(seen, strange)
    if shade is not None:
        rods = [part for part in rods if shade()[part].mean() <= SHADE_SHARE]
        # Where a leg's colours and the ground's are mixed, they look like shade.
        legs = [part for part in legs if shade()[_core(part)].mean() < SHADE_SHARE]
    thin, held = (np.logical_or.reduce([nothing, *parts]) for parts in ((*rods, *legs), handles))
    if gaps.sum() > 0.8 * mask.sum():
        return nothing, thin, held
    # What only a gap's edge held in place goes with it.
    return gaps, thin & touching(thin | held | (mask & ~gaps), mask & ~gaps), held


def _likeness(view: BoxCrop, mask: Mask) -> _Likeness | None:
    """What ``mask`` (h, w) and the ground look like; None where it is too small, or nearly all of it is like ground.

    The object's colours are learned without its gaps, and the cut has little smoothness, so that it follows slats and
    spokes.
    """
    if mask.sum() < 400 or view.outside.sum() < 200:
        return None
    window = view.inside | mask
    beyond = view.outside
    usual = float(np.quantile(ground_likelihood(view, beyond, beyond, ()), USUAL))
    ground = np.full(mask.shape, -np.inf, dtype=np.float32)
    ground[window] = ground_likelihood(view, beyond, window)
    own = mask & ~(window & (ground > usual))
    if own.sum() < OWN_SHARE * mask.sum() or own.sum() < OWN_PIXELS:
        return None
    features = np.dstack([view.lab, view.texture])
    likely = learn(features[own], OBJECT_PARTS + GROUND_PARTS - 5).log_likelihood(features[window])
    ratio = np.zeros(mask.shape, dtype=np.float32)
    ratio[window] = np.clip(likely - ground[window], -4.0, 4.0)
    return _Likeness(
        view=view,
        mask=mask,
        size=float(np.sqrt(mask.sum())),
        ground=ground,
        usual=usual,
        ratio=ratio,
        cut=graph_cut(ratio, principal_contrast(view.lab), 1.0, barred=~window),
        crest=edge_crest(edge_strength(view.lab)),
    )


def _gaps(seen: _Likeness) -> Mask:
    """Gaps (h, w) in the mask."""
    mask = seen.mask
    candidates = []
    core = shrunk(mask)
    for part, box in _parts((mask | enclosed_holes(mask)) & ~seen.cut, 24):
        if float(np.hypot(box[2], box[3])) < LONG * seen.size:
            continue
        if (seen.ground[part] > seen.usual).mean() < 0.4 or (seen.ratio[part] < -0.5).mean() < 0.7:
            continue
        contour = ring_around(part, 1) & core
        if contour.any() and seen.on_edges(contour) < ON_EDGES:
            continue
        if shows_ground(seen.view, part, mask):
            candidates.append(part)
    return _between_slats(mask, candidates, seen.size)


def _strange_cut(seen: _Likeness) -> Mask:
    """A cut (h, w) in which every colour is as likely as one that the object has nowhere else: chairs of cloth have
    legs of wood, clocks handles of steel."""
    window = seen.view.inside | seen.mask
    ratio = np.where(window, np.clip((seen.usual - UNKNOWN) - seen.ground, -4.0, 4.0), 0.0).astype(np.float32)
    return graph_cut(ratio, principal_contrast(seen.view.lab), 1.0, barred=~window)


def _rods(seen: _Likeness) -> list[Mask]:
    """Thin parts (h, w) of the cut beside the mask, unlike the ground, on edges, that touch it."""
    thin = [part for part, _ in _thin_parts(seen, seen.cut)]
    return [part for part in thin if (seen.ratio[part] > 1.0).mean() >= 0.6]


def _handles(seen: _Likeness, strange: Mask) -> list[Mask]:
    """Thin parts (h, w) beside the mask, on edges, that touch it at both ends, of any colour: no crease or shadow of
    the ground begins and ends at the object, but for those between its feet."""
    result = []
    rows = np.flatnonzero(seen.mask.any(axis=1))
    feet = rows[-1] - FEET * len(rows)
    for cut in (seen.cut & (seen.ratio > 0.0), strange):
        for part, joined in _thin_parts(seen, cut):
            _, top, width, height = cv2.boundingRect(part.astype(np.uint8))
            long = float(np.hypot(width, height)) > HANDLE * seen.size
            if long and _joints(joined) > 1 and top + 0.5 * height < feet:
                # With the mixed pixels along it, which are much of it, and between both.
                result.append(grown(part) | (grown(part, 2) & grown(joined, 2)))
    return result


def _thin_parts(seen: _Likeness, cut: Mask) -> list[tuple[Mask, Mask]]:
    """Thin parts (h, w) of ``cut`` (h, w) beside the mask, on edges; and the pixels of the mask that each touches."""
    result = []
    for part, box in _parts(cut & ~seen.mask & seen.view.inside, 16):
        if _width(part) > THIN * seen.size + 3.0 or float(np.hypot(box[2], box[3])) < SHORT * seen.size:
            continue
        contour = ring_around(part, 1) & ~seen.mask
        joined = grown(part, 2) & seen.mask
        if joined.any() and contour.any() and seen.on_edges(contour) >= ON_EDGES:
            result.append((part, joined))
    return result


def _joints(joined: Mask) -> int:
    """The number of places (h, w) where a part touches the mask."""
    return int(cv2.connectedComponents(joined.astype(np.uint8), connectivity=8)[0]) - 1


def _legs(seen: _Likeness, strange: Mask) -> list[Mask]:
    """Parts (h, w) of the cut ``strange`` (h, w) below the object that carry it: thin, upright, on edges, of any colour
    but the ground's."""
    view, mask = seen.view, seen.mask
    free = strange & view.inside & ~ring_around(mask, 1) & ~mask
    result = []
    for part, (_, top, _, height) in _parts(free, 16):
        width = _width(part)
        if not (height > UPRIGHT * width and height > SHORT * seen.size and width < LEG * seen.size):
            continue
        joint = np.flatnonzero((ring_around(part, SEAM) & mask).any(axis=1))
        contour = ring_around(part, 1) & ~mask
        hangs = len(joint) > 0 and joint[-1] < top + 0.25 * height
        if hangs and contour.any() and seen.on_edges(contour) > ON_EDGES:
            # With the mixed pixels between them.
            seam = ring_around(part, SEAM) & ring_around(mask, SEAM) & view.inside & part.any(axis=0)
            result.append(part | seam)
    return result


def _width(part: Mask) -> float:
    """The diameter in pixels of the largest circle in ``part`` (h, w)."""
    return 2.0 * float(cv2.distanceTransform(np.pad(part, 1).astype(np.uint8), cv2.DIST_L2, 3).max())


def _core(part: Mask) -> Mask:
    """``part`` without its outermost pixels, unless nothing would be left."""
    inner = shrunk(part)
    return inner if inner.any() else part


def _between_slats(mask: Mask, candidates: Sequence[Mask], size: float) -> Mask:
    """Return those of ``candidates`` (h, w), joined, around which the object ``mask`` of ``size`` pixels is thin."""
    gaps = np.zeros_like(mask)
    if not candidates:
        return gaps
    solid = mask & ~np.logical_or.reduce(candidates)
    width = max(3, round(SOLID * size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    thick = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
    for part in candidates:
        beside = ring_around(part, max(2, width // 4)) & solid
        if beside.any() and thick[beside].mean() <= SOLID_SHARE:
            gaps |= part
    return gaps


def _parts(mask: Mask, least: int) -> list[tuple[Mask, tuple[int, int, int, int]]]:
    """The connected parts of at least ``least`` pixels, each with left, top, width and height."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [
        (labels == index, (int(stats[index, 0]), int(stats[index, 1]), int(stats[index, 2]), int(stats[index, 3])))
        for index in range(1, count)
        if stats[index, cv2.CC_STAT_AREA] >= least
    ]
