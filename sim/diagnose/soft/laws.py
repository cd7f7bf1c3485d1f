# SPDX-License-Identifier: MIT
"""What acts in a soft body's world, as numbers: the nominal model and every effect added to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...effects.gravity_tilt import tilted

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Laws:
    """SI units; vectors of the body in its rest frame, vectors of the world in the ground's frame (normal +z).

    modulus, poisson_ratio, friction, gravity: what the nominal model has anyway; contact: how stiff its ground is over
    what it is by default, a number of the model and not of the world. The rest is neutral by default and
    means what the parameter of that effect means (sim/effects): factor of Young's modulus; slope of the stiffness as a
    vector towards the stiffer end; fibre modulus and axis; damping time; yield stress (0: none); drag over mass and the
    air's velocity; lift over mass; tether; adhesion and its reach; pellet's share of the mass and its offset; rate of
    the clock.
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
        """Shear modulus and Lamé's first constant in Pa."""
        e, nu = self.factor * self.modulus, self.poisson_ratio
        return e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def flight(self) -> tuple[object, ...]:
        """What matters to a body in free flight."""
        tether = (self.tether_stiffness, self.tether_length, self.tether_anchor, self.tether_string)
        return (self.gravity, self.drag, self.wind, self.lift, tether, self.fraction, self.offset, self.rate)


def with_effect(laws: Laws, name: str, values: Mapping[str, float]) -> Laws:
    """``laws`` with the effect ``name`` of the registry added; ``values`` are that effect's parameters."""

    def vector(prefix: str) -> Vector:
        return values[f"{prefix}_x"], values[f"{prefix}_y"], values[f"{prefix}_z"]

    def unit(prefix: str) -> Array:
        v = np.asarray(vector(prefix), dtype=np.float64)
        return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))

    match name:
        case "stiffness":
            return replace(laws, factor=laws.factor * values["factor"])
        case "internal_damping":
            return replace(laws, damping=laws.damping + values["damping_time"])
        case "plastic_yield":
            return replace(laws, yield_stress=values["yield_stress"])
        case "anisotropy":
            return replace(laws, fibre=values["fibre_modulus"], axis=_triple(unit("axis")))
        case "stiffness_gradient":
            return replace(laws, slope=_triple(values["slope"] * unit("direction")))
        case "friction":
            return replace(laws, friction=values["friction"])
        case "adhesion":
            return replace(laws, adhesion=laws.adhesion + values["pull_per_mass"], reach=values["reach"])
        case "air_drag":
            return replace(laws, drag=laws.drag + values["drag_per_mass"])
        case "wind":
            air = np.asarray(laws.wind) + np.asarray(vector("wind"))
            return replace(laws, drag=laws.drag + values["drag_per_mass"], wind=_triple(air))
        case "magnus":
            return replace(laws, lift=laws.lift + values["lift_per_mass"])
        case "buoyancy":
            return replace(laws, gravity=_triple((1 - values["fraction"]) * np.asarray(laws.gravity)))
        case "gravity_tilt":
            return replace(laws, gravity=_triple(tilted(np.asarray(laws.gravity), values["angle"], values["azimuth"])))
        case "tether":
            return replace(
                laws,
                tether_stiffness=values["stiffness_per_mass"],
                tether_length=values["rest_length"],
                tether_anchor=vector("anchor"),
                tether_string=values["string"] > 0,
            )
        case "mass_offset":
            return replace(laws, fraction=values["fraction"], offset=vector("offset"))
        case "time_scale":
            return replace(laws, rate=laws.rate * values["rate"])
    raise ValueError(f"effect {name!r} means nothing for a soft body's model")


def _triple(v: Array) -> Vector:
    x, y, z = (float(c) for c in v)
    return x, y, z
