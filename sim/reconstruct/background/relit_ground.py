# SPDX-License-Identifier: MIT
"""Ground in shadow keeps its texture: only the light that it lacks is put back, and the rest of the hole is smaller.

A shadow, or a mirror image that was not wholly taken out, changes the ground's level and leaves its pattern in sight.
What the level should be is continued from the border of the hole as a membrane (Pérez et al., Poisson image editing,
SIGGRAPH 2003) over a smooth field of light, with what the ground's own autocovariance predicts of its pattern. The
lack is the difference from that without its detail: a field that is smooth but for steps (``piecewise_light``), which
are the shadows' edges. Where the lack is too deep, steps too suddenly for a coarse copy, or leaves colours that the
surface or the border of the hole has nowhere, the place is inpainted.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from ...robust_deviation import robust_deviation
from .piecewise_light import piecewise_smooth
from .surface_inpainting import AXES, light_field, logarithms
from .texture_prediction import predict_texture

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

CELLS = 80_000
"""Largest size of the copy on which levels are compared."""
MARGIN = 0.6
"""Margin of the photo around the hole, over its larger extent."""
FINE, COARSE = 0.0125, 0.2
"""Blurs over the hole's size: of the level along its border, and beyond which a colour is the surface's own."""
DETAIL = 0.003
"""Penalty on steps of the lack of light in logarithms times cells, over the hole's size in cells. A shadow that takes
a tenth of the light is kept apart from the pattern if it is wider than an eighth of the hole."""
CHECKED = 0.1
"""Blur over the hole's size beyond which a prediction of the pattern is compared with the ground seen in the hole: a
shadow's light is smooth below it but for edges, which no prediction knows. Measured slopes: 0.00 to 0.04 on rock, 1 on
stripes."""
HELD = 5.0
"""Weight of the known ground, which lacks nothing, over that of a cell of the hole."""
SUDDEN = 0.06
"""Deviation in logarithms of the lack from its blurred copy above which it steps too suddenly: the cells' borders would
show."""
STRANGE = 3.0
"""The same beyond which a colour is not the surface's."""
LEAST = 0.015
"""Smallest deviation in logarithms: below it is noise."""
DEEPEST = 0.5
"""Lack in logarithms of sRGB values, a third of the light, above which noise and the shadow's own tint would show."""
TINT, TINTED = np.array([0.8, 2.5], dtype=np.float32), 0.2
"""Most by which a shadow changes the colour differences of ``AXES`` over what it takes of the lightness, and beyond
that: what changes them more is another surface. On orange wood, which is redder in the shade, it is 0.6 and 1.7."""
BEYOND = np.array([0.2, 0.1, 0.1], dtype=np.float32)
"""Most by which the level, which follows a smooth field of light, may leave the membrane of the colours around the
hole, in logarithms, along ``AXES``: a field is a polynomial, and goes off where little is seen."""
MOSTLY = 0.3
"""Share of the ground that could be put back beyond that, above which the field tells nothing."""
SLIVER = 0.02
"""Half the least width over the hole's size of a part whose light is put back."""
FEWEST = 40
"""Fewest cells of shaded ground, and of ground around it."""
RIM = 10.0
"""Pixels at 1024 around objects that are always inpainted: their outline may be wrong by so much, and there shadows are
deepest."""


