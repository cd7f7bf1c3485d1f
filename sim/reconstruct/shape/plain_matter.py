# SPDX-License-Identifier: MIT
"""An object's plain material, from its picture: colours without marks, and grain.

Marks (eyes, letters, bows, highlights) are what the outline does not reach: darker or lighter islands, found as the
difference from a picture whose islands are levelled by greyscale reconstruction from the outline (Vincent, IEEE
Transactions on Image Processing 2(2), 1993). A stripe or ribbon that reaches the outline is none, but what lies on it
is, and so is what an edge encloses (`stripes.py`). Behind a mark goes on what it lies on, stripes as stripes.

Grain is synthesised by blending patches at random places (Deliot & Heitz, GPU Zen 2, 2019): the weights' squares sum
to one, so the contrast stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import reconstruction

from ...composite.inpaint import FillOptions, inpaint_once
from ...composite.pull_push import fill_gaps
from ...srgb import cielab
from .stripes import beside_stripes, enclosed

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

COARSE = 256
"""Pixels along the longer side of the picture on which marks are found."""
MEDIAN = 5
"""Pixels of that picture: what is narrower than half of it is grain."""
RIM_SHARE = 0.02
"""Width of the outline's band, which says what is no mark, over the square root of the area."""
MARK = 9.0
"""Difference in CIELAB, lightness at half weight, above which something is a mark."""
NEXT = 3
"""Width of a mark's rim in pixels of that picture."""
LEAST_RIM = 12
"""Pixels of a rim that tell what the mark lies on."""
MOST_OF_RIM = 0.85
"""Share of a mark's rim of one colour above which the mark lies on that."""
UNLIKE = 16.0
"""Difference in CIELAB, lightness at half weight, from most of its rim from which something around a mark is not what
the mark lies on."""
LEAST_SOURCES = 1.0
"""Pixels without marks over those with, from which patches can be had."""
SMOOTH = 0.02
"""Standard deviation of the plain colours' smoothing over the square root of the area; what is finer is grain."""
EDGE_STEP = 60.0
"""Step of colours, 0 to 255, above which smoothing keeps an edge."""
SWATCH_SIDES = (192, 160, 132, 108, 90, 74, 60, 50, 40, 32, 24)
"""Sides in pixels tried for the square from which grain is taken, largest first."""
SWATCH_SHARE = 0.2
"""Largest side of the square, over the square root of the area."""
FREE = 0.96
"""Least share of the square without marks."""
EDGE = 0.3
"""Distance of neighbouring patches over the side of the square."""
SHARPNESS = 4.0
"""Exponent of the blending weights: at 1 patches blend into each other everywhere."""
CONTRAST = (0.0, 1.4)
"""Limits of the local contrast of grain over the square's."""
USUAL = 50.0
"""Percentile of the grain's deviation over the object that is taken for that of its matter."""
PRINT = 11.0
"""Deviation of grain, of 255, above which it is print: that of fur is 5 to 10, of peel 5, of a printed book 17."""
FLECK = 3.0
"""Deviations of grain from its mean at most, in standard deviations: larger ones would be seen to repeat."""


@dataclass(frozen=True, eq=False)
class PlainMatter:
    """Of a picture (h, w): colours (h, w, 3) without marks and grain, sRGB 0 to 255; marks (h, w); contrast (h, w) of
    the grain over that of swatch; swatch (s, s, 3): grain, of mean 0."""

    colours: Picture
    marks: Mask
    contrast: Picture
    swatch: Picture


def inner_colours(picture: Picture, mask: Mask) -> Picture:
    """Return ``picture`` (h, w, 3) with the colours inside ``mask`` (h, w), not empty, carried outward from two pixels
    inside the outline, whose own pixels are mixed with the background."""
    core = ndimage.binary_erosion(mask, iterations=2)
    core |= mask & ~ndimage.binary_dilation(core, iterations=4)
    nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    return np.asarray(picture[tuple(nearest)], dtype=np.float32)


def plain_matter(pixels: NDArray[np.uint8], mask: Mask) -> PlainMatter:
    """Return the plain matter of the object ``mask`` (h, w), not empty, in ``pixels`` (h, w, 3) sRGB."""
    size = float(np.sqrt(mask.sum()))
    filled = inner_colours(pixels.astype(np.float32), mask)
    colours, marks = _levelled(filled, mask, size)
    sigma = max(1.5, SMOOTH * size)
    inside = mask.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-3)[..., None]
    low = cv2.GaussianBlur(filled * inside[..., None], (0, 0), sigma) / share
    grain = np.where(mask[..., None], filled - low, 0.0).astype(np.float32)
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    free = mask & ~marks & (depth > min(3.0 + RIM_SHARE * size, 0.5 * float(depth.max())))
    if not free.any():
        free = mask
    power = (grain**2).mean(axis=2)
    weight = free.astype(np.float32)
    around = np.maximum(cv2.GaussianBlur(weight, (0, 0), 3.0 * sigma), 1e-4)
    strength = np.sqrt(cv2.GaussianBlur(power * weight, (0, 0), 3.0 * sigma) / around)
    usual = float(np.percentile(strength[free], USUAL))
    swatch = _swatch(grain, filled, strength, usual, free, size)
    own = float(np.sqrt((swatch**2).mean()))
    contrast = np.clip(np.where(around > 1e-3, strength, usual) / max(own, 1e-3), *CONTRAST).astype(np.float32)
    # Matter's own grain is faint; what is strong everywhere is print, of which hardly anything goes on.
    swatch *= min(1.0, PRINT / max(own, 1e-3)) ** 4
    return PlainMatter(colours, marks, contrast, swatch)


