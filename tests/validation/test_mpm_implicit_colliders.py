# SPDX-License-Identifier: MIT
"""Implicit steps on colliders, at rest and moving: the same rest, friction and rebound as on the ground."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.implicit_choice import why_explicit
from physgen.sim.mpm.solver_options import SolverOptions
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.units import Similarity

G = 9.81
GRID = 64
CELL = 2.0 / GRID

pytestmark = pytest.mark.usefixtures("repeatable")  # implicit steps are a CPU's


def world_of(body: BodyParticles, collider: Collider, *, friction: float = 0.4, implicit: bool = True) -> World:
    """A world of one body and one collider in a box of 2 m, cells of 31 mm."""
    return World(
        bodies=[body],
        colliders=[collider],
        contacts=ContactTable(default=SurfaceContact(friction=friction)),
        similarity=Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0)),
        options=SolverOptions(grid=GRID, implicit=implicit),
    )


def slab(rotation: np.ndarray | None = None, *, top: float = 0.0, **motion: Track) -> Collider:
    """A slab of 1.2 x 1.2 x 0.1 m, its upper side ``top`` m above the origin, turned about that."""
    mesh = trimesh.creation.box((1.2, 1.2, 0.1))
    points = np.asarray(mesh.vertices) + np.array([0.0, 0.0, top - 0.05])
    points = points if rotation is None else points @ rotation.T
    return Collider(name="slab", surface=Surface(vertices=points, faces=np.asarray(mesh.faces)), **motion)


def tilt(degrees: float) -> np.ndarray:
    """Rotation about y that tips the z axis towards +x."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def line(end: tuple[float, float, float], seconds: float = 1.0) -> Track:
    """From 0 to ``end`` in so many seconds."""
    return Track(times=np.array([0.0, seconds]), values=np.array([(0.0, 0.0, 0.0), end]))


def explicit_substeps(body: BodyParticles, duration: float) -> float:
    """Substeps that explicit steps would take for ``duration`` s, as long as the undeformed body allows."""
    return duration / (0.4 * CELL / body.material.wave_speed)


