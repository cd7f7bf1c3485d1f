# SPDX-License-Identifier: MIT
"""Implicit steps of stiff matter: flight, rest, friction, rebound as explicit steps have them, at a cost that hardly
depends on the stiffness."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.constitutive import NeoHookeanMaterial, SandMaterial
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.implicit_choice import why_explicit
from physgen.sim.mpm.solver_options import Ground, SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.units import Similarity

G = 9.81
GRID = 64
CELL = 2.0 / GRID

pytestmark = pytest.mark.usefixtures("repeatable")  # implicit steps are a CPU's


def world_of(body: BodyParticles, ground: Ground | None = None, *, implicit: bool = True) -> World:
    """A world of one body in a box of 2 m, cells of 31 mm."""
    return World(
        bodies=[body],
        ground=ground,
        similarity=Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0)),
        options=SolverOptions(grid=GRID, implicit=implicit),
    )


def tilt(degrees: float) -> np.ndarray:
    """Rotation about y that tips the z axis towards +x."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def explicit_substeps(body: BodyParticles, duration: float) -> float:
    """Substeps that explicit steps would take for ``duration`` s, as long as the undeformed body allows."""
    return duration / (0.4 * CELL / body.material.wave_speed)


numbers = st.floats(-1.0, 1.0, allow_nan=False, width=32)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    stiffness=st.floats(7.3, 8.0),
    velocity=st.tuples(numbers, numbers, numbers),
    spin=st.tuples(numbers, numbers, numbers),
    sides=st.tuples(st.integers(3, 6), st.integers(3, 6), st.integers(3, 6)),
)
def test_a_stiff_body_flies_as_a_rigid_one(box, stiffness, velocity, spin, sides):
    """Parabola within 1e-5 of the way, momentum and angular momentum within 1e-4 (the requirement of free flight), by
    implicit steps, whatever speed (up to 5 m/s), spin (up to 17 rad/s) and box."""
    fast, turning = 3.0 * np.array(velocity), 10.0 * np.array(spin)
    body = box(cells=sides, youngs_modulus=10.0**stiffness, density=1000.0, velocity=tuple(fast), spin=tuple(turning))
    world = world_of(body)
    start = world.positions(0).mean(axis=0)
    momentum, turn = world.linear_momentum(), world.angular_momentum(tuple(start))
    size = np.linalg.norm(turn) + body.masses.sum() * 3 * CELL * 0.1
    for _ in range(3):
        world.advance(0.05)
    middle = world.positions(0).mean(axis=0)
    path = 0.15 * fast + np.array([0.0, 0.0, -0.5 * G * 0.15**2])
    assert np.linalg.norm(middle - start - path) < 1e-5 * (0.15 * np.linalg.norm(fast) + 0.11)
    given_momentum = body.masses.sum() * np.array([0.0, 0.0, -G * 0.15])
    assert np.allclose(world.linear_momentum() - momentum, given_momentum, atol=1e-4 * body.masses.sum())
    assert np.linalg.norm(world.angular_momentum(tuple(middle)) - turn) < 1e-4 * size
    assert world.particle_passes < explicit_substeps(body, 0.15)


@pytest.mark.long
@pytest.mark.parametrize("height_in_cells", [0.0, 0.23, 0.81])
@pytest.mark.parametrize("youngs_modulus", [1e7, 1e8])
def test_what_rests_stays(box, height_in_cells, youngs_modulus):
    """Within 0.1 cell of the ground wherever that lies between the nodes, and after it has settled for 0.1 s it moves
    by less than 0.001 cells in half a second."""
    height = height_in_cells * CELL
    world = world_of(box(bottom=(0.0, 0.0, height), youngs_modulus=youngs_modulus), Ground(point=(0.0, 0.0, height)))
    world.advance(0.1)
    before = world.positions(0)
    for _ in range(10):
        world.advance(0.05)
        assert abs(world.ground_gap(0)) < 0.1 * CELL
    assert np.abs(world.positions(0) - before).max() < 1e-3 * CELL
    assert world.particle_passes < 0.5 * explicit_substeps(world.bodies[0], 0.6)


