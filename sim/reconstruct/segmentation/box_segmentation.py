# SPDX-License-Identifier: MIT
"""Segment an object in a loose box.

On a small copy of the box and its surroundings several proposals are made (``mask_proposals``), and the one that looks
most like an object is used. At full resolution its outline may then only move within a narrow band, which is fast and
cannot leak. Doubtful masks give notices.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .contour_evidence import FINE, completed_by_contours, gaps_and_rods
from .ground_shade import shaded_ground, without_ground
from .limb_ends import limb_ends
from .mask_cleanup import drop_ground_shadow, fill_holes, open_holes, settle_outline, smooth_outline, touching
from .mask_proposals import (
    BoxCrop,
    crop_around_box,
    edge_strength,
    ground_like,
    ground_likelihood,
    largest_part,
    proposals,
    refine,
    score,
    without_notches,
)
from .mirrored_outline import mirrored_outline
from .outer_rim import outer_rim
from .plain_backdrop import missing_parts, on_blank_page, plain_backdrop
from .strokes import Strokes, no_strokes

Mask = NDArray[np.bool_]

SECOND = 0.35
"""Area over the larger object's above which a second object in the box gives a notice."""


def mask_warnings(view: BoxCrop, raw: Mask, kept: Mask) -> list[str]:
    """Return notices about ``kept`` (h, w), the part of the proposal ``raw`` that is used for the object."""
    if kept.sum() < 20:
        return []
    messages = []
    count, _, stats, _ = cv2.connectedComponentsWithStats((raw & ~kept).astype(np.uint8), connectivity=8)
    second = int(stats[1:count, cv2.CC_STAT_AREA].max(initial=0))
    if second > SECOND * int(kept.sum()):
        messages.append(
            "its box seems to hold two separate objects; the larger one is used: draw a box around each, "
            "or give a painted mask that contains both"
        )
    if _like_surroundings(view, kept):
        messages.append(
            "looks much like its surroundings, as glass, mirrors and objects of the ground's colour do; "
            "its mask may be wrong: check it, and give a painted mask if it is"
        )
    return messages


