# SPDX-License-Identifier: MIT
"""Parameters of a soft body's world, and candidate effects as vectors of free numbers with priors and starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...effects.gravity_tilt import tilted

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class WorldParameters:
    """World parameters of a soft body in SI units; body vectors in its rest frame, world vectors in the ground's frame.

    modulus, poisson_ratio, friction, gravity: of the nominal model; contact: stiffness of its ground relative to the
    default, a numerical parameter. The rest is neutral by default and has the meaning of that effect's parameter
    (sim/effects): factor of Young's modulus; stiffness gradient towards the stiffer end; fibre modulus and axis;
    damping time; yield stress (0: none); drag over mass and air velocity; lift over mass; tether; adhesion and its
    reach; mass share and offset of a pellet; clock rate.
    """

    modulus: float
    poisson_ratio: float
    friction: float
    gravity: Vector
    contact: float = 1.0
    factor: float = 1.0
    slope: Vector = ZERO
    fibre: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)
    damping: float = 0.0
    yield_stress: float = 0.0
    drag: float = 0.0
    wind: Vector = ZERO
    lift: float = 0.0
    tether_stiffness: float = 0.0
    tether_length: float = 0.0
    tether_anchor: Vector = ZERO
    tether_string: bool = False
    adhesion: float = 0.0
    reach: float = 0.005
    fraction: float = 0.0
    offset: Vector = ZERO
    rate: float = 1.0

    @property
    def lame(self) -> tuple[float, float]:
        """Return shear modulus and Lamé's first parameter in Pa."""
        e, nu = self.factor * self.modulus, self.poisson_ratio
        return e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def flight(self) -> tuple[object, ...]:
        """Return the parameters that act on a body in free flight."""
        tether = (self.tether_stiffness, self.tether_length, self.tether_anchor, self.tether_string)
        return (self.gravity, self.drag, self.wind, self.lift, tether, self.fraction, self.offset, self.rate)


def with_effect(world: WorldParameters, name: str, values: Mapping[str, float]) -> WorldParameters:
    """Return ``world`` with the effect ``name`` added; ``values``: that effect's parameters."""

    def vector(prefix: str) -> Vector:
        return values[f"{prefix}_x"], values[f"{prefix}_y"], values[f"{prefix}_z"]

    def unit(prefix: str) -> Array:
        v = np.asarray(vector(prefix), dtype=np.float64)
        return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))

    match name:
        case "stiffness":
            return replace(world, factor=world.factor * values["factor"])
        case "internal_damping":
            return replace(world, damping=world.damping + values["damping_time"])
        case "plastic_yield":
            return replace(world, yield_stress=values["yield_stress"])
        case "anisotropy":
            return replace(world, fibre=values["fibre_modulus"], axis=_triple(unit("axis")))
        case "stiffness_gradient":
            return replace(world, slope=_triple(values["slope"] * unit("direction")))
        case "friction":
            return replace(world, friction=values["friction"])
        case "adhesion":
            return replace(world, adhesion=world.adhesion + values["pull_per_mass"], reach=values["reach"])
        case "air_drag":
            return replace(world, drag=world.drag + values["drag_per_mass"])
        case "wind":
            air = np.asarray(world.wind) + np.asarray(vector("wind"))
            return replace(world, drag=world.drag + values["drag_per_mass"], wind=_triple(air))
        case "magnus":
            return replace(world, lift=world.lift + values["lift_per_mass"])
        case "buoyancy":
            return replace(world, gravity=_triple((1 - values["fraction"]) * np.asarray(world.gravity)))
        case "gravity_tilt":
            return replace(
                world, gravity=_triple(tilted(np.asarray(world.gravity), values["angle"], values["azimuth"]))
            )
        case "tether":
            return replace(
                world,
                tether_stiffness=values["stiffness_per_mass"],
                tether_length=values["rest_length"],
                tether_anchor=vector("anchor"),
                tether_string=values["string"] > 0,
            )
        case "mass_offset":
            return replace(world, fraction=values["fraction"], offset=vector("offset"))
        case "time_scale":
            return replace(world, rate=world.rate * values["rate"])
    raise ValueError(f"effect {name!r} does not apply to a soft body")


def _triple(v: Array) -> Vector:
    x, y, z = (float(c) for c in v)
    return x, y, z


Values = dict[str, float]

IN_FLIGHT = ("air_drag", "wind", "magnus", "buoyancy", "gravity_tilt", "tether", "time_scale", "mass_offset")
"""Effects visible before contact."""

IN_CONTACT = (
    "stiffness",
    "internal_damping",
    "plastic_yield",
    "anisotropy",
    "stiffness_gradient",
    "friction",
    "adhesion",
)
"""Effects visible from first contact on."""

