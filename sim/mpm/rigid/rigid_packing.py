# SPDX-License-Identifier: MIT
"""Rigid bodies, colliders and their contact pairs as the first rows of the device's arrays, whose columns
``rigid_layout`` names. Metres in, cells out. Imports no Taichi.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bodies import BodyParticles
from ..colliders import Collider
from ..geometry.mass_properties import mass_properties
from ..geometry.signed_distance import DistanceLattice
from ..surface_contact import GROUND_NAME, MODES
from ..world_setup import WorldSetup
from . import rigid_layout as at
from .collision_shapes import NO_POINTS, PointSet, lattice_of, points_of, reach_of

Array = NDArray[np.float64]

MOST_TOGETHER = 40
"""Rigid bodies of a world up to which contacts that hold are solved together (``rigid_direct``): 0.5 MB and, where
everything touches everything, 5 million operations."""


@dataclass(kw_only=True, eq=False)
class RigidBody:
    """A rigid body or collider of world ``world``. World metres.

    center: centre of mass, of colliders the pivot. lattices: of distance, around it at rest; of a collider that deforms
    those of two keyframes, or none before the first segment. motions: velocities of the surfaces of these two.
    """

    world: int
    name: str
    source: BodyParticles | Collider
    center: Array
    lattices: list[DistanceLattice]
    points: PointSet
    motions: tuple[NDArray[np.float32], ...] = ()


def rigid_bodies_of(setups: Sequence[WorldSetup]) -> tuple[list[RigidBody], list[tuple[int, int]]]:
    """Return each world's rigid bodies (in the order of the setup) and then its colliders, and where those of each
    world begin and end."""
    result: list[RigidBody] = []
    spans = []
    for world, setup in enumerate(setups):
        first = len(result)
        result += [_of_body(world, body) for body in setup.bodies if body.rigid]
        result += [_of_collider(world, collider) for collider in setup.colliders]
        spans.append((first, len(result)))
    return result, spans


def _of_body(w: int, body: BodyParticles) -> RigidBody:
    assert body.surface is not None
    center = np.asarray(mass_properties(body.positions, body.masses, volumes=body.volumes).center)
    return RigidBody(
        world=w,
        name=body.name,
        source=body,
        center=center,
        lattices=[lattice_of(body.surface)],
        points=points_of(body.surface, center),
    )


def _of_collider(w: int, collider: Collider) -> RigidBody:
    center = collider.middle
    if collider.vertices is not None:
        return RigidBody(world=w, name=collider.name, source=collider, center=center, lattices=[], points=NO_POINTS)
    return RigidBody(
        world=w,
        name=collider.name,
        source=collider,
        center=center,
        lattices=[collider.lattice or lattice_of(collider.surface)],
        points=points_of(collider.surface, center),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidPacking:
    """What is packed. scales: cells per metre of each world; origins: (W, 3) the world point that is cell (0, 0, 0).

    bodies, spans: of all worlds, see ``rigid_bodies_of``.
    """

    setups: Sequence[WorldSetup]
    scales: Sequence[float]
    origins: Array
    bodies: Sequence[RigidBody]
    spans: Sequence[tuple[int, int]]

    def rows(self) -> dict[str, NDArray[np.generic]]:
        """Return the first contents of all arrays but those of the lattices, by name."""
        worlds, count = len(self.setups), max(len(self.bodies), 1)
        kinds, numbers, state = self._solids()
        points = self._surface_points(kinds)
        pairs, pair_numbers, pair_spans = self._pairs()
        ends, starts, size = self._systems()
        return {
            "steps": np.zeros(worlds),
            "world_spans": np.column_stack([self.spans, pair_spans, ends, starts]).astype(np.int32),
            "world_numbers": self._world_numbers(),
            "world_report": np.zeros((worlds, at.REPORT)),
            "solid_kinds": kinds,
            "solid_numbers": numbers,
            "solids": state,
            "impulses": np.zeros((count, 6)),
            **points,
            "pairs": pairs,
            "pair_numbers": pair_numbers,
            "counts": np.zeros(len(pairs)),
            "contacts": np.zeros(len(pairs) * at.SLOTS * at.ROW),
            "memory": np.zeros(len(pairs) * at.SLOTS * at.MEMORY),
            "reaches": np.zeros(len(pairs)),
            "scores": np.zeros(len(pairs) * at.BINS * at.CHOSEN),
            "chosen": np.zeros(len(pairs) * at.BINS * at.CHOSEN),
            "systems": np.zeros(size),
            "motions": np.zeros(1),
        }

    def solved_together(self) -> bool:
        """Return whether the contacts of any world are."""
        return max(self._systems()[1], default=-1) >= 0

    def _solids(self) -> tuple[NDArray[np.int32], Array, Array]:
        """Kinds, numbers and state of all bodies."""
        count = max(len(self.bodies), 1)
        kinds = np.zeros((count, at.KINDS), dtype=np.int32)
        numbers, state = np.zeros((count, at.NUMBERS)), np.zeros((count, at.STATE))
        for i, rigid in enumerate(self.bodies):
            scale, points, source = self.scales[rigid.world], rigid.points, rigid.source
            spacings = np.array([points.radius, points.spacing, points.bulge]) * scale
            numbers[i, [at.RADIUS, at.SPACING, at.BULGE]] = spacings
            state[i, at.X : at.X + 3] = (rigid.center - self.origins[rigid.world]) * scale
            state[i, at.Q] = 1.0
            state[i, at.R : at.R + 9] = np.eye(3).ravel()
            if isinstance(source, BodyParticles):
                _pack_body(source, scale, self.origins[rigid.world], numbers[i], state[i])
                kinds[i, at.KIND] = at.DYNAMIC
                continue
            if source.lattice is not None:
                numbers[i, at.RADIUS] = max(points.radius, reach_of(source.lattice, rigid.center)) * scale
            if source.vertices is not None:
                farthest = np.linalg.norm(source.vertices.values - rigid.center, axis=2).max()
                numbers[i, at.RADIUS] = float(farthest) * scale
            moves = any(track is not None for track in (source.translations, source.rotations, source.vertices))
            kinds[i, at.KIND] = at.KINEMATIC if moves else at.STATIC
        return kinds, numbers, state

    def _surface_points(self, kinds: NDArray[np.int32]) -> dict[str, NDArray[np.generic]]:
        """Clusters and points of all bodies; where those of each, and its lattices, begin goes into its row of
        ``kinds``."""
        rows, balls, starts = [], [], [np.zeros(1, dtype=np.int64)]
        shape = cluster = point = 0
        for i, rigid in enumerate(self.bodies):
            scale, points = self.scales[rigid.world], rigid.points
            layers = 2 if not rigid.lattices else 1
            kinds[i, at.SHAPE], kinds[i, at.LAYERS] = shape, layers
            kinds[i, at.CLUSTERS : at.CLUSTERS_END + 1] = cluster, cluster + points.hull, cluster + len(points.balls)
            shape += layers
            cluster += len(points.balls)
            lengths = np.ones(at.POINT)
            lengths[[0, 1, 2, 9, 10]] = scale
            rows.append(points.rows * lengths)
            balls.append(points.balls * scale)
            starts.append(points.starts[1:] + point)
            point += len(points.rows)
        return {
            "clusters": np.concatenate([*balls, np.zeros((1, 4))]),
            "cluster_starts": np.concatenate(starts),
            "points": np.concatenate([*rows, np.zeros((1, at.POINT))]),
        }

    def _systems(self) -> tuple[list[int], list[int], int]:
        """Of each world the first collider and the start of its equations, -1 for none; and the numbers of all."""
        ends, starts, size = [], [], 0
        for first, end in self.spans:
            free = sum(isinstance(self.bodies[i].source, BodyParticles) for i in range(first, end))
            together = 1 < free <= MOST_TOGETHER
            ends.append(first + free)
            starts.append(size if together else -1)
            size += 36 * free * free + 18 * free + 12 if together else 0
        return ends, starts, max(size, 1)

    def _pairs(self) -> tuple[NDArray[np.int32], Array, list[tuple[int, int]]]:
        """Every body that can move freely against the plane and against all others, either way round."""
        rows: list[tuple[int, int, int, int]] = []
        laws: list[Array] = []
        pair_spans = []
        for w, (first, end) in enumerate(self.spans):
            begin = len(rows)
            bodies = [i for i in range(first, end) if isinstance(self.bodies[i].source, BodyParticles)]
            if self.setups[w].ground is not None:
                for i in bodies:
                    rows.append((i, -1, -1, len(laws)))
                    laws.append(self._law(w, self.bodies[i].name, GROUND_NAME))
            for i in bodies:
                for j in range(i + 1, end):
                    p = len(rows)
                    both = len(self.bodies[j].points.rows) > 0
                    rows.append((i, j, p + 1 if both else -1, len(laws)))
                    if both:
                        rows.append((j, i, p, len(laws)))
                    laws.append(self._law(w, self.bodies[i].name, self.bodies[j].name))
            pair_spans.append((begin, len(rows)))
        rows = rows or [(0, -1, -1, 0)]
        return np.asarray(rows, dtype=np.int32), np.asarray(laws or [np.zeros(at.CONTACT)]), pair_spans

    def _law(self, w: int, a: str, b: str) -> Array:
        contact, scale = self.setups[w].contact(a, b), self.scales[w]
        law = np.zeros(at.CONTACT)
        law[at.KINETIC], law[at.STATIC_FRICTION] = contact.friction, contact.sticking
        law[at.RESTITUTION], law[at.MODE] = contact.restitution, MODES.index(contact.mode)
        law[at.LEVER] = contact.rolling_resistance * scale
        law[at.ADHESION], law[at.ADHESION_REACH] = contact.adhesion * scale, contact.adhesion_reach * scale
        return law

    def _world_numbers(self) -> Array:
        numbers = np.zeros((len(self.setups), at.WORLD))
        for w, setup in enumerate(self.setups):
            axes, offset = np.eye(3), 0.0
            if setup.ground is not None:
                normal = setup.ground.unit_normal
                first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
                first /= np.linalg.norm(first)
                axes = np.stack([first, np.cross(normal, first), normal])
                offset = -float(setup.ground.heights(self.origins[w])) * self.scales[w]
            numbers[w, at.PLANE : at.PLANE + 9] = axes.ravel()
            numbers[w, at.OFFSET] = offset
        return numbers


def _pack_body(body: BodyParticles, scale: float, origin: Array, numbers: Array, state: Array) -> None:
    properties = mass_properties(body.positions, body.masses, volumes=body.volumes)
    inertia = np.asarray(properties.inertia) * scale**2 * body.inertia_factor
    numbers[at.INVERSE_MASS], numbers[at.MASS] = 1 / properties.mass, properties.mass
    numbers[at.INERTIA : at.INERTIA + 9] = inertia.ravel()
    numbers[at.INVERSE_INERTIA : at.INVERSE_INERTIA + 9] = np.linalg.inv(inertia).ravel()
    numbers[at.GRAVITY_FACTOR : at.TETHER_STRING + 1] = body.forces.in_cells(scale, origin)
    state[at.V : at.V + 3] = np.asarray(body.velocity) * scale
    state[at.W : at.W + 3] = body.spin
    state[at.L : at.L + 3] = inertia @ np.asarray(body.spin)
    state[at.J : at.J + 9] = np.linalg.inv(inertia).ravel()
