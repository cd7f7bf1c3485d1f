# SPDX-License-Identifier: MIT
"""Bodies asleep: which may sleep, what wakes them, and that they sleep through nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.app.bake_estimate import at_rest
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.scene_to_world import prepare_world
from physgen.sim.app.simulation import start_world
from physgen.sim.constitutive import ElasticMaterial, RigidMaterial
from physgen.sim.effects.registry import apply_effects
from physgen.sim.mpm.bodies import BodyForces, BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.sleeping import Sleepers
from physgen.sim.mpm.solver_options import Ground, SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.folder import Scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Effect
from physgen.sim.scene.units import Similarity

CELL = 2.0 / 64
OPTIONS = SolverOptions(grid=64)
HERE = Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0))
SOFT = ElasticMaterial(density=200.0, youngs_modulus=2.5e4, poisson_ratio=0.3)


def box(name="box", *, bottom=(0.0, 0.0, 0.0), cells=(4, 4, 4), material=SOFT, asleep=True, **fields) -> BodyParticles:
    """A box of 8 particles a cell with the middle of its underside at ``bottom``."""
    spacing = CELL / 2
    counts = 2 * np.asarray(cells)
    lattice = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    positions = (lattice - [counts[0] / 2, counts[1] / 2, 0]) * spacing + bottom
    mesh = trimesh.creation.box(counts * spacing)
    mesh.apply_translation(np.add(bottom, (0, 0, counts[2] * spacing / 2)))
    return BodyParticles(
        name=name,
        positions=positions,
        volumes=np.full(len(positions), spacing**3),
        contact_radii=np.full(len(positions), spacing / 2),
        material=material,
        surface=Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)),
        asleep=asleep,
        **fields,
    )


def setup_of(*bodies, **fields) -> WorldSetup:
    return WorldSetup(bodies=bodies, **{"ground": Ground(), **fields})


def sleepers_of(*bodies, **fields) -> list[str]:
    setup = setup_of(*bodies, **fields)
    return [body.name for body, sleeps in zip(setup.bodies, Sleepers(setup, CELL).asleep, strict=True) if sleeps]


def test_stable_bodies_sleep_and_driven_bodies_do_not():
    still = Track(times=np.zeros(1), values=np.zeros((1, 3)))
    assert sleepers_of(box()) == ["box"]
    for fields in (
        {"asleep": False},
        {"velocity": (0.1, 0.0, 0.0)},
        {"spin": (0.0, 0.0, 1.0)},
        {"start_time": 0.1},
        {"acceleration": still},
        {"velocity_keys": still},
        {"goal_stiffness": 1.0},
        {"bottom": (0.0, 0.0, CELL)},
        {"forces": BodyForces(drag=1.0, wind=(1.0, 0.0, 0.0))},
        {"forces": BodyForces(tether_stiffness=1.0)},
        {"forces": BodyForces(gravity_factor=-0.5)},
    ):
        assert sleepers_of(box(**fields)) == [], fields
    assert sleepers_of(box(forces=BodyForces(drag=1.0))) == ["box"], "air that stands still moves nothing"


def test_effects_and_gravity_decide():
    world = setup_of(box())
    gale = Effect(name="wind", parameters={"drag_per_mass": 0.1, "wind_x": 4.0, "wind_y": 0.0, "wind_z": 0.0})
    steep = Effect(name="gravity_tilt", parameters={"angle": 0.7, "azimuth": 0.0})
    slight = dataclasses.replace(steep, parameters={"angle": 0.1, "azimuth": 0.0})
    for effect, sleeps in ((gale, False), (steep, False), (slight, True)):
        assert Sleepers(apply_effects(world, (effect,)), CELL).asleep.tolist() == [sleeps], effect
    shaken = Track(times=np.array([0.0, 1.0]), values=np.array([[0, 0, -9.8], [0, 1, -9.8]]))
    assert sleepers_of(box(), gravity_track=shaken) == []
    assert sleepers_of(box(), gravity=(0.0, 0.0, 0.0)) == []
    assert sleepers_of(box(), ground=None) == []


def test_the_centre_of_mass_must_lie_over_what_carries():
    """A beam of 8 cells on a block of 2: it stands when it reaches out 3 cells a side, and topples when it begins over
    the block's middle; with the block awake it does not sleep either."""
    block = box("block", cells=(2, 4, 2))
    top = 2 * CELL
    centred = box("beam", bottom=(0, 0, top), cells=(8, 4, 2))
    off = box("beam", bottom=(3.5 * CELL, 0, top), cells=(8, 4, 2))
    assert sleepers_of(block, centred) == ["block", "beam"]
    assert sleepers_of(block, off) == ["block"]
    assert sleepers_of(dataclasses.replace(block, velocity=(1.0, 0.0, 0.0)), centred) == []
    assert sleepers_of(box("a", bottom=(0, 0, 1)), box("b", bottom=(0, 0, 1 + 4 * CELL))) == [], "a stack in mid-air"


