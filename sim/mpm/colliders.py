# SPDX-License-Identifier: MIT
"""Keyframed tracks, and surfaces that bodies hit: static, moving, deforming. No Taichi."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .surface_contact import GROUND_NAME

if TYPE_CHECKING:
    from .geometry.signed_distance import DistanceLattice


SAME_TIME = 1e-5
"""Events closer than this in s happen together. Contacts take out overlap within a substep, so that one which only
fills the gap between two keyframes that were meant to be one, 1e-7 s long, would throw what it touches."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Keyframes: ``values`` (K, ...) at ``times`` (K,) in s, linear between them, constant before and after.

    Raises InputError unless the times rise and all numbers are finite.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        times = np.ascontiguousarray(self.times, dtype=np.float64)
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if times.ndim != 1 or len(times) == 0 or len(values) != len(times):
            raise InputError(f"track times has shape {times.shape} and values {values.shape}: give one value a time")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError("track times do not rise: give finite seconds in rising order, each once")
        if not np.isfinite(values).all():
            raise InputError("track values are not finite: remove NaN and infinite numbers")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the value at ``time`` in s."""
        i = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(len(self.times) - 2, 0)))
        if len(self.times) == 1:
            return np.asarray(self.values[0])
        share = np.clip((time - self.times[i]) / (self.times[i + 1] - self.times[i]), 0.0, 1.0)
        return np.asarray((1 - share) * self.values[i] + share * self.values[i + 1])

    def knots(self, start: float, end: float) -> list[float]:
        """Times of keyframes strictly between ``start`` and ``end``, where the slope changes."""
        return [float(t) for t in self.times if start < t < end]


Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A closed triangle mesh: vertices (V, 3) in metres, faces (T, 3). Raises InputError on bad shapes or numbers.

    Whether it is closed is checked where it matters, by ``geometry.signed_distance``.
    """

    vertices: Array
    faces: NDArray[np.int64]

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) == 0 or not np.isfinite(vertices).all():
            raise InputError(f"surface vertices have shape {vertices.shape}: give finite (V, 3), V above 0")
        if faces.ndim != 2 or faces.shape[1:] != (3,) or len(faces) == 0 or not np.issubdtype(faces.dtype, np.integer):
            raise InputError(f"surface faces have shape {faces.shape}: give whole numbers (T, 3), T above 0")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"surface faces name vertex {int(faces.max())}: there are {len(vertices)}, counted from 0")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.int64))


@dataclass(frozen=True, kw_only=True, eq=False)
class Collider:
    """A surface with prescribed motion that bodies hit.

    name: in messages and the contact table.
    surface: at rest, world metres.
    translations: Track of (3,) metres added to the surface, or None.
    rotations: Track of rotation vectors (3,) in radians (axis times angle) about ``pivot``, or None. Between keyframes
        the turn is steady about the axis that leads from one to the next.
    pivot: world point about which it turns; None takes the middle of the surface's bounding box.
    vertices: Track of (V, 3) world metres for a surface that deforms, in place of translations and rotations.
    lattice: signed distances of the surface at rest in place of those that are worked out of it: finer where it is
        thin, or with a boundary of the caller's own. Material may not be where it is below 0; rigid bodies touch it
        too, with their own points. Not of a surface that deforms.
    """

    name: str
    surface: Surface
    translations: Track | None = None
    rotations: Track | None = None
    pivot: tuple[float, float, float] | None = None
    vertices: Track | None = None
    lattice: DistanceLattice | None = None

    def __post_init__(self) -> None:
        if self.name == GROUND_NAME:
            raise InputError(f"collider name is {GROUND_NAME!r}: choose another, this one is the ground's")
        for field in ("translations", "rotations"):
            track = getattr(self, field)
            if track is not None and track.values.shape[1:] != (3,):
                raise InputError(f"collider {self.name!r}: {field} has values {track.values.shape}: give (K, 3)")
        if self.vertices is not None:
            if self.translations is not None or self.rotations is not None:
                raise InputError(f"collider {self.name!r}: give vertices or translations and rotations, not both")
            if self.lattice is not None:
                raise InputError(f"collider {self.name!r}: give vertices or a lattice, not both")
            if self.vertices.values.shape[1:] != self.surface.vertices.shape:
                raise InputError(
                    f"collider {self.name!r}: vertices has values {self.vertices.values.shape}: give (K, V, 3) with "
                    f"V = {len(self.surface.vertices)}, the surface's"
                )
        if self.pivot is not None and not all(math.isfinite(c) for c in self.pivot):
            raise InputError(f"collider {self.name!r}: pivot is {self.pivot!r}: give three finite numbers")

    @property
    def moves(self) -> bool:
        """Whether it ever moves."""
        return any(track is not None for track in (self.translations, self.rotations, self.vertices))

    @property
    def middle(self) -> Array:
        """World point (3,) about which it rotates."""
        if self.pivot is not None:
            return np.asarray(self.pivot, dtype=np.float64)
        return np.asarray(0.5 * (self.surface.vertices.min(axis=0) + self.surface.vertices.max(axis=0)))
