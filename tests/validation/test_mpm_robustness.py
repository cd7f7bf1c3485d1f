# SPDX-License-Identifier: MIT
"""No preset blows up; equal input gives equal bytes; bodies keep their particles."""

from __future__ import annotations

import io

import numpy as np
import pytest
from physgen.benchmarks.mpm import world_of
from physgen.sim.errors import InputError, SimulationError
from physgen.sim.mpm.solver_options import Ground, SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.scene.units import Similarity


@pytest.mark.parametrize("youngs_modulus", [1e4, 1e6, 1e8])
@pytest.mark.parametrize("density", [20.0, 1000.0, 8000.0])
def test_no_material_blows_up_when_dropped_at_5_m_per_s(box, options, similarity, cell, youngs_modulus, density):
    """600 substeps around the impact: finite, and no faster than twice the impact."""
    body = box(
        cells=(3, 3, 3),
        bottom=(0.003, 0.001, 0.05 * cell),
        youngs_modulus=youngs_modulus,
        density=density,
        velocity=(0.5, 0.0, -5.0),
    )
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    world.advance(0.06 * cell / 5)
    while world.substeps < 600 and world.time < 0.3:
        world.advance(min(100 * world.stable_step, 0.01))
    for values in (world.positions(0), world.velocities(0), world.deformation_gradients(0)):
        assert np.isfinite(values).all()
    assert np.linalg.norm(world.velocities(0).mean(axis=0)) < 10.0
    assert np.linalg.norm(world.velocities(0), axis=1).max() < 20.0


def test_very_different_bodies_in_one_scene(box, options, similarity, cell):
    """Foam on steel on jelly, falling: finite, energy does not grow."""
    bodies = [
        box(cells=(5, 5, 2), bottom=(0.0, 0.0, 0.2 * cell), youngs_modulus=1e4, density=1000.0, name="jelly"),
        box(cells=(3, 3, 3), bottom=(0.0, 0.0, 4.0 * cell), youngs_modulus=1e7, density=8000.0, name="steel"),
        box(cells=(4, 4, 2), bottom=(0.01, 0.0, 9.0 * cell), youngs_modulus=3e4, density=20.0, name="foam"),
    ]
    world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
    start = world.energy()
    for _ in range(8):
        world.advance(0.025)
        assert world.energy().total < start.total + 0.02 * start.potential
    for i in range(3):
        assert np.isfinite(world.positions(i)).all()
        assert world.positions(i)[:, 2].min() > -0.1 * cell


def _run(box, options, similarity, cell, restart: bool) -> bytes:
    bodies = [
        box(bottom=(0.0, 0.0, cell), youngs_modulus=2e5, spin=(2.0, 5.0, 1.0), velocity=(1.5, 0.0, 0.0)),
        box(cells=(3, 3, 3), bottom=(0.4, 0.1, cell), youngs_modulus=5e5, name="late", start_time=0.03),
    ]
    world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
    for _ in range(4):
        world.advance(0.02)
        if restart and 0.03 < world.time < 0.05:
            file = io.BytesIO()
            np.savez(file, **world.checkpoint())
            file.seek(0)
            world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
            with np.load(file, allow_pickle=False) as stored:
                world.restore(stored)
    parts = [f(i) for i in range(2) for f in (world.positions, world.velocities, world.deformation_gradients)]
    return b"".join(p.tobytes() for p in parts)


def test_equal_input_gives_equal_bytes_and_checkpoints_continue_exactly(box, options, similarity, cell):
    first = _run(box, options, similarity, cell, restart=False)
    assert first == _run(box, options, similarity, cell, restart=False)
    assert first == _run(box, options, similarity, cell, restart=True)


def test_particles_keep_their_order(box, options, similarity):
    """A fast stiff body crosses many blocks; each particle must still be where a rigid motion takes it."""
    body = box(bottom=(-0.5, 0.0, -0.1), youngs_modulus=1e6, velocity=(3.0, 1.0, 0.5))
    shuffled = np.random.default_rng(1).permutation(body.count)
    object.__setattr__(body, "positions", body.positions[shuffled])
    world = World(bodies=[body], gravity=(0.0, 0.0, 0.0), similarity=similarity, options=options)
    world.advance(0.3)
    moved = world.positions(0) - body.positions
    assert np.abs(moved - np.array([0.9, 0.3, 0.15])).max() < 2e-3


def test_body_waits_for_its_start(box, options, similarity):
    body = box(bottom=(0.0, 0.0, 0.1), start_time=0.1)
    world = World(bodies=[body], similarity=similarity, options=options)
    world.advance(0.07)
    assert np.array_equal(world.positions(0), body.positions)
    world.advance(0.13)
    fall = float((body.positions - world.positions(0)).mean(axis=0)[2])
    assert fall == pytest.approx(0.5 * 9.81 * 0.01, rel=0.02)


