# SPDX-License-Identifier: MIT
"""The budget of a diagnosis, counted in simulated steps: the clock decides nothing, so a verdict can be repeated.

A time is turned into work at a fixed rate, measured once (docs/measurements.md) and written into the report: the same
``--budget`` is the same work on any machine and at any load.
"""

from __future__ import annotations

from dataclasses import dataclass, field

RIGID_RATE = 1_000_000
"""Work per second of a diagnosis of rigid bodies: steps of all worlds, and ``LAUNCH`` for every launch."""

SOFT_RATE = 30_000_000
"""Work per second of a diagnosis of a deformable body on two cores: steps of all worlds times their cells."""

LAUNCH = 10_000
"""Work that a launch of rigid worlds costs beside its steps: what the fit does with its results."""


@dataclass(kw_only=True)
class Work:
    """Simulated work of one diagnosis; worlds add to it, searches ask whether any is left.

    limit: from which no further candidate is started or refined. rate: work per second that ``limit`` stands for.
    skipped: what was left out for lack of work, by effect (two joined by "+").
    """

    limit: float = float("inf")
    rate: float = RIGID_RATE
    spent: int = 0
    skipped: dict[str, str] = field(default_factory=dict)

    def add(self, steps: int) -> None:
        """Count ``steps``."""
        self.spent += int(steps)

    def left(self, share: float = 1.0) -> bool:
        """Return whether less than ``share`` of the budget is spent."""
        return self.spent < share * self.limit

    def skip(self, effects: tuple[str, ...], what: str) -> None:
        """Note that ``effects`` were not ``what`` ("tried", "refined"); the first note of an effect counts."""
        self.skipped.setdefault("+".join(effects), what)


@dataclass(frozen=True, kw_only=True)
class WorkRecord:
    """The cost of a diagnosis, as the report states it.

    budget: largest work; spent: used; per_second: the fixed rate that turns a time into work. skipped: by effect (two
    joined by "+"), what was not done for lack of work.
    """

    budget: int
    spent: int
    per_second: int
    skipped: dict[str, str] = field(default_factory=dict)