def test_a_static_table_carries_and_a_moving_one_keeps_awake():
    slab = trimesh.creation.box((1.0, 1.0, 0.1))
    table = Collider(name="table", surface=Surface(vertices=np.add(slab.vertices, (0, 0, 0.45)), faces=slab.faces))
    on_it = box(bottom=(0, 0, 0.5))
    assert sleepers_of(on_it, colliders=(table,)) == ["box"]
    assert sleepers_of(on_it) == []
    way = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0, 0], [0.0, 0, 0.3]]))
    lift = dataclasses.replace(table, translations=way)
    assert sleepers_of(box(), colliders=(lift,)) == ["box"], "what never comes near it"
    assert sleepers_of(on_it, colliders=(lift,)) == []
    assert sleepers_of(box(bottom=(0, 0, 0.7)), box("low"), colliders=(lift,)) == ["low"]


def test_a_scene_holds_what_would_not_stay_and_says_so(ball_scene):
    """On the ground a ball of 10 cm stays; 1 cm above it (over half a cell of the coarsest quality) it would fall, is
    held, and that is said, whether or not it is thrown afterwards; not if it is not marked asleep."""
    for height, fields, held in (
        (0.05, {}, False),
        (0.06, {}, True),
        (0.06, {"velocity": (0.0, 0.0, 1.0)}, True),
        (0.06, {"asleep": False}, False),
    ):
        folder = ball_scene(height=height, velocity=(0.0, 0.0, 0.0))
        item = dataclasses.replace(folder.model.objects[0], **{"asleep": True, **fields})
        notices: list[str] = []
        scene = Scene(root=folder.root, model=dataclasses.replace(folder.model, objects=(item,)))
        assert at_rest(scene, notices.append).objects == (dataclasses.replace(item, held=held),)
        assert ["ball0.held=false" in text for text in notices] == [True] * held


def test_a_jelly_deep_in_another_stays_where_it_is(ball_scene):
    """Two balls of 10 cm whose middles are 7 cm apart share a third of themselves. One is simulated with a hollow, and
    neither moves, though awake the upper one would slide down the hollow."""
    folder = ball_scene(preset="jelly", height=0.05, velocity=(0.0, 0.0, 0.0), count=2)
    low, high = (dataclasses.replace(item, asleep=True) for item in folder.model.objects)
    moved_by = np.eye(4)
    moved_by[:3, 3] = (-0.12, 0.0, 0.06)
    high = dataclasses.replace(high, world_from_mesh=tuple(map(tuple, moved_by.tolist())))
    scene = Scene(root=folder.root, model=dataclasses.replace(folder.model, objects=(low, high)))
    resting = Scene(root=folder.root, model=at_rest(scene, lambda text: None))
    meshes = [load_object_mesh(resting, item) for item in resting.model.objects]
    prepared = prepare_world(resting, meshes, BakeOptions(frames=2, quality="preview"))
    assert any("hollow" in text for text in prepared.warnings)
    world = start_world(prepared).world
    world.advance(0.1)
    assert [moved(world, i) for i in range(2)] == [0.0, 0.0]


def test_what_is_held_sleeps_in_mid_air_and_leaning_until_its_support_moves():
    """A lamp a metre up carries what stands on it; a plank that leans on a block stays, unless the block is thrown."""
    lamp = box("lamp", bottom=(0, 0, 1), held=True)
    assert sleepers_of(lamp, box("on it", bottom=(0, 0, 1 + 4 * CELL)), box("beside", bottom=(1, 0, 1))) == [
        "lamp",
        "on it",
    ]
    block = box("block", cells=(2, 4, 2))
    leaning = box("leaning", bottom=(3.5 * CELL, 0, 2 * CELL), cells=(8, 4, 2), held=True)
    assert sleepers_of(block, leaning) == ["block", "leaning"]
    thrown = dataclasses.replace(block, velocity=(-1.0, 0.0, 0.0))
    assert sleepers_of(thrown, leaning) == []
    later = dataclasses.replace(thrown, start_time=1.0)
    assert sleepers_of(later, leaning) == ["leaning"], "what is not there yet carries nothing"
    toppling = box("toppling", bottom=(3.5 * CELL, 0, 2 * CELL), cells=(8, 4, 2))
    on_top = box("on top", bottom=(3.5 * CELL, 0, 4 * CELL), held=True)
    assert sleepers_of(block, toppling, on_top) == ["block"], "what it touches is awake"
    assert sleepers_of(dataclasses.replace(lamp, velocity=(0.0, 0.0, 1.0))) == []


