# SPDX-License-Identifier: MIT
"""A plain backdrop: white paper, a studio's sweep, a bare wall that meets a bare floor.

Where hardly an edge crosses the photo's border, whatever is reached from there without an edge is the backdrop, with
its gradients and soft shadows, and what is left are the things before it. Colours say less: a dark ear is a shade of
grey paper, and the face of a toy stands out from it more than the toy from a white page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...srgb import cielab
from ..reconstruct_options import Proposal
from .box_crop import edge_strength
from .mask_geometry import grown, touching
from .outline_sharpness import in_focus
from .proposal_features import copy_of

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Box = tuple[float, float, float, float]

SIDE = 480
"""Longest side in pixels of the copy that is looked at."""
FOCUS_SIDE = 320
"""The same where the sharpness of outlines is judged."""
CALM = 1.2
"""Gradient in CIELAB units per pixel of the copy, below which nothing ends."""
PASS = 2
"""Half the width in pixels of a gap in a contour through which the backdrop does not go in."""
BORDER = 0.9
"""Share of the photo's border that a plain backdrop reaches: 0.93 to 1 was measured on 32 photos with one, at most 0.88
on 20 of rooms, streets, tables and landscapes."""
WHITE, PAGE, PAGE_BORDER, PAGE_SIDE = 245, 0.9, 0.6, 0.25
"""The least channel of a white page; its share of the backdrop; and its shares of the photo's border and of each of its
sides, with which it is one though the thing is cut or fills the photo: a bag 0.86 and 0.7, headphones 0.73 and 0.53. Of
70 other photos a white sky or wall reaches three sides of at most one."""
EVEN = 0.36
"""Median of the gradient on it, in the same units: 0 to 0.34 on all but one of these 32 (0.40), 0.42 and more on drawn
boards and concrete, 0.38 on drawn plain ground with a renderer's noise."""
SPECK, SPECKS = 0.05, 0.03
"""Area over that of the largest thing below which something is a speck, and of all specks over the backdrop's: at most
0.009 on fifteen of these photos, 0.09 on drawn streaks."""
LEAST_AREA, MOST_AREA = 0.0025, 0.85
"""Areas of things over the photo's."""
LOOSE = 0.02
"""Margin of a box around a thing, over its longer side."""
FULL = 0.95
"""Share of the photo above which a box has no margin: nothing would be left around it."""
INSET = 0.006
"""Least distance of such a box from the photo's border, over the photo's sides."""
NEAR_BORDER = 0.02
"""Distance of a box' side from the photo's border, over the photo's side, below which it stands for the border."""
SCORE = 0.95
"""Score of a thing before a plain backdrop."""
WHOLE = 0.995
"""Share of a thing in the box of what stands out by itself from which that is the thing."""
BESIDE = 0.03
"""Area over the largest thing's below which one is left out: a crumb beside a cake."""
ALIKE, OVERLAP, COVERED, FEWEST = 4.0, 0.25, 0.7, 3
"""Candies that touch share one contour, as do the parts of a toy. The contour is split into the boxes of what stands
out by itself where their areas differ by at most this factor, they overlap by less than this share of the smaller,
cover more than this share of the contour, and number at least this many."""
UNLIKE = 5.0
"""Distance in CIELAB from the backdrop of a part that an outline lacks."""
SEAM = 3.0
"""Pixels of the copy: what lies that near an outline is part of it, and thinner parts are its border."""
LEAST_PART = 0.004
"""Area of a part over the object's."""
BESIDE_LINE = 10.0
"""Pixels of the copy beside a mask within which something is its own though it goes on to the photo's border."""
FOOT = 0.35
"""Height over the object's above its foot, below which a part may be its shadow."""
COLOURED = 10.0
"""Distance in CIELAB of a part there from a shade of the backdrop, above which it is no shadow."""
BLANK, SHADED_SHARE, INK = 5, 0.001, 10
"""Difference from the page's colour, in any channel, up to which a pixel is blank; the share of the page that may be
otherwise; and the difference from which a pixel is the thing's."""
HOLE = 0.95
"""Share of an enclosed part that is blank where the page shows through: a highlight is not so even."""


def plain_backdrop(pixels: Pixels) -> Mask | None:
    """Return the backdrop (h, w) of ``pixels`` (H, W, 3) on a copy of at most ``SIDE``; None where it is not plain."""
    small = copy_of(pixels, SIDE)
    steps = edge_strength(cielab(small, blur=0.8))
    calm = (steps < CALM).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * PASS + 1, 2 * PASS + 1))
    _, labels = cv2.connectedComponents(cv2.erode(calm, disc), connectivity=4)
    rim = _rim(calm.shape)
    reached = np.unique(labels[rim])
    result = cv2.dilate(np.isin(labels, reached[reached > 0]).astype(np.uint8), disc) > 0
    areas = cv2.connectedComponentsWithStats((~result).astype(np.uint8), connectivity=8)[2][1:, cv2.CC_STAT_AREA]
    specks = areas[areas < SPECK * areas.max(initial=0)].sum()
    plain = (
        (result[rim].mean() > BORDER or _page(small, result))
        and np.median(steps[result]) < EVEN
        and specks < SPECKS * result.sum()
    )
    return np.asarray(result) if plain else None


