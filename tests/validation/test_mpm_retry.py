# SPDX-License-Identifier: MIT
"""Substeps that go wrong: taken again shorter where that helps, otherwise an error that names the body."""

from __future__ import annotations

import numpy as np
import pytest
from physgen.sim.errors import SimulationError
from physgen.sim.mpm.colliders import Track
from physgen.sim.mpm.world import World, Worlds
from physgen.sim.mpm.world_setup import WorldSetup

NO_GRAVITY = (0.0, 0.0, 0.0)
BLOW = Track(times=[0.0, 1e-3, 1.1e-3], values=[[1e6, 0.0, 0.0], [1e6, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""A hundred thousand g for a millisecond: the first substep, planned for a body at rest, is far too long for it."""


def test_a_blow_is_taken_in_shorter_substeps(box, options, similarity, cell):
    """The speed after it is the integral of the acceleration, 1050 m/s, within the 0.5 % asked of a fall; an even push
    strains nothing, so no particle leaves its place in the body by 0.02 cells; and equal input gives equal bytes on the
    CPU."""
    body = box(cells=(4, 4, 6), acceleration=BLOW)
    runs = []
    for _ in range(2):
        world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
        world.advance(2e-3)
        assert world.retries > 0
        runs.append(world.positions(0))
    assert np.abs(world.velocities(0) - [1050.0, 0.0, 0.0]).max() < 5e-3 * 1050.0
    moved = runs[0] - body.positions
    assert np.abs(moved - moved.mean(axis=0)).max() < 0.02 * cell
    if options.arch == "cpu":
        assert np.array_equal(runs[0], runs[1])


def test_worlds_that_go_well_notice_nothing_of_one_that_is_taken_again(box, options, similarity):
    """Beside a world that must try again, another gives the same bytes as alone."""
    calm = WorldSetup(bodies=(box(cells=(4, 4, 4), spin=(3.0, 5.0, 1.0), youngs_modulus=1e5),))
    struck = WorldSetup(bodies=(box(cells=(4, 4, 6), acceleration=BLOW),))
    together = Worlds([struck, calm], similarity=similarity, options=options)
    together.advance(5e-3)
    assert together.retries > 0
    alone = Worlds([calm], similarity=similarity, options=options)
    alone.advance(5e-3)
    assert np.array_equal(together[1].positions(0), alone[0].positions(0))


@pytest.mark.parametrize("factor", [5.0, 20.0])
def test_a_state_faster_than_its_plan_is_taken_in_shorter_substeps(box, options, similarity, cell, give_motion, factor):
    """A restored state whose particles move 2 and 8 cells in the planned substep: tried again, and then the flight is
    straight, within the 0.5 % asked of a fall."""
    body = box(cells=(6, 6, 6))
    speed = factor * body.material.wave_speed
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    world.advance(1e-3)
    give_motion(world, np.tile([speed, 0.0, 0.0], (body.count, 1)), np.zeros((body.count, 3, 3)))
    before = world.positions(0)
    world.advance(2 * cell / speed)
    assert world.retries > 0
    assert np.abs(world.positions(0) - before - [2 * cell, 0.0, 0.0]).max() < 5e-3 * 2 * cell


@pytest.fixture
def torn(box, options, similarity):
    """A world in good order, the same world after a body was torn beyond help, and the error that this gave."""
    bodies = [box(cells=(4, 4, 4)), box(cells=(4, 4, 4), bottom=(0.4, 0.0, 0.0), name="torn")]
    good = World(bodies=bodies, similarity=similarity, options=options)
    good.advance(0.05)
    state = good.checkpoint()
    state["F"] = state["F"].copy()
    state["F"][state["ids"] >= bodies[0].count] *= 30.0
    bad = World(bodies=bodies, similarity=similarity, options=options)
    bad.restore(state)
    with pytest.raises(SimulationError) as error:
        bad.advance(0.01)
    return good, bad, str(error.value)


def test_divergence_is_an_error_that_names_the_body(torn):
    """The body, the time up to which all was well, and what to do; the frames until then stay, see ``test_bake``."""
    good, bad, message = torn
    assert "'torn'" in message and "0.05 s" in message and "cfl_elastic" in message
    assert bad.retries > 0
    assert bad.time == pytest.approx(good.time)


def test_a_world_that_is_lost_shows_its_last_good_state(torn, cell):
    """Nothing may have moved by more than a cell, which the fall takes 0.06 s for: the time says that all is well."""
    good, bad, _ = torn
    for i in range(2):
        assert np.abs(bad.positions(i) - good.positions(i)).max() < cell
