# SPDX-License-Identifier: MIT
"""Segment an object in a loose box.

On a small copy of the box and its surroundings several proposals are made (``mask_proposals``), and the one that looks
most like an object is used. At full resolution its outline may then only move within a narrow band, which is fast and
cannot leak. Doubtful masks give notices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .box_crop import FINE, Box, BoxCrop, crop_around_box, edge_strength, padded, small_copy
from .contour_evidence import Completed, completed_by_contours
from .gaps_and_rods import gaps_and_rods
from .ground_shade import shaded_ground, without_ground
from .limb_ends import limb_ends
from .mask_cleanup import drop_ground_shadow, fill_holes, open_holes, settle_outline, smooth_outline
from .mask_geometry import Mask, grown, largest_part, outline_of, shrunk, touching
from .mask_notices import continued_sides, mask_warnings, photo_sides, touched_sides
from .mask_proposals import ground_like, proposals, refine, score, without_notches
from .mirrored_outline import mirrored_outline
from .outer_rim import outer_rim
from .plain_backdrop import missing_parts, on_blank_page, plain_backdrop
from .reflected_colour import tinted_ground
from .strokes import Strokes, no_strokes

COARSE_SIZE = 280
"""Longest side in pixels of the copy on which proposals are made."""
FINE_PIXELS = 1_200_000
"""Crops above this size skip the second pass; the first pass' outline is then only smoothed."""
FAINT = 0.4
"""Gradient across an outline, in CIELAB units per pixel, below which there is none."""
SAME = 0.9
"""Share of a mask without shade that the next proposal must keep: it is to lose what else is ground, not the object."""
MIN_AREA = 64
"""Smallest area of a mask in pixels."""


@dataclass(frozen=True)
class _Surroundings:
    """A box' part of the photo. pixels: (h, w, 3). box: in its pixels. left, top: where it lies in the photo.

    taken: (h, w) pixels of other objects. keep, drop: (h, w) what certainly is the object, or is not.
    """

    pixels: NDArray[np.uint8]
    box: Box
    left: int
    top: int
    taken: Mask
    keep: Mask
    drop: Mask

    def in_photo(self, mask: Mask, shape: tuple[int, ...]) -> Mask:
        """``mask`` (h, w) at its place in a photo of ``shape``."""
        whole = np.zeros(shape[:2], dtype=bool)
        whole[self.top : self.top + mask.shape[0], self.left : self.left + mask.shape[1]] = mask
        return whole

    def of_photo(self, mask: Mask) -> Mask:
        """The part (h, w) of a photo's ``mask``."""
        height, width = self.taken.shape
        return mask[self.top : self.top + height, self.left : self.left + width]

    def kept_part(self, mask: Mask) -> Mask:
        """The largest part of ``mask`` (h, w), and all parts with pixels that certainly are the object."""
        return _kept_part(mask, self.taken, self.keep)


@dataclass(frozen=True)
class _Coarse:
    """mask: (h, w) the best proposal. closed: (h, w) its parts that only contours speak for. tint: (h, w) ground that
    shows its colour. notices: about it. sides: of the box, that may cut it."""

    mask: Mask
    closed: Mask
    tint: Mask
    notices: Sequence[str] = ()
    sides: Sequence[str] = ()


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
    x0, y0, x1, y1 = box
    near = _surroundings(pixels, box, where, others, no_strokes(pixels.shape) if strokes is None else strokes)
    coarse = _coarse(near, iterations)
    # A part that only contours speak for is as certain as a stroke: colours would drop it again.
    near = replace(near, keep=near.keep | (coarse.closed & ~near.drop & ~near.taken))
    # Neither the object nor what its background is known by.
    near = replace(near, taken=near.taken | (coarse.tint & ~near.keep))
    notices, sides = coarse.notices, coarse.sides
    gaps: Mask | None = np.zeros_like(near.taken)
    if not near.keep.any() and coarse.mask.sum() < max(MIN_AREA, 0.01 * (x1 - x0) * (y1 - y0)):
        notices = ["colour does not separate the object from the background; an ellipse in the box is used instead"]
        found, sides = _ellipse(near.taken.shape, near.box), ()
    else:
        found, gaps = _outlined(pixels, box, near, coarse.mask)
    mask = near.in_photo(_finished(near, found, gaps), pixels.shape)
    if mask.sum() < MIN_AREA:
        raise InputError(f"{where}: nothing was found in the box; draw it closer around the object")
    for notice in notices:
        warn(f"{where}: {notice}")
    for side in dict.fromkeys([*touched_sides(mask, box), *sides]):
        warn(f"{where}: reaches the {side} edge of its box and may be cut there; draw the box larger")
    for side in photo_sides(mask):
        warn(
            f"{where}: is cut off by the {side} edge of the photo; only the visible part is reconstructed, "
            "and its size and foot are guesses"
        )
    return mask