def membrane(values: Picture, fixed: Mask, free: Mask) -> Picture:
    """Return ``values`` (h, w, c) continued from the pixels ``fixed`` (h, w) over ``free`` without curvature.

    It solves Laplace's equation with the values at ``fixed``, and no flux across any other border. 0 in parts of
    ``free`` that touch no fixed pixel; elsewhere as given.
    """
    free = free & ~fixed
    count = int(free.sum())
    result = values.astype(np.float32, copy=True)
    if not count:
        return result
    index = np.full(free.shape, -1, dtype=np.int64)
    index[free] = np.arange(count)
    diagonal = np.full(count, 1e-7)
    target = np.zeros((count, values.shape[-1]))
    entries: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    ahead, behind = slice(1, None), slice(None, -1)
    whole = slice(None)
    for mine, other in (
        ((ahead, whole), (behind, whole)),
        ((behind, whole), (ahead, whole)),
        ((whole, ahead), (whole, behind)),
        ((whole, behind), (whole, ahead)),
    ):
        both = free[mine] & free[other]
        entries.append((index[mine][both], index[other][both]))
        held = free[mine] & fixed[other]
        np.add.at(target, index[mine][held], values[other][held])
        for joined in (both, held):
            np.add.at(diagonal, index[mine][joined], 1.0)
    rows, columns = (np.concatenate(part) for part in zip(*entries, strict=True))
    system = sparse.csc_matrix((np.full(len(rows), -1.0), (rows, columns)), shape=(count, count))
    system = (system + sparse.diags(diagonal)).tocsc()
    result[free] = linalg.splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(target)
    return result


FINEST_BLUR = 6.0
"""Pixels; wider blurs are made on a copy on which they are that wide."""
MEMBRANE_PIXELS = 30_000
"""Largest size of the copy on which a membrane over a full picture is solved: it has no detail."""


def continued(values: Picture, fixed: Mask, free: Mask) -> Picture:
    """Return the ``membrane`` over ``free`` (h, w) at full size, solved on a smaller copy; 0 where there is none."""
    height, width = free.shape
    scale = min(1.0, float(np.sqrt(MEMBRANE_PIXELS / free.size)))
    if scale > 0.9:
        return np.where((free | fixed)[..., None], membrane(values, fixed, free), 0.0).astype(np.float32)
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    held = fixed.astype(np.float32)
    total, share, inner = (
        cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        for part in (np.asarray(values * held[..., None], np.float32), held, free.astype(np.float32))
    )
    means = np.asarray(total.reshape(*share.shape, -1) / np.maximum(share, 1e-6)[..., None], dtype=np.float32)
    small = membrane(means, share > 0.0, inner > 0.0)
    # What is interpolated beside the border must not mix in cells that the membrane does not cover.
    covered = (share > 0.0) | (inner > 0.0)
    small = np.where(covered[..., None], small, smoothed(small, covered, 1.0))
    whole = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole.reshape(values.shape), dtype=np.float32)


def smoothed(values: Picture, where: Mask, blur: float) -> Picture:
    """Return the mean (h, w, c) of ``values`` over pixels ``where`` (h, w) nearby; 0 where none is near."""
    height, width = where.shape
    weight = where.astype(np.float32)
    total = np.ascontiguousarray(values * weight[..., None], dtype=np.float32)
    scale = min(1.0, FINEST_BLUR / blur)
    if scale < 0.7:
        # A wide blur of a smaller copy is the same in a fraction of the time.
        size = (max(4, round(width * scale)), max(4, round(height * scale)))
        total, weight = (
            np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.float32) for part in (total, weight)
        )
        blur *= size[0] / width
    sums = cv2.GaussianBlur(total, (0, 0), blur).reshape(*weight.shape, -1)
    mean = np.asarray(sums / np.maximum(cv2.GaussianBlur(weight, (0, 0), blur), 1e-6)[..., None], dtype=np.float32)
    if scale < 0.7:
        whole = cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(whole.reshape(values.shape), dtype=np.float32)
    return mean


def near_any(where: Mask, blur: float) -> Mask:
    """Return the pixels (h, w) for which ``smoothed`` finds pixels ``where``."""
    return np.asarray(cv2.GaussianBlur(where.astype(np.float32), (0, 0), blur) > 1e-3)


@dataclass(frozen=True)
class _Cells:
    """A coarse copy around the hole: logarithms (h, w, 3); cells of known ground, of the hole, and of its core, which
    is inpainted in any case."""

    logs: Picture
    known: Mask
    hole: Mask
    core: Mask

    @property
    def side(self) -> float:
        """Size of the hole in cells."""
        return float(np.sqrt(max(int(self.hole.sum()), 1)))


