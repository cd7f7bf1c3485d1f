# SPDX-License-Identifier: MIT
"""Hidden causes in the motion of a rigid body: every applicable effect of the vocabulary.

Each cause has one strength, in its own unit, which a case scales to the desired signal-to-noise ratio.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..sim.diagnose.capture import Camera
from ..sim.diagnose.diagnosis import UNKNOWN
from .case import Lens, moved_camera
from .mujoco_world import GRAVITY, Array, Push, RigidWorld

AIR = 1.2
"""Density of air, kg/m³."""

ACTIVE = ("push", "always", "touched", "struck", "slid", "pulled", "turned", "rolling", "window")
"""When a cause acts: while its force exceeds a tenth of its maximum, always, during contact, while sliding, …"""


def _same_world(strength: float, world: RigidWorld) -> RigidWorld:
    return world


def _no_parameters(strength: float) -> Mapping[str, Any]:
    return {}


@dataclass(frozen=True, kw_only=True)
class Cause:
    """A cause.

    effect: name in the vocabulary, or ``unknown``. mechanism: in words; by default the effect's name. low, high: bounds
    of the strength.

    change: the world with it. clock: recorded times (T,) → true times. camera: (strength, assumed camera, the point it
    looks at) → true camera. lens: of the strength. active: see ``ACTIVE``. styles: of the trials that show it.
    window: s since the first frame, with ``active="window"``.
    """

    effect: str = UNKNOWN
    mechanism: str = ""
    low: float
    high: float
    styles: tuple[str, ...]
    active: str = "push"
    change: Callable[[float, RigidWorld], RigidWorld] = _same_world
    clock: Callable[[float, Array], Array] | None = None
    camera: Callable[[float, Camera, Array], Camera] | None = None
    lens: Callable[[float], Lens] | None = None
    parameters: Callable[[float], Mapping[str, Any]] = _no_parameters
    ambiguous_with: Mapping[str, str] = field(default_factory=dict)
    window: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.mechanism:
            object.__setattr__(self, "mechanism", self.effect)


Maker = Callable[[RigidWorld, np.random.Generator], Cause]
"""Draws the details of a cause in a world; its strength is chosen afterwards."""


def pushing(push_of: Callable[[float], Push]) -> Callable[[float, RigidWorld], RigidWorld]:
    """Return the change that adds the force per mass ``push_of(strength)`` to a world's others."""

    def change(strength: float, world: RigidWorld) -> RigidWorld:
        before, push = world.push, push_of(strength)
        if before is None:
            return dataclasses.replace(world, push=push)
        both: Push = lambda t, p, v, w, turn: before(t, p, v, w, turn) + push(t, p, v, w, turn)  # noqa: E731
        return dataclasses.replace(world, push=both)

    return change


def either_sign(rng: np.random.Generator) -> float:
    """Return -1 or 1."""
    return float(rng.choice([-1, 1]))


TOSSES = ("toss",)
NONE_STYLES = ("toss", "drop", "slide", "roll")


def drag_per_mass(world: RigidWorld, coefficient: float) -> float:
    """Return rho c_d A / (2 m) in 1/m."""
    return 0.5 * AIR * coefficient * world.body.cross_section / world.body.mass


def air_drag(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Quadratic drag in still air; strength: c_d."""

    def push_of(cd: float) -> Push:
        k = drag_per_mass(world, cd)
        return lambda t, p, v, w, turn: -k * math.sqrt(v @ v) * v

    return Cause(
        effect="air_drag",
        low=0.1,
        high=1.5,
        styles=TOSSES,
        change=pushing(push_of),
        parameters=lambda cd: {"cd": cd, "drag_per_mass_1_per_m": drag_per_mass(world, cd)},
        ambiguous_with={"wind": "still air is wind of speed zero"},
    )


def wind(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Drag against air that moves; strength: its speed in m/s."""
    cd, azimuth, rise = float(rng.uniform(0.35, 0.8)), rng.uniform(-np.pi, np.pi), rng.uniform(-0.2, 0.2)
    direction = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])

    def push_of(speed: float) -> Push:
        k, air = drag_per_mass(world, cd), speed * direction

        def push(t: float, p: Array, v: Array, w: Array, turn: Array) -> Array:
            u = v - air
            return np.asarray(-k * math.sqrt(u @ u) * u)

        return push

    return Cause(
        effect="wind",
        low=0.5,
        high=5.0,
        styles=TOSSES,
        change=pushing(push_of),
        parameters=lambda s: {
            "cd": cd,
            "wind": (s * direction).tolist(),
            "wind_speed": s,
            "drag_per_mass_1_per_m": drag_per_mass(world, cd),
        },
    )


