# SPDX-License-Identifier: MIT
"""Legs of a silhouette: runs of the outline that end below, and the depths at which their feet stand.

A foot farther up in the photo stands farther back. Legs are upright, so each is as far away as its foot; what they
carry lies between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from ...scene.model import Camera
from ..camera.ground_camera import on_ground

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

JUNCTION = 1.6
"""Width over a leg's own at which it has met something else."""
BESIDE = 3.2
"""Width over a leg's own up to which a step in one of its sides is another leg beside it."""
STEP = (2.0, 0.15)
"""Step from one row to the next that is such a step: pixels, and share of the width; the larger."""
FOOT = 0.5
"""Height of a foot, over a leg's width, up to which it may grow."""
STRAIGHT = 0.16
"""Largest deviation of a straight leg's sides from lines, over its width."""
TAPERED = 0.3
"""Largest standard deviation of a straight leg's width, over its width."""


@dataclass(frozen=True)
class Leg:
    """A leg in a mask. rows: (n,) from the foot upwards; left, right: (n,) its columns, right exclusive; width: pixels;
    foot: (2,) x, y of the middle of its lower end. beside: whether another leg is seen beside it."""

    rows: NDArray[np.int64]
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    width: float
    foot: Points
    beside: bool = False

    @property
    def straight(self) -> bool:
        """Return whether its sides are straight, and it is as wide above as below."""
        ends = len(self.rows) // 8
        keep = slice(min(ends, 4), len(self.rows) - ends)
        rows, left, right = (side[keep].astype(np.float64) for side in (self.rows, self.left, self.right))
        if len(rows) < 4 or float((right - left).std()) > TAPERED * self.width + 0.5:
            return False
        off = [float(np.std(side - np.polyval(np.polyfit(rows, side, 1), rows))) for side in (left, right)]
        return max(off) <= STRAIGHT * self.width + 0.5

    def region(self, shape: tuple[int, ...]) -> Mask:
        """Return its pixels (h, w)."""
        found = np.zeros(shape, dtype=bool)
        for row, left, right in zip(self.rows, self.left, self.right, strict=True):
            found[row, left:right] = True
        return found

    def lowness(self, shape: tuple[int, ...]) -> Points:
        """Return (h, w) how low its pixels are: 1 at the foot, 0 from ``HIGH`` on and outside of it."""
        rows = np.arange(shape[0])
        high = (self.foot[1] - 1.0 - rows) / (HIGH * self.width)
        low = np.clip(1.0 - high**2, 0.0, 1.0)[:, None]
        return np.asarray(np.where(self.region(shape), low, 0.0), dtype=np.float64)


def outline_size(mask: Mask) -> float:
    """Return the longer side in pixels of the bounding box of ``mask`` (H, W)."""
    return float(max(np.ptp(np.flatnonzero(mask.any(axis=axis))) for axis in (0, 1)) + 1)


def find_legs(mask: Mask, widest: float, longest: float) -> list[Leg]:
    """Return the legs in ``mask`` (h, w) from left to right: at most ``widest`` pixels wide, at least ``longest`` times
    as long as wide."""
    lowest = np.where(mask.any(axis=0), mask.shape[0] - 1 - np.argmax(mask[::-1], axis=0), -1)
    legs: list[Leg] = []
    starts, ends = _runs(mask)
    taken = np.zeros(mask.shape[1], dtype=bool)
    for column in np.argsort(-lowest, kind="stable"):
        if lowest[column] < 0 or taken[column]:
            continue
        leg = _leg(mask, starts, ends, int(column), int(lowest[column]), widest)
        if leg is None:
            taken[column] = True
            continue
        span = slice(max(0, int(leg.left[:4].min()) - 1), int(leg.right[:4].max()) + 1)
        new = not taken[span].any()
        taken[span] = True
        if new and leg.width <= widest and len(leg.rows) >= longest * leg.width:
            legs.append(leg)
    return sorted(legs, key=lambda leg: float(leg.foot[0]))


