# SPDX-License-Identifier: MIT
"""The still background of a video: its frames aligned, and the place behind what moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .pose_estimation import Array
from .video_file import Frame, Video

Picture = NDArray[np.uint8]
WORK_PIXELS = 520_000
"""Pixels of a frame at which regions are found; larger videos are reduced, so that memory is bounded."""
MOST_SAMPLES = 48
"""Frames in memory for the background."""
UNSURE = 10.0
"""Grey levels between the quartiles of a pixel over time above which the median may show the moving body."""
LIKE_AROUND, LEAST_SHARE = 22.0, 0.03
"""Grey levels within which a value counts as that of the surroundings, and least share of them that it must have."""
LIKE_RARE = 12.0
"""Distance in grey levels (BGR) to any pixel of the surroundings, however rare, within which a value counts, too."""
PLAIN_SHARE, PLAIN_BESIDE, PLAIN_SPREAD = 0.4, 0.55, 8.0
"""A hole lies in a plain surface if this share of what is around it, and right beside most of its sides, follows one
smooth course of colours, within three times its scatter, and that is at most so many grey levels."""
LEAST_AROUND = 0.25
"""Share of a hole and its surroundings that has to lie outside of it to tell what is within."""
COMMON = 30
"""Grey levels about the commonest brightness around a hole that belong to the surface at first."""
WIDE = 1.3
"""Area of a hull over its contents from which it is more than the way of one body."""


class Aligner:
    """Maps frames of a slowly drifting camera onto a reference by the background's corners."""

    def __init__(self, reference: Picture) -> None:
        self._grey = cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY)
        corners = cv2.goodFeaturesToTrack(self._grey, 240, 0.01, 12)
        self._corners = np.empty((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._last = np.eye(2, 3)

    def map(self, frame: Picture) -> Array:
        """Return the (2, 3) map from ``frame`` to the reference; the last one where nothing matches."""
        if len(self._corners) < 12:
            return self._last
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        back = cv2.invertAffineTransform(self._last)
        guess = np.ascontiguousarray((self._corners[:, 0] @ back[:, :2].T + back[:, 2])[:, None], dtype=np.float32)
        ends, found, _ = cv2.calcOpticalFlowPyrLK(
            self._grey, grey, self._corners, guess, winSize=(21, 21), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        good = found[:, 0] > 0
        if good.sum() < 10:
            return self._last
        matrix, inliers = cv2.estimateAffinePartial2D(
            ends[good], self._corners[good], method=cv2.RANSAC, ransacReprojThreshold=1.0, maxIters=300
        )
        if matrix is not None and int(inliers.sum()) >= max(8, 0.4 * good.sum()):
            self._last = np.asarray(matrix, np.float64)
        return self._last


def working_scale(width: int, height: int) -> float:
    """Return working pixels per video pixel, at most 1."""
    return min(1.0, float(np.sqrt(WORK_PIXELS / (width * height))))


def reduced(frame: Frame, scale: float) -> Picture:
    """Return the frame's colours (H, W, 3) at the working size."""
    if scale >= 1:
        return frame.colour
    return np.asarray(cv2.resize(frame.colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


STEADY, MOST_GAIN = 0.015, 1.3
"""Relative change of brightness that counts as none, and the largest that is evened out."""


def evenly_lit(picture: Picture, reference: Picture) -> Picture:
    """Return ``picture`` as bright as ``reference``: lamps flicker, and cameras change their exposure.

    The factor is the median over pixels, of which a body covers less than half.
    """
    few = (slice(None, None, 4), slice(None, None, 4), 1)
    ratios = (reference[few].astype(np.float32) + 1) / (picture[few].astype(np.float32) + 1)
    gain = float(np.median(ratios))
    if abs(gain - 1) < STEADY or not 1 / MOST_GAIN < gain < MOST_GAIN:
        return picture
    return np.asarray(cv2.convertScaleAbs(picture, alpha=gain), np.uint8)


def sampled_frames(
    path: Path, start: int, end: int | None, on_frame: Callable[[], None]
) -> tuple[list[Picture], float]:
    """Return frames spread evenly over the video, at the working size."""
    kept: list[Picture] = []
    stride, count = 1, 0
    with Video(path) as video:
        scale = working_scale(video.info.width, video.info.height)
        for frame in video.frames(start, end):
            on_frame()
            if count % stride == 0:
                kept.append(np.array(reduced(frame, scale)))
                if len(kept) > MOST_SAMPLES:
                    kept, stride = kept[::2], 2 * stride
            count += 1
    return kept, scale


def still_background(stack: NDArray[np.uint8]) -> tuple[Picture, Array]:
    """Return the background (H, W, 3) of frames (N, H, W, 3), and each pixel's noise (H, W)."""
    out = np.empty(stack.shape[1:], np.uint8)
    wide = np.empty(stack.shape[1:3])
    noise = np.empty(stack.shape[1:3])
    levels = np.empty((5, *stack.shape[1:]), np.uint8)
    for top in range(0, stack.shape[1], 64):  # in bands: percentiles copy what they sort
        band = np.percentile(stack[:, top : top + 64], (4, 25, 50, 75, 96), axis=0)
        levels[:, top : top + 64] = band.astype(np.uint8)
        wide[top : top + 64] = largest_channel(band[4] - band[0])
        noise[top : top + 64] = largest_channel(band[3] - band[1]) / 1.35
        out[top : top + 64] = band[2].astype(np.uint8)
    unsure = cv2.morphologyEx((wide > UNSURE + 6 * np.median(noise)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    unsure = cv2.morphologyEx(unsure, cv2.MORPH_CLOSE, np.ones((9, 9)))
    filled = np.zeros_like(unsure)
    outlines, _ = cv2.findContours(unsure, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    for outline in outlines:
        if cv2.contourArea(outline) > 30:
            # A slow body covers some pixels all the time: they lie within the hull of those that it leaves.
            hull = cv2.convexHull(outline)
            compact = cv2.contourArea(hull) < WIDE * cv2.contourArea(outline)
            cv2.drawContours(filled, [hull if compact else outline], -1, 1, cv2.FILLED)
    filled = cv2.dilate(filled, np.ones((7, 7), np.uint8))
    return _bare(out, noise, np.asarray(filled, np.uint8), levels) if filled.any() else (out, noise)


def _bare(median: Picture, noise: Array, holes: Picture, levels: NDArray[np.uint8]) -> tuple[Picture, Array]:
    """Return background and noise with what covers ``holes`` for long taken away.

    levels: (5, H, W, 3) percentiles over time. A value counts if its colour occurs around the hole, the median first;
    where none does, the body was there all the time, and the hole is filled from its rim. In a plain surface, a table
    or a wall, the colour expected there decides, so that a body is kept apart from surfaces of similar colour.
    """
    out, noise = median.copy(), noise.copy()
    empty = np.zeros_like(holes)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(holes)
    for k in range(1, count):
        x, y, w, h = (int(v) for v in stats[k, :4])
        pad = int(np.clip(0.25 * max(w, h), 8, 40))
        rows, columns = slice(max(0, y - pad), y + h + pad), slice(max(0, x - pad), x + w + pad)
        inside = labels[rows, columns] == k
        around = median[rows, columns][holes[rows, columns] == 0].astype(np.float32)
        if len(around) < 20 or inside.sum() < 9:
            continue
        plain = _plain_surface(median, holes, (x, y, w, h))
        if plain is not None:
            _bare_plain(out, noise, levels, labels == k, plain)
            continue
        around = around[:: max(1, len(around) // 1500)]
        rules = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 12, 1.0)
        cv2.setRNGSeed(0)
        _, groups, centres = cv2.kmeans(around, min(8, len(around)), None, rules, 1, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
        shares = np.bincount(groups[:, 0], minlength=len(centres)) / len(around)
        centres = centres[shares > LEAST_SHARE]
        seen = levels[:, rows, columns][:, inside][[2, 1, 3, 0, 4]].astype(np.float32)
        off = np.abs(seen[:, :, None] - centres[None, None]).max(axis=-1).min(axis=-1)
        order = np.where(off[0] < LIKE_AROUND, 0, off.argmin(axis=0))
        chosen = seen[order, np.arange(seen.shape[1])]
        unknown = off[order, np.arange(seen.shape[1])] >= LIKE_AROUND
        if unknown.any():
            # Thin things, as the edge of a board that the body slides on, have a small share and a colour of their own.
            apart = cKDTree(around).query(seen[:, unknown])[0]
            rare = np.where(apart[0] < LIKE_RARE, 0, apart.argmin(axis=0))
            known = apart[rare, np.arange(len(rare))] < LIKE_RARE
            at = np.flatnonzero(unknown)[known]
            order[at] = rare[known]
            chosen[at] = seen[order[at], at]
            unknown[at] = False
        part = out[rows, columns]
        part[inside] = chosen.astype(np.uint8)
        # What a body covers for a while leaves the median to one side only; leaves in the wind do to both.
        spread = np.minimum(np.abs(seen[1] - chosen).max(axis=-1), np.abs(seen[2] - chosen).max(axis=-1))
        noise[rows, columns][inside] = np.where(order == 0, 1.5 * spread, 0.0)
        if unknown.any():
            # Beside what is never bare, pixels are bare too briefly to be trusted.
            left, reach = np.zeros(inside.shape, np.uint8), 2 * int(0.06 * max(w, h)) + 3
            left[inside] = unknown
            left = cv2.morphologyEx(left, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
            left = cv2.dilate(left, np.ones((reach, reach), np.uint8))
            empty[rows, columns] |= left & inside.astype(np.uint8)
    if empty.any():
        out = np.asarray(cv2.inpaint(out, empty, 5, cv2.INPAINT_TELEA), np.uint8)
    return out, np.where(noise > 0, noise, float(np.median(noise)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _PlainSurface:
    """Colours that vary smoothly. colours: (H, W, 3) of the whole picture's part ``at``. tolerance: grey levels.
    rare: (N, 3) what stands around and does not follow."""

    at: tuple[slice, slice]
    colours: NDArray[np.float32]
    tolerance: float
    rare: NDArray[np.float32]


def _plain_surface(median: Picture, holes: Picture, box: tuple[int, int, int, int]) -> _PlainSurface | None:
    """Return the smooth surface around the hole in ``box`` (x, y, w, h), extended into it; None if there is none."""
    x, y, w, h = box
    pad = int(np.clip(0.6 * max(w, h), 16, 160))
    at = slice(max(0, y - pad), y + h + pad), slice(max(0, x - pad), x + w + pad)
    near = cv2.dilate(holes[at], np.ones((2 * (max(w, h) // 24) + 3,) * 2, np.uint8))
    part = cv2.GaussianBlur(median[at], (3, 3), 0).astype(np.float32)
    rows, columns = np.mgrid[0 : part.shape[0], 0 : part.shape[1]].astype(np.float32)
    v, u = rows / part.shape[0] - 0.5, columns / part.shape[1] - 0.5
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    around = np.flatnonzero(near.ravel() == 0)
    ring = (cv2.dilate(near, np.ones((2 * (pad // 3) + 1,) * 2, np.uint8)) > near).ravel()
    top, left = y - at[0].start, x - at[1].start
    sides = [(ring & away.ravel()) for away in (rows < top, rows >= top + h, columns < left, columns >= left + w)]
    # Beside a large hole most of what is left may be something else: then the median within it counts, too.
    for free in (around, np.arange(near.size)):
        if len(free) < max(60, LEAST_AROUND * near.size):
            continue
        free = free[:: max(1, len(free) // 4000)]
        a, b = terms.reshape(-1, 6)[free].astype(np.float64), part.reshape(-1, 3)[free].astype(np.float64)
        # Something else stands beside many a table: what has the commonest brightness begins, and counts alone for
        # how much the surface scatters.
        grey = b.mean(axis=1)
        common = np.convolve(np.bincount(grey.astype(int), minlength=256), np.ones(2 * COMMON + 1), "same").argmax()
        weights = (np.abs(grey - common) <= COMMON).astype(np.float64)
        off, usual, fit = np.zeros(len(a)), 0.0, np.zeros((6, 3))
        for step in range(16):
            fit = np.linalg.lstsq(a * weights[:, None], b * weights[:, None], rcond=None)[0]
            off = np.abs(b - a @ fit).max(axis=1)
            own = weights > 0 if step == 0 else off < 3 * usual
            # A fit that has left all of its pixels begins anew with all.
            usual = max(float(np.median(off[own] if own.any() else off)), 0.5)
            weights = 1.0 / np.maximum(1.0, off / usual) * (1.0 if step < 8 else off < 6 * usual)
        spread = max(1.48 * usual, 1.0)
        # A table below a hedge is plain, and says nothing about the hedge: it has to lie on most sides of the hole.
        plain = off < 3 * spread
        beside = [plain[side[free]].mean() >= PLAIN_BESIDE for side in sides if side[free].sum() >= 12]
        if spread <= PLAIN_SPREAD and plain.mean() >= PLAIN_SHARE and 2 * sum(beside) > len(beside):
            break
    else:
        return None
    rare = part.reshape(-1, 3)[free][off > 6 * spread]
    return _PlainSurface(
        at=at, colours=(terms @ fit).clip(0, 255).astype(np.float32), tolerance=3 * spread, rare=rare[:1500]
    )


def _bare_plain(
    out: Picture, noise: Array, levels: NDArray[np.uint8], hole: NDArray[np.bool_], plain: _PlainSurface
) -> None:
    """Fill ``hole`` (H, W) of ``out`` and ``noise`` by what was seen there of the surface, or of rare things around."""
    inside = hole[plain.at]
    wanted = plain.colours[inside]
    seen = levels[:, plain.at[0], plain.at[1]][:, inside][[2, 1, 3, 0, 4]].astype(np.float32)
    off = np.abs(seen - wanted).max(axis=-1)
    order = np.where(off[0] < plain.tolerance, 0, off.argmin(axis=0))
    chosen = seen[order, np.arange(len(wanted))]
    strange = off[order, np.arange(len(wanted))] >= plain.tolerance
    chosen[strange] = wanted[strange]
    if strange.any() and len(plain.rare) >= 20:
        apart = cKDTree(plain.rare).query(seen[:, strange])[0]
        rare = np.where(apart[0] < LIKE_RARE, 0, apart.argmin(axis=0))
        known = apart[rare, np.arange(len(rare))] < LIKE_RARE
        places = np.flatnonzero(strange)[known]
        chosen[places] = seen[rare[known], places]
    # A hull reaches over things that stand still beside the body's way: what never changes and goes on outside of the
    # hole is one of them.
    still = np.zeros(inside.shape, np.uint8)
    still[inside] = strange & (np.abs(seen[4] - seen[3]).max(axis=-1) < plain.tolerance)
    rim = cv2.dilate((~inside).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, things = cv2.connectedComponents(still)
    stays = (still > 0) & np.isin(things, np.unique(things[rim & (still > 0)]))
    chosen[stays[inside]] = seen[0][stays[inside]]
    out[plain.at][inside] = chosen.round().astype(np.uint8)
    noise[plain.at][inside] = plain.tolerance / 3


def warped(picture: Picture, matrix: Array) -> Picture:
    """Return the picture (H, W, 3) mapped by the (2, 3) ``matrix``, its border repeated."""
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.warpAffine(picture, matrix, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def largest_channel(colours: NDArray[Any]) -> NDArray[Any]:
    """Return (H, W) the largest channel of (H, W, 3); numpy reduces a short last axis ten times slower."""
    b, g, r = cv2.split(colours)
    return np.asarray(cv2.max(cv2.max(b, g), r))


def least_channel(colours: NDArray[Any]) -> NDArray[Any]:
    """Return (H, W) the least channel of (H, W, 3)."""
    b, g, r = cv2.split(colours)
    return np.asarray(cv2.min(cv2.min(b, g), r))


def difference(picture: Picture, background: Picture) -> NDArray[np.float32]:
    """Return (H, W) the largest difference of a channel, grey levels, smoothed over neighbours."""
    return np.asarray(cv2.GaussianBlur(largest_channel(cv2.absdiff(picture, background)).astype(np.float32), (3, 3), 0))
