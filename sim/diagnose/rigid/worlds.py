# SPDX-License-Identifier: MIT
"""Launches of ``kernel``: rows of states and of numbers in, states at times out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...mpm.options import SolverOptions
from ...mpm.runtime import ensure_started
from .body import RigidBody

Array = NDArray[np.float64]

CONTACT_TIME = 0.002
"""Half period of a contact in s where nothing else is known: hard bodies as large as a hand."""

STEPS = 20
"""Steps to the half period of a contact."""

SOFTER = 0.98
"""Of the damping ratio for a restitution: simulators differ by some percent in what they make of a coefficient."""

MOST_DAMPING = 2.5
"""Damping ratio; a contact's steps, of a twentieth of its half period, do not hold much more, and 2.5 bounce to 4 %."""

LONGEST = 0.005
"""Step in flight, s."""

SLOTS: Mapping[str, Any] = {
    "gravity": slice(0, 3),
    "drag": 3,
    "wind": slice(4, 7),
    "lift": 7,
    "tether": 8,
    "length": 9,
    "anchor": slice(10, 13),
    "string": 13,
    "friction": 14,
    "rolling": 15,
    "pull": 16,
    "reach": 17,
    "center": slice(18, 21),
    "inertia": slice(21, 27),
    "mobility": slice(27, 33),
    "spring": 33,
    "dashpot": 34,
    "rub": 35,
    "step": 36,
    "normal": slice(37, 40),
    "point": slice(40, 43),
}
NUMBERS, STATE, RECORD = 43, 13, 17


@cache
def _bounces() -> tuple[Array, Array]:
    """Restitutions, rising, and the damping ratios that give them, of a spring and dashpot that cannot pull.

    Schwager and Pöschel, Granular Matter 9 (2007), equations 15 and 20.
    """
    low, high = np.linspace(0.0, 0.999, 400), np.geomspace(1.001, 30.0, 200)
    root, far = np.sqrt(1 - low**2), np.sqrt(high**2 - 1)
    swing = np.exp(-low / root * np.arccos(np.clip(2 * low**2 - 1, -1, 1)))
    creep = np.exp(-high / far * np.log((high + far) / (high - far)))
    found, ratios = np.concatenate([swing, creep]), np.concatenate([low, high])
    return found[::-1].copy(), ratios[::-1].copy()


def damping_ratio(restitution: Array) -> Array:
    """Of the contact's dashpot, for restitutions from 0 to 1."""
    known, ratios = _bounces()
    return np.asarray(SOFTER * np.minimum(np.interp(restitution, known, ratios), MOST_DAMPING))


def set_contact(numbers: Array, restitution: Array, contact_time: Array, rub: Array) -> None:
    """Write springs and dashpots into ``numbers`` (W, NUMBERS); restitution, half period in s: (W,).

    rub: (W,) share of the dashpot's rate at which sliding is taken up.
    """
    rate = np.pi / contact_time
    numbers[:, SLOTS["spring"]] = rate**2
    numbers[:, SLOTS["dashpot"]] = 2 * damping_ratio(restitution) * rate
    numbers[:, SLOTS["rub"]] = rub * rate
    numbers[:, SLOTS["step"]] = contact_time / STEPS


def six(matrix: Array) -> Array:
    """Symmetric (..., 3, 3) as (..., 6): xx, yy, zz, xy, xz, yz."""
    return np.stack([matrix[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Launcher:
    """Runs worlds of one body.  longest: step in flight in s. threads: 0 takes all."""

    body: RigidBody
    longest: float = LONGEST
    threads: int = 0

    def run(self, starts: Array, numbers: Array, times: list[Array] | Array) -> Array:
        """States (W, M, RECORD) of the centre of volume at ``times`` of every world, in s since its start.

        starts (W, STATE), numbers (W, NUMBERS), times (W, M) or W arrays of up to M; what is beyond them stays zero.
        """
        from . import kernel  # Taichi loads only where something moves

        ensure_started(SolverOptions(threads=self.threads))
        count = np.array([len(t) for t in times], dtype=np.int32)
        padded = np.zeros((len(count), max(1, int(count.max(initial=0)))))
        for row, t in zip(padded, times, strict=True):
            row[: len(t)] = t
        out = np.zeros((len(count), padded.shape[1], RECORD))
        if len(count) and count.max() > 0:
            kernel.advance(
                len(count),
                len(self.body.corners),
                self.body.radius,
                self.body.bound,
                self.longest,
                np.ascontiguousarray(self.body.corners),
                np.ascontiguousarray(starts),
                np.ascontiguousarray(numbers),
                count,
                padded,
                out,
            )
        return out