def _like_surroundings(view: BoxCrop, kept: Mask, share: float = 0.5) -> bool:
    """Return whether more than ``share`` of the object's interior could be ground, by colour, texture and position."""
    inner = cv2.erode(kept.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    outside = view.outside
    if inner.sum() < 50 or outside.sum() < 200:
        return False
    usual = float(np.quantile(ground_likelihood(view, outside, outside, ()), 0.1))
    return float((ground_likelihood(view, outside, inner, ()) > usual).mean()) > share


def cut_sides(view: BoxCrop, kept: Mask, share: float = 0.2) -> list[str]:
    """Return sides of the box, inside the photo, beyond which ``kept`` (h, w) seems to continue for ``share`` of the
    side.

    The mask comes close to the side there, and the colour just beyond equals that at its edge.
    """
    x0, y0, x1, y1 = view.box
    result = []
    for name, turns in (("top", 0), ("right", 1), ("bottom", 2), ("left", 3)):
        # Rotated so that the side in question is the upper one.
        mask, lab = np.rot90(kept, turns), np.rot90(view.lab, turns)
        inside = np.zeros(kept.shape, dtype=bool)
        inside[y0:y1, x0:x1] = True
        rows, columns = (np.flatnonzero(np.rot90(inside, turns).any(axis=axis)) for axis in (1, 0))
        upper, near = int(rows[0]), max(3, round(0.1 * len(rows)))
        if upper < 3:
            continue
        strip = mask[upper : upper + near, columns]
        edge = np.where(strip.any(axis=0), strip.argmax(axis=0), 0) + upper
        # Two pixels inside the edge, where colours are not mixed.
        own, beyond = lab[np.minimum(edge + 2, len(lab) - 1), columns], lab[upper - 3, columns]
        alike = strip.any(axis=0) & (np.linalg.norm(own - beyond, axis=1) < 9.0)
        if alike.sum() > share * len(columns):
            result.append(name)
    return result


def outline_strength(view: BoxCrop, kept: Mask) -> float:
    """Median colour gradient across the outline, in CIELAB units per pixel."""
    kernel = np.ones((3, 3), np.uint8)
    binary = kept.astype(np.uint8)
    outline = (cv2.dilate(binary, kernel) > 0) & ~(cv2.erode(binary, kernel, borderValue=0) > 0)
    return float(np.median(edge_strength(view.lab)[outline])) if outline.any() else 0.0


Box = tuple[int, int, int, int]

COARSE_SIZE = 280
"""Longest side in pixels of the copy on which proposals are made."""
FINE_PIXELS = 1_200_000
"""Crops above this size skip the second pass; the first pass' outline is then only smoothed."""
PADDING = 0.35
"""Margin of background to learn from, over the box' longer side."""
FAINT = 0.4
"""Gradient across an outline, in CIELAB units per pixel, below which there is none."""
MIN_AREA = 64
"""Smallest area of a mask in pixels."""


def pixel_box(box: Sequence[float], scale: float, width: int, height: int, where: str) -> Box:
    """Return ``box`` of the upright original, clipped to the working photo of ``width`` x ``height`` pixels.

    Raises InputError when the box has no area, or lies outside the photo.
    """
    x0, y0, x1, y1 = (float(v) * scale for v in box)
    shown = ",".join(f"{v:g}" for v in box)
    if x1 <= x0 or y1 <= y0:
        raise InputError(f"{where}: box {shown} has no area; give x0,y0,x1,y1 with x0 < x1 and y0 < y1")
    left, top = max(0, int(np.floor(x0))), max(0, int(np.floor(y0)))
    right, bottom = min(width, int(np.ceil(x1))), min(height, int(np.ceil(y1)))
    if right <= left or bottom <= top:
        size = f"{width / scale:.0f}x{height / scale:.0f}"
        raise InputError(f"{where}: box {shown} lies outside the photo of {size} pixels; draw it around the object")
    if min(right - left, bottom - top) < 6:
        raise InputError(f"{where}: box {shown} is too thin to hold an object; draw it around the whole object")
    return left, top, right, bottom


def segment(
    pixels: NDArray[np.uint8],
    box: Box,
    where: str,
    iterations: int = 6,
    warn: Callable[[str], None] = lambda _: None,
    *,
    others: Mask | None = None,
    strokes: Strokes | None = None,
) -> Mask:
    """Return the object in ``box`` as a mask (H, W).

    pixels: (H, W, 3) sRGB. where: names the object in messages. warn: called when the mask is a guess or incomplete.
    others: (H, W) pixels of other objects: neither this one nor background to learn from; parts separated by them stay
    together. strokes: what certainly belongs to it, and what does not. Holes stay open where the background shows
    through. Raises InputError when the mask would be empty or full.
    """
    height, width = pixels.shape[:2]
    x0, y0, x1, y1 = box
    margin = int(np.ceil(PADDING * max(x1 - x0, y1 - y0))) + 2
    left, top = max(0, x0 - margin), max(0, y0 - margin)
    right, bottom = min(width, x1 + margin), min(height, y1 + margin)
    crop = np.ascontiguousarray(pixels[top:bottom, left:right])
    inner = (x0 - left, y0 - top, x1 - left, y1 - top)
    if (x1 - x0) * (y1 - y0) > 0.98 * width * height:
        raise InputError(f"{where}: the box covers the whole photo; leave background around the object")
    taken = np.zeros(crop.shape[:2], dtype=bool) if others is None else others[top:bottom, left:right]
    if taken[inner[1] : inner[3], inner[0] : inner[2]].all():
        raise InputError(f"{where}: other objects fill its whole box; draw the boxes around the visible part of each")
    told = no_strokes(pixels.shape) if strokes is None else strokes
    keep, drop = (np.ascontiguousarray(part[top:bottom, left:right]) for part in (told.keep, told.drop))
    keep = keep & ~taken
    found, closed, notices, sides = _coarse(crop, inner, taken, iterations, keep, drop)
    # A part that only contours speak for is as certain as a stroke: colours would drop it again.
    keep = keep | (closed & ~drop & ~taken)
    gaps, whole = np.zeros_like(taken), None
    if not keep.any() and found.sum() < max(MIN_AREA, 0.01 * (x1 - x0) * (y1 - y0)):
        sides = []
        notices = ["colour does not separate the object from the background; an ellipse in the box is used instead"]
        found = _ellipse(crop.shape[:2], inner)
    else:
        opened = open_holes(crop, found)
        # What the user keeps is no hole, whatever shows there.
        found = opened | touching(found & ~opened, keep) if keep.any() else opened
        if crop.shape[0] * crop.shape[1] <= FINE_PIXELS:
            found = _fine(crop, inner, found, taken, keep, drop)
        gaps, rods = _details(crop, inner, found, taken, keep, drop)
        found = (found & ~gaps) | rods
        found = settle_outline(crop, drop_ground_shadow(crop, _kept_part(found & ~taken, taken, keep)))
        mirrored = mirrored_outline(crop, inner, found, taken, drop)
        if (mirrored != found).any():
            found = settle_outline(crop, mirrored)
        rim = outer_rim(crop, found, taken | drop)
        if rim.any():
            found = settle_outline(crop, found | rim)
        ends = limb_ends(crop, inner, found, taken | drop)
        if ends.any():
            found = settle_outline(crop, found | ends)
        backdrop = plain_backdrop(pixels)
        if backdrop is not None and not taken.any() and not drop.any():
            whole = on_blank_page(pixels, _at(found, pixels.shape, left, top), box, backdrop)
        if whole is not None:
            found, gaps = settle_outline(crop, whole[top:bottom, left:right]), np.zeros_like(taken)
        elif backdrop is not None:
            lacking = missing_parts(pixels, _at(found, pixels.shape, left, top), box, backdrop)
            lacking = lacking[top:bottom, left:right] & ~taken & ~drop & ~gaps
            # A stroke that drops some of a part means all of it.
            lacking &= ~touching(lacking | drop, drop)
            if lacking.any():
                beside = cv2.dilate(lacking.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
                found = np.where(beside, settle_outline(crop, found | lacking), found)
    found = _kept_part((found | keep) & ~drop & ~taken, taken, keep)
    # On a blank page it is known which holes are open.
    found = found if whole is not None else fill_holes(crop, found) & ~gaps
    if keep.any():
        # Between what is kept and the rest their mixed colours look like a third one: bridge the groove.
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
        reach = 2 * max(8, round(0.08 * float(np.sqrt(found.sum())))) + 1
        near = cv2.dilate(keep.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
        found |= (cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0) & near
    found = (smooth_outline(found) | keep | _thin_parts(found)) & ~taken & ~drop
    found[:, : inner[0]] = found[: inner[1]] = False
    found[:, inner[2] :] = found[inner[3] :] = False
    mask = _at(_kept_part(found, taken, keep), pixels.shape, left, top)
    if mask.sum() < MIN_AREA:
        raise InputError(f"{where}: nothing was found in the box; draw it closer around the object")
    for notice in notices:
        warn(f"{where}: {notice}")
    for side in dict.fromkeys([*_cut_sides(mask, box), *sides]):
        warn(f"{where}: reaches the {side} edge of its box and may be cut there; draw the box larger")
    for side in photo_sides(mask):
        warn(
            f"{where}: is cut off by the {side} edge of the photo; only the visible part is reconstructed, "
            "and its size and foot are guesses"
        )
    return mask


def _at(part: Mask, shape: tuple[int, ...], left: int, top: int) -> Mask:
    """``part`` (h, w) of a picture of the given ``shape``, at its place."""
    whole = np.zeros(shape[:2], dtype=bool)
    whole[top : top + part.shape[0], left : left + part.shape[1]] = part
    return whole


def _kept_part(mask: Mask, others: Mask, keep: Mask) -> Mask:
    """The largest part of ``mask``, and all parts with pixels of ``keep``."""
    largest = largest_part(mask, others)
    return largest | touching(mask, keep) if keep.any() else largest


def photo_sides(mask: Mask, share: float = 0.1) -> list[str]:
    """Return photo borders along which ``mask`` runs for more than ``share`` of its own extent in that direction."""
    if not mask.any():
        return []
    wide, high = (float(mask.any(axis=axis).sum()) for axis in (0, 1))
    edges = (
        ("left", mask[:, 0], high),
        ("top", mask[0], wide),
        ("right", mask[:, -1], high),
        ("bottom", mask[-1], wide),
    )
    return [name for name, edge, extent in edges if edge.sum() > share * extent]


def _cut_sides(mask: Mask, box: Box, share: float = 0.2) -> list[str]:
    """Sides of ``box``, inside the photo, along which ``mask`` touches more than ``share`` of the side."""
    height, width = mask.shape
    x0, y0, x1, y1 = box
    sides = (
        ("left", x0 > 0, mask[y0:y1, x0]),
        ("top", y0 > 0, mask[y0, x0:x1]),
        ("right", x1 < width, mask[y0:y1, x1 - 1]),
        ("bottom", y1 < height, mask[y1 - 1, x0:x1]),
    )
    return [name for name, inside, edge in sides if inside and edge.mean() > share]


def check_distinct(masks: Sequence[Mask], names: Sequence[str]) -> None:
    """Raise InputError when two masks show the same object: their intersection is over half of their union."""
    for first in range(len(masks)):
        for second in range(first + 1, len(masks)):
            common = int((masks[first] & masks[second]).sum())
            union = int((masks[first] | masks[second]).sum())
            if common > 0.5 * union:
                raise InputError(
                    f"boxes of {names[first]} and {names[second]}: both hold the same object "
                    f"({100 * common / union:.0f} % in common); draw one box around each object"
                )


def _coarse(
    crop: NDArray[np.uint8], inner: Box, taken: Mask, iterations: int, keep: Mask, drop: Mask
) -> tuple[Mask, Mask, list[str], list[str]]:
    """The best proposal (h, w) at the crop's size, its parts that only contours speak for, notices about it, and sides
    of the box that may cut it."""
    nothing = np.zeros(crop.shape[:2], dtype=bool)
    height, width = crop.shape[:2]
    scale = min(1.0, COARSE_SIZE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    closed = cv2.resize(taken.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    x0, y0, x1, y1 = (round(v * scale) for v in inner)
    # A stroke is thinner than a pixel of the copy: keep every pixel that it touches, unless both do.
    own, other = (cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA) for part in (keep, drop))
    view = crop_around_box(
        small,
        (x0, y0, max(x1, x0 + 1), max(y1, y0 + 1)),
        closed,
        keep=(own > other) & ~closed,
        drop=(other > own) & ~closed,
    )
    if not view.inside.any():
        return nothing, nothing, [], []
    raw, chosen = _best_proposal(view, iterations)
    if outline_strength(view, chosen) < FAINT and not view.keep.any():
        return nothing, nothing, [], []
    rest = without_ground(view, chosen)
    if (chosen & ~rest).sum() > 0.02 * chosen.sum():
        # Once more, with the shadow among what the ground is known by.
        told = replace(view, drop=view.drop | (chosen & ~rest))
        again = _best_proposal(told, iterations)[1]
        near = cv2.dilate(rest.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        again = _kept_part(without_ground(told, again) & near, closed, view.keep)
        rest = again if again.sum() > 0.5 * rest.sum() else rest
    chosen = _without_images(view, chosen, rest)
    completed = completed_by_contours(view, chosen, shade=_shade(view, chosen))
    notices = mask_warnings(view, raw, chosen)
    if completed.doubtful.any():
        away = np.argwhere(completed.doubtful).mean(axis=0) - np.argwhere(completed.mask).mean(axis=0)
        sides = ("above", "below") if abs(away[0]) > abs(away[1]) else ("left of", "right of")
        share = 100.0 * completed.doubtful.sum() / completed.mask.sum()
        notices.append(
            f"a part {sides[int(away[np.argmax(np.abs(away))] > 0)]} its middle, {share:.0f} % of its size, has a "
            "contour of its own and may belong to it: a keep stroke over it adds it"
        )
    full, closed = (
        cv2.resize(part.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
        for part in (
            completed.mask,
            cv2.erode(completed.added.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0),
        )
    )
    return np.asarray(full), np.asarray(closed), notices, cut_sides(view, completed.mask)


def _without_images(view: BoxCrop, whole: Mask, rest: Mask) -> Mask:
    """``rest`` of the proposal ``whole``, both (h, w), without the object's mirror images in polished ground.

    An underside that the ground lights has their colours as well: seams a few pixels wide stay.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    images = (rest & ~without_ground(view, whole, polished=True)).astype(np.uint8)
    wide = cv2.dilate(cv2.morphologyEx(images, cv2.MORPH_OPEN, disc), np.ones((3, 3), np.uint8)) > 0
    return _kept_part(rest & ~(wide & (images > 0)), view.others, view.keep)


def _best_proposal(view: BoxCrop, iterations: int) -> tuple[Mask, Mask]:
    """The proposal (h, w) that looks most like an object, and its part that is used."""
    raw = proposals(view, iterations)
    guesses = [_kept_part(mask, view.others, view.keep) for mask in raw]
    for index, mask in enumerate(list(guesses)):
        whole = without_notches(mask, view.inside)
        if whole is not None:
            guesses.append(whole)
            raw.append(raw[index] | whole)
    ground = ground_like(view)
    best = int(np.argmax([score(view, mask, ground) for mask in guesses]))
    return raw[best], guesses[best]


def _details(
    crop: NDArray[np.uint8], inner: Box, found: Mask, taken: Mask, keep: Mask, drop: Mask
) -> tuple[Mask, Mask]:
    """Gaps and rods (h, w) at the crop's size, found on a copy that shows them."""
    height, width = crop.shape[:2]
    scale = min(1.0, FINE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    masks = [
        np.asarray(cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA)) > share
        for part, share in ((found, 0.5), (taken, 0.5), (keep, 0.0), (drop, 0.0))
    ]
    x0, y0, x1, y1 = (round(v * scale) for v in inner)
    view = crop_around_box(small, (x0, y0, x1, y1), masks[1], keep=masks[2], drop=masks[3] & ~masks[2])
    gaps, rods = gaps_and_rods(view, masks[0], shade=_shade(view, masks[0]))
    large = [cv2.resize(part.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
             for part in (gaps, rods)]  # fmt: skip
    return large[0] & ~keep, large[1] & ~drop & ~taken


def _shade(view: BoxCrop, mask: Mask) -> Callable[[], Mask] | None:
    """``shaded_ground`` around ``mask``, computed when it is first asked for; None around nothing."""
    return functools.cache(lambda: shaded_ground(view, mask)) if mask.any() else None


def _thin_parts(mask: Mask) -> Mask:
    """Rods and wires (h, w) of ``mask``, which smoothing would take away; single hairs of a few pixels are not."""
    size = float(np.sqrt(mask.sum()))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats((mask & ~opened).astype(np.uint8), connectivity=8)
    extent = np.hypot(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    # Longer than a jag of the outline, and not the rind that the opening peels off a corner.
    long = (extent > max(12.0, 0.08 * size)) & (stats[:, cv2.CC_STAT_AREA] > 1.6 * extent)
    long[0] = False
    return np.asarray(long[labels])


def _fine(crop: NDArray[np.uint8], inner: Box, found: Mask, taken: Mask, keep: Mask, drop: Mask) -> Mask:
    """``found`` with its outline re-estimated at full resolution, within a band of a few pixels."""
    band = max(3, round(2.0 * max(crop.shape[:2]) / COARSE_SIZE))
    view = crop_around_box(crop, inner, taken, keep=keep, drop=drop)
    refined = _kept_part(refine(view, found, band), taken, keep)
    # If both sides share colours the band can collapse: keep the first outline then.
    return refined if 0.9 * found.sum() < refined.sum() < 1.1 * found.sum() else found


def _ellipse(shape: tuple[int, ...], inner: Box) -> Mask:
    x0, y0, x1, y1 = inner
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    across = (columns - (x0 + x1) / 2) / ((x1 - x0) / 2)
    down = (rows - (y0 + y1) / 2) / ((y1 - y0) / 2)
    return np.asarray(across**2 + down**2 < 0.96)