@pytest.mark.parametrize("top", [0.0, 0.43 * CELL])
def test_what_rests_on_a_collider_stays(box, top):
    """After it has settled for 0.1 s it moves by less than 0.001 cells in 0.3 s, by implicit steps."""
    world = world_of(box(bottom=(0.0, 0.0, top), cells=(4, 4, 4), youngs_modulus=3e7), slab(top=top))
    world.advance(0.1)
    before = world.positions(0)
    world.advance(0.3)
    assert np.abs(world.positions(0) - before).max() < 1e-3 * CELL
    assert world.particle_passes < 0.5 * explicit_substeps(world.bodies[0], 0.4)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_block_slides_down_a_tilted_collider(box, friction):
    """a = g (sin th - mu cos th) within 3 % (Coulomb), from a tenth of a second on."""
    rotation = tilt(30.0)
    body = box(cells=(6, 6, 3), rotation=rotation, youngs_modulus=3e7)
    world = world_of(body, slab(rotation), friction=friction)
    world.advance(0.1)
    before = world.velocities(0).mean(axis=0)
    world.advance(0.15)
    gained = (world.velocities(0).mean(axis=0) - before) @ rotation[:, 0]
    expected = G * (np.sin(np.radians(30.0)) - friction * np.cos(np.radians(30.0)))
    assert gained / 0.15 == pytest.approx(expected, rel=0.03)
    assert world.substeps < 0.99 * explicit_substeps(body, 0.25)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_block_slides_over_a_round_collider_as_with_explicit_steps(box, friction):
    """Over a cylinder of radius 0.4 m from 15 degrees beside its top, 0.25 s: within 0.05 cells."""
    places = []
    for implicit in (False, True):
        mesh = trimesh.creation.cylinder(radius=0.4, height=1.0, sections=256)
        points = np.asarray(mesh.vertices)[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
        collider = Collider(name="slab", surface=Surface(vertices=points, faces=np.asarray(mesh.faces)))
        rotation = tilt(15.0)
        body = box(bottom=tuple(0.4 * rotation[:, 2]), cells=(3, 6, 3), rotation=rotation, youngs_modulus=3e7)
        world = world_of(body, collider, friction=friction, implicit=implicit)
        world.advance(0.25)
        places.append(world.positions(0).mean(axis=0))
    assert np.linalg.norm(places[1] - places[0]) < 0.05 * CELL
    assert world.substeps < 0.99 * explicit_substeps(body, 0.25)


def test_a_block_dropped_on_a_collider_bounces_as_with_explicit_steps(box):
    """Speed of the centre of mass after an impact at 2 m/s within 5 %."""
    after = []
    for implicit in (False, True):
        body = box(bottom=(0.0, 0.0, 0.2), cells=(4, 4, 4), rotation=tilt(17.0), youngs_modulus=1e7)
        world = world_of(body, slab(), implicit=implicit)
        world.advance(0.26)
        after.append(world.velocities(0).mean(axis=0)[2])
    assert after[1] == pytest.approx(after[0], rel=0.05)


@pytest.mark.parametrize(
    "motion",
    [
        {"translations": line((0.2, 0.0, 0.0))},
        {"translations": line((0.0, 0.0, 0.3))},
        {"rotations": line((0.0, 0.0, 1.0))},
    ],
    ids=["belt", "lift", "turntable"],
)
def test_what_stands_on_a_moving_collider_is_carried(box, motion):
    """After 0.2 s it stands still on the collider: it creeps by less than 0.01 cells in 0.2 s, by implicit steps."""
    body = box(bottom=(0.1, 0.0, 0.0), cells=(4, 4, 4), youngs_modulus=3e7)
    world = world_of(body, slab(**motion), friction=0.6)
    world.advance(0.2)
    before = world.positions(0)
    substeps = world.substeps
    world.advance(0.2)
    slide = np.asarray(motion.get("translations", line((0.0, 0.0, 0.0))).values[1]) * 0.2
    turn = np.asarray(motion.get("rotations", line((0.0, 0.0, 0.0))).values[1])[2] * 0.2
    c, s = np.cos(turn), np.sin(turn)
    carried = before @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + slide
    assert np.linalg.norm(world.positions(0).mean(axis=0) - carried.mean(axis=0)) < 0.01 * CELL
    assert world.substeps - substeps < 0.8 * explicit_substeps(body, 0.2)


def test_a_racket_hits_what_rests_on_it(box):
    """A collider that starts to rise at 1 m/s throws what stands on it as with explicit steps: its speed within 5 %."""
    after = []
    for implicit in (False, True):
        body = box(cells=(4, 4, 4), youngs_modulus=1e7)
        rises = Track(times=np.array([0.0, 0.1, 0.12]), values=np.array([(0, 0, 0), (0, 0, 0), (0, 0, 0.02)], float))
        world = world_of(body, slab(translations=rises), implicit=implicit)
        world.advance(0.1)
        world.advance(0.05)
        after.append(world.velocities(0).mean(axis=0)[2])
    assert after[1] == pytest.approx(after[0], rel=0.05)


def test_equal_bytes_from_a_checkpoint_on_a_moving_collider(box):
    """Whether a step is implicit, and where the collider is, follows from the state alone."""
    body = box(bottom=(0.0, 0.0, 0.02), cells=(3, 3, 3), youngs_modulus=3e7)
    world = world_of(body, slab(translations=line((0.3, 0.0, 0.1))))
    world.advance(0.1)
    kept = world.checkpoint()
    world.advance(0.1)
    end = world.positions(0)
    world.restore(kept)
    world.advance(0.1)
    assert np.array_equal(end, world.positions(0))


def test_a_collider_that_deforms_takes_explicit_steps(box):
    """It is named."""
    still = slab()
    moved = np.stack([still.surface.vertices, still.surface.vertices + 0.01])
    vertices = Track(times=np.array([0.0, 1.0]), values=moved)
    collider = Collider(name="slab", surface=still.surface, vertices=vertices)
    block = box(cells=(3, 3, 3), youngs_modulus=1e7)
    assert why_explicit(WorldSetup(bodies=(block,), colliders=(still,))) is None
    assert "slab" in str(why_explicit(WorldSetup(bodies=(block,), colliders=(collider,))))