def test_what_is_held_falls_when_it_is_hit():
    lamp = box("lamp", bottom=(0, 0, 0.5), held=True)
    thrown = box("thrown", bottom=(-8 * CELL, 0, 0.5), velocity=(2.0, 0.0, 0.0), asleep=False)
    world = World(bodies=(lamp, thrown), ground=Ground(), similarity=HERE, options=OPTIONS)
    world.advance(0.75 * 4 * CELL / 2.0)
    assert world.asleep(0) and moved(world, 0) == 0.0
    world.advance(0.25)
    assert not world.asleep(0)
    assert world.positions(0)[:, 2].mean() < lamp.positions[:, 2].mean() - CELL


def moved(world: World, index: int) -> float:
    return float(np.abs(world.positions(index) - world.bodies[index].positions).max())


@pytest.mark.parametrize("matter", [SOFT, RigidMaterial(density=500.0)])
def test_a_sleeper_wakes_when_it_is_hit_and_takes_the_momentum(matter):
    """The bullet starts 4 cells away at 2 m/s: until it is there nothing moves, then the target does; without gravity
    and friction the momentum stays what it was, to 1 %, and no more of the target is entered than contact allows."""
    bullet = box("bullet", bottom=(-8 * CELL, 0, 0.02), velocity=(2.0, 0.0, 0.0), asleep=False, material=matter)
    target, away = box("target", material=matter), box("away", bottom=(0, 20 * CELL, 0), material=matter)
    world = World(bodies=(bullet, target, away), ground=Ground(friction=0.0), similarity=HERE, options=OPTIONS)
    assert [world.asleep(i) for i in range(3)] == [False, True, True]
    before = world.linear_momentum()[0]
    world.advance(0.75 * 4 * CELL / 2.0)
    assert world.asleep(1) and moved(world, 1) == 0.0
    world.advance(0.08)
    assert [world.asleep(i) for i in range(3)] == [False, False, True]
    assert moved(world, 1) > CELL and moved(world, 2) == 0.0
    assert world.linear_momentum()[0] == pytest.approx(before, rel=0.01)
    gap = world.positions(1)[:, 0].min() - world.positions(0)[:, 0].max() - CELL / 2
    assert gap > -0.5 * CELL


def test_departing_body_wakes_no_neighbour_but_a_stack_wakes_together():
    neighbour, top = box("neighbour"), box("top", bottom=(0, 0, 4 * CELL))
    jumps = box("jumps", bottom=(4 * CELL, 0, 0), velocity=(0.3, 0.0, 2.0))
    world = World(bodies=(neighbour, top, jumps), ground=Ground(), similarity=HERE, options=OPTIONS)
    world.advance(0.2)
    assert world.asleep(0) and world.asleep(1) and moved(world, 0) == moved(world, 1) == 0.0
    comes = dataclasses.replace(jumps, velocity=(-1.0, 0.0, 0.0))
    world = World(bodies=(neighbour, top, comes), ground=Ground(), similarity=HERE, options=OPTIONS)
    world.advance(0.05)
    assert not world.asleep(0) and not world.asleep(1)


def test_a_checkpoint_goes_on_to_the_same_bytes():
    bullet = box("bullet", bottom=(-8 * CELL, 0, 0.02), velocity=(2.0, 0.0, 0.0), asleep=False)
    rigid = box("rigid", bottom=(8 * CELL, 0, 0), material=RigidMaterial(density=300.0))
    bodies = (bullet, box("target"), rigid)
    worlds = [World(bodies=bodies, ground=Ground(), similarity=HERE, options=OPTIONS) for _ in range(2)]
    worlds[0].advance(0.05)
    kept = worlds[0].checkpoint()
    worlds[0].advance(0.05)
    worlds[1].restore(kept)
    assert worlds[1].asleep(2)
    worlds[1].advance(0.05)
    for index in range(3):
        np.testing.assert_array_equal(worlds[0].positions(index), worlds[1].positions(index))


def test_worlds_without_sleepers_are_bitwise_unchanged():
    """Bodies that may not sleep take the same substeps as bodies that are not told to."""
    falling = box("falling", bottom=(0, 0, 0.1))
    worlds = [
        World(bodies=(dataclasses.replace(falling, asleep=told),), ground=Ground(), similarity=HERE, options=OPTIONS)
        for told in (False, True)
    ]
    for world in worlds:
        world.advance(0.15)
    np.testing.assert_array_equal(worlds[0].positions(0), worlds[1].positions(0))
    assert worlds[0].substeps == worlds[1].substeps
