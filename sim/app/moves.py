# SPDX-License-Identifier: MIT
"""One motion of one object, as a default motion sets it going."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Vector

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Move:
    """The motion of one object: a hop, or a push along the ground.

    name: of the object. height: peak of its path over its rest, m; 0 of a push. aside: where it comes down or stops,
    (3,) m from its rest. start_s: when it begins. flight_s: from leaving to coming down, or to stopping. settle_s:
    from then until it is at rest, about. pause_s: from then until it may be moved again, no longer. velocity, spin: m/s
    and rad/s at the beginning.
    """

    name: str
    height: float
    aside: Vector
    start_s: float
    flight_s: float
    settle_s: float
    pause_s: float
    velocity: Vector
    spin: Vector

    @property
    def landed_s(self) -> float:
        """Return the time in s at which it comes down, or stops."""
        return self.start_s + self.flight_s

    @property
    def slides(self) -> bool:
        """Return whether it is a push."""
        return self.height == 0.0

    @property
    def on_the_spot(self) -> bool:
        """Return whether it is a hop straight up."""
        return not self.slides and not any(self.aside)

    def slower(self, share: float) -> Move:
        """Return the same move with ``share`` of the speed: to the square of it as high and as far."""
        return dataclasses.replace(
            self,
            height=share**2 * self.height,
            aside=rounded(share**2 * np.asarray(self.aside)),
            flight_s=share * self.flight_s,
            settle_s=share * self.settle_s,
            pause_s=share * self.pause_s,
            velocity=rounded(share * np.asarray(self.velocity)),
            spin=rounded(share * np.asarray(self.spin)),
        )


def unit(vector: Array) -> Array:
    """Return ``vector`` (3,) at length 1."""
    return np.asarray(vector / np.linalg.norm(vector))


def rounded(values: Array) -> Vector:
    """Return ``values`` (3,) to 6 digits, so that a scene folder says what is meant, the same on every machine."""
    # What cancels is nothing: sines of multiples of π leave 1e-17.
    x, y, z = (float(f"{value:.6g}") + 0.0 for value in np.round(values, 9))
    return x, y, z