NAMES = IN_FLIGHT + IN_CONTACT

STIFFNESSES = [float(x) for x in np.exp(np.arange(-7, 8) * 0.2) if x != 1.0]
"""Starting factors: after ten periods of ringing, a modulus 20 % off is a cycle out of phase."""

PELLET = 0.3
"""Mass share of the pellet: a motion only determines share times offset."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One effect with p free parameters.

    values: free parameters (p,) → the effect's parameters. mean, spread: (p,) of the Gaussian prior. step: (p,) for
    finite differences. starts: (S, p). low, high: (p,) bounds. choices: number of candidates of one name (axes).
    weak: (W, p) where the effect hardly acts, from where it is searched again beside the model without it; W is 0 for
    effects that flights show.
    """

    name: str
    values: Callable[[Array], Values]
    mean: Array
    spread: Array
    step: Array
    starts: Array
    low: Array
    high: Array
    choices: int = 1
    weak: Array

    def world(self, base: WorldParameters, free: Array) -> WorldParameters:
        """Return ``base`` with the effect."""
        return with_effect(base, self.name, self.values(np.clip(free, self.low, self.high)))


def _make(
    name: str,
    values: Callable[[Array], Values],
    mean: list[float],
    spread: list[float],
    step: list[float],
    starts: list[list[float]],
    low: list[float],
    high: list[float],
    choices: int = 1,
    *,
    weak: Sequence[Sequence[float]] = (),
) -> Candidate:
    as_array = [np.asarray(a, dtype=np.float64) for a in (mean, spread, step, starts, low, high)]
    m, s, d, at, lo, hi = as_array
    little = np.asarray(weak, dtype=np.float64).reshape(-1, len(m))
    return Candidate(
        name=name, values=values, mean=m, spread=s, step=d, starts=at, low=lo, high=hi, choices=choices, weak=little
    )


def _one(
    name: str,
    parameter: str,
    guess: float,
    spread: float,
    starts: list[float],
    *,
    most: float,
    weak: Sequence[float] = (),
) -> Candidate:
    """Return a candidate with a single positive parameter, free in its logarithm."""
    return _make(
        name,
        lambda free: {parameter: math.exp(free[0])},
        [math.log(guess)],
        [spread],
        [0.03],
        [[math.log(x)] for x in starts],
        [math.log(guess) - 8],
        [math.log(most)],
        weak=[[math.log(x)] for x in weak],
    )


def candidates(base: WorldParameters, size: float, middle: Array) -> dict[str, tuple[Candidate, ...]]:
    """Return the candidates by name; several per name where a choice is discrete.

    size: half the body's width in m; middle: (3,) centre of the motion.
    """
    return {
        **_of_matter(base.modulus),
        **_of_contact(base.friction),
        **_of_forces(middle),
        "time_scale": (
            _make("time_scale", lambda f: {"rate": math.exp(f[0])}, [0.0], [0.1], [1e-3], [[0.0]], [-1.0], [1.0]),
        ),
        "mass_offset": (
            _make(
                "mass_offset",
                lambda f: {"fraction": PELLET, "offset_x": f[0], "offset_y": f[1], "offset_z": f[2]},
                [0.0] * 3,
                [0.3 * size] * 3,
                [1e-3 * size] * 3,
                [[0.0, 0.0, 0.0]],
                [-0.8 * size] * 3,
                [0.8 * size] * 3,
            ),
        ),
    }


def _of_matter(e: float) -> dict[str, tuple[Candidate, ...]]:
    """Return the candidates that change the matter, of Young's modulus ``e`` in Pa."""
    return {
        "stiffness": (_one("stiffness", "factor", 1.0, 0.8, STIFFNESSES, most=12.0, weak=[1.0]),),
        "internal_damping": (
            _one("internal_damping", "damping_time", 4e-4, 1.2, [1e-4, 3e-4], most=2e-3, weak=[5e-5]),
        ),
        "plastic_yield": (
            _one(
                "plastic_yield",
                "yield_stress",
                0.15 * e,
                0.8,
                [0.05 * e, 0.1 * e, 0.2 * e, 0.4 * e],
                most=3 * e,
                weak=[0.25 * e, 0.5 * e],
            ),
        ),
        "anisotropy": tuple(_fibres(e, axis) for axis in np.eye(3)),
        "stiffness_gradient": (_gradient(),),
    }