def magnus(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Lift S ω×v; strength: the lift slope, S = rho A r slope / (2 m)."""

    def lift(slope: float) -> float:
        return drag_per_mass(world, slope) * world.body.size

    def push_of(slope: float) -> Push:
        s = lift(slope)

        def push(t: float, p: Array, v: Array, w: Array, turn: Array) -> Array:
            return s * np.array([w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0]])

        return push

    return Cause(
        effect="magnus",
        low=0.1,
        high=1.2,
        styles=("spun",),
        change=pushing(push_of),
        parameters=lambda slope: {"lift_per_mass": lift(slope), "lift_slope": slope},
    )


def buoyancy(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Gravity times 1 - fraction; strength: the fraction's size."""
    sign = either_sign(rng)
    return Cause(
        effect="buoyancy",
        low=0.004,
        high=0.15,
        styles=("toss", "toss", "drop"),
        active="always",
        change=lambda s, w: dataclasses.replace(w, gravity=(0.0, 0.0, -GRAVITY * (1 - sign * s))),
        parameters=lambda s: {"fraction": sign * s},
        ambiguous_with={
            "time_scale": "rigid motion has no clock but gravity: gravity times k equals clock rate sqrt(k)"
        },
    )


def gravity_tilt(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Gravity turned by an angle; strength: the angle."""
    azimuth = float(rng.uniform(-np.pi, np.pi))

    def gravity(angle: float) -> tuple[float, float, float]:
        flat = GRAVITY * math.sin(angle)
        return flat * math.cos(azimuth), flat * math.sin(azimuth), -GRAVITY * math.cos(angle)

    return Cause(
        effect="gravity_tilt",
        low=0.006,
        high=0.09,
        styles=("toss", "toss", "slide"),
        active="always",
        change=lambda s, w: dataclasses.replace(w, gravity=gravity(s)),
        parameters=lambda s: {"angle": s, "azimuth": azimuth, "gravity": list(gravity(s))},
    )


def tether(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A spring to a fixed point, slack below its rest length; strength: stiffness per mass in 1/s²."""
    azimuth, rest = rng.uniform(-np.pi, np.pi), float(rng.uniform(0.15, 0.4))
    anchor = np.array([0.45 * np.cos(azimuth), 0.45 * np.sin(azimuth), rng.uniform(0.6, 1.2)])

    def push_of(k: float) -> Push:
        def push(t: float, p: Array, v: Array, w: Array, turn: Array) -> Array:
            line = anchor - p
            length = math.sqrt(line @ line)
            return np.asarray(k * max(0.0, length - rest) / max(length, 1e-9) * line)

        return push

    return Cause(
        effect="tether",
        low=0.05,
        high=6.0,
        styles=("toss", "toss", "drop"),
        change=pushing(push_of),
        parameters=lambda k: {"stiffness_per_mass": k, "rest_length": rest, "anchor": anchor.tolist()},
    )


def friction(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Another Coulomb coefficient; strength: log of the factor."""
    sign = either_sign(rng)
    return Cause(
        effect="friction",
        low=0.04,
        high=0.9,
        styles=("slide", "slide", "slide", "toss"),
        active="slid",
        change=lambda s, w: dataclasses.replace(w, friction=w.friction * math.exp(sign * s)),
        parameters=lambda s: {"mu": world.friction * math.exp(sign * s)},
    )


def restitution(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Another restitution; strength: the difference."""
    sign = 1.0 if world.restitution < 0.35 else -1.0 if world.restitution > 0.6 else either_sign(rng)

    def bounce(s: float) -> float:
        return min(max(world.restitution + sign * s, 0.16), 0.93)

    return Cause(
        effect="restitution",
        low=0.015,
        high=0.4,
        styles=("drop", "drop", "toss"),
        active="struck",
        change=lambda s, w: dataclasses.replace(w, restitution=bounce(s)),
        parameters=lambda s: {"e": bounce(s)},
    )


def rolling_resistance(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Rolling resistance; strength: arm over the radius."""
    return Cause(
        effect="rolling_resistance",
        low=0.002,
        high=0.06,
        styles=("roll", "roll", "roll", "toss"),
        active="rolling",
        change=lambda s, w: dataclasses.replace(w, rolling=s * w.body.half[0]),
        parameters=lambda s: {"coefficient": s},
    )


def adhesion(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Adhesion: a pull on a separating body within a reach; strength: pull per mass in m/s²."""
    reach = float(rng.uniform(0.002, 0.006))
    return Cause(
        effect="adhesion",
        low=3.0,
        high=150.0,
        styles=("drop",),
        active="pulled",
        change=lambda s, w: dataclasses.replace(w, adhesion=(s, reach)),
        parameters=lambda s: {"pull_per_mass": s, "reach": reach},
    )


def mass_offset(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Off-centre pellet; strength: its mass over the body's."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    at = tuple(float(x) for x in direction * np.array(world.body.half) * rng.uniform(0.5, 0.8))
    place = (at[0], at[1], at[2])
    return Cause(
        effect="mass_offset",
        low=0.02,
        high=0.8,
        styles=("spun", "toss"),
        active="always",
        change=lambda s, w: dataclasses.replace(w, pellet=(s, place)),
        parameters=lambda s: {
            "pellet_fraction": s,
            "pellet_at": list(at),
            "centre_shift": [x * s / (1 + s) for x in at],
        },
    )


def inertia(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A hollow body; strength: what its moments of inertia have more, up to a thin shell's two thirds."""
    return Cause(
        effect="inertia",
        low=0.04,
        high=2 / 3,
        styles=("toss", "toss", "slide") if world.body.shape == "sphere" else ("toss", "spun", "drop"),
        active="turned",
        change=lambda s, w: dataclasses.replace(w, inertia=1 + s),
        parameters=lambda s: {"factor": 1 + s},
    )


def time_scale(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Wrong clock rate; strength: deviation from 1."""
    sign = either_sign(rng)
    return Cause(
        effect="time_scale",
        low=0.003,
        high=0.07,
        styles=("toss", "toss", "drop"),
        active="always",
        clock=lambda s, t: np.asarray(t * (1 + sign * s)),
        parameters=lambda s: {"rate": 1 + sign * s},
        ambiguous_with={"buoyancy": "rigid motion has no clock but gravity: rate s equals gravity times s^2"},
    )


def camera_pose(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """The camera turned about a level axis through what it looks at, and raised; strength: the angle."""
    azimuth, shift = rng.uniform(-np.pi, np.pi), float(rng.uniform(-0.2, 0.2))
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])

    def real(angle: float, camera: Camera, target: Array) -> Camera:
        turn = Rotation.from_rotvec(angle * axis).as_matrix()
        return moved_camera(camera, turn, target - turn @ target + (0.0, 0.0, shift * angle))

    return Cause(
        effect="camera_pose",
        low=0.004,
        high=0.08,
        styles=("toss", "drop", "toss"),
        active="always",
        camera=real,
        parameters=lambda s: {"rotation_vector": (s * axis).tolist(), "angle": s, "height_shift": s * shift},
    )


KNOWN_CAUSES: Mapping[str, Maker] = {
    "air_drag": air_drag,
    "wind": wind,
    "magnus": magnus,
    "buoyancy": buoyancy,
    "gravity_tilt": gravity_tilt,
    "tether": tether,
    "friction": friction,
    "restitution": restitution,
    "rolling_resistance": rolling_resistance,
    "adhesion": adhesion,
    "mass_offset": mass_offset,
    "time_scale": time_scale,
    "camera_pose": camera_pose,
    "inertia": inertia,
}
