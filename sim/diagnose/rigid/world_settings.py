# SPDX-License-Identifier: MIT
"""Settings of the worlds in which a rigid body is simulated, and the nominal ones; rows of numbers for the kernel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from .quaternions import skew
from .rigid_simulator import CONTACT_TIME, NUMBERS, SLOTS, RigidBody, set_contact, six_components

Array = NDArray[np.float64]

RUB = 5.0 / np.pi
"""Tangential damping: sliding decays five times per contact half period, as without shear compliance."""

FOOTING, FOOTING_SPREAD = 0.75, 0.25
"""Where friction acts under a face that slides and turns, over its corners' distance from the middle, and the standard
deviation of its logarithm: 1 for a face that stands on its corners, 0.54 for a square one that carries evenly. It tells
how fast friction stops the turn."""

UNKNOWN_RESTITUTION, UNKNOWN_RESTITUTION_SPREAD = 0.35, 0.2


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """Settings of one world. inertia: over that of uniform density. rate: true over recorded time. camera: rotation
    (3, 3) and translation (3,) from true to assumed camera; None if the camera is where it was assumed."""

    gravity: Array
    drag: float = 0.0
    wind: Array = field(default_factory=lambda: np.zeros(3))
    lift: float = 0.0
    tether: tuple[float, float, Array] | None = None
    friction: float
    restitution: float
    contact_time: float
    rub: float = RUB
    inset: float = 0.0
    rolling: float = 0.0
    pull: float = 0.0
    reach: float = 0.0
    center: Array = field(default_factory=lambda: np.zeros(3))
    fraction: float = 0.0
    inertia: float = 1.0
    rate: float = 1.0
    camera: tuple[Array, Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyScene:
    """Nominal model of one body, shared by all candidates. middle: (3,) m, centre of the observed points.

    unscaled: only its centre is tracked, so neither its size nor its spin checks the recording's scale and clock.
    turns_on_a_face: it slides and turns on one of its faces all the time, so that where this carries counts.
    """

    capture: Capture
    body: RigidBody
    middle: Array
    unscaled: bool = False
    turns_on_a_face: bool = False

    @property
    def base(self) -> WorldSettings:
        """Return the nominal settings."""
        ground = self.capture.ground
        bounce = UNKNOWN_RESTITUTION if ground.restitution is None else ground.restitution
        return WorldSettings(
            gravity=np.asarray(self.capture.gravity, dtype=np.float64),
            friction=ground.friction,
            restitution=bounce,
            contact_time=CONTACT_TIME,
            inset=1 - FOOTING if self.turns_on_a_face else 0.0,
        )

    def numbers(self, settings: list[WorldSettings]) -> Array:
        """Return rows (S, NUMBERS) for the kernel."""
        out = np.zeros((len(settings), NUMBERS))
        body, ground = self.body, self.capture.ground
        out[:, SLOTS["normal"]] = ground.unit_normal
        out[:, SLOTS["point"]] = ground.point
        for row, s in zip(out, settings, strict=True):
            row[SLOTS["gravity"]], row[SLOTS["drag"]], row[SLOTS["wind"]] = s.gravity, s.drag, s.wind
            row[SLOTS["lift"]] = s.lift
            if s.tether is not None:
                row[SLOTS["tether"]], row[SLOTS["length"]], row[SLOTS["anchor"]] = s.tether
                row[SLOTS["string"]] = 1.0
            row[SLOTS["friction"]], row[SLOTS["rolling"]] = max(s.friction, 0.0), max(s.rolling, 0.0)
            row[SLOTS["pull"]], row[SLOTS["reach"]] = max(s.pull, 0.0), s.reach
            row[SLOTS["inset"]] = s.inset
            inertia = s.inertia * body.inertia
            if s.fraction > 0:
                pellet, turn = s.center / s.fraction, skew(s.center)
                rest = skew(pellet - s.center)
                inertia = (1 - s.fraction) * (inertia - turn @ turn) - s.fraction * rest @ rest
            row[SLOTS["center"]] = s.center
            row[SLOTS["inertia"]], row[SLOTS["mobility"]] = (
                six_components(inertia),
                six_components(np.linalg.inv(inertia)),
            )
        set_contact(
            out,
            np.clip([s.restitution for s in settings], 0.0, 1.0),
            np.array([s.contact_time for s in settings]),
            np.array([s.rub for s in settings]),
        )
        return out
