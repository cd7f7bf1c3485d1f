# SPDX-License-Identifier: MIT
"""Rigid bodies that touch the ground, each other and colliders."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world_setup import WorldSetup

G = 9.81
CELL = 1 / 32
NO_GRAVITY = (0.0, 0.0, 0.0)


def tilt(angle: float) -> np.ndarray:
    """Rotation about y that tips the z axis towards +x by ``angle``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def slope(angle: float, **friction: float) -> Ground:
    return Ground(normal=tuple(tilt(angle)[:, 2]), **friction)


def plate(center, size, name="plate", **motion) -> Collider:
    mesh = trimesh.creation.box(size)
    surface = Surface(vertices=np.asarray(mesh.vertices) + np.asarray(center), faces=np.asarray(mesh.faces))
    return Collider(name=name, surface=surface, **motion)


@pytest.mark.long
@pytest.mark.parametrize("shape", ["ball", "box"])
@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_bounce_height(box_body, ball_body, rigid_bodies, shape, restitution):
    """Newton: rises to e² h, e within 0.05 (a body that touches within a substep bounces at once: v dt / h = 0.2 %)."""
    height = 0.3
    body = {"ball": ball_body, "box": box_body}[shape](center=(0.0, 0.0, 0.1 + height))
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=Ground(restitution=restitution)))
    fall = np.sqrt(2 * height / G)
    world.advance(5e-4, int(fall / 5e-4) + 4)
    top = -1.0
    for _ in range(int((restitution * fall + 0.02) / 5e-4 / 10) + 1):
        world.advance(5e-4, 10)
        top = max(top, world.pose(0, shape).center[2] - 0.1)
    assert np.sqrt(max(top, 0.0) / height) == pytest.approx(restitution, abs=0.05)
    assert np.abs(world.pose(0, shape).spin).max() < 0.05


@pytest.mark.parametrize("degrees, friction", [(20.0, 0.1), (30.0, 0.3)])
def test_box_slides_down_a_slope(box_body, rigid_bodies, degrees, friction):
    """a = g (sin th - mu cos th) within 1 % (Coulomb)."""
    angle = np.radians(degrees)
    turn = tilt(angle)
    body = box_body(center=tuple(0.05 * turn[:, 2]), size=(0.2, 0.2, 0.1), rotation=turn)
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=slope(angle, friction=friction)))
    world.advance(1e-3, 100)
    first = world.pose(0, "box").velocity @ turn[:, 0]
    world.advance(1e-3, 200)
    second = world.pose(0, "box").velocity @ turn[:, 0]
    assert (second - first) / 0.2 == pytest.approx(G * (np.sin(angle) - friction * np.cos(angle)), rel=0.01)


def test_box_sticks_on_a_slope(box_body, rigid_bodies):
    """tan 20° = 0.364 < mu = 0.4: moves less than 1e-4 of its size in 2 s."""
    angle = np.radians(20.0)
    turn = tilt(angle)
    body = box_body(center=tuple(0.05 * turn[:, 2]), size=(0.2, 0.2, 0.1), rotation=turn)
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=slope(angle, friction=0.4)))
    world.advance(1e-3, 2000)
    assert np.linalg.norm(world.pose(0, "box").center - 0.05 * turn[:, 2]) < 1e-4 * 0.2


def test_static_friction_holds_what_kinetic_friction_does_not(box_body, rigid_bodies):
    """At 25° (tan 0.466) with mu_s 0.55 and mu_k 0.3 a box at rest stays, one that moves speeds up with
    g (sin th - mu_k cos th) within 2 %."""
    angle = np.radians(25.0)
    turn = tilt(angle)
    ground = slope(angle, friction=0.3, static_friction=0.55)
    place = {"center": tuple(0.05 * turn[:, 2]), "size": (0.2, 0.2, 0.1), "rotation": turn}
    rest = WorldSetup(bodies=(box_body(**place),), ground=ground)
    pushed = WorldSetup(bodies=(box_body(**place, velocity=tuple(0.2 * turn[:, 0])),), ground=ground)
    world = rigid_bodies(rest, pushed)
    world.advance(1e-3, 500)
    assert np.linalg.norm(world.pose(0, "box").center - 0.05 * turn[:, 2]) < 1e-4 * 0.2
    speed = world.pose(1, "box").velocity @ turn[:, 0]
    assert (speed - 0.2) / 0.5 == pytest.approx(G * (np.sin(angle) - 0.3 * np.cos(angle)), rel=0.02)