def _of_contact(mu: float) -> dict[str, tuple[Candidate, ...]]:
    """Return the candidates that change the contact with the ground, whose friction is believed to be ``mu``."""
    return {
        "friction": (
            _one("friction", "friction", max(mu, 0.02), 0.8, [0.4 * mu + 0.01, 1.8 * mu + 0.02], most=5.0, weak=[mu]),
        ),
        "adhesion": (
            _make(
                "adhesion",
                lambda f: {"pull_per_mass": math.exp(f[0]), "reach": math.exp(f[1])},
                [math.log(40.0), math.log(5e-3)],
                [1.0, 0.7],
                [0.05, 0.05],
                [[math.log(40.0), math.log(5e-3)], [math.log(150.0), math.log(5e-3)]],
                [-3.0, math.log(5e-4)],
                [7.0, math.log(0.05)],
                weak=[[math.log(10.0), math.log(5e-3)]],
            ),
        ),
    }


def _of_forces(middle: Array) -> dict[str, tuple[Candidate, ...]]:
    """Return the candidates that pull or push the body. middle: (3,) centre of the motion."""
    return {
        "air_drag": (_one("air_drag", "drag_per_mass", 0.1, 1.2, [0.1], most=20.0),),
        "wind": (
            _make(
                "wind",
                lambda f: {"drag_per_mass": math.exp(f[0]), "wind_x": f[1], "wind_y": f[2], "wind_z": f[3]},
                [math.log(0.1), 0.0, 0.0, 0.0],
                [1.0, 3.0, 3.0, 1.0],
                [0.05, 0.1, 0.1, 0.1],
                [[math.log(0.1), a * 2.0, b * 2.0, 0.0] for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))],
                [-6.0, -30.0, -30.0, -30.0],
                [3.0, 30.0, 30.0, 30.0],
            ),
        ),
        "magnus": (_make("magnus", lambda f: {"lift_per_mass": f[0]}, [0.0], [0.05], [1e-3], [[0.0]], [-2.0], [2.0]),),
        "buoyancy": (_make("buoyancy", lambda f: {"fraction": f[0]}, [0.0], [0.25], [1e-3], [[0.0]], [-2.0], [0.97]),),
        "gravity_tilt": (
            _make(
                "gravity_tilt",
                lambda f: {"angle": math.hypot(f[0], f[1]), "azimuth": math.atan2(f[1], f[0])},
                [0.0, 0.0],
                [0.1, 0.1],
                [1e-3, 1e-3],
                [[0.0, 0.0]],
                [-0.7, -0.7],
                [0.7, 0.7],
            ),
        ),
        "tether": tuple(_tether(middle, string) for string in (1.0, 0.0)),
    }


def _fibres(modulus: float, axis: Array) -> Candidate:
    x, y, z = (float(a) for a in axis)
    return _make(
        "anisotropy",
        lambda f: {"fibre_modulus": math.exp(f[0]), "axis_x": x, "axis_y": y, "axis_z": z},
        [math.log(modulus)],
        [0.9],
        [0.05],
        [[math.log(0.5 * modulus)], [math.log(1.5 * modulus)]],
        [math.log(1e-3 * modulus)],
        [math.log(20 * modulus)],
        choices=3,
        weak=[[math.log(0.1 * modulus)]],
    )


def _gradient() -> Candidate:
    def values(f: Array) -> Values:
        q = float(np.linalg.norm(f))
        d = f / q if q > 1e-9 else np.array([0.0, 0.0, 1.0])
        names = ("direction_x", "direction_y", "direction_z")
        return {"slope": min(q, 0.95), **dict(zip(names, (float(a) for a in d), strict=True))}

    starts = [list(sign * 0.45 * axis) for axis in np.eye(3) for sign in (1, -1)]
    return _make(
        "stiffness_gradient",
        values,
        [0.0] * 3,
        [0.4] * 3,
        [0.04] * 3,
        starts,
        [-0.95] * 3,
        [0.95] * 3,
        weak=[[0.0] * 3],
    )


def _tether(middle: Array, string: float) -> Candidate:
    def values(f: Array) -> Values:
        return {
            "stiffness_per_mass": math.exp(f[0]),
            "rest_length": float(f[1]),
            "anchor_x": float(f[2]),
            "anchor_y": float(f[3]),
            "anchor_z": float(f[4]),
            "string": string,
        }

    starts = [
        [math.log(10.0), 0.2, *(middle + np.array([dx, dy, 0.6]))]
        for dx, dy in ((0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
    ]
    return _make(
        "tether",
        values,
        [math.log(15.0), 0.3, *(middle + np.array([0.0, 0.0, 0.5]))],
        [1.0, 0.3, 0.6, 0.6, 0.6],
        [0.03, 0.01, 0.01, 0.01, 0.01],
        starts,
        [-4.0, 0.0, -20.0, -20.0, -20.0],
        [8.0, 10.0, 20.0, 20.0, 20.0],
        choices=2,
    )
