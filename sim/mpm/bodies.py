# SPDX-License-Identifier: MIT
"""Bodies made of particles, and the forces on them. World metres, kilograms, seconds. No Taichi."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..constitutive import DeformableMaterial, RigidMaterial, bounding_speed
from ..errors import InputError
from .colliders import Surface, Track
from .surface_contact import GROUND_NAME

Vector = tuple[float, float, float]

THIN_CELLS = 1.5
"""Thickness in grid cells from which on a body's faces are found as those of any other."""


@dataclass(frozen=True, kw_only=True)
class BodyForces:
    """Accelerations of a body of velocity v and angular velocity w at the place x of its centre of mass.

        a = gravity_factor g - drag |v - wind| (v - wind) + lift w x (v - wind) + tether

    The tether pulls with tether_stiffness (d - tether_length) towards its anchor, d the distance to it; a string
    (``tether_string``) only where d is larger than its length. Drag of matter that deforms acts with the matter's local
    velocity, all else on the body as a whole. Raises InputError on a value out of range.
    """

    gravity_factor: float = 1.0
    """Share of gravity that acts, -10 to 10; 1 - fraction of the weight that a medium carries."""

    drag: float = 0.0
    """rho c_d A / (2 m) in 1/m, 0 to 1e4."""

    wind: Vector = (0.0, 0.0, 0.0)
    """Velocity of the air in m/s."""

    lift: float = 0.0
    """Magnus coefficient S / m, no unit, -10 to 10."""

    tether_stiffness: float = 0.0
    """Spring constant over mass in 1/s², 0 to 1e6."""

    tether_length: float = 0.0
    """Length in metres at which the tether does not pull, 0 or more."""

    tether_anchor: Vector = (0.0, 0.0, 0.0)
    """Where the tether is fixed, world metres."""

    tether_string: bool = False
    """Whether the tether only pulls (a string) or also pushes (a spring)."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("gravity_factor", -10.0, 10.0),
            ("drag", 0.0, 1e4),
            ("lift", -10.0, 10.0),
            ("tether_stiffness", 0.0, 1e6),
            ("tether_length", 0.0, 1e6),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"force {name} is {value!r}: give {low:g} to {high:g}")
        for name in ("wind", "tether_anchor"):
            vector = getattr(self, name)
            if len(vector) != 3 or not all(math.isfinite(c) for c in vector):
                raise InputError(f"force {name} is {vector!r}: give three finite numbers")

    def in_cells(self, scale: float, origin: NDArray[np.float64]) -> NDArray[np.float64]:
        """The fields in their order as 12 numbers for the kernels, ``scale`` cells a metre counted from ``origin``."""
        return np.array(
            [
                self.gravity_factor,
                self.drag / scale,
                *(np.asarray(self.wind) * scale),
                self.lift,
                self.tether_stiffness,
                self.tether_length * scale,
                *((np.asarray(self.tether_anchor) - origin) * scale),
                float(self.tether_string),
            ]
        )


NO_FORCES = BodyForces()


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyParticles:
    """One body at rest in its undeformed shape. Raises InputError on bad shapes or values."""

    name: str
    """Name of the body in messages."""

    positions: NDArray[np.float64]
    """Particle positions (N, 3), world metres."""

    volumes: NDArray[np.float64]
    """Volume of each particle (N,), m³, above 0."""

    material: DeformableMaterial | RigidMaterial
    """Material: a model of ``constitutive``, or rigid."""

    materials: tuple[DeformableMaterial, ...] = ()
    """More materials in the same body, for the particles that ``material_index`` sends there; none may be rigid."""

    material_index: NDArray[np.int32] | None = None
    """Material of each particle (N,): 0 is ``material``, i is ``materials[i - 1]``. None: all of ``material``."""

    material_track: tuple[tuple[float, int], ...] = ()
    """(time s, index), times rising from 0 or more: from that time on all particles are of that material, with the mass
    and volume they have. Not of rigid bodies."""

    parameter_tracks: Mapping[str, Track] = field(default_factory=dict)
    """Parameters of ``material`` over time by name, fields that its law reads, values (K,) in their units: at each time
    all of that material has the values of then, whatever it was made with. Not the density: mass stays. Particles of
    ``materials``, by index or from a time on, keep theirs. Not of rigid bodies."""

    density_scale: NDArray[np.float64] | None = None
    """Factor (N,) on the density of each particle, above 0; None: 1."""

    inertia_factor: float = 1.0
    """Factor on the moments of inertia that its particles have, above 0. Of rigid bodies only."""

    stiffness_scale: NDArray[np.float64] | None = None
    """Factor (N,) on the moduli of each particle, above 0; None: 1."""

    surface: Surface | None = None
    """The body's skin at rest, world metres; a rigid body needs it."""

    forces: BodyForces = NO_FORCES
    """Forces on the body besides gravity and contact."""

    acceleration: Track | None = None
    """Force over mass of the whole body over time, (K, 3) m/s²."""

    velocity_keys: Track | None = None
    """At each of its times the body's mean velocity is set to (3,) m/s: all particles change by the same amount.
    Between the times it moves freely."""

    pins: NDArray[np.bool_] | None = None
    """Particles (N,) held in place, or where ``pin_motion`` takes them. Not of rigid bodies."""

    pin_motion: Track | None = None
    """Displacement (K, 3) in metres of all pinned particles from rest, over time; None holds them there."""

    goal_stiffness: float = 0.0
    """Pull of every particle to its place at rest (moved with ``pin_motion``), force over mass and distance in 1/s²,
    0 (none) to 1e6."""

    goal_damping: float = 0.0
    """Share of critical damping of the pull to the goal, 0 to 1."""

    contact_radii: NDArray[np.float64] | None = None
    """Distance (N,) in metres at which a particle touches the ground: its distance to the body's surface, at most half
    the particle spacing, as ``sample_interior`` returns it. None takes half the cube root of the volume."""

    thickness: float | None = None
    """Metres across a body that is thin all over, a sheet or a rod; None of others. Its contact with other bodies that
    deform then knows its faces, see ``deformable_contact``; its other contacts know them anyway."""

    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity of the centre of mass, m/s."""

    spin: Vector = (0.0, 0.0, 0.0)
    """Angular velocity about the centre of mass, rad/s, right-handed."""

    start_time: float = 0.0
    """Time in s at which the body enters the simulation. Until then it stays in place and touches nothing."""

    asleep: bool = False
    """Whether the body keeps its pose until something moving reaches it, if it stands at the start and nothing but
    gravity acts on it; see ``sleeping``."""

    held: bool = False
    """Whether it does so where nothing carries it, too."""

    def __post_init__(self) -> None:
        positions = np.ascontiguousarray(self.positions, dtype=np.float64)
        volumes = np.ascontiguousarray(self.volumes, dtype=np.float64)
        self._require(
            positions.ndim == 2 and positions.shape[1:] == (3,) and len(positions) > 0,
            "positions",
            positions.shape,
            "give an (N, 3) array with N above 0",
        )
        self._require(bool(np.isfinite(positions).all()), "positions", "not finite", "remove NaN and infinite numbers")
        self._require(
            volumes.shape == (len(positions),), "volumes", volumes.shape, f"give {len(positions)}, one a particle"
        )
        self._require(
            bool(np.isfinite(volumes).all() and (volumes > 0).all()),
            "volumes",
            "not all above 0",
            "give m³ above 0 for every particle",
        )
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "volumes", volumes)
        radii = 0.5 * np.cbrt(volumes) if self.contact_radii is None else self.contact_radii
        radii = np.ascontiguousarray(radii, dtype=np.float64)
        self._require(
            radii.shape == (len(positions),) and bool(np.isfinite(radii).all() and (radii >= 0).all()),
            "contact_radii",
            radii.shape,
            f"give {len(positions)} finite metres, none below 0",
        )
        object.__setattr__(self, "contact_radii", radii)
        self._check_fields(len(positions))
        thin = self.thickness
        self._require(
            thin is None or (math.isfinite(thin) and thin > 0), "thickness", thin, "give metres above 0, or None"
        )
        for name in ("velocity", "spin"):
            vector = getattr(self, name)
            self._require(
                len(vector) == 3 and all(math.isfinite(c) for c in vector), name, vector, "give three finite numbers"
            )
        self._require(
            math.isfinite(self.start_time) and self.start_time >= 0,
            "start_time",
            self.start_time,
            "give seconds, 0 or more",
        )

    def _check_fields(self, count: int) -> None:
        """Check the fields with a value per particle or per time."""
        for name in ("density_scale", "stiffness_scale"):
            scale = getattr(self, name)
            if scale is not None:
                scale = np.ascontiguousarray(scale, dtype=np.float64)
                good = scale.shape == (count,) and bool(np.isfinite(scale).all() and (scale > 0).all())
                self._require(good, name, scale.shape, f"give {count} finite numbers above 0")
                object.__setattr__(self, name, scale)
        if self.material_index is not None:
            index = np.ascontiguousarray(self.material_index, dtype=np.int32)
            good = index.shape == (count,) and bool((index >= 0).all() and (index <= len(self.materials)).all())
            self._require(good, "material_index", index.shape, f"give {count} numbers from 0 to {len(self.materials)}")
            object.__setattr__(self, "material_index", index)
        self._check_material_track()
        self._check_parameter_tracks()
        if self.pins is not None:
            pins = np.ascontiguousarray(self.pins, dtype=np.bool_)
            self._require(pins.shape == (count,), "pins", pins.shape, f"give {count}, one a particle")
            object.__setattr__(self, "pins", pins)
        for name in ("acceleration", "velocity_keys", "pin_motion"):
            track = getattr(self, name)
            if track is not None:
                self._require(track.values.shape[1:] == (3,), name, track.values.shape, "give values (K, 3)")
        for name, high in (("goal_stiffness", 1e6), ("goal_damping", 1.0)):
            value = getattr(self, name)
            self._require(math.isfinite(value) and 0 <= value <= high, name, value, f"give 0 to {high:g}")
        self._require(self.name != GROUND_NAME, "name", self.name, "choose another, this one is the ground's")
        if self.rigid:
            self._require(self.surface is not None, "surface", None, "give the mesh of a rigid body")
            factor = self.inertia_factor
            self._require(math.isfinite(factor) and factor > 0, "inertia_factor", factor, "give a number above 0")
            held = self.pins is not None or self.goal_stiffness > 0
            held = held or bool(self.materials or self.material_track or self.parameter_tracks)
            self._require(not held, "pins, goals and materials", "given", "leave them out of a rigid body")
        else:
            self._require(self.inertia_factor == 1.0, "inertia_factor", self.inertia_factor, "give 1: it deforms")

    def _check_material_track(self) -> None:
        times = [time for time, _ in self.material_track]
        rising = all(a < b for a, b in zip([-1.0, *times], times, strict=False))
        self._require(
            all(math.isfinite(t) and t >= 0 for t in times) and rising,
            "material_track",
            self.material_track,
            "give rising times of 0 s or more, each once",
        )
        known = all(isinstance(i, int) and 0 <= i <= len(self.materials) for _, i in self.material_track)
        self._require(
            known, "material_track", self.material_track, f"give indices of materials, 0 to {len(self.materials)}"
        )

    def _check_parameter_tracks(self) -> None:
        if self.rigid or not self.parameter_tracks:
            return
        assert not isinstance(self.material, RigidMaterial)
        known = [name for name in self.material.reads if name != "fibre_axis"]
        for name, track in self.parameter_tracks.items():
            self._require(name in known, "parameter_tracks", name, f"give some of {', '.join(known)}")
            self._require(track.values.ndim == 1, f"parameter_tracks[{name!r}]", track.values.shape, "give values (K,)")
        try:
            _ = self.materials_over_time
        except InputError as error:
            raise InputError(f"body {self.name!r}: parameter_tracks: {error}") from None

    def material_at(self, time: float) -> DeformableMaterial:
        """``material``, of a body that deforms, as its tracks have it at ``time`` in s."""
        assert not isinstance(self.material, RigidMaterial)
        if not self.parameter_tracks:
            return self.material
        values: dict[str, Any] = {name: float(track.at(time)) for name, track in self.parameter_tracks.items()}
        return dataclasses.replace(self.material, **values)

    @property
    def materials_over_time(self) -> tuple[DeformableMaterial, ...]:
        """All that a body that deforms is made of at any keyframe: ``material`` at each, and ``materials``."""
        times = sorted({float(t) for track in self.parameter_tracks.values() for t in track.times}) or [0.0]
        return (*(self.material_at(time) for time in times), *self.materials)

    @property
    def rigid(self) -> bool:
        """Whether the body does not deform."""
        return isinstance(self.material, RigidMaterial)

    def bounding_speed(self, material: DeformableMaterial, scale: float) -> float:
        """Speed in cells/s of the wave in ``material`` that bounds the substep, with ``scale`` cells a metre."""
        stiffer = 1.0 if self.stiffness_scale is None else float(self.stiffness_scale.max())
        lighter = 1.0 if self.density_scale is None else float(self.density_scale.min())
        return bounding_speed(
            scale * material.wave_speed * math.sqrt(stiffer / lighter),
            scale**2 * material.diffusivity * stiffer / lighter,
        )

    @property
    def spring_step(self) -> float:
        """Longest substep in s that goals and the tether allow: explicit springs are stable to 2 / frequency."""
        return 0.5 / math.sqrt(max(self.goal_stiffness + self.forces.tether_stiffness, 1e-12))

    def _require(self, condition: bool, field: str, value: object, remedy: str) -> None:
        if not condition:
            raise InputError(f"body {self.name!r}: {field} is {value!r}: {remedy}")

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.positions)

    @property
    def masses(self) -> NDArray[np.float64]:
        """Mass of each particle (N,), kg."""
        density = np.full(self.count, self.material.density)
        if self.material_index is not None:
            density = np.array([self.material.density, *(m.density for m in self.materials)])[self.material_index]
        return self.volumes * density if self.density_scale is None else self.volumes * density * self.density_scale

    @property
    def center_of_mass(self) -> NDArray[np.float64]:
        """Centre of mass (3,), world metres."""
        return np.average(self.positions, axis=0, weights=self.masses)

    @property
    def initial_velocities(self) -> NDArray[np.float64]:
        """Velocity of each particle (N, 3), m/s: translation plus rotation about the centre of mass."""
        arms = self.positions - self.center_of_mass
        return np.asarray(self.velocity) + np.cross(np.asarray(self.spin), arms)

    @property
    def initial_velocity_gradient(self) -> NDArray[np.float64]:
        """Velocity gradient (3, 3), 1/s, of the rotation: the matrix of ``spin x``."""
        x, y, z = self.spin
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
