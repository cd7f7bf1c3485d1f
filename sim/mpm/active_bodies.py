# SPDX-License-Identifier: MIT
"""Which bodies of all worlds take part: who has started, who sleeps, and which particles are whose. No Taichi."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .sleeping import Sleepers
from .world_setup import WorldSetup

Array = NDArray[np.float64]

LEAST_WATCH = 1e-4
"""Seconds that pass at least between two looks at what may touch a sleeper."""


class ActiveBodies:
    """The B bodies of all worlds in one row, world after world.

    offsets: (B + 1,) the first particle's number of each body. started: (B,) whether it has entered the simulation.
    asleep: (B,) whether it waits to be touched; it then has not started.
    """

    def __init__(self, setups: Sequence[WorldSetup], cell: float) -> None:
        """cell: size of a grid cell, m."""
        self._setups = tuple(setups)
        bodies = [body for setup in setups for body in setup.bodies]
        self._first = np.concatenate([[0], np.cumsum([len(setup.bodies) for setup in setups])])
        self.offsets = np.concatenate([[0], np.cumsum([body.count for body in bodies])])
        self.started = np.zeros(len(bodies), dtype=bool)
        self.asleep = np.zeros(len(bodies), dtype=bool)
        self._sleepers = [
            Sleepers(setup, cell) if any(body.asleep for body in setup.bodies) else None for setup in setups
        ]
        for world, sleepers in enumerate(self._sleepers):
            if sleepers is not None:
                self.asleep[self.of(world)] = sleepers.asleep

    def of(self, world: int) -> slice:
        """Return the places of the bodies of world ``world``."""
        return slice(int(self._first[world]), int(self._first[world + 1]))

    @property
    def any_may_sleep(self) -> bool:
        """Return whether any body of any world may sleep, awake or not."""
        return any(sleepers is not None for sleepers in self._sleepers)

    def may_wake(self, world: int) -> bool:
        """Return whether something sleeps in world ``world`` that something else could touch."""
        own = self.of(world)
        return bool(self._sleepers[world] is not None and self.asleep[own].any() and self.started[own].any())

    def start(self, world: int, now: float) -> list[int]:
        """Let the bodies of world ``world`` start that are due at ``now``, s; return those that deform, by index."""
        found, first = [], self.of(world).start
        for i, body in enumerate(self._setups[world].bodies):
            if not self.started[first + i] and not self.asleep[first + i] and body.start_time <= now:
                self.started[first + i] = True
                if not body.rigid:
                    found.append(i)
        return found

    def wake(
        self, world: int, now: float, moving: Callable[[], tuple[dict[int, Array], float]]
    ) -> tuple[list[int], float]:
        """Let the bodies of world ``world`` start that moving matter has come to touch at ``now``, s.

        moving: returns the particles (N, 3) in world metres of each body that has started, by index, and the speed in
        m/s of the fastest. Returns the indices of what woke, and the time in s until which nothing else will.
        """
        sleepers, own = self._sleepers[world], self.of(world)
        found: list[int] = []
        if sleepers is None:
            return found, math.inf
        asleep = self.asleep[own]
        while True:
            matter, speed = moving()
            woken, rest = sleepers.touched(matter, asleep, now, speed)
            if not woken:
                return found, now + max(rest, LEAST_WATCH)
            for i in sleepers.with_neighbours(woken, asleep):
                self.asleep[own.start + i], self.started[own.start + i] = False, True
                found.append(i)
