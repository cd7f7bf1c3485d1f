# SPDX-License-Identifier: MIT
"""The recording's clock runs slow or fast.

Equation: t = t0 + r (t' - t0), t' the time that the recording states, t0 its first frame; r > 1: more time went by
    than it says, and all motion looks faster, gravity r² times as strong.
Source: kinematics: x(t0 + r s) differentiated twice has r² times the acceleration.
Bodies: none; a world stays as it is, see ``true_times``.
Twice: rates multiply.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .schema import Effect, Parameter, Values, leave


def true_times(values: Values, times: NDArray[np.float64], *, first: float | None = None) -> NDArray[np.float64]:
    """When frames were really taken: recorded ``times`` (T,) in s to true ones, equal at ``first`` (or times[0])."""
    origin = times[0] if first is None else first
    return np.asarray(times + (EFFECT.checked(values)["rate"] - 1.0) * (times - origin))


EFFECT = Effect(
    name="time_scale",
    kind="observation",
    parameters=(
        Parameter(name="rate", unit="1", low=0.1, high=10.0, default=1.05, description="r, true over recorded time"),
    ),
    description=__doc__,
    transform=leave,
    neutral={"rate": 1.0},
    of_world=True,
)