def _levelled(filled: Picture, mask: Mask, size: float) -> tuple[Picture, Mask]:
    """The colours of ``filled`` (h, w, 3) without islands and grain, and the islands (h, w)."""
    height, width = mask.shape
    scale = min(1.0, COARSE / max(height, width))
    shape = (max(4, round(width * scale)), max(4, round(height * scale)))
    small = cv2.resize(filled, shape, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(mask.astype(np.float32), shape, interpolation=cv2.INTER_AREA) > 0.5
    small = cv2.medianBlur(small, MEDIAN) if min(shape) > MEDIAN else small
    lab: Picture = np.asarray(cv2.cvtColor(np.ascontiguousarray(small / 255.0), cv2.COLOR_RGB2LAB), dtype=np.float32)
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    sources = depth <= max(2.0, RIM_SHARE * size * scale)
    plain = np.stack([_without_islands(lab[..., i], sources) for i in range(3)], axis=-1)
    difference = np.linalg.norm((plain - lab) * (0.5, 1.0, 1.0), axis=-1)
    marks = ndimage.binary_dilation(difference > MARK, iterations=2) & inside
    if (inside & ~marks).any():
        # A channel alone may have a way to the outline through a shadow: what is a mark in one goes in all.
        plain = _filled(plain, marks, inside)
    rim = max(2.0, RIM_SHARE * size * scale)
    islands = enclosed(plain, inside, rim) & ~marks
    if islands.any() and (inside & ~marks & ~islands).any():
        marks = marks | islands
        plain = _filled(plain, marks, inside)
    for region, beside in beside_stripes(plain, inside, rim):
        if (inside & ~region & ~marks).any():
            plain[beside] = _without_gaps(plain, inside & ~region & ~marks)[beside]
            marks = marks | beside
    colours: Picture = np.asarray(cv2.cvtColor(plain.astype(np.float32), cv2.COLOR_LAB2RGB), dtype=np.float32) * 255.0
    colours = inner_colours(colours, inside) if inside.any() else colours
    # Edges between colours stay sharp.
    sigma = max(0.8, SMOOTH * size * scale)
    smooth = cv2.bilateralFilter(colours, 2 * round(2.0 * sigma) + 1, EDGE_STEP, sigma)
    smooth = cv2.GaussianBlur(smooth, (0, 0), 0.5 * sigma)
    large = np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    marked = cv2.resize(marks.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return np.clip(large, 0.0, 255.0), marked & mask


def _filled(plain: NDArray[np.float64], marks: Mask, inside: Mask) -> NDArray[np.float64]:
    """``plain`` (h, w, 3), CIELAB, with the ``marks`` (h, w) filled from around.

    Where a part of what is around a mark has another colour than most of its rim, it has no share in it: a patch on a
    cushion that touches the stool's wood is cushion below. What lies on several colours, such as a heart on stripes, is
    filled with patches of them.
    """
    result = _without_gaps(plain, inside & ~marks)
    several = np.zeros_like(marks)
    labels, _ = ndimage.label(marks)
    for number, (rows, columns) in enumerate(ndimage.find_objects(labels), 1):
        reach = NEXT + round(0.5 * float(np.sqrt((labels[rows, columns] == number).sum())))
        window = (
            slice(max(0, rows.start - reach), rows.stop + reach),
            slice(max(0, columns.start - reach), columns.stop + reach),
        )
        own = labels[window] == number
        away = ndimage.distance_transform_edt(~own)
        around = inside[window] & ~marks[window] & (away <= reach)
        rim = around & (away <= NEXT)
        if rim.sum() < LEAST_RIM:
            continue
        difference = (plain[window] - np.median(plain[window][rim], axis=0)) * (0.5, 1.0, 1.0)
        like = around & (np.linalg.norm(difference, axis=-1) <= UNLIKE)
        # Stripes of two colours go on behind it.
        if (like & rim).sum() <= MOST_OF_RIM * rim.sum():
            several[window] |= own
        elif (around & ~like).any():
            result[window][own] = _without_gaps(plain[window], like)[own]
    if several.any() and (inside & ~marks).sum() >= LEAST_SOURCES * marks.sum():
        colours = cv2.cvtColor(result.astype(np.float32), cv2.COLOR_LAB2RGB)
        patched = inpaint_once(
            np.rint(colours * 255.0).astype(np.uint8), several, ~inside | marks, FillOptions(radius=3)
        )
        result[several] = cielab(patched)[several]
    return result


def _without_gaps(values: NDArray[np.float64], known: Mask) -> NDArray[np.float64]:
    """``values`` (h, w, 3) filled where they are not ``known`` (h, w)."""
    weights = known.astype(np.float32)
    filled = [fill_gaps(values[..., i].astype(np.float32), weights) for i in range(3)]
    return np.stack(filled, axis=-1).astype(np.float64)


def _without_islands(values: Picture, sources: Mask) -> NDArray[np.float64]:
    """``values`` (h, w) with what is darker or lighter than every way to ``sources`` (h, w) levelled."""
    if not sources.any():
        return values.astype(np.float64)
    raised = reconstruction(np.where(sources, values, values.max()), values, method="erosion")
    return np.asarray(reconstruction(np.where(sources, raised, raised.min()), raised, method="dilation"))


def _swatch(grain: Picture, filled: Picture, strength: Picture, usual: float, free: Mask, size: float) -> Picture:
    """The square (s, s, 3) of ``grain`` that is most typical of ``free`` (h, w) and has the fewest creases and flecks,
    which would be seen to repeat; one of zeros where there is none. usual: the grain's deviation."""
    typical = np.median(filled[free], axis=0)
    unlike = np.abs(np.log((strength + 1.0) / (usual + 1.0))) + np.abs(filled - typical).mean(axis=2) / 64.0
    unlike += 0.1 * np.minimum((np.abs(grain.mean(axis=2)) / np.maximum(strength, 0.5)) ** 4, 200.0)
    for side in SWATCH_SIDES:
        if side > max(SWATCH_SHARE * size, SWATCH_SIDES[-1]) or side > min(free.shape):
            continue
        known = _window_sums(free.astype(np.float64), side) / side**2
        if not (known >= FREE).any():
            continue
        cost = np.where(known >= FREE, _window_sums(unlike.astype(np.float64), side), np.inf)
        top, left = np.unravel_index(int(np.argmin(cost)), cost.shape)
        part = grain[top : top + side, left : left + side]
        limit = FLECK * float(np.sqrt(np.median(part**2)) / 0.6745)
        part = np.clip(part, -limit, limit)
        return np.asarray(part - part.mean(axis=(0, 1)), dtype=np.float32)
    return np.zeros((SWATCH_SIDES[-1], SWATCH_SIDES[-1], 3), dtype=np.float32)


def _window_sums(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Sums (h − s + 1, w − s + 1) over all squares of ``side`` pixels in ``values`` (h, w)."""
    total = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    return np.asarray(total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side])


def synthesised_grain(swatch: Picture, at: NDArray[np.float64], seed: int) -> Picture:
    """Return grain (n, 3) of mean 0 at points ``at`` (n, 2) of a plane, in pixels of ``swatch`` (s, s, 3).

    seed: planes of different seeds have different patches.
    """
    side = len(swatch)
    # A triangular lattice: each point blends the patches of the three corners around it.
    edge = EDGE * side
    u = at[:, 0] / edge - at[:, 1] / (np.sqrt(3.0) * edge)
    v = at[:, 1] * 2.0 / (np.sqrt(3.0) * edge)
    column, row = np.floor(u), np.floor(v)
    across, down = u - column, v - row
    upper = (across + down > 1.0).astype(np.float64)
    corners = ((upper, upper), (1.0, 0.0), (0.0, 1.0))
    shares = (
        np.abs(1.0 - across - down),
        np.where(upper > 0, 1.0 - down, across),
        np.where(upper > 0, 1.0 - across, down),
    )
    weights = np.stack(shares, axis=-1) ** SHARPNESS
    weights /= np.maximum(np.sqrt((weights**2).sum(axis=1, keepdims=True)), 1e-12)
    result = np.zeros((len(at), 3), dtype=np.float32)
    for (i, j), weight in zip(corners, weights.T, strict=True):
        x0, y0 = column + i, row + j
        used = np.flatnonzero(weight > 0.02)
        # A point is at most an edge away from its corners, so each patch lies inside the square.
        free = side * (1.0 - 2.0 * EDGE)
        centre = EDGE * side + free * _scattered(x0[used].astype(np.int64), y0[used].astype(np.int64), seed)
        middle = np.stack([(x0 + 0.5 * y0) * edge, y0 * (np.sqrt(3.0) / 2.0) * edge], axis=-1)[used]
        place = np.clip(np.floor(at[used] - middle + centre), 0, side - 1).astype(np.int64)
        result[used] += weight[used, None].astype(np.float32) * swatch[place[:, 1], place[:, 0]]
    return result


def _scattered(i: NDArray[np.int64], j: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Numbers (n, 2), 0 to 1, that depend on the cell ``i``, ``j`` and the seed only."""
    mixed = (i * 374761393 + j * 668265263 + seed * 974711) & 0xFFFFFFFF
    result = []
    for factor in (1274126177, 2246822519):
        mixed = ((mixed ^ (mixed >> 13)) * factor) & 0xFFFFFFFF
        mixed = mixed ^ (mixed >> 16)
        result.append((mixed & 0xFFFFFF) / float(0x1000000))
    return np.stack(result, axis=-1)
