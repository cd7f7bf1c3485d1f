# SPDX-License-Identifier: MIT
"""Gravity not along the assumed direction: the ground is not level, or the camera's up direction is wrong.

Equation: g' = R g, R the rotation by the angle a that takes -z towards (cos b, sin b, 0), b the azimuth; a gravity
    along -z becomes |g| (sin a cos b, sin a sin b, -cos a). Its strength stays.
Source: Rodrigues, J. Math. Pures Appl. 5 (1840), for the rotation about an axis.
Bodies: the whole world; no bodies can be named.
Twice: rotations follow each other, which for small angles is their sum in any order.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from ..mpm.colliders import Track
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values


def tilted(gravity: NDArray[np.float64], angle: float, azimuth: float) -> NDArray[np.float64]:
    """Return ``gravity`` (..., 3) turned by ``angle`` towards ``azimuth``, both in radians."""
    axis = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    along = (gravity @ axis)[..., None] * axis
    return np.asarray(
        math.cos(angle) * gravity + math.sin(angle) * np.cross(axis, gravity) + (1 - math.cos(angle)) * along
    )


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    angle, azimuth = values["angle"], values["azimuth"]
    x, y, z = tilted(np.asarray(setup.gravity, dtype=np.float64), angle, azimuth)
    track = setup.gravity_track
    if track is not None:
        track = Track(times=track.times, values=tilted(track.values, angle, azimuth))
    return dataclasses.replace(setup, gravity=(float(x), float(y), float(z)), gravity_track=track)


EFFECT = Effect(
    name="gravity_tilt",
    kind="force",
    parameters=(
        Parameter(name="angle", unit="rad", low=0.0, high=math.pi, default=0.1, description="how far it leans"),
        Parameter(
            name="azimuth",
            unit="rad",
            low=-2 * math.pi,
            high=2 * math.pi,
            default=0.0,
            description="where to: 0 is +x, pi/2 is +y",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"angle": 0.0},
    of_world=True,
)
