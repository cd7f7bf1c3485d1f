# SPDX-License-Identifier: MIT
"""Scales of the pictures: round ticks, places on the page, curves with no more corners than can be seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...page.markup import short

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Numbers from low to high onto places from start to end; ``root``: their square roots evenly spaced instead."""

    low: float
    high: float
    start: float
    end: float
    root: bool = False

    def __call__(self, value: float) -> float:
        """Where ``value`` is, kept between start and end; start for what is no number."""
        if not math.isfinite(value) or not self.high > self.low:
            return self.start
        share = min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)
        return self.start + (self.end - self.start) * (math.sqrt(share) if self.root else share)

    def ticks(self, count: int = 4) -> list[float]:
        """About ``count`` round numbers between low and high."""
        if self.root:
            return [t for t in (0.0, *_decades(self.high)) if self.low <= t <= self.high]
        return round_numbers(self.low, self.high, count)


def round_numbers(low: float, high: float, count: int = 4) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten between low and high, about ``count`` of them."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return []
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next((power * factor for factor in (1, 2, 5) if power * factor >= rough * 0.999), power * 10)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    if last - first > 100:
        return []
    return [round(index * step, 12) for index in range(first, last + 1)]


def round_up(value: float) -> float:
    """The next 1, 1.5, 2, 3, 4, 5, 6 or 8 times a power of ten; 1 for what is no positive number."""
    if not math.isfinite(value) or not 1e-300 < value < 1e300:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next((power * f for f in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if power * f >= value * 0.9999), power * 10)


def _decades(high: float) -> list[float]:
    """Three round numbers whose square roots are about evenly spaced, the last of them ``high`` or a little less."""
    if not (math.isfinite(high) and high > 0):
        return []
    return sorted({_round_down(high / part) for part in (16, 3.5, 1)})


def _round_down(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return max((power * f for f in (1, 2, 5) if power * f <= value * 1.0001), default=power)


def curve(xs: Sequence[float] | Array, ys: Sequence[float] | Array) -> str:
    """The ``d`` of a path through the places (N,), (N,), broken where one is no number; "" where there is none."""
    parts, pen_down, last = [], False, ""
    for x, y in zip(xs, ys, strict=True):
        if not (math.isfinite(x) and math.isfinite(y)):
            pen_down = False
            continue
        place = f"{short(float(x))} {short(float(y))}"
        if pen_down and place == last:
            continue
        parts.append(f"{'L' if pen_down else 'M'}{place}")
        pen_down, last = True, place
    return "".join(parts)


def peaks(times: Array, values: Array, *, start: float, end: float, count: int) -> tuple[Array, Array]:
    """The largest value in each of ``count`` equal stretches from start to end, (N,) times and values.

    A curve on a page has no more places than this; taking the largest keeps short peaks.
    """
    good = np.isfinite(values) & np.isfinite(times)
    times, values = times[good], values[good]
    if len(times) <= count or end <= start:
        return times, values
    slots = np.clip(((times - start) / (end - start) * count).astype(int), 0, count - 1)
    order = np.lexsort((-values, slots))
    first = np.unique(slots[order], return_index=True)[1]
    chosen = np.sort(order[first])
    return times[chosen], values[chosen]