def _runs(mask: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First column of the run of each pixel of ``mask`` (h, w) in its row, and the column after its last."""
    columns = np.arange(mask.shape[1])
    starts = np.maximum.accumulate(np.where(mask, 0, columns + 1), axis=1)
    ends = np.minimum.accumulate(np.where(mask, mask.shape[1], columns)[:, ::-1], axis=1)[:, ::-1]
    return starts, ends


def _leg(
    mask: Mask, starts: NDArray[np.intp], ends: NDArray[np.intp], column: int, bottom: int, widest: float
) -> Leg | None:
    """The run of ``mask`` upwards from its lower end at ``column``, ``bottom``; None if it is wider than ``widest``.

    starts, ends: of ``_runs``.
    """
    rows: list[int] = []
    left: list[int] = []
    right: list[int] = []
    low, high = column, column + 1
    beside, own = 0, 0.0
    for row in range(bottom, -1, -1):
        inside = mask[row, low:high].nonzero()[0]
        if not len(inside):
            break
        at = low + int(inside[len(inside) // 2])
        start, end = int(starts[row, at]), int(ends[row, at])
        # A foot that is seen at a slant grows to its width first.
        if len(rows) >= 6 and len(rows) >= FOOT * (right[-1] - left[-1]):
            if own == 0.0 or len(rows) < 12 or len(rows) % 8 == 0:
                own = float(np.median(np.subtract(right, left)))
            if own > 2.0 * widest:
                return None
            jump = max(STEP[0], STEP[1] * own)
            wider = (left[-1] - start > jump, end - right[-1] > jump)
            if end - start > BESIDE * own or all(wider):
                break
            # A step on one side is another leg beside this one.
            if wider[0]:
                start, beside = left[-1] + end - right[-1], beside + 1
            elif wider[1]:
                end, beside = right[-1] + start - left[-1], beside + 1
            if end - start > JUNCTION * own + 1.0:
                break
        rows.append(row)
        left.append(start)
        right.append(end)
        low, high = start, end
    if len(rows) < 6:
        return None
    width = float(np.median(np.subtract(right, left)))
    middle = (left[2] + right[2]) / 2.0
    return Leg(np.array(rows), np.array(left), np.array(right), width, np.array([middle, bottom + 1.0]), beside >= 4)


FAT = 0.75
"""Largest width of a leg over that of the body's thickest part."""
SHORT = 1.8
"""Least length of a leg over its width."""
FARTHEST = 0.5
"""Largest distance of a foot behind the foremost one, over the body's width; others hang in the air."""
SLOPE = 0.15
"""Smoothing of distances, over the width of legs."""
LOWEST = 0.03
"""Height of the foremost foot over the outline's lowest point, over its longer side: what stands on legs touches the
ground with nothing else."""
HIGH = 1.2
"""Height of feet over the width of their legs: what may reach farther than the leg that stands on it."""
COARSE = 90
"""Pixels along the longer side of the grid on which depth is carried from the legs through the body."""


@dataclass(frozen=True)
class StandingDepth:
    """Where a body on legs is. away: (h, w) units along the ground from the camera; low: (h, w) 1 at the feet, fading
    to 0 above them; radius: half the width of a leg, units; legs: how many are seen."""

    away: Points
    low: Points
    radius: float
    legs: int


def standing_depth(camera: Camera, mask: Mask, distance: Points, left: int, top: int) -> StandingDepth | None:
    """Return where a body that stands on legs is; None unless two or more are visible.

    mask, distance: (h, w) on a crop whose first pixel's corner is at the photo's pixel ``left``, ``top``. Legs are as
    far away as their feet; elsewhere the distance is harmonic, without flow through the outline.
    """
    legs = find_legs(mask, FAT * 2.0 * float(distance.max()), SHORT)
    if len(legs) < 2:
        return None
    corner = np.array([left, top], dtype=np.float64)
    feet = np.array([leg.foot for leg in legs]) + corner
    ground = on_ground(camera, feet)
    columns = np.flatnonzero(mask.any(axis=0))
    finite = np.isfinite(ground).all(axis=1)
    if not finite.any():
        return None
    nearest = ground[finite, 1].min()
    unit = float(camera.project(ground[finite][int(np.argmin(ground[finite, 1]))])[2]) / camera.fx
    stands = finite & (ground[:, 1] - nearest < FARTHEST * len(columns) * unit)
    chosen = [leg for leg, keep in zip(legs, stands, strict=True) if keep]
    lowest = np.flatnonzero(mask.any(axis=1))[-1] + 1.0
    if len(chosen) < 2 or lowest - max(leg.foot[1] for leg in chosen) > LOWEST * outline_size(mask):
        return None
    away = np.full(mask.shape, np.nan)
    pinned = np.zeros_like(mask)
    for leg, place in zip(chosen, ground[stands], strict=True):
        ray = camera.rays(leg.foot + corner)
        declination = float(np.arctan2(-ray[2], np.hypot(ray[0], ray[1])))
        region = leg.region(mask.shape) & mask
        # The middle of a round foot is behind the point that touches its line of sight.
        away[region & ~pinned] = place[1] + 0.5 * leg.width * unit * np.tan(declination / 2.0)
        pinned |= region
    # Between two legs of different distance side by side there is a slope, not a cliff.
    slope = SLOPE * float(np.median([leg.width for leg in chosen]))
    low = np.asarray(np.max([leg.lowness(mask.shape) for leg in chosen], axis=0), dtype=np.float64)
    radius = 0.5 * unit * float(np.median([leg.width for leg in chosen]))
    return StandingDepth(_carried(mask, away, pinned, slope), low, radius, len(chosen))


def _carried(mask: Mask, values: Points, pinned: Mask, slope: float) -> Points:
    """``values`` (h, w) of the ``pinned`` pixels carried through ``mask`` harmonically, and beyond it by nearness;
    smooth over ``slope`` pixels."""
    height, width = mask.shape
    step = max(1, int(np.ceil(max(mask.shape) / COARSE)))
    rows, columns = -(-height // step), -(-width // step)
    cell = (np.arange(height) // step)[:, None] * columns + (np.arange(width) // step)[None, :]
    count = rows * columns
    inside = np.bincount(cell[mask], minlength=count) > 0
    weight = np.bincount(cell[pinned], minlength=count).astype(np.float64)
    given = np.bincount(cell[pinned], weights=values[pinned], minlength=count) / np.maximum(weight, 1e-12)
    index = np.full(count, -1)
    index[inside] = np.arange(int(inside.sum()))
    grid = index.reshape(rows, columns)
    pairs = [(grid[:, :-1].ravel(), grid[:, 1:].ravel()), (grid[:-1].ravel(), grid[1:].ravel())]
    first, second = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
    linked = (first >= 0) & (second >= 0)
    first, second = first[linked], second[linked]
    size = int(inside.sum())
    links = sparse.coo_matrix((np.ones(len(first)), (first, second)), (size, size)).tocsr()
    links = links + links.T
    # A pin is a strong spring; a weak one everywhere keeps cells without any link determined.
    pin = 1e4 * (weight[inside] > 0) + 1e-9
    mean = float(values[pinned].mean())
    right = np.where(weight[inside] > 0, given[inside], mean) * pin
    matrix = sparse.diags(np.asarray(links.sum(axis=1)).ravel() + pin) - links
    solved = np.full(count, np.nan)
    solved[inside] = spsolve(matrix.tocsc(), right)
    coarse = solved.reshape(rows, columns)
    nearest = ndimage.distance_transform_edt(np.isnan(coarse), return_distances=False, return_indices=True)
    coarse = coarse[tuple(nearest)]
    fine = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)[:height, :width]
    return np.asarray(ndimage.gaussian_filter(fine, max(0.5 * step, slope), mode="nearest"), dtype=np.float64)