@pytest.mark.long
def test_a_block_sags_under_its_weight(box):
    """rho g H² / 2E from the lowest to the highest point, free to widen, between the layers of particles: within 10 %,
    since a cell is a sixth of the block."""
    body = box(youngs_modulus=1e7)
    world = world_of(body, Ground(friction=0.0))
    world.advance(0.4)
    z, rest = world.positions(0)[:, 2], body.positions[:, 2]
    low, high = rest < rest.min() + 1e-6, rest > rest.max() - 1e-6
    sag = (rest[high].mean() - rest[low].mean()) - (z[high].mean() - z[low].mean())
    top, bottom = rest.max(), rest.min()
    stress = 1000.0 * G * ((6 * CELL) * (top - bottom) - 0.5 * (top**2 - bottom**2))
    assert sag == pytest.approx(stress / 1e7, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("youngs_modulus", [1e7, 1e8])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_block_slides_down_a_slope(box, youngs_modulus, friction):
    """a = g (sin th - mu cos th) within 3 % (Coulomb), from a tenth of a second on."""
    rotation = tilt(30.0)
    body = box(cells=(6, 6, 3), rotation=rotation, youngs_modulus=youngs_modulus)
    world = world_of(body, Ground(normal=tuple(rotation[:, 2]), friction=friction))
    world.advance(0.1)
    before = world.velocities(0).mean(axis=0)
    world.advance(0.2)
    gained = (world.velocities(0).mean(axis=0) - before) @ rotation[:, 0]
    expected = G * (np.sin(np.radians(30.0)) - friction * np.cos(np.radians(30.0)))
    assert gained / 0.2 == pytest.approx(expected, rel=0.03)


@pytest.mark.long
def test_a_block_sticks_below_the_friction_angle(box):
    """mu = 0.5 holds on 20 degrees (tan 20 = 0.36): less than 0.02 cells of creep in half a second."""
    rotation = tilt(20.0)
    body = box(cells=(6, 6, 3), rotation=rotation, youngs_modulus=1e7)
    world = world_of(body, Ground(normal=tuple(rotation[:, 2]), friction=0.5))
    world.advance(0.1)
    before = world.positions(0).mean(axis=0)
    world.advance(0.5)
    assert abs((world.positions(0).mean(axis=0) - before) @ rotation[:, 0]) < 0.02 * CELL


@pytest.mark.long
@pytest.mark.parametrize("degrees", [0.0, 17.0])
def test_a_dropped_block_bounces_as_with_explicit_steps(box, degrees):
    """Speed of the centre of mass after an impact at 2 m/s within 5 % of that with explicit steps: both read the same
    impact, the difference is when sorts drop the second derivatives of the transfers (2 % in explicit steps alone)."""
    after = []
    for implicit in (False, True):
        body = box(bottom=(0.0, 0.0, 0.3), rotation=tilt(degrees), youngs_modulus=1e7)
        world = world_of(body, Ground(friction=0.4), implicit=implicit)
        world.advance(0.32)
        after.append(world.velocities(0).mean(axis=0)[2])
    assert after[1] == pytest.approx(after[0], rel=0.05)


@pytest.mark.long
def test_ten_times_as_stiff_costs_at_most_half_as_much_again(box):
    """Passes over the particles for a block that falls on an edge, bounces and comes to rest in a second; explicit
    steps need sqrt(10) = 3.2 times as many."""
    passes = []
    for youngs_modulus in (1e7, 1e8):
        body = box(bottom=(0.0, 0.0, 0.3), rotation=tilt(17.0), youngs_modulus=youngs_modulus)
        world = world_of(body, Ground(friction=0.4))
        for _ in range(24):
            world.advance(1 / 24)
        passes.append(world.particle_passes)
    assert passes[1] < 1.5 * passes[0]
    assert passes[1] < explicit_substeps(body, 1.0) / 3


def test_bodies_apart_share_a_step_and_those_that_meet_do_not(box):
    """A flying block beside a resting one: the parabola within 1e-5 m and rest within 0.001 cells, by implicit steps.
    On top of each other they run to the same place as without the option, within 0.1 cells: explicit steps in
    bursts."""
    low = box(cells=(4, 4, 4), youngs_modulus=3e7, name="low")
    beside = box(bottom=(0.4, 0.0, 0.5), cells=(4, 4, 4), youngs_modulus=3e7, name="beside", spin=(3.0, 0.0, 0.0))
    above = box(bottom=(0.0, 0.0, 0.13), cells=(4, 4, 4), youngs_modulus=3e7, name="above")

    def run(other: BodyParticles, *, implicit: bool) -> World:
        around = Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0))
        options = SolverOptions(grid=GRID, implicit=implicit)
        world = World(bodies=[low, other], ground=Ground(), similarity=around, options=options)
        world.advance(0.1)
        return world

    world = run(beside, implicit=True)
    fallen = beside.positions.mean(axis=0) - world.positions(1).mean(axis=0)
    assert np.allclose(fallen, (0.0, 0.0, 0.5 * G * 0.01), atol=1e-5)
    assert np.abs(world.positions(0) - low.positions).max() < 1e-3 * CELL
    assert world.particle_passes < explicit_substeps(low, 0.1)
    met, expected = run(above, implicit=True), run(above, implicit=False)
    assert np.abs(met.positions(1) - expected.positions(1)).max() < 0.1 * CELL