@pytest.mark.parametrize("inertia", [1.0, 5 / 3])
def test_ball_rolls_down_a_slope(ball_body, rigid_bodies, inertia):
    """a = g sin th / (1 + 2/5 k) within 2 %, 5/7 for a solid ball and 3/5 for a shell; rolls without sliding to 1 %."""
    angle = np.radians(15.0)
    normal, downhill = tilt(angle)[:, 2], tilt(angle)[:, 0]
    body = dataclasses.replace(ball_body(center=tuple(0.1 * normal - 0.5 * downhill)), inertia_factor=inertia)
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=slope(angle, friction=0.6)))
    world.advance(1e-3, 100)
    first = world.pose(0, "ball").velocity @ downhill
    world.advance(1e-3, 600)
    second = world.pose(0, "ball")
    assert (second.velocity @ downhill - first) / 0.6 == pytest.approx(
        G * np.sin(angle) / (1 + 0.4 * inertia), rel=0.02
    )
    assert second.spin[1] * 0.1 == pytest.approx(second.velocity @ downhill, rel=0.01)


def test_rolling_resistance_slows_a_ball(ball_body, rigid_bodies):
    """On the level: m a = -F, I a / r = F r - lever m g, I = 2/5 m r²: a = -5/7 g lever / r, within 3 %."""
    lever = 0.004
    contacts = ContactTable(default=SurfaceContact(rolling_resistance=lever, friction=0.6))
    body = ball_body(center=(-0.3, 0.0, 0.1), velocity=(1.0, 0.0, 0.0), spin=(0.0, 10.0, 0.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=Ground(friction=0.6), contacts=contacts))
    world.advance(1e-3, 100)
    first = world.pose(0, "ball").velocity[0]
    world.advance(1e-3, 400)
    assert (world.pose(0, "ball").velocity[0] - first) / 0.4 == pytest.approx(-5 / 7 * G * lever / 0.1, rel=0.03)


