# SPDX-License-Identifier: MIT
"""Adhesion of bodies that deform to one another, to rigid bodies and to colliders: p times the reduced mass of the two.

A body of mass m under one that cannot move thus hangs where p > g; under one that is held and weighs as much, where
p > 2 g. What is asked of ground adhesion holds here, too: 0.02 cells, and 0.1 cells between two that deform, whose
gap is not known better (docs/physics.md).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.colliders import Collider, Surface
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World, Worlds
from physgen.sim.mpm.world_setup import WorldSetup

G, REACH, SIDE = 9.81, 0.01, 4


def glue(pull: float, friction: float = 0.4) -> ContactTable:
    return ContactTable(default=SurfaceContact(friction=friction, adhesion=pull, adhesion_reach=REACH))


@pytest.fixture
def ceiling() -> Collider:
    """A plate with its underside at z = 0."""
    mesh = trimesh.creation.box((0.6, 0.6, 0.1))
    mesh.apply_translation((0.0, 0.0, 0.05))
    return Collider(name="ceiling", surface=Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)))


def height(worlds: Worlds, world: int) -> float:
    """How far the first body has risen in metres."""
    view = worlds[world]
    return float((view.positions(0) - view.bodies[0].positions)[:, 2].mean())


@pytest.mark.long
def test_a_soft_body_hangs_where_the_pull_exceeds_its_weight(box, box_body, ceiling, options, similarity, cell):
    """Under a collider, under a soft body whose particles are pinned, under a rigid one a thousand times as heavy that
    rests on a ledge: at 1.25 times the pull that carries it, it hangs for 0.3 s; at 0.75 times it falls by as much as
    the fall with at least a quarter of g gives."""
    low = box(cells=(SIDE,) * 3, bottom=(0.0, 0.0, -SIDE * cell), name="low")
    top = box(cells=(SIDE,) * 3, name="top")
    top = dataclasses.replace(top, pins=np.ones(top.count, dtype=bool))
    slab = box_body(name="slab", center=(0.0, 0.0, 0.1), size=(0.2, 0.2, 0.2), density=1000.0 * 1000)
    ledges = []
    for side in (-1, 1):
        mesh = trimesh.creation.box((0.03, 0.2, 0.1))
        mesh.apply_translation((side * 0.09, 0.0, -0.05))
        ledges.append(Collider(name=f"ledge{side}", surface=Surface(vertices=mesh.vertices, faces=mesh.faces)))
    setups = []
    for share in (1.25, 0.75):
        setups += [
            WorldSetup(bodies=(low,), colliders=(ceiling,), contacts=glue(share * G)),
            WorldSetup(bodies=(low, top), contacts=glue(share * 2 * G)),
            WorldSetup(bodies=(low, slab), colliders=tuple(ledges), contacts=glue(share * G)),
        ]
    worlds = Worlds(setups, similarity=similarity, options=options)
    for _ in range(6):
        worlds.advance(0.05)
        assert abs(height(worlds, 0)) < 0.02 * cell
        assert abs(height(worlds, 1)) < 0.1 * cell
        assert abs(height(worlds, 2)) < 0.02 * cell
    for world in (3, 4, 5):
        assert height(worlds, world) < -0.25 * G * 0.3**2 / 2


def test_adhesion_keeps_both_momenta(box, box_body, options, similarity, cell):
    """Two soft bodies and a rigid one in flight, which turn and pull each other: what would part holds together, and
    momentum and angular momentum stay within 1e-4 of all |m v| and |m r v|."""
    bodies = (
        box(cells=(SIDE,) * 3, name="a", velocity=(0.2, 0.0, 0.0), spin=(0.0, 2.0, 0.0)),
        box(cells=(SIDE,) * 3, bottom=(0.0, 0.0, SIDE * cell), name="b", velocity=(-0.2, 0.1, 0.1)),
        box_body(name="c", center=(0, 0, -0.5 * SIDE * cell), size=(SIDE * cell,) * 3, velocity=(0.0, 0.0, -0.1)),
    )
    setup = WorldSetup(bodies=bodies, gravity=(0.0, 0.0, 0.0), contacts=glue(30.0))
    worlds = Worlds([setup], similarity=similarity, options=options)
    view = worlds[0]
    before, turning = view.linear_momentum(), view.angular_momentum()
    worlds.advance(0.2)
    mass = bodies[0].masses.sum()
    assert np.abs(view.linear_momentum() - before).max() < 1e-4 * 0.6 * mass
    assert np.abs(view.angular_momentum() - turning).max() < 1e-4 * 0.6 * mass * 2 * SIDE * cell
    heights = [view.positions(1)[:, 2].mean(), view.positions(0)[:, 2].mean(), view.pose("c").center[2]]
    assert -np.diff(heights) == pytest.approx([SIDE * cell] * 2, abs=0.2 * cell), "apart by 0.02 m without"


def test_what_leaves_faster_than_the_pull_can_hold_goes_on_alone(box, ceiling, options, similarity):
    """Below a collider, without gravity: v² - 2 p r is left of v², as on the ground, within a tenth."""
    body = box(cells=(SIDE,) * 3, rotation=np.diag([1.0, -1.0, -1.0]), velocity=(0.0, 0.0, -1.0), name="low")
    setup = WorldSetup(bodies=(body,), colliders=(ceiling,), gravity=(0.0, 0.0, 0.0), contacts=glue(20.0))
    worlds = Worlds([setup], similarity=similarity, options=options)
    worlds.advance(0.1)
    assert worlds[0].velocities(0)[:, 2].mean() ** 2 == pytest.approx(1 - 2 * 20.0 * REACH, rel=0.1)


def test_adhesion_without_a_partner_in_reach_changes_nothing(box, options, similarity, cell):
    """Equal bytes: beyond the reach, and at pull 0 within it."""
    low = box(cells=(3, 3, 3), name="low", velocity=(0.0, 0.0, -0.1))
    high = box(cells=(3, 3, 3), bottom=(0.0, 0.0, 5 * cell), name="high")
    setup = WorldSetup(bodies=(low, high), ground=Ground())
    plain, far = (
        World(bodies=setup.bodies, gravity=(0, 0, 0), contacts=table, similarity=similarity, options=options)
        for table in (ContactTable(), glue(30.0))
    )
    for world in (plain, far):
        world.advance(0.05)
    assert plain.positions(0).tobytes() == far.positions(0).tobytes()
    assert not plain.group._engine.worlds.adheres and far.group._engine.worlds.adheres