def _surroundings(
    pixels: NDArray[np.uint8], box: Box, where: str, others: Mask | None, strokes: Strokes
) -> _Surroundings:
    """The part of the photo ``pixels`` (H, W, 3) from which the object in ``box`` is segmented.

    Raises InputError when there is no background in it, or no room for the object.
    """
    height, width = pixels.shape[:2]
    x0, y0, x1, y1 = box
    if (x1 - x0) * (y1 - y0) > 0.98 * width * height:
        raise InputError(f"{where}: the box covers the whole photo; leave background around the object")
    window, inner = padded(box, (height, width), math.ceil)
    crop = np.ascontiguousarray(pixels[window])
    taken = np.zeros(crop.shape[:2], dtype=bool) if others is None else others[window]
    if taken[inner[1] : inner[3], inner[0] : inner[2]].all():
        raise InputError(f"{where}: other objects fill its whole box; draw the boxes around the visible part of each")
    keep, drop = (np.ascontiguousarray(part[window]) for part in (strokes.keep, strokes.drop))
    return _Surroundings(crop, inner, window[1].start, window[0].start, taken, keep & ~taken, drop)


def _outlined(pixels: NDArray[np.uint8], box: Box, near: _Surroundings, coarse: Mask) -> tuple[Mask, Mask | None]:
    """``coarse`` (h, w) with its outline at full size, holes and thin parts, and what colours have lost; and gaps (h,
    w) that stay open, None where it is known already which holes do: on a blank page.

    pixels: (H, W, 3) the photo, in which ``box`` is the object's.
    """
    crop, taken, keep, drop = near.pixels, near.taken, near.keep, near.drop
    opened = open_holes(crop, coarse)
    # What the user keeps is no hole, whatever shows there.
    found = opened | touching(coarse & ~opened, keep) if keep.any() else opened
    if crop.shape[0] * crop.shape[1] <= FINE_PIXELS:
        found = _fine(near, found)
    gaps, rods, handles = _details(near, found)
    found = near.kept_part(((found & ~gaps) | rods | handles) & ~taken)
    # A handle is no shadow, and has no middle whose colour would tell its outline.
    found = settle_outline(crop, drop_ground_shadow(crop, found)) | (handles & found)
    mirrored = mirrored_outline(crop, near.box, found, taken, drop)
    if (mirrored != found).any():
        # The outline of a handle goes around what shows through it.
        through = mirrored & ~keep & ~open_holes(crop, mirrored, within=shrunk(mirrored & ~found, 3))
        gaps |= through
        found = settle_outline(crop, mirrored & ~through)
    rim = outer_rim(crop, found, taken | drop)
    if rim.any():
        found = settle_outline(crop, found | rim)
    ends = limb_ends(crop, near.box, found, taken | drop)
    if ends.any():
        found = settle_outline(crop, found | ends)
    backdrop = plain_backdrop(pixels)
    if backdrop is None:
        return found, gaps
    if not taken.any() and not drop.any():
        whole = on_blank_page(pixels, near.in_photo(found, pixels.shape), box, backdrop)
        if whole is not None:
            return settle_outline(crop, near.of_photo(whole)), None
    lacking = missing_parts(pixels, near.in_photo(found, pixels.shape), box, backdrop)
    lacking = near.of_photo(lacking) & ~taken & ~drop & ~gaps
    # A stroke that drops some of a part means all of it.
    lacking &= ~touching(lacking | drop, drop)
    if lacking.any():
        found = np.where(grown(lacking, 4), settle_outline(crop, found | lacking), found)
    return found, gaps