def relit(
    picture: Picture, target: Mask, closed: Mask, objects: Mask, changed: Mask | None = None
) -> tuple[Picture, Mask]:
    """Return ``picture`` (H, W, 3), 0 to 255, with the light that the ground in ``target`` (H, W) lacks put back, and
    what of ``target`` is left to inpaint.

    One surface. closed: (H, W) other pixels that say nothing about it. objects: (H, W) pixels that do not show the
    ground. changed: (H, W) where something was taken out of the picture, such as a mirror image; there the level may
    have to fall as well. Outside of ``target`` the picture is returned as it is.
    """
    rows, columns = np.flatnonzero(target.any(axis=1)), np.flatnonzero(target.any(axis=0))
    room = round(MARGIN * max(np.ptp(rows), np.ptp(columns))) + 8
    window = (
        slice(max(0, int(rows[0]) - room), int(rows[-1]) + 1 + room),
        slice(max(0, int(columns[0]) - room), int(columns[-1]) + 1 + room),
    )
    inside = target[window]
    height, width = inside.shape
    reach = RIM * max(target.shape) / 1024.0
    near = objects[window] & inside
    if near.any():
        near = cv2.distanceTransform((~near).astype(np.uint8), cv2.DIST_L2, 5) <= reach
    shaded = inside & ~near
    scale = min(1.0, float(np.sqrt(CELLS / inside.size)))
    if shaded.sum() * scale**2 < FEWEST:
        return picture, target
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    logs = logarithms(picture[window])

    def part_of(mask: Mask) -> Picture:
        return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA))

    cut = part_of(inside)
    cells = _Cells(
        logs=np.asarray(cv2.resize(logs, size, interpolation=cv2.INTER_AREA), dtype=np.float32),
        known=np.asarray((part_of(closed[window] & ~inside) + cut) < 1e-3),
        hole=np.asarray(cut > 0.0),
        core=np.asarray(part_of(near & inside) > 0.0),
    )
    if cells.known.sum() < FEWEST:
        return picture, target
    lack, trusted = _lack(cells, None if changed is None else part_of(changed[window]) > 0.0)
    gain = cv2.resize(lack, (width, height), interpolation=cv2.INTER_LINEAR)
    sure = cv2.resize(trusted.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    take = shaded & sure
    result = picture.copy()
    result[window] = np.where(take[..., None], np.exp(logs + gain), picture[window])
    left = target.copy()
    left[window] &= ~take
    return result, left


def _lack(cells: _Cells, changed: Mask | None) -> tuple[Picture, Mask]:
    """The light (h, w, 3) that the cells of the hole lack, in logarithms, and where that is sure."""
    slow, _ = light_field(cells.logs, cells.known, cells.hole)
    pattern = cells.logs - slow
    # The border's level, not its single pixels, is continued inside.
    both = _continued_border(np.concatenate([pattern, cells.logs], axis=-1).astype(np.float32), cells)
    level, around_it = both[..., :3], both[..., 3:]
    beyond = (np.abs((slow + level - around_it) @ AXES.T) > BEYOND).any(axis=-1)
    away = cv2.distanceTransform((~cells.hole).astype(np.uint8), cv2.DIST_L2, 5)
    around = cells.known & (away > 2.0)
    if around.sum() < FEWEST:
        around = cells.known
    altered = np.zeros_like(cells.hole) if changed is None else changed
    chosen = _steps((_foreseen(pattern, cells) + (level - pattern) @ AXES.T).astype(np.float32), cells)
    blurred = cv2.GaussianBlur(chosen, (0, 0), max(1.0, FINE * cells.side))
    sudden = (np.abs(chosen - blurred) > SUDDEN).any(axis=-1)
    usual = smoothed(pattern, cells.known, max(1.0, COARSE * cells.side)) @ AXES.T
    lack = np.asarray(cv2.GaussianBlur(chosen, (0, 0), 1.0))
    axes = pattern @ AXES.T
    own = axes - level @ AXES.T + lack
    strange = np.abs(own) > STRANGE * np.maximum(_deviations((axes - usual)[around]), 2.0 * LEAST)
    strange[..., 1:] |= np.abs(lack[..., 1:]) > TINT * np.abs(lack[..., :1]) + TINTED
    trusted = ~strange.any(axis=-1) & (np.abs(lack[..., 0]) < DEEPEST) & ~cells.core & ~sudden
    told = trusted & cells.hole
    trusted &= ~beyond & ((told & beyond).sum() <= MOSTLY * told.sum())
    # Between what is inpainted, slivers of the photo would be islands.
    wide = 2 * max(1, round(SLIVER * cells.side)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    # Beyond the border of the photo goes on what is beside it: that is eroded, but nothing grows in from there.
    sure = cv2.erode((trusted | cells.known).astype(np.uint8), disc, borderType=cv2.BORDER_REPLICATE)
    sure = cv2.dilate(sure, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    trusted = cv2.erode(sure, np.ones((3, 3), np.uint8), borderValue=1) > 0
    # A shadow takes light away.
    lack[..., 0] = np.where(altered, lack[..., 0], np.maximum(lack[..., 0], 0.0))
    back = lack @ np.linalg.inv(AXES).T.astype(np.float32)
    return np.asarray(back, dtype=np.float32), np.asarray(trusted)


def _continued_border(values: Picture, cells: _Cells) -> Picture:
    """``values`` (h, w, c) of the known cells, and in the hole their level along its border continued as a membrane."""
    border = smoothed(values, cells.known, max(1.0, FINE * cells.side))
    return membrane(np.where(cells.known[..., None], border, 0.0).astype(np.float32), cells.known, cells.hole)


def _foreseen(pattern: Picture, cells: _Cells) -> Picture:
    """What the known cells predict of ``pattern`` (h, w, 3) in the hole beyond its level, along ``AXES``; 0 elsewhere.

    Broad stripes would else be taken for shadows. It counts as far as the ground that is seen in the hole agrees: on an
    irregular ground it is chance, and what is put back for it would be stains.
    """
    values = np.where(cells.known[..., None], pattern - pattern[cells.known].mean(axis=0), 0.0).astype(np.float32)
    found, _ = predict_texture(values, cells.known, cells.hole)
    foreseen = np.where(cells.hole[..., None], found - _continued_border(found, cells), 0.0) @ AXES.T
    seen, blur = cells.hole & ~cells.core, max(1.0, CHECKED * cells.side)
    guess, truth = (
        (values - smoothed(np.asarray(values, np.float32), seen, blur))[seen] for values in (foreseen, pattern @ AXES.T)
    )
    # The slope (3,) of what is seen over what was foreseen: 1 where it is right.
    slope = (guess * truth).sum(axis=0) / (np.square(guess).sum(axis=0) + len(guess) * LEAST**2)
    return np.asarray(foreseen * np.clip(slope, 0.0, 1.0), dtype=np.float32)


def _steps(difference: Picture, cells: _Cells) -> Picture:
    """``difference`` (h, w, 3) of the hole's visible ground without its detail, over all of the hole; 0 elsewhere."""
    near = cv2.dilate(cells.hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    window = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    hole, seen = cells.hole[window], (cells.hole & ~cells.core)[window]
    weight = np.where(cells.known[window], HELD, seen).astype(np.float32)
    values = np.where(seen[..., None], difference[window], 0.0).astype(np.float32)
    result = np.zeros_like(difference)
    result[window] = np.where(hole[..., None], piecewise_smooth(values, weight, DETAIL * cells.side), 0.0)
    return result


def _deviations(values: Picture) -> Picture:
    """Robust standard deviations (c,) of ``values`` (n, c) about their medians."""
    return np.asarray(robust_deviation(values - np.median(values, axis=0), axis=0), dtype=np.float32)
