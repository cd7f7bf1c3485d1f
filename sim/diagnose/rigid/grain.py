# SPDX-License-Identifier: MIT
"""How well a model of contact can be trusted: the spread of where a body comes out of one.

Two simulators with the same coefficients differ by a share of the impulse that was exchanged, because they resolve a
contact of a few milliseconds in other steps; a face or an edge that lands flat differs by more than a ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .body import RigidBody

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Grain:
    """Standard deviations. blow: share of an impact's impulse; rub: of friction's; late: s, of an impact's duration;
    floor_speed: m/s, floor_shift: m, of every contact. blow, rub and late are for one body shape."""

    blow: float
    rub: float
    late: float
    floor_speed: float = 1.5e-3
    floor_shift: float = 5e-5


ROUND = Grain(blow=0.006, rub=0.02, late=2.5e-4)
CORNERED = Grain(blow=0.03, rub=0.04, late=3e-4)


def grain_of(body: RigidBody) -> Grain:
    """By the body's shape."""
    return ROUND if body.round else CORNERED


def contact_spread(grain: Grain, body: RigidBody, record: Array, weight: float) -> tuple[Array, Array]:
    """Standard deviations of speed (F,) m/s and place (F,) m after what ``record`` (F, 17) adds up to.

    weight: believed gravity across the ground, m/s²: a body that lies there passes it on all the time, which is no
    impact.
    """
    touched = record[:, 15]
    blow = np.maximum(record[:, 13] - weight * touched, 0.0)
    speed = np.hypot(grain.blow * blow, grain.rub * record[:, 14])
    speed = np.hypot(speed, grain.floor_speed * (touched > 0))
    place = np.hypot(grain.late * blow, grain.floor_shift * (touched > 0))
    return speed, place


def covariance(grain: Grain, body: RigidBody, record: Array, times: Array, weight: float) -> Array:
    """Of the state (12, 12) at the end of a segment: ``record`` (F, 17) at ``times`` (F,), s."""
    speed, place = contact_spread(grain, body, record, weight)
    # An error made at some time during the segment has moved the body ever since.
    made = np.diff(np.concatenate([[0.0], speed**2]))
    since = times[-1] - np.concatenate([[times[0]], times[:-1]])
    moved = np.sqrt(np.sum(np.maximum(made, 0.0) * since**2) / 3) + place[-1] + 2e-5
    size = body.bound
    turn = 1.0 if body.round else 1.5
    spin = turn * speed[-1] / size + 1e-3
    deviations = np.repeat([moved, moved * turn / size + 1e-4, speed[-1] + 2e-4, spin], 3)
    return np.diag(deviations**2)


def frame_weights(grain: Grain, body: RigidBody, record: Array, times: Array, weight: float, info: Array) -> Array:
    """Weights (F,) of a segment's frames. info: (F, 6, 6) on the pose, which the grain makes worth less."""
    speed, place = contact_spread(grain, body, record, weight)
    made = np.maximum(np.diff(np.concatenate([[0.0], speed**2])), 0.0)
    before = np.concatenate([[times[0]], times[:-1]])
    since = np.maximum(times[:, None] - before[None], 0.0)
    moved = np.sqrt(np.sum(made[None] * since**2, axis=1) / 3) + place
    after = np.cumsum(moved > 0)
    # The error is one and the same for all frames that follow, so together they say no more than it lets through.
    known = np.trace(info[:, :3, :3], axis1=1, axis2=2) / 3
    together = np.cumsum(np.where(moved > 0, known, 0.0))
    total = together[-1] if after[-1] else 0.0
    return np.where(moved > 0, 1.0 / (1.0 + total * moved**2), 1.0)