def _finished(near: _Surroundings, found: Mask, gaps: Mask | None) -> Mask:
    """``found`` (h, w) with its strokes, without holes but ``gaps`` (see ``_outlined``), smooth, and within the box."""
    taken, keep, drop = near.taken, near.keep, near.drop
    found = near.kept_part((found | keep) & ~drop & ~taken)
    if gaps is not None:
        found = fill_holes(near.pixels, found) & ~gaps
    if keep.any():
        # Between what is kept and the rest their mixed colours look like a third one: bridge the groove.
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
        reach = 2 * max(8, round(0.08 * float(np.sqrt(found.sum())))) + 1
        beside = cv2.dilate(keep.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
        found |= (cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0) & beside
    found = (smooth_outline(found) | keep | _thin_parts(found)) & ~taken & ~drop
    x0, y0, x1, y1 = near.box
    found[:, :x0] = found[:y0] = False
    found[:, x1:] = found[y1:] = False
    return near.kept_part(found)


def _kept_part(mask: Mask, others: Mask, keep: Mask) -> Mask:
    """The largest part of ``mask``, and all parts with pixels of ``keep``."""
    largest = largest_part(mask, others)
    return largest | touching(mask, keep) if keep.any() else largest


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


def _coarse(near: _Surroundings, iterations: int) -> _Coarse:
    """The best proposal, found on a small copy; empty where colours show no outline."""
    empty = np.zeros_like(near.taken)
    nothing = _Coarse(empty, empty, empty)
    copy = small_copy(near.taken.shape, COARSE_SIZE)
    closed = copy.mask(near.taken)
    # A stroke is thinner than a pixel of the copy: keep every pixel that it touches, unless both do.
    own, other = copy.share(near.keep), copy.share(near.drop)
    view = crop_around_box(
        copy.pixels(near.pixels),
        copy.box(near.box),
        closed,
        keep=(own > other) & ~closed,
        drop=(other > own) & ~closed,
    )
    if not view.inside.any():
        return nothing
    raw, chosen = _best_proposal(view, iterations)
    if outline_strength(view, chosen) < FAINT and not view.keep.any():
        return nothing
    chosen = _without_images(view, chosen, _without_shade(view, chosen, iterations))
    tint = tinted_ground(view, chosen)
    if tint.any():
        view = replace(view, others=view.others | tint)
        chosen = _kept_part(chosen & ~tint, view.others, view.keep)
    completed = completed_by_contours(view, chosen, shade=_shade(view, chosen))
    notices = [*mask_warnings(view, raw, chosen), *_doubts(completed)]
    return _Coarse(
        copy.enlarged(completed.mask),
        copy.enlarged(shrunk(completed.added)),
        copy.enlarged(tint),
        notices,
        continued_sides(view, completed.mask),
    )


def _without_shade(view: BoxCrop, chosen: Mask, iterations: int) -> Mask:
    """The proposal ``chosen`` (h, w) without shaded ground, proposed once more where it had much of that."""
    rest = without_ground(view, chosen)
    if (chosen & ~rest).sum() <= 0.02 * chosen.sum():
        return rest
    # Once more, with the shadow among what the ground is known by.
    told = replace(view, drop=view.drop | (chosen & ~rest))
    again = _best_proposal(told, iterations)[1]
    again = _kept_part(without_ground(told, again) & grown(rest), view.others, view.keep)
    return again if again.sum() > SAME * rest.sum() else rest


def _doubts(completed: Completed) -> list[str]:
    """A notice of the parts that may belong to the object, if there are any."""
    if not completed.doubtful.any():
        return []
    away = np.argwhere(completed.doubtful).mean(axis=0) - np.argwhere(completed.mask).mean(axis=0)
    sides = ("above", "below") if abs(away[0]) > abs(away[1]) else ("left of", "right of")
    share = 100.0 * completed.doubtful.sum() / completed.mask.sum()
    return [
        f"a part {sides[int(away[np.argmax(np.abs(away))] > 0)]} its middle, {share:.0f} % of its size, has a "
        "contour of its own and may belong to it: a keep stroke over it adds it"
    ]


def outline_strength(view: BoxCrop, kept: Mask) -> float:
    """Median colour gradient across the outline, in CIELAB units per pixel."""
    outline = outline_of(kept)
    return float(np.median(edge_strength(view.lab)[outline])) if outline.any() else 0.0


def _without_images(view: BoxCrop, whole: Mask, rest: Mask) -> Mask:
    """``rest`` of the proposal ``whole``, both (h, w), without the object's mirror images in polished ground.

    An underside that the ground lights has their colours as well: seams a few pixels wide stay.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    images = (rest & ~without_ground(view, whole, polished=True)).astype(np.uint8)
    wide = grown(cv2.morphologyEx(images, cv2.MORPH_OPEN, disc) > 0)
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


def _details(near: _Surroundings, found: Mask) -> tuple[Mask, Mask, Mask]:
    """Gaps in ``found``, and rods and handles beside it, all (h, w), found on a copy that shows them."""
    copy = small_copy(found.shape, FINE)
    mask, keep = copy.mask(found), copy.share(near.keep) > 0.0
    drop = (copy.share(near.drop) > 0.0) & ~keep
    view = crop_around_box(copy.pixels(near.pixels), copy.box(near.box), copy.mask(near.taken), keep=keep, drop=drop)
    gaps, *beside = gaps_and_rods(view, mask, shade=_shade(view, mask))
    rods, handles = (copy.enlarged(part) & ~near.drop & ~near.taken for part in beside)
    return copy.enlarged(gaps) & ~near.keep, rods, handles


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


def _fine(near: _Surroundings, found: Mask) -> Mask:
    """``found`` (h, w) with its outline re-estimated at full resolution, within a band of a few pixels."""
    band = max(3, round(2.0 * max(found.shape) / COARSE_SIZE))
    view = crop_around_box(near.pixels, near.box, near.taken, keep=near.keep, drop=near.drop)
    refined = near.kept_part(refine(view, found, band))
    # If both sides share colours the band can collapse: keep the first outline then.
    return refined if 0.9 * found.sum() < refined.sum() < 1.1 * found.sum() else found


def _ellipse(shape: tuple[int, ...], inner: Box) -> Mask:
    x0, y0, x1, y1 = inner
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    across = (columns - (x0 + x1) / 2) / ((x1 - x0) / 2)
    down = (rows - (y0 + y1) / 2) / ((y1 - y0) / 2)
    return np.asarray(across**2 + down**2 < 0.96)
