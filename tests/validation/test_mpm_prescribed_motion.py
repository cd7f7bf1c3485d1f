# SPDX-License-Identifier: MIT
"""Prescribed motion of single particles, and colliders with distances of the caller's own."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.mpm.colliders import Collider, Surface
from physgen.sim.mpm.geometry.signed_distance import DistanceLattice
from physgen.sim.mpm.world import World


def test_given_velocities_carry_each_particle(box, options, similarity, cell):
    """A soft body without gravity, half of it sent off to +x and half to -x, keeps the momentum it was given."""
    body = box(youngs_modulus=1e3)
    world = World(bodies=[body], gravity=(0, 0, 0), similarity=similarity, options=options)
    world.advance(0.01)
    sense = np.where(body.positions[:, 0] > 0, 1.0, -0.5)
    velocities = sense[:, None] * np.array([0.2, 0.0, 0.0])
    world.set_motion(0, velocities=velocities)
    assert world.velocities(0) == pytest.approx(velocities, abs=1e-6)
    momentum = world.linear_momentum()
    world.advance(0.05)
    assert world.linear_momentum() == pytest.approx(momentum, abs=1e-5 * np.abs(momentum).max())
    way = (world.positions(0) - body.positions)[:, 0]
    assert way[body.positions[:, 0] > 2 * cell].min() > 0 > way[body.positions[:, 0] < -2 * cell].max()


def test_given_places_and_gradients_are_taken(box, options, similarity, cell):
    """Moved by 40 cells and stretched by 5 %, a body is there, keeps its order and swings back as an elastic one."""
    body = box(youngs_modulus=1e5)
    world = World(
        bodies=[body, box(name="other", bottom=(0.5, 0, 0))], gravity=(0, 0, 0), similarity=similarity, options=options
    )
    stretched = body.positions * [1.05, 1, 1] + [0.0, 40 * cell, 0.0]
    gradients = np.broadcast_to(np.diag([1.05, 1.0, 1.0]), (body.count, 3, 3))
    world.set_motion(0, velocities=np.zeros((body.count, 3)), positions=stretched, gradients=gradients)
    assert world.positions(0) == pytest.approx(stretched, abs=1e-7)
    energy = world.energy().elastic
    assert energy > 0
    world.advance(0.002)
    assert np.ptp(world.positions(0)[:, 0]) < np.ptp(stretched[:, 0])
    assert world.positions(1) == pytest.approx(world.bodies[1].positions, abs=1e-9)


def test_motion_that_cannot_be_given(box, box_body, options, similarity):
    world = World(bodies=[box(), box_body(name="rigid", center=(0.5, 0, 0))], similarity=similarity, options=options)
    count = world.bodies[0].count
    with pytest.raises(InputError, match="velocities have shape"):
        world.set_motion(0, velocities=np.zeros((count - 1, 3)))
    velocities = np.zeros((count, 3))
    velocities[7, 1] = np.nan
    with pytest.raises(InputError, match="particle 7"):
        world.set_motion(0, velocities=velocities)
    with pytest.raises(InputError, match="rigid"):
        world.set_motion(1, velocities=np.zeros((world.bodies[1].count, 3)))


def test_collider_with_distances_of_its_own(box, options, similarity, cell):
    """A body falls onto the plane that the lattice says, four cells above the mesh it stands for."""
    mesh = trimesh.creation.box((0.4, 0.4, 0.1))
    origin = np.array([-0.5, -0.5, -0.3])
    height = np.arange(17) * 0.0625 + origin[2] - 4 * cell
    lattice = DistanceLattice(
        origin=origin, spacing=0.0625, distances=np.broadcast_to(height, (17, 17, 17)).astype(np.float32)
    )
    collider = Collider(name="plate", surface=Surface(vertices=mesh.vertices, faces=mesh.faces), lattice=lattice)
    body = box(bottom=(0.0, 0.0, 4.5 * cell), youngs_modulus=1e5, cells=(4, 4, 4))
    world = World(bodies=[body], colliders=[collider], similarity=similarity, options=options)
    world.advance(0.6)
    low = (world.positions(0)[:, 2] - body.contact_radii).min()
    assert low == pytest.approx(4 * cell, abs=0.1 * cell)
