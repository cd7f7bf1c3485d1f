# SPDX-License-Identifier: MIT
"""What changes or holds things over time: keyframes, boxes of pins, the motion of colliders, contacts of pairs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from .checks import finite, require, require_range

Vector = tuple[float, float, float]

CONTACT_MODES = ("separate", "slip", "sticky")
GROUND = "ground"
"""What the ground is called in ``contacts``."""


@dataclass(frozen=True, kw_only=True)
class Key:
    """One keyframe: ``value`` at ``time_s`` seconds after frame 1. The field that holds it says what the value is."""

    time_s: float
    value: Vector

    def __post_init__(self) -> None:
        require(finite(self.time_s), "time_s", self.time_s, "give finite seconds")
        require(len(self.value) == 3 and finite(*self.value), "value", self.value, "give three finite numbers")


Keys = tuple[Key, ...]
"""Keyframes with straight lines between them, constant before the first and after the last; none: no such track."""


def require_rising(field_name: str, keys: Keys) -> None:
    """Raise InputError unless the times of ``keys`` rise."""
    for before, after in itertools.pairwise(keys):
        require(
            before.time_s < after.time_s,
            f"{field_name}: time_s after {before.time_s:g}",
            after.time_s,
            "give rising times, each once",
        )


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in world metres from its corner ``low`` to its corner ``high``."""

    low: Vector
    high: Vector

    def __post_init__(self) -> None:
        require(finite(*self.low), "low", self.low, "give three finite numbers in metres")
        good = finite(*self.high) and all(a < b for a, b in zip(self.low, self.high, strict=True))
        require(good, "high", self.high, f"give three finite numbers in metres above those of low, {self.low}")


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How a collider moves: as a whole (translations, rotations) or vertex by vertex (vertices_file).

    translations: m, added to where the mesh stands.
    rotations: rotation vectors (axis times angle in rad) about ``pivot``; the turn from one to the next is steady.
    pivot: world point in metres; None takes the middle of the mesh's bounding box.
    vertices_file: ``.npz`` in the scene folder with ``times`` (K,) in s, rising, and ``vertices`` (K, V, 3) in world
        metres, V and their order as in the object's mesh file.
    """

    translations: Keys = ()
    rotations: Keys = ()
    pivot: Vector | None = None
    vertices_file: str | None = None

    def __post_init__(self) -> None:
        require_rising("motion.translations", self.translations)
        require_rising("motion.rotations", self.rotations)
        pivot = self.pivot
        require(pivot is None or finite(*pivot), "motion.pivot", pivot, "give three finite numbers in metres or null")
        both = self.vertices_file is not None and bool(self.translations or self.rotations)
        require(not both, "motion.vertices_file", self.vertices_file, "leave out translations and rotations with it")


@dataclass(frozen=True, kw_only=True)
class Contact:
    """How one pair of surfaces meets; what is None follows from the two objects (docs/file-formats.md).

    between: two names of objects, or one and ``ground``.
    friction, static_friction: Coulomb's coefficients, 0 to 10.
    restitution: Newton's coefficient of rigid bodies, 0 to 1.
    mode: ``separate`` (friction, free to leave), ``slip`` (neither leaves nor rubs), ``sticky`` (neither leaves nor
        slides).
    rolling_resistance: lever arm in m of the normal force against rolling, of rigid bodies, 0 to 1.
    adhesion: pull in m/s² (force over mass) within ``adhesion_reach`` m; 0 to 1e5 and 0 to 1.
    """

    between: tuple[str, str]
    friction: float | None = None
    static_friction: float | None = None
    restitution: float | None = None
    mode: str | None = None
    rolling_resistance: float = 0.0
    adhesion: float = 0.0
    adhesion_reach: float = 0.0

    def __post_init__(self) -> None:
        first, second = self.between
        require(first != second, "contact.between", self.between, "name two different things")
        require_surface("contact", self.friction, self.static_friction, self.restitution, self.mode)
        require_range("contact.rolling_resistance", self.rolling_resistance, 0.0, 1.0, "metres")
        require_range("contact.adhesion", self.adhesion, 0.0, 1e5, "m/s²")
        require_range("contact.adhesion_reach", self.adhesion_reach, 0.0, 1.0, "metres")


def require_surface(
    where: str, friction: float | None, static_friction: float | None, restitution: float | None, mode: str | None
) -> None:
    """Raise InputError for numbers of a surface that are out of range; ``where`` begins the names of the fields."""
    require_range(f"{where}.friction", friction, 0.0, 10.0)
    require_range(f"{where}.static_friction", static_friction, 0.0, 10.0)
    if static_friction is not None:
        require(
            friction is not None and friction <= static_friction,
            f"{where}.static_friction",
            static_friction,
            f"give friction (it is {friction}) as well, and no less than it here",
        )
    require_range(f"{where}.restitution", restitution, 0.0, 1.0)
    known = mode is None or mode in CONTACT_MODES
    require(known, f"{where}.mode", mode, f"choose one of {', '.join(CONTACT_MODES)}, or null")
