# SPDX-License-Identifier: MIT
"""Deformable bodies against rigid bodies and colliders: rest, friction, carrying, pushing, momentum, many worlds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import RigidMaterial
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World, Worlds
from physgen.sim.mpm.world_setup import WorldSetup

G = 9.81


def block(size, bottom, turn=None) -> Surface:
    """A box with the centre of its underside on ``bottom``, turned about it."""
    mesh = trimesh.creation.box(size)
    vertices = mesh.vertices + np.array([0.0, 0.0, size[2] / 2])
    if turn is not None:
        vertices = vertices @ turn.T
    return Surface(vertices=vertices + np.asarray(bottom), faces=mesh.faces)


def as_rigid(body: BodyParticles, cells, cell, bottom, density=500.0) -> BodyParticles:
    surface = block(np.array(cells) * cell, bottom)
    return dataclasses.replace(body, material=RigidMaterial(density=density), surface=surface)


def lowest(world: World, index: int) -> float:
    """Height in metres of the underside of a body on the level."""
    return float((world.positions(index)[:, 2] - world.bodies[index].contact_radii).min())


@pytest.mark.parametrize("height_in_cells", [0.1, 0.6])
def test_jelly_rests_on_a_table(box, options, similarity, cell, height_in_cells):
    """On a mesh collider as on the ground: underside within 0.1 cell of its top, wherever that is in the grid."""
    top = height_in_cells * cell
    table = Collider(name="table", surface=block((9 * cell, 9 * cell, 4 * cell), (0.0, 0.0, top - 4 * cell)))
    jelly = box(cells=(5, 5, 4), bottom=(0.0, 0.0, top + 0.3 * cell), youngs_modulus=2e5)
    world = World(bodies=[jelly], colliders=[table], similarity=similarity, options=options)
    for _ in range(6):
        world.advance(0.1)
    assert abs(lowest(world, 0) - top) < 0.1 * cell


def test_jelly_slides_down_a_turned_box(box, options, similarity, cell):
    """On the tilted face of a mesh collider: a = g (sin th - mu cos th) within 3 %, as on a tilted ground."""
    angle, friction = np.radians(25.0), 0.2
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    ramp = Collider(name="ramp", surface=block((24 * cell, 12 * cell, 4 * cell), -4 * cell * turn[:, 2], turn))
    contacts = ContactTable(default=SurfaceContact(friction=friction))
    jelly = box(cells=(6, 6, 3), rotation=turn, bottom=tuple(-5 * cell * turn[:, 0]), youngs_modulus=1e6)
    world = World(bodies=[jelly], colliders=[ramp], contacts=contacts, similarity=similarity, options=options)
    track = []
    for _ in range(12):
        world.advance(0.025)
        track.append((world.time, float(world.velocities(0).mean(axis=0) @ turn[:, 0])))
    slope = np.polyfit(*np.array(track).T, 1)[0]
    assert slope == pytest.approx(G * (np.sin(angle) - friction * np.cos(angle)), rel=0.03)


def test_jelly_on_a_rigid_block_on_the_ground(box, options, similarity, cell):
    """A stack of both kinds stays: neither moves by 0.02 cells once at rest, and there is no gap between them."""
    jelly = box(cells=(4, 4, 3), bottom=(0.0, 0.0, 3.05 * cell), youngs_modulus=1e5, name="jelly")
    wood = as_rigid(box(cells=(6, 6, 3), name="wood"), (6, 6, 3), cell, (0.0, 0.0, 0.0))
    world = World(bodies=[jelly, wood], ground=Ground(), similarity=similarity, options=options)
    world.advance(0.5)
    before = world.pose("wood").center
    assert abs(lowest(world, 0) - 3 * cell) < 0.02 * cell
    world.advance(0.5)
    assert np.abs(world.pose("wood").center - before).max() < 0.02 * cell
    assert abs(lowest(world, 0) - 3 * cell) < 0.02 * cell


@pytest.mark.parametrize(
    "density", [pytest.param(10.0, marks=pytest.mark.slow), 500.0, pytest.param(5000.0, marks=pytest.mark.slow)]
)
def test_rigid_block_on_jelly_comes_to_rest(box, options, similarity, cell, density):
    """Light or heavy, on jelly of 1000 kg/m³: at rest the jelly's push is the block's weight, and the surfaces touch
    within 0.1 cell; never deeper than 0.3 cells on the way."""
    jelly = box(cells=(8, 8, 4), youngs_modulus=2e5, name="jelly")
    jelly = dataclasses.replace(jelly, material=dataclasses.replace(jelly.material, damping_time=1e-3))
    wood = as_rigid(
        box(cells=(3, 3, 3), bottom=(0.1 * cell, 0.0, 4.3 * cell), name="wood"),
        (3, 3, 3),
        cell,
        (0.1 * cell, 0.0, 4.3 * cell),
        density,
    )
    world = World(bodies=[jelly, wood], ground=Ground(), similarity=similarity, options=options)

    def gap() -> float:
        under = (np.abs(world.positions(0)[:, :2] - (0.1 * cell, 0.0)) < 1.0 * cell).all(axis=1)
        top = (world.positions(0)[under, 2] + jelly.contact_radii[under]).max()
        return float(world.ground_gap(1) - top) / cell

    gaps = []
    for _ in range(20):
        world.advance(0.04)
        gaps.append(gap())
    assert min(gaps) > -0.3
    assert abs(gaps[-1]) < 0.1
    assert np.abs(world.pose("wood").velocity).max() < 0.01


def test_a_rigid_body_and_jelly_keep_their_momentum(box, options, similarity, cell):
    """Off-centre collision in free flight: momentum to 1e-5, angular momentum to 1e-4 of the collision's, energy not
    more than before."""
    jelly = box(
        cells=(4, 4, 4), bottom=(-3 * cell, 0.0, 0.0), velocity=(1.0, 0.0, 0.0), youngs_modulus=1e5, name="jelly"
    )
    at = (3 * cell, 0.5 * cell, 0.3 * cell)
    wood = as_rigid(box(cells=(4, 4, 4), bottom=at, name="wood"), (4, 4, 4), cell, at, 800.0)
    world = World(bodies=[jelly, wood], gravity=(0.0, 0.0, 0.0), similarity=similarity, options=options)
    momentum, spin, energy = world.linear_momentum(), world.angular_momentum(), world.energy().total
    world.advance(0.2)
    assert world.pose("wood").velocity[0] > 0.3
    size = np.abs(momentum).max()
    assert np.abs(world.linear_momentum() - momentum).max() < 1e-5 * size
    assert np.abs(world.angular_momentum() - spin).max() < 1e-4 * size * 4 * cell
    assert world.energy().total < energy


def test_a_moving_platform_carries_and_a_rising_one_lifts(box, options, similarity, cell):
    """A platform that sets out to the side at 0.2 m/s carries the jelly by friction; one that rises lifts it without a
    gap: both follow within 5 % of the way."""
    way = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.08, 0.0, 0.08]])
    track = Track(times=np.array([0.0, 0.1, 0.5]), values=way)
    platform = Collider(
        name="platform", surface=block((8 * cell, 8 * cell, 4 * cell), (0.0, 0.0, -4 * cell)), translations=track
    )
    jelly = box(cells=(4, 4, 3), youngs_modulus=3e5, name="jelly")
    jelly = dataclasses.replace(jelly, material=dataclasses.replace(jelly.material, damping_time=2e-3))
    contacts = ContactTable(default=SurfaceContact(friction=0.8))
    world = World(bodies=[jelly], colliders=[platform], contacts=contacts, similarity=similarity, options=options)
    world.advance(0.5)
    moved = (world.positions(0) - jelly.positions).mean(axis=0)
    assert moved[0] == pytest.approx(0.08, rel=0.05)
    assert lowest(world, 0) == pytest.approx(0.08, abs=0.1 * cell)


def test_keyframes_that_were_meant_for_a_frame_throw_nothing(box, options, similarity, cell):
    """Keyframes that rounding put 10 ns beside the frames change the motion of what they lift hardly at all."""
    times = np.arange(4) / 24
    way = np.stack([0 * times, 0 * times, 0.2 * cell * np.arange(4) ** 2], axis=1)
    heights = []
    for off in (0.0, 1e-8):
        track = Track(times=times + off * np.array([0.0, 1.0, -1.0, 1.0]), values=way)
        platform = Collider(
            name="platform", surface=block((8 * cell, 8 * cell, 4 * cell), (0.0, 0.0, -4 * cell)), translations=track
        )
        world = World(bodies=[box(cells=(4, 4, 3))], colliders=[platform], similarity=similarity, options=options)
        for frame in range(1, 4):
            world.advance(frame / 24 - world.time)
        heights.append(world.positions(0)[:, 2].mean())
    assert heights[1] == pytest.approx(heights[0], abs=1e-3 * cell)


def test_a_collider_that_deforms_pushes(box, options, similarity, cell):
    """A slab whose top rises in the middle of its life, given by vertices over time: the jelly on it goes along."""
    slab = block((8 * cell, 8 * cell, 4 * cell), (0.0, 0.0, -4 * cell))
    raised = slab.vertices.copy()
    raised[raised[:, 2] > -cell, 2] += 2 * cell
    track = Track(times=np.array([0.0, 0.2, 0.6]), values=np.stack([slab.vertices, slab.vertices, raised]))
    jelly = box(cells=(4, 4, 3), youngs_modulus=3e5)
    collider = Collider(name="slab", surface=slab, vertices=track)
    world = World(bodies=[jelly], colliders=[collider], similarity=similarity, options=options)
    world.advance(0.2)
    assert abs(lowest(world, 0)) < 0.1 * cell
    world.advance(0.4)
    assert lowest(world, 0) == pytest.approx(2 * cell, abs=0.15 * cell)


def test_jelly_in_a_corner_goes_through_neither_wall(box, options, similarity, cell):
    """Pushed into a corner by gravity: no particle more than 0.1 cell in the wall or in the ground."""
    wall = Collider(name="wall", surface=block((4 * cell, 16 * cell, 12 * cell), (5 * cell, 0.0, -2 * cell)))
    jelly = box(cells=(4, 4, 4), bottom=(-0.5 * cell, 0.0, 1.0 * cell), youngs_modulus=1e5, velocity=(2.0, 0.0, -1.0))
    world = World(
        bodies=[jelly],
        ground=Ground(),
        gravity=(9.81, 0.0, -9.81),
        colliders=[wall],
        similarity=similarity,
        options=options,
    )
    for _ in range(25):
        world.advance(0.01)
        points = world.positions(0)
        assert points[:, 0].max() < 3.1 * cell
        assert points[:, 2].min() > -0.1 * cell


@pytest.mark.usefixtures("repeatable")
def test_worlds_with_and_without_matter_are_worlds_alone(box, options, similarity, cell):
    """Solids only, matter only and both in one launch: each the same bytes as alone."""
    jelly = box(cells=(3, 3, 3), bottom=(0.0, 0.0, 4.2 * cell), youngs_modulus=1e5, name="jelly")
    wood = as_rigid(
        box(cells=(3, 3, 3), bottom=(0.2 * cell, 0.0, 0.4 * cell), name="wood", spin=(1.0, 2.0, 0.0)),
        (3, 3, 3),
        cell,
        (0.2 * cell, 0.0, 0.4 * cell),
    )
    ground = Ground(restitution=0.3)
    setups = [WorldSetup(bodies=bodies, ground=ground) for bodies in ((wood,), (jelly,), (wood, jelly))]
    together = Worlds(setups, similarity=similarity, options=options)
    for _ in range(3):
        together.advance(0.03)
    for i, setup in enumerate(setups):
        alone = Worlds([setup], similarity=similarity, options=options)
        for _ in range(3):
            alone.advance(0.03)
        for body in range(len(setup.bodies)):
            assert np.array_equal(alone[0].positions(body), together[i].positions(body)), (i, body)


@pytest.mark.usefixtures("repeatable")
def test_rigid_bodies_and_colliders_resume_exactly(box, options, similarity, cell):
    """A checkpoint of jelly, a rigid body and a turning collider continues with equal bytes."""
    jelly = box(cells=(3, 3, 3), bottom=(0.0, 0.0, 4.2 * cell), youngs_modulus=1e5, name="jelly")
    wood = as_rigid(box(cells=(3, 3, 3), name="wood"), (3, 3, 3), cell, (0.0, 0.0, 0.0))
    turning = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    plate = Collider(
        name="plate", surface=block((8 * cell, 8 * cell, 2 * cell), (0.0, 0.0, -2 * cell)), rotations=turning
    )

    def make() -> World:
        return World(bodies=[jelly, wood], colliders=[plate], similarity=similarity, options=options)

    whole = make()
    for _ in range(4):
        whole.advance(0.02)
    first = make()
    for _ in range(2):
        first.advance(0.02)
    second = make()
    second.restore(first.checkpoint())
    for _ in range(2):
        second.advance(0.02)
    for i in range(2):
        assert np.array_equal(whole.positions(i), second.positions(i))
