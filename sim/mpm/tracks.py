# SPDX-License-Identifier: MIT
"""Values over time: keyframes with straight lines between them. No Taichi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

SAME_TIME = 1e-5
"""Events closer than this in s happen together. Contacts take out overlap within a substep, so that one which only
fills the gap between two keyframes that were meant to be one, 1e-7 s long, would throw what it touches."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Keyframes: ``values`` (K, ...) at ``times`` (K,) in s, linear between them, constant before and after.

    Raises InputError unless the times rise and all numbers are finite.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        times = np.ascontiguousarray(self.times, dtype=np.float64)
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if times.ndim != 1 or len(times) == 0 or len(values) != len(times):
            raise InputError(f"track times has shape {times.shape} and values {values.shape}: give one value a time")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError("track times do not rise: give finite seconds in rising order, each once")
        if not np.isfinite(values).all():
            raise InputError("track values are not finite: remove NaN and infinite numbers")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    def at(self, time: float) -> NDArray[np.float64]:
        """The value at ``time`` in s."""
        i = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(len(self.times) - 2, 0)))
        if len(self.times) == 1:
            return np.asarray(self.values[0])
        share = np.clip((time - self.times[i]) / (self.times[i + 1] - self.times[i]), 0.0, 1.0)
        return np.asarray((1 - share) * self.values[i] + share * self.values[i + 1])

    def knots(self, start: float, end: float) -> list[float]:
        """Times of keyframes strictly between ``start`` and ``end``, where the slope changes."""
        return [float(t) for t in self.times if start < t < end]