def test_equal_bytes_repeated_and_from_a_checkpoint(box):
    """Whether a step is implicit follows from the state alone."""
    ends = []
    for _ in range(2):
        body = box(bottom=(0.0, 0.0, 0.05), rotation=tilt(17.0), youngs_modulus=3e7, cells=(4, 4, 4))
        world = world_of(body, Ground(friction=0.4))
        world.advance(0.05)
        kept = world.checkpoint()
        world.advance(0.1)
        ends.append(world.positions(0))
    world.restore(kept)
    world.advance(0.1)
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], world.positions(0))


def test_the_relaxing_part_relaxes(box):
    """Without load, the strain of a branch with a share q of the stiffness decays as exp(-t / (1 + q) relaxation time)
    (Zener's solid at zero stress): within 1 %."""
    material = NeoHookeanMaterial(
        density=1000.0, youngs_modulus=3e7, poisson_ratio=0.3, relaxing_share=0.3, relaxation_time=0.05
    )
    body = dataclasses.replace(box(cells=(4, 4, 4)), material=material)
    world = world_of(body)
    state = world.checkpoint()
    stretched = np.diag([1.001, 0.999, 1.0]).astype(np.float32)
    state["conformation"] = np.broadcast_to(stretched, (body.count, 3, 3)).copy()
    world.restore(state)
    left = []
    for duration in (0.01, 0.02):
        world.advance(duration)
        strain = world.checkpoint()["conformation"]
        left.append(np.mean(strain[:, 0, 0] - strain[:, 1, 1]))
    assert left[1] / left[0] == pytest.approx(np.exp(-0.02 / (0.05 * 1.3)), rel=0.01)
    assert world.particle_passes < 0.5 * explicit_substeps(body, 0.03)


def test_what_implicit_steps_do_not_know_takes_explicit_ones(box):
    """Sand, pins and rigid bodies are named; such a world runs to the same bytes with and without the option."""
    block = box(bottom=(0.0, 0.0, 0.02), youngs_modulus=1e7, cells=(3, 3, 3))
    sand = SandMaterial(density=1500.0, youngs_modulus=1e6, poisson_ratio=0.3, friction_angle=0.5)
    assert why_explicit(WorldSetup(bodies=(block,))) is None
    assert "sand" in str(why_explicit(WorldSetup(bodies=(dataclasses.replace(block, material=sand),))))
    held = dataclasses.replace(block, pins=block.positions[:, 2] < 0.03)
    assert "held" in str(why_explicit(WorldSetup(bodies=(held,))))
    ends = []
    for implicit in (False, True):
        world = world_of(held, Ground(), implicit=implicit)
        world.advance(0.02)
        ends.append(world.positions(0))
    assert np.array_equal(*ends)
