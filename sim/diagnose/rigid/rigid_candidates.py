# SPDX-License-Identifier: MIT
"""Candidate effects of a rigid body: free parameters with standard normal priors, mapped to world parameters.

The prior widths state what is plausible for hand-sized objects thrown for about a second.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .quaternions import as_matrix, from_rotvec
from .rigid_simulator import RigidBody
from .world_settings import FOOTING, FOOTING_SPREAD, UNKNOWN_RESTITUTION_SPREAD, BodyScene, WorldSettings

Array = NDArray[np.float64]

AIR = 1.2
"""Density of air, kg/m³."""

GRIP_SPREAD = 0.7
"""Standard deviation of the logarithm of ``RUB``: how far an impact stops sliding where friction would suffice. Elastic
skins keep or return a part of it, and simulators differ: MuJoCo damps both directions alike, up to eight times less."""

FRICTION_SPREAD, RESTITUTION_SPREAD, CONTACT_TIME_SPREAD = 0.01, 0.01, 0.1
"""Standard deviations of the nominal coefficients (relative; absolute; relative); larger deviations are an effect."""

SCALE_SPREAD, CLOCK_SPREAD = 0.01, 0.005
RECORDED_GRAVITY_SPREAD = float(np.hypot(SCALE_SPREAD, 2 * CLOCK_SPREAD))
"""Relative standard deviations of the length scale and the clock of a recording of single points. In flight both are a
gravity that differs in strength: lengths scale it, times scale it twice, and speeds are free."""

Values = Mapping[str, float]
Change = Callable[[BodyScene, WorldSettings, Array], WorldSettings]


@dataclass(frozen=True, kw_only=True)
class CandidateEffect:
    """One effect with P free numbers. change: settings and numbers (P,) to settings. values: numbers to the effect's
    parameters. starts: initial numbers, neutral first if there are several. positive: the first number is an amount
    that cannot be negative. grid: numbers to scan first, for effects of contact."""

    name: str
    size: int
    change: Change
    values: Callable[[BodyScene, WorldSettings, Array], Values]
    starts: tuple[tuple[float, ...], ...]
    positive: bool = False
    step: float = 0.05
    grid: tuple[tuple[float, ...], ...] = ((0.0,),)


def drag_reference(body: RigidBody) -> float:
    """Return rho A / (2 m) in 1/m, the drag per mass at drag coefficient 1."""
    return 0.5 * AIR * body.area / body.mass


def _inset(z: float) -> float:
    """Return the share by which friction acts nearer to the middle than a face's corners."""
    return float(np.clip(1 - FOOTING * np.exp(FOOTING_SPREAD * np.clip(z, -5, 5)), 0.0, 0.95))


def _beliefs(scene: BodyScene, setting: WorldSettings, z: Array) -> WorldSettings:
    known = scene.capture.ground.restitution is not None
    spread = RESTITUTION_SPREAD if known else UNKNOWN_RESTITUTION_SPREAD
    return dataclasses.replace(
        setting,
        friction=setting.friction * float(np.exp(FRICTION_SPREAD * z[0])),
        restitution=setting.restitution + spread * float(z[1]),
        contact_time=setting.contact_time * float(np.exp(CONTACT_TIME_SPREAD * np.clip(z[2], -4, 4))),
        rub=setting.rub * float(np.exp(GRIP_SPREAD * np.clip(z[4], -4, 4))),
        gravity=setting.gravity * float(np.exp(RECORDED_GRAVITY_SPREAD * z[3])) if scene.unscaled else setting.gravity,
        inset=_inset(float(z[3])) if scene.turns_on_a_face else setting.inset,
    )


BELIEFS = CandidateEffect(
    name="beliefs",
    size=5,
    change=_beliefs,
    values=lambda scene, setting, z: {"friction": setting.friction, "restitution": setting.restitution},
    starts=((0.0,) * 5,),
    step=0.2,
)
"""Return settings with the nominal model's own parameters changed."""


def _drag(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, drag=s.drag + 0.5 * drag_reference(scene.body) * float(z[0]))


WIND_SPREAD = np.array([1.5, 1.5, 0.5])


