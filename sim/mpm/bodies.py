# SPDX-License-Identifier: MIT
"""What is simulated: bodies made of particles. World metres, kilograms, seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .materials import ElasticMaterial

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyParticles:
    """One body at rest in its undeformed shape. Raises InputError on bad shapes or values."""

    name: str
    """What messages call the body."""

    positions: NDArray[np.float64]
    """Particle positions (N, 3), world metres."""

    volumes: NDArray[np.float64]
    """Volume of each particle (N,), m³, above 0."""

    material: ElasticMaterial
    """The whole body's material: any of ``materials``."""

    contact_radii: NDArray[np.float64] | None = None
    """Distance (N,) in metres at which a particle touches the ground: its distance to the body's surface, at most half
    the particle spacing, as ``sampling.sample_interior`` returns it. None takes half the cube root of the volume."""

    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity of the centre of mass, m/s."""

    spin: Vector = (0.0, 0.0, 0.0)
    """Angular velocity about the centre of mass, rad/s, right-handed."""

    start_time: float = 0.0
    """Time in s at which the body enters the simulation. Until then it stays in place and touches nothing."""

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
        for field in ("velocity", "spin"):
            vector = getattr(self, field)
            self._require(
                len(vector) == 3 and all(math.isfinite(c) for c in vector), field, vector, "give three finite numbers"
            )
        self._require(
            math.isfinite(self.start_time) and self.start_time >= 0,
            "start_time",
            self.start_time,
            "give seconds, 0 or more",
        )

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
        return self.volumes * self.material.density

    @property
    def center_of_mass(self) -> NDArray[np.float64]:
        """Centre of mass (3,), world metres."""
        return np.average(self.positions, axis=0, weights=self.volumes)

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