def test_a_particle_takes_400_bytes():
    """With the caller's own 40: its place, volume and contact radius. Eight particles a cell, contact with a ground."""
    world = world_of(100_000, arch="cpu", threads=2, cache_folder=None)
    assert world.device_bytes / sum(body.count for body in world.bodies) < 360


def test_body_that_leaves_the_box_flies_on_and_is_reported(box, options, similarity):
    """Out of the box of the profile and four times its side away: same flight, same shape; memory follows the body."""
    body = box(bottom=(0.3, 0.0, 0.0), youngs_modulus=1e5, velocity=(20.0, 0.0, 0.0))
    world = World(bodies=[body], gravity=(0.0, 0.0, 0.0), similarity=similarity, options=options)
    assert world.particles_outside(0) == 0
    before = world.device_bytes
    world.advance(0.4)
    assert world.particles_outside(0) == body.count
    moved = world.positions(0) - body.positions
    assert np.abs(moved - np.array([8.0, 0.0, 0.0])).max() < 2e-3
    assert world.device_bytes < 2 * before


def test_lost_state_names_the_body(box, options, similarity):
    bodies = [box(bottom=(0.0, 0.0, 0.1)), box(bottom=(0.4, 0.0, 0.1), name="culprit")]
    world = World(bodies=bodies, similarity=similarity, options=options)
    broken = world.checkpoint()
    velocities = broken["v"].copy()
    velocities[broken["ids"] >= bodies[0].count] = np.nan
    broken["v"] = velocities
    world.restore(broken)
    with pytest.raises(SimulationError, match="culprit"):
        world.advance(0.01)


def test_bad_input_is_an_input_error(box, options, similarity):
    body = box(bottom=(0.0, 0.0, 0.1))
    with pytest.raises(InputError, match="grid"):
        SolverOptions(grid=30)
    with pytest.raises(InputError, match="arch"):
        SolverOptions(arch="abacus")
    with pytest.raises(InputError, match="poisson_ratio"):
        box(poisson_ratio=0.5)
    with pytest.raises(InputError, match="density"):
        box(density=float("nan"))
    with pytest.raises(InputError, match="bodies"):
        World(bodies=[], similarity=similarity, options=options)
    with pytest.raises(InputError, match="from the origin"):
        World(bodies=[box(bottom=(1e5, 0.0, 0.0))], similarity=similarity, options=options)
    with pytest.raises(InputError, match="below the ground"):
        World(bodies=[body], ground=Ground(point=(0.0, 0.0, 0.4)), similarity=similarity, options=options)
    with pytest.raises(InputError, match="gravity"):
        World(bodies=[body], gravity=(0.0, float("inf"), 0.0), similarity=similarity, options=options)
    world = World(bodies=[body], similarity=similarity, options=options)
    with pytest.raises(InputError, match="duration"):
        world.advance(-1.0)
    with pytest.raises(InputError, match="another scene"):
        other = Similarity(scale=0.9, origin=(-1.0, -1.0, -1.0))
        World(bodies=[body], similarity=other, options=options).restore(world.checkpoint())


def test_broken_deformation_is_a_simulation_error(box, options, similarity):
    world = World(bodies=[box(bottom=(0.0, 0.0, 0.1), name="torn")], similarity=similarity, options=options)
    broken = world.checkpoint()
    broken["F"] = np.full_like(broken["F"], np.inf)
    world.restore(broken)
    with pytest.raises(SimulationError, match="torn"):
        world.advance(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("youngs_modulus", [1e4, 1e5, 1e6, 1e7, 1e8])
@pytest.mark.parametrize("density", [20.0, 200.0, 1000.0, 8000.0])
@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3, 0.48])
def test_no_material_blows_up_in_2000_substeps(box, options, similarity, cell, youngs_modulus, density, poisson_ratio):
    """The fast test's grid, finer and longer: finite, and no faster than twice the impact."""
    body = box(
        cells=(3, 3, 3),
        bottom=(0.003, 0.001, 0.05 * cell),
        youngs_modulus=youngs_modulus,
        density=density,
        poisson_ratio=poisson_ratio,
        velocity=(0.5, 0.0, -5.0),
        spin=(3.0, 2.0, 1.0),
    )
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    while world.substeps < 2000 and world.time < 0.3:
        world.advance(min(200 * world.stable_step, 0.01))
        assert np.isfinite(world.deformation_gradients(0)).all()
        assert np.linalg.norm(world.velocities(0), axis=1).max() < 20.0
        assert world.ground_gap(0) > -0.1 * cell