def _wind(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(_drag(scene, s, z), wind=s.wind + WIND_SPREAD * z[1:4])


def _lift(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, lift=s.lift + 0.4 * 0.75 * AIR / scene.body.density * float(z[0]))


def _buoyancy(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, gravity=s.gravity * (1 - 0.05 * float(z[0])))


def _clock(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, rate=s.rate * float(np.exp(0.025 * np.clip(z[0], -20, 20))))


TILT_SPREAD = 0.04


def _tilt(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    way = TILT_SPREAD * np.array([float(z[1]), -float(z[0]), 0.0])
    # Gravity along -z leans towards (z0, z1): a rotation about (z1, -z0).
    return dataclasses.replace(s, gravity=as_matrix(from_rotvec(way)) @ s.gravity)


def _tilt_values(scene: BodyScene, s: WorldSettings, z: Array) -> Values:
    return {"angle": TILT_SPREAD * float(np.hypot(z[0], z[1])), "azimuth": float(np.arctan2(z[1], z[0]))}


def _tether_numbers(scene: BodyScene, z: Array) -> tuple[float, float, Array]:
    stiffness = 1.0 * float(np.exp(1.2 * np.clip(z[0], -6, 6)))
    length = 0.3 * float(np.exp(0.6 * np.clip(z[1], -5, 4)))
    return stiffness, length, scene.middle + np.array([0.0, 0.0, 0.5]) + 0.5 * z[2:5]


def tether_numbers(scene: BodyScene, stiffness: float, length: float, anchor: Array) -> tuple[float, ...]:
    """Return the numbers (5,) of a tether: stiffness per mass 1/s², rest length m, anchor (3,) m."""
    place = (anchor - scene.middle - np.array([0.0, 0.0, 0.5])) / 0.5
    return (float(np.log(stiffness)) / 1.2, float(np.log(length / 0.3)) / 0.6, *map(float, place))


def _tether(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, tether=_tether_numbers(scene, z))


def _tether_values(scene: BodyScene, s: WorldSettings, z: Array) -> Values:
    stiffness, length, (x, y, h) = _tether_numbers(scene, z)
    found = {"stiffness_per_mass": stiffness, "rest_length": length}
    return {**found, "anchor_x": float(x), "anchor_y": float(y), "anchor_z": float(h), "string": 1.0}


def _friction(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, friction=s.friction * float(np.exp(0.35 * np.clip(z[0], -10, 8))))


def _restitution(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, restitution=float(np.clip(s.restitution + 0.15 * z[0], 0.0, 1.0)))


def _rolling(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, rolling=s.rolling + 0.02 * scene.body.bound * float(z[0]))


def _adhesion_numbers(z: Array) -> tuple[float, float]:
    return 25.0 * float(np.exp(0.8 * np.clip(z[0], -6, 6))), 0.004 * float(np.exp(0.5 * np.clip(z[1], -5, 5)))


def _adhesion(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    pull, reach = _adhesion_numbers(z)
    return dataclasses.replace(s, pull=pull, reach=reach)


def _offset_numbers(scene: BodyScene, z: Array) -> tuple[Array, float]:
    center = 0.06 * scene.body.bound * z[:3]
    fraction = 0.15 * float(np.exp(0.5 * np.clip(z[3], -4, 3)))
    # The pellet lies within the body, at most at its surface.
    least = float(np.linalg.norm(center)) / scene.body.reach(center)
    return center, float(np.clip(max(fraction, least), 0.005, 0.9))


def _offset(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    center, fraction = _offset_numbers(scene, z)
    return dataclasses.replace(s, center=center, fraction=fraction)


def _offset_values(scene: BodyScene, s: WorldSettings, z: Array) -> Values:
    center, fraction = _offset_numbers(scene, z)
    return {"fraction": fraction, **{f"offset_{a}": float(v) for a, v in zip("xyz", center / fraction, strict=True)}}


INERTIA_SPREAD = 0.25
"""Standard deviation of the logarithm of the inertia over that of uniform density; thin shells of balls and cubes have
two of them more."""


def _inertia(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    return dataclasses.replace(s, inertia=s.inertia * float(np.exp(INERTIA_SPREAD * np.clip(z[0], -4, 4))))


def _camera_numbers(scene: BodyScene, z: Array) -> tuple[Array, Array, Array]:
    assert scene.capture.camera is not None
    place = scene.capture.camera.matrix[:3, 3]
    return as_matrix(from_rotvec(0.03 * z[:3])), place, 0.02 * z[3:6]


def _camera(scene: BodyScene, s: WorldSettings, z: Array) -> WorldSettings:
    turn, place, shift = _camera_numbers(scene, z)
    # What the true camera sees at X, the assumed one sees at turn^T (X - place - shift) + place.
    return dataclasses.replace(s, camera=(turn.T, place - turn.T @ (place + shift)))


def _camera_values(scene: BodyScene, s: WorldSettings, z: Array) -> Values:
    turn, place, shift = _camera_numbers(scene, z)
    moved = place + shift - turn @ place
    found = {f"rotation_{a}": float(v) for a, v in zip("xyz", 0.03 * z[:3], strict=True)}
    return {**found, **{f"shift_{a}": float(v) for a, v in zip("xyz", moved, strict=True)}}


def _tether_starts() -> tuple[tuple[float, ...], ...]:
    corners = [(x, y, h) for x, y, h in ((-0.6, -0.6, 0.3), (-0.6, 0.6, 0.3), (0.6, -0.6, 0.3), (0.6, 0.6, 0.3))]
    return tuple((-0.5, -0.5, *c) for c in corners)


CANDIDATE_EFFECTS: Mapping[str, CandidateEffect] = {
    f.name: f
    for f in (
        CandidateEffect(
            name="air_drag",
            size=1,
            change=_drag,
            values=lambda scene, s, z: {"drag_per_mass": s.drag},
            starts=((0.0,),),
            positive=True,
        ),
        CandidateEffect(
            name="wind",
            size=4,
            change=_wind,
            values=lambda scene, s, z: {
                "drag_per_mass": s.drag,
                **{f"wind_{a}": float(v) for a, v in zip("xyz", s.wind, strict=True)},
            },
            starts=((0.8, 0.0, 0.0, 0.0),),
            positive=True,
        ),
        CandidateEffect(
            name="magnus", size=1, change=_lift, values=lambda scene, s, z: {"lift_per_mass": s.lift}, starts=((0.0,),)
        ),
        CandidateEffect(
            name="buoyancy",
            size=1,
            change=_buoyancy,
            values=lambda scene, s, z: {"fraction": 0.05 * float(z[0])},
            starts=((0.0,),),
        ),
        CandidateEffect(name="gravity_tilt", size=2, change=_tilt, values=_tilt_values, starts=((0.0, 0.0),)),
        CandidateEffect(
            name="tether", size=5, change=_tether, values=_tether_values, starts=_tether_starts(), step=0.1
        ),
        CandidateEffect(
            name="friction",
            size=1,
            change=_friction,
            values=lambda scene, s, z: {"friction": s.friction},
            starts=((0.0,),),
            grid=tuple((0.25 * k,) for k in range(-12, 13)),
        ),
        CandidateEffect(
            name="restitution",
            size=1,
            change=_restitution,
            values=lambda scene, s, z: {"restitution": s.restitution},
            starts=((0.0,),),
            grid=tuple((0.1 * k,) for k in range(-20, 21)),
        ),
        CandidateEffect(
            name="rolling_resistance",
            size=1,
            change=_rolling,
            values=lambda scene, s, z: {"lever_arm": max(s.rolling, 0.0)},
            starts=((0.3,),),
            positive=True,
            grid=tuple((z,) for z in (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)),
        ),
        CandidateEffect(
            name="adhesion",
            size=2,
            change=_adhesion,
            values=lambda scene, s, z: {"pull_per_mass": s.pull, "reach": s.reach},
            starts=((0.0, 0.0),),
            step=0.1,
            grid=tuple(
                (a, b) for a in (-2.0, -1.0, -0.4, 0.0, 0.4, 0.8, 1.3) for b in (-1.2, -0.6, -0.2, 0.2, 0.6, 1.2)
            ),
        ),
        CandidateEffect(
            name="mass_offset",
            size=4,
            change=_offset,
            values=_offset_values,
            starts=((0.05, 0.05, 0.05, 0.0),),
        ),
        CandidateEffect(
            name="inertia",
            size=1,
            change=_inertia,
            values=lambda scene, s, z: {"factor": s.inertia},
            starts=((0.0,),),
            grid=tuple((0.25 * k,) for k in range(-10, 11)),
        ),
        CandidateEffect(
            name="time_scale",
            size=1,
            change=_clock,
            values=lambda scene, s, z: {"rate": s.rate},
            starts=((0.0,),),
        ),
        CandidateEffect(name="camera_pose", size=6, change=_camera, values=_camera_values, starts=((0.0,) * 6,)),
    )
}
