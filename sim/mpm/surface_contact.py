# SPDX-License-Identifier: MIT
"""Contact parameters of two surfaces: friction, restitution, adhesion. No Taichi."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ..errors import InputError

MODES = ("separate", "slip", "sticky")
GROUND_NAME = "ground"
"""Name of the ground in a contact table; no body or collider may have it."""

LEAST_FRICTION, MOST_FRICTION = 0.05, 0.95


@dataclass(frozen=True, kw_only=True)
class SurfaceContact:
    """Contact parameters of two surfaces. Raises InputError on a value out of range."""

    friction: float = 0.4
    """Coulomb's kinetic coefficient, 0 (ice) to 10."""

    static_friction: float | None = None
    """Coulomb's static coefficient, at least ``friction``, up to 10; None takes ``friction``."""

    restitution: float = 0.0
    """Newton's coefficient for rigid bodies: speed of leaving over speed of approach, 0 to 1. Deformable bodies
    bounce by their own elasticity; there it is the share of the outermost layer's energy that is returned, which
    matters less with finer cells (docs/physics.md)."""

    mode: str = "separate"
    """"separate": Coulomb friction, free to leave. "slip": neither leaves nor rubs. "sticky": neither leaves nor
    slides."""

    rolling_resistance: float = 0.0
    """Lever arm in metres of the normal force against rolling, of rigid bodies, 0 to 1."""

    adhesion: float = 0.0
    """Pull of the surfaces towards each other within ``adhesion_reach`` in m/s², 0 to 1e5: force over the reduced mass
    m_a m_b / (m_a + m_b) of the bodies, which is the mass of one where the other is the ground or a collider."""

    adhesion_reach: float = 0.0
    """Distance in metres within which the adhesion pulls, 0 to 1."""

    def __post_init__(self) -> None:
        for name, high in (
            ("friction", 10.0),
            ("restitution", 1.0),
            ("rolling_resistance", 1.0),
            ("adhesion", 1e5),
            ("adhesion_reach", 1.0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= high):
                raise InputError(f"contact {name} is {value!r}: give 0 to {high:g}")
        static = self.static_friction
        if static is not None and not (math.isfinite(static) and self.friction <= static <= 10):
            raise InputError(f"contact static_friction is {static!r}: give {self.friction:g} (friction) to 10, or None")
        if self.mode not in MODES:
            raise InputError(f"contact mode is {self.mode!r}: choose one of {', '.join(MODES)}")

    @property
    def sticking(self) -> float:
        """The static coefficient."""
        return self.friction if self.static_friction is None else self.static_friction


def friction_from_roughness(roughness: float) -> float:
    """Coulomb coefficient of a surface with the estimated ``roughness``, 0 (polished) to 1 (coarse).

    Linear from 0.05 (wet ice, PTFE on steel) to 0.95 (rubber on concrete); the middle, 0.5, is dry wood on wood.
    """
    if not (math.isfinite(roughness) and 0 <= roughness <= 1):
        raise InputError(f"roughness is {roughness!r}: give 0 (polished) to 1 (coarse)")
    return LEAST_FRICTION + (MOST_FRICTION - LEAST_FRICTION) * roughness


@dataclass(frozen=True, kw_only=True)
class ContactTable:
    """Contact parameters by pair of names; ``GROUND_NAME`` is the ground.

    default: for all pairs that ``pairs`` does not name.
    pairs: keyed by the pair of names in sorted order; ``with_pair`` takes care of that.
    """

    default: SurfaceContact = field(default_factory=SurfaceContact)
    pairs: Mapping[tuple[str, str], SurfaceContact] = field(default_factory=lambda: MappingProxyType({}))

    def between(self, a: str, b: str) -> SurfaceContact:
        """Return the contact of ``a`` with ``b``, in either order."""
        return self.pairs.get((min(a, b), max(a, b)), self.default)

    def with_pair(self, a: str, b: str, contact: SurfaceContact) -> ContactTable:
        """This table with the contact of ``a`` with ``b`` set."""
        key = (min(a, b), max(a, b))
        return ContactTable(default=self.default, pairs=MappingProxyType({**self.pairs, key: contact}))