def test_ball_keeps_rolling_on_the_level(ball_body, rigid_bodies):
    """Without resistance it loses less than 1 % of its speed over five radii: it is round, not a polyhedron."""
    body = ball_body(center=(-0.3, 0.0, 0.1), velocity=(1.0, 0.0, 0.0), spin=(0.0, 10.0, 0.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=Ground(friction=0.6)))
    world.advance(1e-3, 500)
    assert world.pose(0, "ball").velocity[0] == pytest.approx(1.0, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("count", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_boxes_stay_stacked(box_body, rigid_bodies, count):
    """Drift below 1 % of the size in 5 s."""
    bodies = tuple(box_body(name=f"box{i}", center=(0.0, 0.0, 0.1 + 0.2 * i)) for i in range(count))
    world = rigid_bodies(WorldSetup(bodies=bodies, ground=Ground(friction=0.5)))
    world.advance(1e-3, 5000)
    for i in range(count):
        pose = world.pose(0, f"box{i}")
        assert np.linalg.norm(pose.center - [0.0, 0.0, 0.1 + 0.2 * i]) < 0.01 * 0.2
        assert np.linalg.norm(pose.velocity) < 1e-3


@pytest.mark.parametrize("overhang, falls", [(0.085, False), (0.115, True)])
def test_box_tips_over_an_edge_beyond_its_support(box_body, rigid_bodies, overhang, falls):
    """A box of 0.2 m on a table tips if and only if its centre stands beyond the edge, to 15 mm (two lattice nodes)."""
    table = plate((0.0, 0.0, -0.05), (0.4, 0.6, 0.1))
    body = box_body(center=(0.2 - 0.1 + overhang, 0.0, 0.1))
    world = rigid_bodies(WorldSetup(bodies=(body,), colliders=(table,)))
    world.advance(1e-3, 1000)
    assert (world.pose(0, "box").center[2] < 0.05) == falls


def test_head_on_collision_swaps_velocities(ball_body, rigid_bodies):
    """Equal balls, e = 1: velocities swap within 1 %, momentum stays within 1e-12 and energy within 1 %."""
    bodies = (
        ball_body(name="a", center=(-0.15, 0.0, 0.0), velocity=(1.0, 0.0, 0.0)),
        ball_body(name="b", center=(0.15, 0.0, 0.0)),
    )
    contacts = ContactTable(default=SurfaceContact(restitution=1.0, friction=0.3))
    world = rigid_bodies(WorldSetup(bodies=bodies, contacts=contacts, gravity=NO_GRAVITY))
    before = [world.pose(0, name) for name in "ab"]
    world.advance(1e-3, 200)
    after = [world.pose(0, name) for name in "ab"]
    assert after[0].velocity == pytest.approx([0.0, 0.0, 0.0], abs=0.01)
    assert after[1].velocity == pytest.approx([1.0, 0.0, 0.0], abs=0.01)
    momentum = sum(p.momentum for p in before)
    assert sum(p.momentum for p in after) == pytest.approx(momentum, abs=1e-12 * np.linalg.norm(momentum))
    assert sum(p.kinetic for p in after) == pytest.approx(sum(p.kinetic for p in before), rel=0.01)


def test_collision_off_the_axis_conserves_angular_momentum(box_body, ball_body, rigid_bodies):
    """A ball hits a box's edge: momentum within 1e-12. Impulses keep angular momentum as exactly; taking out depth
    shifts centres by less than 0.01 cell, which times the momentum is what may be missing."""
    bodies = (
        box_body(name="a"),
        ball_body(name="b", center=(0.3, 0.08, 0.05), velocity=(-2.0, 0.0, 0.0), spin=(0.0, 0.0, 5.0)),
    )
    world = rigid_bodies(WorldSetup(bodies=bodies, gravity=NO_GRAVITY))

    def totals():
        poses = [world.pose(0, name) for name in "ab"]
        return np.concatenate(
            [sum(p.momentum for p in poses), sum(p.angular_momentum + np.cross(p.center, p.momentum) for p in poses)]
        )

    before = totals()
    world.advance(1e-3, 200)
    assert np.linalg.norm(world.pose(0, "a").velocity) > 0.1
    momentum = np.linalg.norm(before[:3])
    assert totals()[:3] == pytest.approx(before[:3], abs=1e-12 * momentum)
    assert totals()[3:] == pytest.approx(before[3:], abs=0.01 * CELL * momentum)


def test_box_rides_on_a_platform(box_body, rigid_bodies):
    """A platform at 0.3 m/s that starts with a jolt takes the box along: its velocity within 1 % after it stopped
    sliding (v / mu g = 0.06 s)."""
    move = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.06]]))
    table = plate((0.0, 0.0, -0.05), (0.6, 0.6, 0.1), translations=move)
    world = rigid_bodies(WorldSetup(bodies=(box_body(center=(0.0, 0.0, 0.1)),), colliders=(table,)))
    world.advance(1e-3, 500)
    assert world.pose(0, "box").velocity == pytest.approx([0.3, 0.0, 0.06], abs=0.003)
    assert world.pose(0, "plate").translation == pytest.approx([0.15, 0.0, 0.03], abs=1e-9)


def test_box_turns_with_a_turntable(box_body, rigid_bodies):
    """Spin within 1 % of the table's 1.5 rad/s; the box circles at its radius (drift below 2 %)."""
    spin = Track(times=np.array([0.0, 2.0]), values=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]))
    table = plate((0.0, 0.0, -0.05), (0.9, 0.9, 0.1), rotations=spin)
    body = box_body(center=(0.2, 0.0, 0.05), size=(0.1, 0.1, 0.1), velocity=(0.0, 0.3, 0.0), spin=(0.0, 0.0, 1.5))
    world = rigid_bodies(WorldSetup(bodies=(body,), colliders=(table,)))
    world.set_segments({0: (0.0, 2.0)})
    world.advance(1e-3, 1000)
    pose = world.pose(0, "box")
    assert pose.spin[2] == pytest.approx(1.5, rel=0.01)
    assert pose.center == pytest.approx([0.2 * np.cos(1.5), 0.2 * np.sin(1.5), 0.05], abs=0.004)


@pytest.mark.parametrize("speed", [2.0, 5.0])
def test_bodies_do_not_penetrate(box_body, rigid_bodies, speed):
    """No corner of a tumbling box deeper than 0.1 cell in the ground, at any time."""
    body = box_body(center=(0.0, 0.0, 0.25), velocity=(0.5, 0.0, -speed), spin=(3.0, 7.0, 2.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), ground=Ground(restitution=0.3)))
    corners = body.surface.vertices
    for _ in range(150):
        world.advance(5e-4, 4)
        pose = world.pose(0, "box")
        assert (corners @ pose.rotation.T + pose.translation)[:, 2].min() > -0.1 * CELL


