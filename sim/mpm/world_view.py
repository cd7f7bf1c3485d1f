# SPDX-License-Identifier: MIT
"""Read access to one world: positions, velocities, deformation, energies. World SI units."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from . import diagnostics
from .bodies import BodyParticles, Vector
from .kernels import layout
from .packing import materials_of
from .rigid.rigid_bodies import RigidPose
from .world_setup import WorldSetup

if TYPE_CHECKING:
    from .world_group import WorldGroup

Array = NDArray[np.float64]


class WorldView:
    """Read access to world ``index`` of ``group``."""

    def __init__(self, group: WorldGroup, index: int) -> None:
        self.group = group
        self.index = index

    @property
    def setup(self) -> WorldSetup:
        """Setup of the world."""
        return self.group.setups[self.index]

    @property
    def bodies(self) -> tuple[BodyParticles, ...]:
        """The world's bodies, in the order in which methods count them."""
        return self.setup.bodies

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self.group.time(self.index)

    @property
    def substeps(self) -> int:
        """Substeps taken since the world was made."""
        return int(self.group.control(self.index)[layout.SUBSTEPS])

    @property
    def particle_passes(self) -> int:
        """Passes over the particles since the world was made: one an explicit substep, several an implicit step."""
        return self.group.particle_passes(self.index)

    @property
    def stable_step(self) -> float:
        """Longest substep in s that the present state allows."""
        return self.group.stable_step(self.index)

    # ---- state --------------------------------------------------------------------------------------------------

    def _number(self, index: int) -> int:
        return self.group.body_number(self.index, index)

    def _gather(self, name: str, index: int, resting: Array) -> Array:
        return self.group.gather(name, self._number(index), resting)

    def _scale(self) -> float:
        return self.group.cells.scale

    def asleep(self, index: int) -> bool:
        """Return whether body ``index`` sleeps: it is at rest until something touches it."""
        return self.group.asleep(self._number(index))

    def positions(self, index: int) -> Array:
        """Particle positions (N, 3) of body ``index``, world metres, in the order in which they were given."""
        number, body = self._number(index), self.bodies[index]
        if not self.group.started(number):
            return body.positions.copy()
        if body.rigid:
            pose = self.pose(body.name)
            return body.positions @ pose.rotation.T + pose.translation
        return self.group.cells.points_to_world(self._gather("position", index, np.zeros((body.count, 3))))

    def pose(self, name: str) -> RigidPose:
        """Pose and motion of the rigid body or collider ``name``."""
        return self.group.pose(self.index, name)

    def velocities(self, index: int) -> Array:
        """Particle velocities (N, 3) of body ``index``, m/s. Zero before the body starts."""
        number, body = self._number(index), self.bodies[index]
        if body.rigid and self.group.started(number):
            pose = self.pose(body.name)
            return pose.velocity + np.cross(pose.spin, self.positions(index) - pose.center)
        return self.group.gather("v", number, np.zeros((body.count, 3))) / self._scale()

    def velocity_gradients(self, index: int) -> Array:
        """APIC velocity gradients (N, 3, 3) of body ``index``, 1/s."""
        number, body = self._number(index), self.bodies[index]
        if body.rigid and self.group.started(number):
            x, y, z = self.pose(body.name).spin
            turning = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            return np.asarray(np.broadcast_to(turning, (body.count, 3, 3)).copy())
        return self.group.gather("C", number, np.zeros((body.count, 3, 3)))

    def deformation_gradients(self, index: int) -> Array:
        """Deformation gradients (N, 3, 3) of body ``index``: current from undeformed shape.

        Of plastic materials and fluids they are fitted to the particles' positions, because their own deformation
        gradient holds the elastic part only; see ``diagnostics``.
        """
        number, body = self._number(index), self.bodies[index]
        if body.rigid:
            turn = self.pose(body.name).rotation if self.group.started(number) else np.eye(3)
            return np.asarray(np.broadcast_to(turn, (body.count, 3, 3)).copy())
        if not any(material.plastic for material in materials_of(body)):
            return self.elastic_gradients(index)
        return self.group.fitted(number, body.positions).gradients(self.positions(index))

    def elastic_gradients(self, index: int) -> Array:
        """Elastic parts (N, 3, 3) of the deformation gradients of body ``index``, which carry its stress."""
        number = self._number(index)
        if self.bodies[index].rigid:
            return self.deformation_gradients(index)
        return self.group.gather("F", number, np.broadcast_to(np.eye(3), (self.bodies[index].count, 3, 3)).copy())

    def memories(self, index: int) -> Array:
        """History variables (N,) of body ``index``: ln J_P of snow, ln of past expansion of sand, ln J of fluids."""
        number, body = self._number(index), self.bodies[index]
        if body.rigid or not any(material.plastic for material in materials_of(body)):
            return np.zeros(body.count)
        return self.group.gather("memory", number, np.zeros(body.count))

    # ---- diagnostics --------------------------------------------------------------------------------------------

    def _moving(self) -> list[int]:
        return [i for i in range(len(self.bodies)) if self.group.started(self._number(i))]

    def linear_momentum(self) -> Array:
        """Return the momentum (3,) of all bodies, kg m/s."""
        terms = [
            self.pose(self.bodies[i].name).momentum
            if self.bodies[i].rigid
            else diagnostics.linear_momentum(self.bodies[i].masses, self.velocities(i))
            for i in self._moving()
        ]
        return np.asarray(np.sum(terms, axis=0)) if terms else np.zeros(3)

    def angular_momentum(self, about: Vector = (0.0, 0.0, 0.0)) -> Array:
        """Angular momentum (3,) of all bodies about a world point, kg m²/s, with the affine velocities' part."""
        terms = [self._angular_momentum(i, np.asarray(about, dtype=np.float64)) for i in self._moving()]
        return np.asarray(np.sum(terms, axis=0)) if terms else np.zeros(3)

    def _angular_momentum(self, index: int, about: Array) -> Array:
        body = self.bodies[index]
        if body.rigid:
            pose = self.pose(body.name)
            return np.asarray(pose.angular_momentum + np.cross(pose.center - about, pose.momentum))
        return diagnostics.angular_momentum(
            body.masses,
            self.positions(index),
            self.velocities(index),
            self.velocity_gradients(index),
            1.0 / self._scale(),
            about,
        )

    def energy(self) -> diagnostics.Energy:
        """Energies of all bodies that have started, J."""
        kinetic = elastic = potential = 0.0
        gravity = np.asarray(self.setup.gravity_at(self.time))
        for i in self._moving():
            body = self.bodies[i]
            masses = body.masses
            if body.rigid:
                pose = self.pose(body.name)
                kinetic += pose.kinetic
                potential -= float(masses.sum() * gravity @ pose.center)
                continue
            kinetic += diagnostics.kinetic_energy(
                masses, self.velocities(i), self.velocity_gradients(i), 1.0 / self._scale()
            )
            elastic += self._elastic_energy(i)
            potential -= float(masses @ (self.positions(i) @ gravity))
        return diagnostics.Energy(kinetic=kinetic, elastic=elastic, potential=potential)

    def _elastic_energy(self, index: int) -> float:
        body = self.bodies[index]
        choice = self.group.material_choice(self.index, index)
        volumes = body.volumes if body.stiffness_scale is None else body.volumes * body.stiffness_scale
        gradients, memories = self.elastic_gradients(index), self.memories(index)
        parts = [(m, choice == i) for i, m in enumerate(materials_of(body, self.time))]
        parts = [(m, mine) for m, mine in parts if mine.any()]
        stored = sum(m.elastic_energy(volumes[mine], gradients[mine], memories[mine]) for m, mine in parts)
        relaxing = [(m, mine) for m, mine in parts if m.relaxing_share > 0]
        if relaxing:
            at_rest = np.broadcast_to(np.eye(3), (body.count, 3, 3)).copy()
            kept = self.group.gather("conformation", self._number(index), at_rest)
            stored += sum(m.relaxing_energy(volumes[mine], kept[mine]) for m, mine in relaxing)
        return stored

    def ground_gap(self, index: int) -> float:
        """Least distance in metres of body ``index``'s surface to the ground; below 0 under it, inf without ground."""
        ground = self.setup.ground
        if ground is None:
            return math.inf
        body = self.bodies[index]
        if body.rigid:
            assert body.surface is not None
            pose = self.pose(body.name)
            return float(ground.heights(body.surface.vertices @ pose.rotation.T + pose.translation).min())
        assert body.contact_radii is not None
        return float((ground.heights(self.positions(index)) - body.contact_radii).min())

    def particles_outside(self, index: int) -> int:
        """Particles of body ``index`` outside the engine's box; they move on there as inside."""
        cells = self.group.cells.points_to_engine(self.positions(index))
        outside = (cells < 0.0) | (cells > self.group.options.grid)
        return int(outside.any(axis=1).sum())
