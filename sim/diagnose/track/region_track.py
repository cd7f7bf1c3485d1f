# SPDX-License-Identifier: MIT
"""Moving regions → the path of one body: they are linked from frame to frame and over gaps; the freest is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .moving_regions import MovingRegions, Region
from .pose_estimation import Array

LONGEST_GAP = 10
"""Frames without a region after which a path ends; gaps behind an occluder are closed afterwards."""
LONGEST_HIDDEN = 0.35
"""Largest share of the path so far that a body may be hidden before its path goes on."""
LEAST_TRAVEL = 0.5
"""Way in sizes of the body that counts as motion."""
THIN_PX = 0.45
"""Standard deviation across, in working px, below which a region is a column of compression and no body."""
LEAST_FRAMES = 8
"""Frames of the shortest path."""
COLOUR_STEP, SIZE_STEP = 40.0, 0.45
"""Change of colour in grey levels, and of the logarithm of the area, that cost as much as a step of one size."""
AHEAD, ALIKE, ROUND_OFF = 5, 0.3, 0.25
"""Steps on each side that a jump ahead is compared with, largest difference of its neighbours from them, and of the
jump from a whole number of steps."""
TWIN = 0.12
"""A frame counts as a repetition if it differs from the one before by less than this share of the usual change."""


@dataclass(eq=False)
class RegionPath:
    """Regions of one thing, one a frame at most, in the order of frames."""

    regions: list[Region] = field(default_factory=list)

    @property
    def frames(self) -> NDArray[np.int64]:
        """Return the frames (N,) in which it is seen."""
        return np.array([r.frame for r in self.regions], dtype=np.int64)

    @property
    def middles(self) -> Array:
        """Return the centres (N, 2), working px."""
        return np.array([r.middle for r in self.regions]).reshape(-1, 2)

    @property
    def size(self) -> float:
        """Return the median root of the area, working px."""
        return float(np.sqrt(np.median([r.area for r in self.regions])))

    @property
    def travel(self) -> float:
        """Return the length of the smoothed path in working px; a short one may be a toss that turns within it."""
        places = self.middles
        width = int(np.clip(len(places) // 5, 1, 5))
        smooth = np.stack([np.convolve(places[:, i], np.ones(width) / width, mode="valid") for i in (0, 1)], axis=1)
        return float(np.linalg.norm(np.diff(smooth[:: max(1, width - 1)], axis=0), axis=1).sum())

    def velocity(self, last: bool) -> Array:
        """Return px a frame (2,) at the end, or at the beginning."""
        part = self.regions[-5:] if last else self.regions[:5]
        if len(part) < 2:
            return np.zeros(2)
        times = np.array([r.frame for r in part], dtype=np.float64)
        return np.asarray(np.polyfit(times - times[0], np.array([r.middle for r in part]), 1)[0])

    def freedom(self) -> float:
        """Return how much this is a body that moves on its own: its way, less for what changes size, is not solid or
        touches the border."""
        if len(self.regions) < LEAST_FRAMES:
            return 0.0
        inner = [r for r in self.regions if not r.cut]
        if len(inner) < LEAST_FRAMES or self.travel < LEAST_TRAVEL * self.size:
            return 0.0
        if np.median([r.axes[1] for r in inner]) < THIN_PX:
            return 0.0
        across = np.log([r.axes[1] for r in inner])
        steady = float(np.exp(-3.0 * np.median(np.abs(across - np.median(across)))))
        solid = float(np.median([r.solid for r in inner])) ** 3
        slim = float(np.median([r.axes[1] / r.axes[0] for r in inner])) ** 0.5
        # A thing of few pixels is as good as a large one; noise of the same size does not travel.
        return self.travel * steady * solid * slim * len(inner) / len(self.regions) * min(1.0, self.size / 4.0)


def link_regions(found: MovingRegions) -> list[RegionPath]:
    """Return all paths, freest first."""
    live: list[RegionPath] = []
    done: list[RegionPath] = []
    for frame, regions in enumerate(found.regions):
        pairs = []
        for i, path in enumerate(live):
            last = path.regions[-1]
            wait = frame - last.frame
            ahead = last.middle + path.velocity(last=True) * wait
            size = np.sqrt(last.area)
            speed = float(np.linalg.norm(path.velocity(last=True)))
            reach = 1.2 * size + 0.7 * speed * wait + (3.0 * size + 12.0 if len(path.regions) < 3 else 4.0)
            for k, region in enumerate(regions):
                off = min(np.linalg.norm(region.middle - ahead), 1.3 * np.linalg.norm(region.middle - last.middle))
                if off < reach:
                    pairs.append((_cost(last, region, float(off)), i, k))
        taken: set[int] = set()
        used: set[int] = set()
        for cost, i, k in sorted(pairs):
            if i not in used and k not in taken and cost < 6.0:
                live[i].regions.append(regions[k])
                used.add(i)
                taken.add(k)
        ended = [p for p in live if frame - p.regions[-1].frame > LONGEST_GAP]
        done += ended
        live = [p for p in live if frame - p.regions[-1].frame <= LONGEST_GAP]
        live += [RegionPath([r]) for k, r in enumerate(regions) if k not in taken]
    paths = [p for p in done + live if len(p.regions) >= 3]
    return sorted(_joined(paths), key=lambda p: -p.freedom())


def _cost(a: Region, b: Region, off: float) -> float:
    size = np.sqrt(min(a.area, b.area)) + 2.0
    colour = float(np.abs(a.colour - b.colour).max()) / COLOUR_STEP
    return off / size + abs(float(np.log(a.area / b.area))) / SIZE_STEP * 0.5 + 0.5 * colour


def _joined(paths: list[RegionPath]) -> list[RegionPath]:
    """Return ``paths`` with those joined that go on behind something that hides them."""
    paths = sorted(paths, key=lambda p: int(p.frames[0]))
    out: list[RegionPath] = []
    for path in paths:
        best: tuple[float, RegionPath] | None = None
        for before in out:
            gap = int(path.frames[0] - before.frames[-1])
            if not 0 < gap <= max(LONGEST_GAP, LONGEST_HIDDEN * 2 * len(before.regions)):
                continue
            if min(len(path.regions), len(before.regions)) < 4:
                continue
            size = min(path.size, before.size)
            if abs(np.log(path.size / before.size)) > 0.3:
                continue
            a, b = before.velocity(last=True), path.velocity(last=False)
            ahead = before.middles[-1] + 0.5 * (a + b) * gap
            off = float(np.linalg.norm(path.middles[0] - ahead))
            if off < 1.2 * size + 0.2 * gap * np.linalg.norm(a) and np.linalg.norm(a - b) < 0.6 * size:
                cost = off / size + gap / 20
                if best is None or cost < best[0]:
                    best = cost, before
        if best is None:
            out.append(path)
        else:
            best[1].regions.extend(path.regions)
    return out


def true_times(
    stamps: Sequence[float], change: Array, fps: float, override: float | None
) -> tuple[Array, NDArray[np.bool_], str]:
    """Return times (T,) s, whether a frame is new (T,), and a sentence or nothing.

    A recording of fewer frames than its file has shows some twice, at even distances: those are left out, and the rest
    is spread evenly. change: (T,) mean difference from the frame before.
    """
    count = len(stamps)
    if override is not None:
        times = np.arange(count) / override
    else:
        times = np.asarray(stamps, dtype=np.float64)
        if not (np.isfinite(times).all() and (np.diff(times) > 1e-6).all()):
            times = np.arange(count) / (fps or 30.0)
    times = times - times[0]
    usual = float(np.median(change[1:])) if count > 1 else 0.0
    fresh = np.ones(count, dtype=np.bool_)
    fresh[1:] = change[1:] > TWIN * usual
    twins = int((~fresh).sum())
    if twins == 0 or usual <= 0:
        return times, np.ones(count, dtype=np.bool_), ""
    said = f"{twins} of {count} frames repeat the one before and are left out"
    places = np.flatnonzero(~fresh)
    apart = np.diff(places)
    if twins >= 3 and float(apart.std()) < 0.35 * float(apart.mean()) and fresh.sum() >= 3:
        spread = np.linspace(times[0], times[-1], int(fresh.sum()))
        times = times.copy()
        times[fresh] = spread
        said += f"; the others were recorded at {(fresh.sum() - 1) / max(times[-1], 1e-9):.3g} frames per second"
    return times, fresh, said


def with_missing_frames(times: Array, places: Array) -> tuple[Array, int]:
    """Return times (T,) s with the time of frames that a camera has dropped put in, and how many those are.

    A body that jumps ahead by a whole number of its steps, and goes on as before, was not seen in between: an impact
    would have changed its velocity. places: (T, 2) px.
    """
    steps = np.diff(places, axis=0)
    spans = np.diff(times)
    pace = np.linalg.norm(steps, axis=1) / np.maximum(spans, 1e-12)
    added = np.zeros(len(pace))
    for k in range(1, len(pace) - 1):
        near = np.r_[pace[max(0, k - AHEAD) : k], pace[k + 1 : k + 1 + AHEAD]]
        usual = float(np.median(near))
        if usual * spans[k] < 2.0 or np.abs(near - usual).max() > ALIKE * usual:
            continue
        jump = pace[k] / usual
        whole = round(jump)
        if 2 <= whole <= 4 and abs(jump - whole) < ROUND_OFF:
            added[k] = (whole - 1) * spans[k]
    count = int(np.count_nonzero(added))
    return times + np.r_[0.0, np.cumsum(added)], count