def test_adhesion_holds_a_box_under_a_ceiling(box_body, rigid_bodies):
    """A pull of 15 m/s² holds against gravity, 5 m/s² does not: it falls with g as soon as it is out of reach."""
    for pull, holds in ((15.0, True), (5.0, False)):
        contacts = ContactTable(default=SurfaceContact(adhesion=pull, adhesion_reach=0.01))
        ceiling = plate((0.0, 0.0, 0.25), (0.6, 0.6, 0.1))
        world = rigid_bodies(
            WorldSetup(bodies=(box_body(center=(0.0, 0.0, 0.1)),), colliders=(ceiling,), contacts=contacts)
        )
        world.advance(1e-3, 300)
        assert (abs(world.pose(0, "box").center[2] - 0.1) < 0.001) == holds


@pytest.mark.parametrize("mode", ["slip", "sticky"])
def test_modes_do_not_let_go(box_body, rigid_bodies, mode):
    """Under a ceiling: neither falls (1 mm); on sideways push slip moves freely (v within 1 %), sticky not at all."""
    contacts = ContactTable(default=SurfaceContact(mode=mode))
    ceiling = plate((0.0, 0.0, 0.25), (1.2, 0.6, 0.1))
    body = box_body(center=(-0.1, 0.0, 0.1), velocity=(0.5, 0.0, 0.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), colliders=(ceiling,), contacts=contacts))
    world.advance(1e-3, 300)
    pose = world.pose(0, "box")
    assert pose.center[2] == pytest.approx(0.1, abs=0.001)
    assert pose.velocity[0] == pytest.approx(0.5 if mode == "slip" else 0.0, abs=0.005)


def test_a_rising_deforming_collider_lifts_a_box(box_body, rigid_bodies):
    """Its top rises at 0.2 m/s, so does the box, within 2 %."""
    mesh = trimesh.creation.box((0.6, 0.6, 0.1))
    low = np.asarray(mesh.vertices) - [0.0, 0.0, 0.05]
    high = low + np.where(low[:, 2:] > -0.05, [[0.0, 0.0, 0.1]], 0.0)
    track = Track(times=np.array([0.0, 0.5]), values=np.stack([low, high]))
    collider = Collider(name="bed", surface=Surface(vertices=low, faces=np.asarray(mesh.faces)), vertices=track)
    world = rigid_bodies(WorldSetup(bodies=(box_body(center=(0.0, 0.0, 0.1)),), colliders=(collider,)))
    world.set_segments({0: (0.0, 0.5)})
    world.advance(1e-3, 400)
    pose = world.pose(0, "box")
    assert pose.velocity[2] == pytest.approx(0.2, rel=0.02)
    assert pose.center[2] == pytest.approx(0.18, abs=0.1 * CELL)


def scene(box_body, ball_body, turn=0.0) -> WorldSetup:
    bodies = (
        box_body(name="a", center=(0.0, 0.0, 0.12), spin=(0.3, turn, 0.0)),
        ball_body(name="b", center=(0.05, 0.02, 0.35), subdivisions=3),
        box_body(name="c", center=(0.3, 0.0, 0.1), size=(0.1, 0.2, 0.2), velocity=(-1.0, 0.0, 0.0)),
    )
    return WorldSetup(bodies=bodies, ground=Ground(restitution=0.2))


def test_equal_input_gives_equal_bytes_and_worlds_do_not_mix(box_body, ball_body, rigid_bodies):
    """Bit for bit: the same again, in company of other worlds, and from a checkpoint."""
    one, other = scene(box_body, ball_body), scene(box_body, ball_body, turn=2.0)
    alone = rigid_bodies(one)
    alone.advance(1e-3, 200)
    middle = alone.state()
    alone.advance(1e-3, 200)
    twice = rigid_bodies(one)
    twice.restore(middle)
    twice.advance(1e-3, 200)
    together = rigid_bodies(other, one, other)
    together.advance([5e-4, 1e-3, 2e-4], 400)
    n = len(alone.state()["solids"])
    assert np.array_equal(alone.state()["solids"], twice.state()["solids"])
    assert np.array_equal(alone.state()["solids"], together.state()["solids"][n : 2 * n])
