# SPDX-License-Identifier: MIT
"""Amodal completion: whole masks of partly hidden objects, and colours for the hidden parts.

The hidden part is guessed by several rules (``outline_guesses``, ``hidden_legs``). A guess is scored by how well its
rule explains the visible outline, and by whether it needs a coincidence: an object's true outline seldom runs along
that of the thing in front of it (the generic view: Freeman, Nature 1994).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...errors import InputError
from .hidden_legs import with_hidden_legs
from .hidden_solids import box, round_body
from .mask_geometry import Mask, grown
from .outline_guesses import OutlineGuess, continued, ellipse, known_share, mirrored, point_mirrored

GUESS_SIDE = 112
"""Pixels of the visible part's longer side in the copy on which guesses are made."""
ROOM = 1.0
"""Margin in that copy over the longer side: no hidden part is assumed to reach farther."""
COINCIDENCE = 0.1
"""Cost of an outline that follows the occluder's border everywhere, in shares of the visible area."""
PREFERENCE = {
    "ellipse": -0.03,
    "box": -0.01,
    "round_body": 0.0,
    "legs": 0.0,
    "mirrored": 0.02,
    "point_mirrored": 0.03,
    "seen_again": 0.03,
    "continued": 0.06,
}
"""Cost of each rule at equal fit, in shares of the visible area; tuned on drawn solids in front of others."""


def complete_outline(mask: Mask, hidden_by: Mask, *, seen_again: Mask | None = None) -> Mask:
    """Return the whole mask (H, W) of the object whose visible part is ``mask``.

    hidden_by: (H, W) pixels of the objects in front of it. seen_again: (H, W) the object as segmented in the picture
    without them (paper A.1); one more guess. The result contains ``mask`` and, beyond it, only pixels of ``hidden_by``;
    it equals ``mask`` where nothing in front touches the object.
    """
    in_front = hidden_by & ~mask
    if not mask.any() or not in_front.any():
        return mask.copy()
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(int(np.ptp(rows)), int(np.ptp(columns))) + 1
    room = int(np.ceil(ROOM * side))
    window = (int(rows[0]) - room, int(rows[-1]) + 1 + room, int(columns[0]) - room, int(columns[-1]) + 1 + room)
    scale = GUESS_SIDE / side
    seen = _copy(mask, window, scale, outside=False)
    # Beyond the picture everything is unknown as well.
    unknown = _copy(in_front, window, scale, outside=True) & ~seen
    # Two masks segmented one after the other leave a seam of a few pixels.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    closed = cv2.morphologyEx((seen | unknown).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    beside = cv2.dilate(seen.astype(np.uint8), kernel) > 0
    unknown = (unknown | (closed & beside)) & ~seen
    if not (unknown & beside).any():
        return mask.copy()
    guesses = _guesses(seen, unknown, _lowest_base(in_front, window, scale))
    if seen_again is not None:
        again = _copy(seen_again, window, scale, outside=False)
        guesses.append(OutlineGuess("seen_again", again, known_share(again ^ seen, seen, unknown)))
    costs = [
        guess.misfit + PREFERENCE[guess.rule] + COINCIDENCE * _coincidence(guess.outline | seen, seen, unknown)
        for guess in guesses
    ]
    best = (guesses[int(np.argmin(costs))].outline | seen) & (seen | unknown)
    return mask | (_at_full_size(best, mask.shape, window, scale) & in_front)


def _guesses(seen: Mask, unknown: Mask, lowest_base: float) -> list[OutlineGuess]:
    guesses = [continued(seen, unknown, lowest_base)]
    standing = with_hidden_legs(seen, unknown, lowest_base)
    if standing is not None:
        guesses.append(OutlineGuess("legs", standing, 0.0))
    for rule in (ellipse, box, round_body, mirrored, point_mirrored):
        guess = rule(seen, unknown)
        if guess is not None:
            guesses.append(guess)
    return guesses


def _coincidence(outline: Mask, seen: Mask, unknown: Mask) -> float:
    """Share of the border between ``seen`` and ``unknown`` that ``outline`` makes the object's own edge."""
    border = seen & grown(unknown)
    if not border.any():
        return 0.0
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    inside = cv2.erode(outline.astype(np.uint8), kernel, borderValue=0) > 0
    return float((border & ~inside).sum() / border.sum())


def _lowest_base(in_front: Mask, window: tuple[int, int, int, int], scale: float) -> float:
    """Lowest row, in the copy, of the base of an object hidden by ``in_front``.

    An occluder covers about as much ground in depth as it is wide. Seen from 20 to 30 degrees above, an object behind
    it stands about half its width higher in the picture.
    """
    top, bottom, left, right = window
    height, width = in_front.shape
    inside = in_front[max(0, top) : min(height, bottom), max(0, left) : min(width, right)]
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(in_front.any(axis=1))
    if len(columns) == 0:
        return float("inf")
    return (float(rows[-1]) - 0.45 * float(np.ptp(columns)) - top) * scale


