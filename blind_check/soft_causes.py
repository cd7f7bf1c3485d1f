# SPDX-License-Identifier: MIT
"""Causes that act on soft bodies."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .finite_elements import (
    Array,
    SoftWorld,
    Solid,
)


@dataclass(frozen=True, kw_only=True)
class SoftCause:
    """A cause; effect, mechanism, low and high as in ``rigid_causes.Cause``. change: the world with that strength.

    weaker: whether a smaller strength is the larger effect (a yield stress). active: ``strained``, ``losing`` or
    ``always``. where: (M,) the elements it acts on, None for all or for those that flowed.
    """

    effect: str
    mechanism: str
    low: float
    high: float
    change: Callable[[float, SoftWorld], SoftWorld]
    parameters: Callable[[float], Mapping[str, Any]]
    weaker: bool = False
    active: str = "strained"
    where: NDArray[np.bool_] | None = None


def stiffness(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """Another Young's modulus; strength: log of the factor."""
    sign, young = float(rng.choice([-1, 1])), world.youngs_modulus
    return SoftCause(
        effect="stiffness",
        mechanism="stiffness",
        low=0.1,
        high=1.1,
        change=lambda s, w: dataclasses.replace(w, youngs_modulus=young * float(np.exp(sign * s))),
        parameters=lambda s: {"E": young * float(np.exp(sign * s))},
    )


def internal_damping(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """Kelvin-Voigt viscosity; strength: its time in s."""
    return SoftCause(
        effect="internal_damping",
        mechanism="internal_damping",
        low=2e-5,
        high=5e-4,
        change=lambda s, w: dataclasses.replace(w, viscosity_s=s),
        parameters=lambda s: {"tau": s},
        active="losing",
    )


def plastic_yield(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """Von Mises plasticity; strength: yield stress over Young's modulus."""
    young = world.youngs_modulus
    return SoftCause(
        effect="plastic_yield",
        mechanism="plastic_yield",
        low=0.1,
        high=1.0,
        change=lambda s, w: dataclasses.replace(w, yield_stress=s * young),
        parameters=lambda s: {"yield_s": s * young},
        weaker=True,
    )


def anisotropy(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """Fibres along one rest axis; strength: their modulus over Young's."""
    axis, young = np.eye(3)[int(rng.integers(3))], world.youngs_modulus
    return SoftCause(
        effect="anisotropy",
        mechanism="anisotropy",
        low=0.15,
        high=2.5,
        change=lambda s, w: dataclasses.replace(w, fibre=(s * young, axis)),
        parameters=lambda s: {"fibre": s * young, "axis": axis.tolist()},
    )


def stiffness_gradient(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """Stiffness that rises along one rest axis, E (1 + slope x); strength: slope, x from -1 to 1."""
    axis, sign = int(np.argmax(np.ptp(solid.nodes, axis=0))), float(rng.choice([-1, 1]))
    direction = sign * np.eye(3)[axis]
    return SoftCause(
        effect="stiffness_gradient",
        mechanism="stiffness_gradient",
        low=0.2,
        high=0.9,
        change=lambda s, w: dataclasses.replace(w, gradient=s * direction),
        parameters=lambda s: {"slope": s, "direction": direction.tolist()},
        where=np.abs(relative(solid)[:, axis]) > 0.5,
    )


def relative(solid: Solid) -> Array:
    """Return element centres over the half extents: (M, 3) in [-1, 1]."""
    return np.asarray(solid.centres / (np.ptp(solid.nodes, axis=0) / 2))


def periodic(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """A horizontal oscillating force; strength: m/s²."""
    azimuth, rate = rng.uniform(-np.pi, np.pi), float(rng.uniform(10, 25))
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return SoftCause(
        effect="unknown",
        mechanism="periodic",
        low=0.3,
        high=8.0,
        change=lambda s, w: dataclasses.replace(w, force=lambda t: s * np.sin(rate * t) * direction),
        parameters=lambda s: {"amplitude": (s * direction).tolist(), "omega": rate},
        active="always",
    )


def growth(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """A body that swells; strength: 1/s."""
    sign = float(rng.choice([-1, 1]))
    return SoftCause(
        effect="unknown",
        mechanism="growth",
        low=0.02,
        high=0.35,
        change=lambda s, w: dataclasses.replace(w, growth=sign * s),
        parameters=lambda s: {"rate": sign * s},
        active="always",
    )


def fading(solid: Solid, world: SoftWorld, rng: np.random.Generator) -> SoftCause:
    """A body that softens over time; strength: 1/s."""
    return SoftCause(
        effect="unknown",
        mechanism="fading",
        low=0.2,
        high=1.3,
        change=lambda s, w: dataclasses.replace(w, fading=s),
        parameters=lambda s: {"rate": s},
    )


Maker = Callable[[Solid, SoftWorld, np.random.Generator], SoftCause]

KNOWN_CAUSES: Mapping[str, Maker] = {
    "stiffness": stiffness,
    "internal_damping": internal_damping,
    "plastic_yield": plastic_yield,
    "anisotropy": anisotropy,
    "stiffness_gradient": stiffness_gradient,
}
UNKNOWN_CAUSES: Mapping[str, Maker] = {"periodic": periodic, "growth": growth, "fading": fading}
