# SPDX-License-Identifier: MIT
"""One surface, seen so that it looks alike everywhere, with its hole filled.

What can be foreseen comes from ``conditional``: shades, and patterns as regular as they are. What cannot comes from
PatchMatch, led by what could be foreseen: texture, with the contrast that the surface has at each scale of detail less
what is foreseen of it already. So the filling has neither the blotches of a texture that does not know the light, nor
the softness of a mean.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.inpaint import FillOptions, searched
from .bounds import bounded
from .conditional import foreseen, shift_to_known, shifted
from .shading import light_field, logarithms

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

FORESEEN_PIXELS = 70_000
"""Pixels on which the mean is solved for."""
SOLVE_SIDE = 150.0
"""Pixels; larger holes are searched at a scale that makes them this large: what is foreseen holds the structure."""
LED = 1.0
"""How much PatchMatch's guide weighs what is foreseen, over its standard deviation."""
CONTRAST = 60.0
"""Standard deviation that the surface's pattern gets in PatchMatch's 256 steps."""
GRAIN = 0.06
"""Scales up to this share of the hole's size are grain, which may be added from elsewhere."""
DONORS = 4
"""Places that grain is taken from, at most."""


def fill_surface(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """``picture`` (h, w, 3), values 0 to 255, with ``hole`` (h, w) filled from what is in neither it nor ``barred``.

    Raises InputError when nothing is left to fill from, or the native library is missing.
    """
    known = ~(hole | barred)
    logs = logarithms(picture)
    slow, lack = light_field(logs, known, hole)
    pattern = logs - slow - lack
    centre = pattern[known].mean(axis=0) if known.any() else np.zeros(3, np.float32)
    pattern = np.where(known[..., None], pattern - centre, 0.0).astype(np.float32)
    mean = _mean(pattern, known, hole)
    texture = _texture(pattern, mean, hole, barred, options)
    merged = mean + _balanced(pattern, mean, texture - mean, known, hole)
    new = np.where(hole[..., None], merged + slow + centre, logs).astype(np.float32)
    filled = np.exp(bounded(new, hole, known))
    return np.asarray(np.where(hole[..., None], filled, picture), dtype=np.float32)


def _mean(pattern: Picture, known: Mask, hole: Mask) -> Picture:
    """What can be foreseen of the pattern."""
    height, width = known.shape
    scale = min(1.0, float(np.sqrt(FORESEEN_PIXELS / known.size)))
    if scale > 0.9:
        return foreseen(pattern, known, hole)[0]
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    share, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    small = cv2.resize(pattern, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)[..., None]
    found, _ = foreseen(np.asarray(small, dtype=np.float32), np.asarray(share > 0.999), np.asarray(cut > 0.0))
    whole = cv2.resize(found, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(whole, dtype=np.float32)


def _texture(pattern: Picture, mean: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """The pattern with its hole filled by PatchMatch."""
    known = ~(hole | barred)
    spread = max(float(pattern[known].std()), 1e-3)
    gain = min(CONTRAST / spread, 500.0)
    pixels = np.clip(127.5 + gain * np.where(hole[..., None], mean, pattern), 0, 255).astype(np.uint8)
    axes = np.linalg.eigh(np.cov(mean[known].astype(np.float64), rowvar=False))[1][:, :0:-1]
    guide = (mean @ axes.astype(np.float32)) / spread * LED
    filled = searched(pixels, hole, barred, options, np.ascontiguousarray(guide, dtype=np.float32), SOLVE_SIDE)
    return np.asarray((filled.astype(np.float32) - 127.5) / gain, dtype=np.float32)


def _balanced(pattern: Picture, mean: Picture, rest: Picture, known: Mask, hole: Mask) -> Picture:
    """``rest``, what cannot be foreseen, with the contrast that the surface misses at each scale.

    The variance of a surface is that of its conditional mean and of what deviates from that (law of total variance):
    what PatchMatch has too much of is weakened. What it averaged away comes from ``_donor``.
    """
    side = float(np.sqrt(hole.sum()))
    levels = max(1, min(round(np.log2(max(side / 3.0, 2.0))), int(np.log2(min(hole.shape))) - 2))
    masks = np.stack([known, hole, hole], axis=-1).astype(np.float32)
    bands: list[Picture] = []
    stack = np.concatenate([pattern, mean, rest, _donor(pattern, known, hole), masks], axis=-1)
    for level in range(levels + 1):
        coarser = stack if level == levels else _down(stack)
        back = np.zeros_like(stack) if level == levels else _up(coarser, stack)
        own, foretold, given, donor = (stack[..., i : i + 3] - back[..., i : i + 3] for i in (0, 3, 6, 9))
        # Next to what is unknown, blurs have mixed with it.
        seen, filled = _inner(stack[..., 12] > 0.98, 3), stack[..., 13] > 0.5
        if seen.sum() >= 16 and filled.sum() >= 4:
            missing = max(float(own[seen].var() - foretold[filled].var()), 0.0)
            given = min(1.0, float(np.sqrt(missing / max(float(given[filled].var()), 1e-12)))) * given
            if 2.0**level <= GRAIN * side:
                # By medians: edges and single spots make variance, but are no grain.
                grain, has = _spread(own[seen]), _spread((foretold + given)[filled])
                share = np.sqrt(np.maximum(1.0 - np.square(has / np.maximum(grain, 1e-6)), 0.0))
                share = share * np.clip((grain / np.maximum(own[seen].std(axis=0), 1e-6) - 0.5) / 0.3, 0.0, 1.0)
                given = given + share * np.clip(donor, -3.0 * grain, 3.0 * grain)
        bands.append(given)
        stack = coarser
    total = bands[-1]
    for band in bands[-2::-1]:
        total = _up(total, band) + band
    return total


def _spread(values: Picture) -> Picture:
    """Standard deviation (c,) of ``values`` (n, c) of 0 mean, if they were normal."""
    return np.asarray(1.4826 * np.median(np.abs(values[:: max(1, len(values) // 20_000)]), axis=0), dtype=np.float32)


def _donor(pattern: Picture, known: Mask, hole: Mask) -> Picture:
    """``pattern`` with other places of it in its hole, each as large as can be; 0 where none would do."""
    # Single spots are left out, or they would come along as ghosts.
    middle = np.median(pattern[known][:: max(1, int(known.sum()) // 20_000)], axis=0)
    most = 3.0 * _spread(pattern[known] - middle)
    pattern = np.clip(pattern, middle - most, middle + most)
    result, left = np.where(known[..., None], pattern, 0.0).astype(np.float32), hole.copy()
    for _ in range(DONORS):
        shift = shift_to_known(left, known)
        if shift is None:
            break
        there = left & shifted(known, -shift[0], -shift[1])
        result[there] = shifted(pattern, -shift[0], -shift[1])[there]
        left &= ~there
        if left.sum() < 0.01 * hole.sum():
            break
    return result


def _down(image: Picture) -> Picture:
    halves = [
        cv2.pyrDown(np.ascontiguousarray(part)) for part in np.array_split(image, range(3, image.shape[2], 3), axis=-1)
    ]
    return np.concatenate([half.reshape(*half.shape[:2], -1) for half in halves], axis=-1)


def _up(image: Picture, like: Picture) -> Picture:
    size = (like.shape[1], like.shape[0])
    parts = np.array_split(image, range(3, image.shape[2], 3), axis=-1)
    wholes = [cv2.pyrUp(np.ascontiguousarray(part), dstsize=size) for part in parts]
    return np.concatenate([whole.reshape(*whole.shape[:2], -1) for whole in wholes], axis=-1)


def _inner(known: Mask, side: int) -> Mask:
    """``known`` without its border, unless nothing would be left."""
    inner = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    return np.asarray(inner) if inner.sum() > 100 else known
