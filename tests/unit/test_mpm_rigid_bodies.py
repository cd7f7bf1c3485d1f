# SPDX-License-Identifier: MIT
"""Rigid bodies and colliders: packing, poses over time, bad input, patches of round surfaces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import ElasticMaterial, RigidMaterial
from physgen.sim.errors import InputError
from physgen.sim.mpm.bodies import BodyForces, BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.kernels import runtime
from physgen.sim.mpm.rigid import rigid_layout as at
from physgen.sim.mpm.rigid.collision_shapes import patches, points_of
from physgen.sim.mpm.rigid.rigid_bodies import RigidBodies
from physgen.sim.mpm.solver_options import Ground, SolverOptions
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world_setup import WorldSetup

SCALE = 20.0
ORIGIN = (-1.0, -1.0, -1.0)


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


def cube(name: str = "cube", **fields: object) -> BodyParticles:
    grid = (np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / 4 - 0.5
    return BodyParticles(
        name=name,
        positions=0.4 * grid,
        volumes=np.full(64, 0.4**3 / 64),
        material=RigidMaterial(density=500.0),
        surface=surface_of(trimesh.creation.box((0.4, 0.4, 0.4))),
        **fields,
    )


def collider(name: str = "table", **motion: object) -> Collider:
    return Collider(name=name, surface=surface_of(trimesh.creation.box((1.0, 1.0, 0.2))), **motion)


def rigid_bodies(*setups: WorldSetup) -> RigidBodies:
    runtime.ensure_started(SolverOptions(grid=64))
    return RigidBodies(setups, [SCALE] * len(setups), [ORIGIN] * len(setups))


def row(world: RigidBodies, name: str, array: str, stride: int) -> np.ndarray:
    return world.arrays[array].to_numpy().reshape(-1, stride)[world.index(0, name)]


def test_mass_and_inertia_come_from_the_particles():
    """A cube of side a: I = m a²/6; twice as dense above: the centre of mass moves up by a/12."""
    plain = rigid_bodies(WorldSetup(bodies=(cube(),)))
    numbers = row(plain, "cube", "solid_numbers", at.NUMBERS)
    mass = 500.0 * 0.4**3
    assert numbers[at.MASS] == pytest.approx(mass)
    assert numbers[at.INERTIA : at.INERTIA + 9].reshape(3, 3) == pytest.approx(
        np.eye(3) * mass * (0.4 * SCALE) ** 2 / 6
    )
    body = cube()
    heavy = cube(density_scale=np.where(body.positions[:, 2] > 0, 2.0, 1.0))
    pose = rigid_bodies(WorldSetup(bodies=(heavy,))).pose(0, "cube")
    assert pose.center == pytest.approx([0.0, 0.0, 0.4 / 12])
    assert pose.translation == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_units_of_forces_and_contacts():
    forces = BodyForces(drag=3.0, wind=(1.0, 0.0, 0.0), tether_stiffness=7.0, tether_anchor=(0.0, 0.0, 1.0))
    contact = SurfaceContact(friction=0.2, static_friction=0.3, rolling_resistance=0.01, adhesion=2.0, mode="sticky")
    table = ContactTable().with_pair("cube", "table", contact)
    world = rigid_bodies(WorldSetup(bodies=(cube(forces=forces),), colliders=(collider(),), contacts=table))
    numbers = row(world, "cube", "solid_numbers", at.NUMBERS)
    assert numbers[at.DRAG] == pytest.approx(3.0 / SCALE)
    assert numbers[at.WIND] == pytest.approx(SCALE)
    assert numbers[at.TETHER_ANCHOR : at.TETHER_ANCHOR + 3] == pytest.approx([SCALE, SCALE, 2 * SCALE])
    pairs = world.arrays["pairs"].to_numpy().reshape(-1, at.PAIRS)
    assert pairs[:, :3].tolist() == [[0, 1, 1], [1, 0, 0]]
    law = world.arrays["pair_numbers"].to_numpy().reshape(-1, at.CONTACT)[pairs[0, 3]]
    assert law[:7] == pytest.approx([0.2, 0.3, 0.0, at.STICKY, 0.01 * SCALE, 2.0 * SCALE, 0.0])


def test_colliders_do_not_meet_each_other_and_worlds_have_their_own_pairs():
    one = WorldSetup(bodies=(cube(),), ground=Ground(), colliders=(collider("a"), collider("b")))
    world = rigid_bodies(one, one)
    spans = world.arrays["world_spans"].to_numpy().reshape(-1, at.SPANS)
    assert spans.tolist() == [[0, 3, 0, 5, 1, -1], [3, 6, 5, 10, 4, -1]]
    pairs = world.arrays["pairs"].to_numpy().reshape(-1, at.PAIRS)
    assert pairs[5:, :2].tolist() == [[3, -1], [3, 4], [4, 3], [3, 5], [5, 3]]


def test_collider_follows_its_tracks():
    """Two turns between keyframes are two turns; the pivot stays where the translation puts it."""
    turn = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 4 * np.pi]]))
    move = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    moving = collider(rotations=turn, translations=move, pivot=(0.5, 0.0, 0.0))
    world = rigid_bodies(WorldSetup(bodies=(cube(),), colliders=(moving,)))
    world.set_segments({0: (0.125, 0.5)})
    pose = world.pose(0, "table")
    assert pose.spin == pytest.approx([0.0, 0.0, 4 * np.pi])
    assert pose.velocity == pytest.approx([2.0, 0.0, 0.0])
    assert pose.center == pytest.approx([0.75, 0.0, 0.0])
    assert pose.rotation @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    world.set_segments({0: (2.0, 3.0)})
    assert np.abs(world.pose(0, "table").velocity).max() == 0.0


def test_collider_turns_steadily_about_the_axis_that_leads_on():
    keys = np.array([[0.5 * np.pi, 0.0, 0.0], [0.0, 0.5 * np.pi, 0.0]])
    turning = collider(rotations=Track(times=np.array([0.0, 1.0]), values=keys))
    world = rigid_bodies(WorldSetup(bodies=(cube(),), colliders=(turning,)))
    world.set_segments({0: (0.0, 1.0)})
    spin = world.pose(0, "table").spin
    world.set_segments({0: (0.5, 1.0)})
    assert world.pose(0, "table").spin == pytest.approx(spin)
    world.set_segments({0: (1.0, 2.0)})
    assert world.pose(0, "table").rotation @ [0.0, 0.0, 1.0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_body_waits_for_its_start():
    world = rigid_bodies(WorldSetup(bodies=(cube(start_time=0.5, velocity=(1.0, 0.0, 0.0)),)))
    world.advance(1e-3, 10)
    assert world.pose(0, "cube").center == pytest.approx([0.0, 0.0, 0.0], abs=1e-15)
    world.set_segments({0: (0.5, 1.0)})
    world.advance(1e-3, 10)
    assert world.pose(0, "cube").center[0] == pytest.approx(0.01)


def test_bad_input_is_named():
    setup = WorldSetup(bodies=(cube(),))
    with pytest.raises(InputError, match="give one of each"):
        RigidBodies([setup], [1.0, 2.0], [ORIGIN])
    with pytest.raises(InputError, match=r"scale is 0\.0"):
        RigidBodies([setup], [0.0], [ORIGIN])
    world = rigid_bodies(setup)
    with pytest.raises(InputError, match="no rigid body or collider 'cup'"):
        world.pose(0, "cup")
    with pytest.raises(InputError, match="segment is"):
        world.set_segments({0: (1.0, 1.0)})
    with pytest.raises(InputError, match="dt is"):
        world.advance(0.0)
    state = world.state()
    with pytest.raises(InputError, match="another scene"):
        world.restore({**state, "solids": state["solids"][:-1]})
    del state["memory"]
    with pytest.raises(InputError, match="no memory"):
        world.restore(state)


def test_worlds_without_rigid_bodies_pass():
    jelly = dataclasses.replace(cube(), material=ElasticMaterial(density=1e3, youngs_modulus=1e5, poisson_ratio=0.3))
    world = rigid_bodies(WorldSetup(bodies=(jelly,), ground=Ground()))
    world.advance(1e-3, 2)
    assert world.count == 0
    both = rigid_bodies(WorldSetup(bodies=(jelly,)), WorldSetup(bodies=(jelly, cube("rock"))))
    both.advance(1e-3, 2)
    assert both.index(1, "rock") == 0


def test_patches_know_balls_flats_and_edges():
    """A ball's radius within 2 % at all points; a box is flat, and not smooth at its edges."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    points = points_of(surface_of(ball), np.zeros(3))
    assert points.rows[:, 9:11] == pytest.approx(np.full((len(points.rows), 2), 0.3), rel=0.02)
    assert points.rows[:, 11].all()
    box = points_of(surface_of(trimesh.creation.box((0.4, 0.4, 0.4))), np.zeros(3))
    assert (box.rows[:, 9:11] == 0).all()
    at_edge = (np.abs(box.rows[:, :3]) > 0.199).sum(axis=1) > 1
    assert not box.rows[at_edge, 11].any()
    corners = box.rows[: box.starts[box.hull]]
    assert len(corners) == 8


def test_patches_of_few_points_are_points():
    table, smooth = patches(np.eye(3), np.eye(3), 1.0)
    assert not smooth.any()
    assert (table[:, 9:] == 0).all()