def _page(pixels: Pixels, backdrop: Mask) -> bool:
    """Whether ``backdrop`` (h, w) is a white page that reaches all sides of the copy ``pixels`` (h, w, 3)."""
    white = backdrop & (pixels.min(axis=-1) >= WHITE)
    sides = [white[0], white[-1], white[:, 0], white[:, -1]]
    whole = np.concatenate(sides).mean() > PAGE_BORDER and min(side.mean() for side in sides) > PAGE_SIDE
    return bool(whole and white.sum() > PAGE * backdrop.sum())


def things_before_backdrop(pixels: Pixels, seen: Sequence[Proposal]) -> list[Proposal]:
    """Return the objects of ``pixels`` (H, W, 3) before a plain backdrop, largest first, boxes in its pixels; those
    out of focus are left out. Empty where it has no such backdrop.

    seen: what stands out by itself. Where things touch, these are returned in their place.
    """
    backdrop = plain_backdrop(pixels)
    if backdrop is None:
        return []
    height, width = backdrop.shape
    across, down = pixels.shape[1] / width, pixels.shape[0] / height
    _, labels, stats, _ = cv2.connectedComponentsWithStats(_solid(~backdrop).astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    least = max(LEAST_AREA * labels.size, BESIDE * int(areas[1:].max(initial=0)))
    order = np.argsort(-areas[1:], kind="stable") + 1
    things = [labels == index for index in order if least <= areas[index] <= MOST_AREA * labels.size]
    found: list[Proposal] = []
    for thing, is_sharp in zip(things, _in_focus(things, pixels), strict=True):
        if not is_sharp:
            continue
        parts = [item for item in seen if (thing & _window(thing.shape, item.box, across, down)).any()]
        if apart := _told_apart(thing, parts, across, down):
            found += apart
            continue
        if best := _holding(thing, parts, across, down):
            found.append(best)
            continue
        x0, y0, x1, y1 = _loose(thing)
        box = (round(x0 * across), round(y0 * down), round(x1 * across), round(y1 * down))
        found.append(Proposal((float(box[0]), float(box[1]), float(box[2]), float(box[3])), SCORE))
    return found


def _holding(thing: Mask, parts: Sequence[Proposal], across: float, down: float) -> Proposal | None:
    """That of ``parts`` whose box holds ``thing`` (h, w) and leaves room around it; None where none does."""
    for item in parts:
        window = _window(thing.shape, item.box, across, down)
        if window.mean() < FULL and (thing & window).sum() > WHOLE * thing.sum():
            return replace(item, score=max(item.score, SCORE))
    return None


def _in_focus(things: Sequence[Mask], pixels: Pixels) -> list[bool]:
    """Whether each of ``things`` (h, w) is about the sharpest, on a copy of the size that ``in_focus`` is for."""
    small = copy_of(pixels, FOCUS_SIDE)
    size = small.shape[1::-1]
    return in_focus([cv2.resize(thing.astype(np.float32), size) > 0.5 for thing in things], small)


def missing_parts(pixels: Pixels, mask: Mask, box: tuple[int, int, int, int], backdrop: Mask) -> Mask:
    """Return parts (H, W) of the object ``mask`` (H, W) that it lacks, within ``box``, before a plain ``backdrop``
    (h, w) of the photo ``pixels`` (H, W, 3).

    A part touches the mask, is thicker than the outline may be off, ends within the box, and is unlike the backdrop
    beside it; near the object's foot also unlike its shade.
    """
    nothing = np.zeros_like(mask)
    size = backdrop.shape[::-1]
    across, down = pixels.shape[1] / size[0], pixels.shape[0] / size[1]
    own = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    rows = np.flatnonzero(own.any(axis=1))
    if len(rows) == 0:
        return nothing
    lab = cielab(copy_of(pixels, SIDE), blur=0.8)
    behind = _behind(lab, backdrop)
    foot = rows[-1] - FOOT * (rows[-1] - rows[0])
    below = (np.arange(len(own)) > foot)[:, None]
    shade = cv2.morphologyEx((_shaded(lab, behind) & below).astype(np.uint8), cv2.MORPH_OPEN, _disc(PASS)) > 0
    unlike = (np.linalg.norm(lab - behind, axis=-1) > UNLIKE) & ~shade
    near = cv2.dilate(own.astype(np.uint8), _disc(SEAM)) > 0
    parts = cv2.morphologyEx((~backdrop & ~own & unlike).astype(np.uint8), cv2.MORPH_OPEN, _disc(SEAM)) > 0
    parts = touching(parts, near)
    x0, y0, x1, y1 = _to_border(box, mask.shape)
    within = nothing.copy()
    within[y0 + 1 if y0 else 0 : y1 - 1 if y1 < len(mask) else y1,
           x0 + 1 if x0 else 0 : x1 - 1 if x1 < mask.shape[1] else x1] = True  # fmt: skip
    inside = cv2.resize(within.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    count, labels, stats, _ = cv2.connectedComponentsWithStats(parts.astype(np.uint8), connectivity=8)
    kept = np.zeros_like(own)
    for index in range(1, count):
        part = labels == index
        if stats[index, cv2.CC_STAT_AREA] < LEAST_PART * own.sum() or (part & ~inside).any():
            continue
        kept |= part
    if not kept.any():
        return nothing
    # The seam between them is the object's, too.
    joined = cv2.morphologyEx((own | kept).astype(np.uint8), cv2.MORPH_CLOSE, _disc(SEAM)) > 0
    added = joined & ~own & ~shade & (cv2.dilate(kept.astype(np.uint8), _disc(SEAM)) > 0) & (~backdrop | kept)
    full = cv2.resize(added.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
    reach = round(SEAM * max(across, down)) + 1
    beside = grown(mask, reach)
    return np.asarray((full | (beside & _thin_between(mask, full, reach))) & ~mask & within)


def on_blank_page(pixels: Pixels, mask: Mask, box: tuple[int, int, int, int], backdrop: Mask) -> Mask | None:
    """Return all (H, W) of the object ``mask`` (H, W) in ``box`` on a blank page, as of cut-outs; None on others.

    A page without any shading shows no shadow, so all that is not blank and hangs together is the thing: white socks, a
    foot of a shadow's colour. None too where it goes on beyond the box. backdrop: (h, w), the reached page.
    """
    page = np.median(copy_of(pixels, SIDE)[backdrop], axis=0)
    calm = cv2.erode(backdrop.astype(np.uint8), _disc(2 * SEAM)) > 0
    if not calm.any() or (np.abs(copy_of(pixels, SIDE)[calm] - page).max(axis=-1) > BLANK).mean() > SHADED_SHARE:
        return None
    apart = np.abs(pixels - page).max(axis=-1)
    # A white collar hardly differs from the page: there colours and contours have decided.
    thing = touching(apart > INK, mask) | (mask & (apart > BLANK))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~thing).astype(np.uint8), connectivity=4)
    outside = np.unique(labels[_rim(mask.shape)])
    areas = stats[:, cv2.CC_STAT_AREA]
    blank = np.bincount(labels[apart <= BLANK], minlength=len(areas)) / areas
    filled = (areas < LEAST_PART * thing.sum()) | (blank < HOLE)
    filled[outside] = False
    thing |= filled[labels]
    x0, y0, x1, y1 = _to_border(box, mask.shape)
    beyond = thing.copy()
    beyond[y0:y1, x0:x1] = False
    if beyond.any() or not (thing & mask).sum() > 0.5 * mask.sum():
        return None
    return np.asarray(thing)


def _to_border(box: tuple[int, int, int, int], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """``box`` with the sides that are near the border of a photo of that ``shape`` moved there: a box around all of a
    photo ends before it, and what it holds may not.
    """
    height, width = shape[:2]
    near_x, near_y = NEAR_BORDER * width, NEAR_BORDER * height
    x0, y0, x1, y1 = box
    return (
        x0 if x0 > near_x else 0,
        y0 if y0 > near_y else 0,
        x1 if x1 < width - near_x else width,
        y1 if y1 < height - near_y else height,
    )


def _thin_between(mask: Mask, part: Mask, reach: int) -> Mask:
    """The seam (H, W) between ``mask`` and ``part``, at most twice ``reach`` wide."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    near = cv2.dilate(part.astype(np.uint8), disc) > 0
    return np.asarray((cv2.morphologyEx(((mask & near) | part).astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0) & near)


def _shaded(colours: NDArray[np.float32], behind: NDArray[np.float32]) -> Mask:
    """Whether ``colours`` (…, 3) are those of the backdrop ``behind`` them (…, 3), CIELAB, in its own shade."""
    factor = (colours[..., :1] + 16.0) / (behind[..., :1] + 16.0)
    # Shade scales chroma as it does lightness, with the cube root of light.
    away = np.linalg.norm(colours[..., 1:] - factor * behind[..., 1:], axis=-1)
    return np.asarray((factor[..., 0] < 1.0) & (away < COLOURED))


def remnants(pixels: Pixels, masks: Sequence[Mask]) -> list[Mask]:
    """Return for each of ``masks`` (H, W) what else stands before a plain backdrop in ``pixels`` (H, W, 3) and touches
    it, above its foot: it belongs to the object though the mask lacks it, and would hang in the air.

    Nothing where the backdrop is not plain. What touches it at the foot may carry it, as a stand does, and stays.
    """
    backdrop = plain_backdrop(pixels)
    result = [np.zeros_like(mask) for mask in masks]
    if backdrop is None:
        return result
    for index, mask in enumerate(masks):
        own = cv2.resize(mask.astype(np.float32), backdrop.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        rows = np.flatnonzero(own.any(axis=1))
        if len(rows) == 0:
            continue
        above = (np.arange(len(own)) < rows[-1] - FOOT * (rows[-1] - rows[0]))[:, None]
        found = touching((~backdrop | own) & above, own) & ~own
        # What goes on to the photo's border is where a wall meets the floor; beside the mask it may be fur.
        away = found & ~(cv2.dilate(own.astype(np.uint8), _disc(BESIDE_LINE)) > 0)
        if not (own & _rim(own.shape)).any():
            found &= ~touching(away, _rim(own.shape))
        result[index] = cv2.resize(found.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.2
    return result


def _told_apart(thing: Mask, parts: Sequence[Proposal], across: float, down: float) -> list[Proposal]:
    """``parts`` where they are alike things that touch and make up ``thing`` (h, w); else empty."""
    areas = [(item.box[2] - item.box[0]) * (item.box[3] - item.box[1]) for item in parts]
    if len(parts) < FEWEST or max(areas) > ALIKE * min(areas):
        return []
    count = np.zeros(thing.shape, dtype=np.int32)
    windows = [_window(thing.shape, item.box, across, down) for item in parts]
    for window in windows:
        count += window
    if any((count[window] > 1).mean() > OVERLAP for window in windows if window.any()):
        return []
    return list(parts) if (count[thing] > 0).mean() > COVERED else []


def _window(shape: tuple[int, ...], box: Box, across: float, down: float) -> Mask:
    result = np.zeros(shape, dtype=bool)
    result[round(box[1] / down) : round(box[3] / down), round(box[0] / across) : round(box[2] / across)] = True
    return result


def _solid(mask: Mask) -> Mask:
    """``mask`` (h, w) without the gradient around its things, and without lines that go to the photo's border."""
    solid = cv2.erode(mask.astype(np.uint8), _disc(PASS))
    padded = cv2.copyMakeBorder(solid, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, _disc(SEAM))[1:-1, 1:-1] > 0
    cut = touching(solid > 0, _rim(mask.shape))
    return np.asarray(((solid > 0) & ~cut) | (opened & cut))


def _rim(shape: tuple[int, ...]) -> Mask:
    """The outermost pixels of a picture of that ``shape``."""
    rim = np.ones(shape, dtype=bool)
    rim[1:-1, 1:-1] = False
    return rim


def _loose(mask: Mask) -> Box:
    """The box around ``mask`` (h, w), with a margin where the photo has room for one."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    # The gradient around a thing was taken away.
    x0, y0, x1, y1 = columns[0] - PASS, rows[0] - PASS, columns[-1] + 1 + PASS, rows[-1] + 1 + PASS
    margin = LOOSE * max(x1 - x0, y1 - y0)
    height, width = mask.shape
    wide = (max(0.0, x0 - margin), max(0.0, y0 - margin), min(width, x1 + margin), min(height, y1 + margin))
    if (wide[2] - wide[0]) * (wide[3] - wide[1]) < FULL * mask.size:
        return wide
    # A box around all of the photo would leave nothing to learn the backdrop's colours from.
    across, down = INSET * width, INSET * height
    return (max(across, x0), max(down, y0), min(width - across, x1), min(height - down, y1))


def _behind(lab: NDArray[np.float32], backdrop: Mask) -> NDArray[np.float32]:
    """The backdrop's colours (h, w, 3) beside each pixel, from the nearest scale that sees some of it.

    Sideways from farther off: a floor meets a wall along a level line.
    """
    total = np.zeros_like(lab)
    weight = np.full(backdrop.shape, 1e-9, dtype=np.float32)
    for share, across, down in ((1.0, 6.0, 6.0), (1e-3, 48.0, 6.0), (1e-6, 96.0, 96.0)):
        weight += share * cv2.GaussianBlur(backdrop.astype(np.float32), (0, 0), across, sigmaY=down)
        total += share * cv2.GaussianBlur(lab * backdrop[..., None], (0, 0), across, sigmaY=down)
    return np.asarray(total / weight[..., None], dtype=np.float32)


def _disc(radius: float) -> NDArray[np.uint8]:
    side = 2 * round(radius) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), dtype=np.uint8)