def _copy(mask: Mask, window: tuple[int, int, int, int], scale: float, *, outside: bool) -> Mask:
    """The ``window`` (top, bottom, left, right) of ``mask`` at ``scale``; ``outside`` is its value beyond the
    picture."""
    top, bottom, left, right = window
    height, width = mask.shape
    part = mask[max(0, top) : min(height, bottom), max(0, left) : min(width, right)]
    margins = ((max(0, -top), max(0, bottom - height)), (max(0, -left), max(0, right - width)))
    padded = np.pad(part, margins, constant_values=outside).astype(np.float32)
    size = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(padded, size, interpolation=method) > 0.5)


def _at_full_size(small: Mask, shape: tuple[int, ...], window: tuple[int, int, int, int], scale: float) -> Mask:
    top, bottom, left, right = window
    soft = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 0.8)
    large = cv2.resize(soft, (right - left, bottom - top), interpolation=cv2.INTER_LINEAR) > 0.5
    result = np.zeros(shape, dtype=bool)
    rows = slice(max(0, top), min(shape[0], bottom))
    columns = slice(max(0, left), min(shape[1], right))
    result[rows, columns] = large[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return result


COLOUR_SIDE = 200.0
"""Largest side in pixels at which hidden colours are inpainted; larger objects are scaled down."""
ENOUGH = 400
"""Visible pixels at that scale, below which the nearest colour is used instead of patches."""
SEAM = 2
"""Pixels along the visible part's edge that are mixed with the neighbour's colour, and are not a source."""


def complete_colours(
    pixels: NDArray[np.uint8], mask: Mask, full: Mask, *, radius: int = 3, seed: int = 0
) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) with the hidden part, ``full`` without ``mask``, in the object's own colours.

    mask: (H, W) visible pixels of the object; full: (H, W) its whole mask. All sources are pixels of ``mask``, never of
    the occluder or the surroundings. PatchMatch (Barnes et al., SIGGRAPH 2009) with patches of (2 radius + 1)² pixels;
    the nearest colour where too little is visible. Raises InputError for an empty mask, or when the native library is
    missing.
    """
    hidden = full & ~mask
    if not hidden.any():
        return pixels.copy()
    if not mask.any():
        raise InputError("complete_colours: the mask is empty; give the visible pixels of the object")
    rows, columns = (np.flatnonzero((mask | hidden).any(axis=axis)) for axis in (1, 0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    crop, own, missing = pixels[window], mask[window], hidden[window]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SEAM + 1, 2 * SEAM + 1))
    core = cv2.erode(own.astype(np.uint8), disc, borderValue=0) > 0
    source = core if core.sum() > 0.3 * own.sum() else own
    filled = _filled_colours(crop, source, radius, seed)
    result = pixels.copy()
    result[window] = np.where(missing[..., None], filled, crop)
    return result


def _filled_colours(crop: NDArray[np.uint8], source: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    """``crop`` (h, w, 3) with everything but ``source`` filled from ``source``."""
    height, width = source.shape
    scale = min(1.0, COLOUR_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    weight = cv2.resize(source.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # Average over source pixels only, or downscaling would mix in the neighbours' colours.
    total = cv2.resize(crop * source[..., None].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = np.clip(total / np.maximum(weight, 1e-6)[..., None] + 0.5, 0, 255).astype(np.uint8)
    known = weight > 0.5
    if not known.any():
        known = weight > 0.0
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    plain = small[nearest[0], nearest[1]]
    if known.sum() < ENOUGH or known.mean() < 0.05 or min(size) < 4 * radius:
        filled = np.where(known[..., None], plain, cv2.GaussianBlur(plain, (0, 0), 2.0))
    else:
        filled = _patch_match(plain, ~known, radius, seed)
    return np.asarray(cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def _patch_match(pixels: NDArray[np.uint8], hole: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    if not hole.any():
        return pixels
    # Imported late: importing the package must not load a native library.
    from patchmatch import patch_match

    if not getattr(patch_match, "patchmatch_available", False):
        raise InputError("the inpainting library pypatchmatch cannot be loaded; install it again for this Python")
    patch_match.set_random_seed(seed)
    try:
        return np.asarray(patch_match.inpaint(np.ascontiguousarray(pixels), hole.astype(np.uint8), patch_size=radius))
    except RuntimeError:
        # Too few patches: keep the nearest colours.
        return pixels
