# SPDX-License-Identifier: MIT
"""Colliders that deform along their own surface, belts and turntables given as vertices, drag what lies on them.

Friction speeds a body up by mu g until it has the surface's velocity: v(t) = min(mu g t, V), reached after V / (mu g).
Tolerances as for rigid motion (1 %) and, of bodies that deform, for sliding (3 %); 5 % of the time to reach the belt's
speed, as wanted.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.rigid.collision_shapes import lattice_of
from physgen.sim.mpm.rigid.surface_motion import footing_of
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup

G, SPEED, FRICTION = 9.81, 0.5, 0.4
RUBBING = ContactTable(default=SurfaceContact(friction=FRICTION))


def belt(seconds: float) -> Collider:
    """A slab whose top, at z = 0, slides along +x at SPEED and whose underside stays: its sides shear."""
    mesh = trimesh.creation.box((1.2, 0.5, 0.1)).subdivide().subdivide()
    rest = np.asarray(mesh.vertices) - [0.0, 0.0, 0.05]
    moved = rest + np.where(rest[:, 2:] > -0.01, [[SPEED * seconds, 0.0, 0.0]], 0.0)
    track = Track(times=np.array([0.0, seconds]), values=np.stack([rest, moved]))
    return Collider(name="belt", surface=Surface(vertices=rest, faces=np.asarray(mesh.faces)), vertices=track)


def closed_belt(seconds: float, keys: int = 6) -> Collider:
    """A belt round two rollers, seen as one solid: every vertex travels round its rim at SPEED, the shape stays.

    Top at z = 0 from x = -0.6 to 0.6 m, rollers of 50 mm radius, 0.5 m wide.
    """
    straight, radius, width, count = 1.2, 0.05, 0.5, 108
    turn = np.pi * radius
    rim = 2 * (straight + turn)

    def place(along: np.ndarray) -> np.ndarray:
        """(n, 2) x and z of the distances (n,) in metres along the rim, from the top's left end."""
        s = along % rim
        right, left = (s - straight) / radius, (s - 2 * straight - turn) / radius
        x = np.select(
            [s < straight, s < straight + turn, s < 2 * straight + turn],
            [s, straight + radius * np.sin(right), 2 * straight + turn - s],
            -radius * np.sin(left),
        )
        z = np.select(
            [s < straight, s < straight + turn, s < 2 * straight + turn],
            [0.0, radius * (np.cos(right) - 1), -2 * radius],
            -radius * (1 + np.cos(left)),
        )
        return np.stack([x - straight / 2, z], axis=1)

    def rows(along: np.ndarray) -> np.ndarray:
        """(2 n + 2, 3) both rims and the middles of both sides."""
        ring = place(along)
        sides = [np.insert(ring, 1, y, axis=1) for y in (-width / 2, width / 2)]
        middles = [[[0.0, y, -radius]] for y in (-width / 2, width / 2)]
        return np.concatenate([*sides, *middles])

    here = np.arange(count)
    after = (here + 1) % count
    near, far = np.full(count, 2 * count), np.full(count, 2 * count + 1)
    faces = np.concatenate(
        [
            np.stack([here, after, here + count], axis=1),
            np.stack([after, after + count, here + count], axis=1),
            np.stack([near, after, here], axis=1),
            np.stack([far, here + count, after + count], axis=1),
        ]
    )
    times = np.linspace(0.0, seconds, keys)
    start = here * rim / count
    track = Track(times=times, values=np.stack([rows(start + SPEED * t) for t in times]))
    return Collider(name="belt", surface=Surface(vertices=rows(start), faces=faces), vertices=track)


def turntable(spin: float, seconds: float, keys: int) -> Collider:
    """A disc whose vertices go round, top at z = 0."""
    mesh = trimesh.creation.cylinder(radius=0.4, height=0.1, sections=48).subdivide()
    rest = np.asarray(mesh.vertices) - [0.0, 0.0, 0.05]
    times = np.linspace(0.0, seconds, keys)
    turned = [rest @ trimesh.transformations.rotation_matrix(spin * t, (0, 0, 1))[:3, :3].T for t in times]
    track = Track(times=times, values=np.stack(turned))
    return Collider(name="table", surface=Surface(vertices=rest, faces=np.asarray(mesh.faces)), vertices=track)


def check_start(times: list[float], speeds: list[float], within: float) -> None:
    """mu g while it slips, the belt's speed after that, reached in time."""
    t, v = np.array(times), np.array(speeds)
    reached = SPEED / (FRICTION * G)
    slipping = (t > 0.2 * reached) & (t < 0.9 * reached)
    slope, start = np.polyfit(t[slipping], v[slipping], 1)
    assert slope == pytest.approx(FRICTION * G, rel=within)
    assert (SPEED - start) / slope == pytest.approx(reached, rel=0.05)
    assert v[t > 1.2 * reached] == pytest.approx(SPEED, rel=within)


BELTS = [belt, pytest.param(closed_belt, marks=pytest.mark.long)]
"""Of a closed belt, what goes down round the end roller and back below the bodies does not slow the top."""


@pytest.mark.parametrize("make", BELTS)
def test_a_belt_takes_a_rigid_box_along(box_body, rigid_bodies, make):
    carrier = make(0.25)
    world = rigid_bodies(
        WorldSetup(bodies=(box_body(center=(-0.3, 0.0, 0.1)),), colliders=(carrier,), contacts=RUBBING)
    )
    times, speeds = [], []
    for start, end in pairwise(carrier.vertices.times):
        world.set_segments({0: (start, end)})
        pieces = round((end - start) / 0.0125)
        for i in range(pieces):
            world.advance((end - start) / pieces / 12, 12)
            times.append(start + (i + 1) / pieces * (end - start))
            speeds.append(world.pose(0, "box").velocity[0])
    check_start(times, speeds, 0.01)


@pytest.mark.parametrize("make", BELTS)
def test_a_belt_takes_a_soft_box_along(box, options, similarity, make):
    body = box(cells=(5, 5, 3), bottom=(-0.3, 0.0, 0.0))
    world = World(bodies=[body], colliders=[make(0.25)], contacts=RUBBING, similarity=similarity, options=options)
    times, speeds = [], []
    for i in range(20):
        world.advance(0.012)
        times.append(0.012 * (i + 1))
        speeds.append(float(world.velocities(0)[:, 0].mean()))
    check_start(times, speeds, 0.03)
    assert abs(world.velocities(0)[:, 1].mean()) < 0.01 * SPEED


@pytest.mark.long
def test_a_turntable_of_vertices_turns_what_lies_on_it(box_body, rigid_bodies):
    """With mu g above w² r it goes round with the disc: the disc's own spin within 2 %, on its circle within 2 %."""
    spin, seconds, keys, radius = 2.0, 0.4, 5, 0.2
    body = box_body(
        center=(radius, 0.0, 0.05), size=(0.1, 0.1, 0.1), velocity=(0.0, spin * radius, 0.0), spin=(0.0, 0.0, spin)
    )
    contacts = ContactTable(default=SurfaceContact(friction=0.8))
    world = rigid_bodies(WorldSetup(bodies=(body,), colliders=(turntable(spin, seconds, keys),), contacts=contacts))
    for k in range(keys - 1):
        world.set_segments({0: (k * seconds / (keys - 1), (k + 1) * seconds / (keys - 1))})
        world.advance(seconds / (keys - 1) / 20, 20)
    pose = world.pose(0, "box")
    assert pose.spin[2] == pytest.approx(spin, rel=0.02)
    assert np.hypot(*pose.center[:2]) == pytest.approx(radius, rel=0.02)
    assert np.arctan2(pose.center[1], pose.center[0]) == pytest.approx(spin * seconds, rel=0.02)


def test_velocities_of_a_surface_at_its_lattice():
    """Linear in place on flat faces, so that trilinear interpolation gives them: within a third of a spacing."""
    mesh = trimesh.creation.box((0.6, 0.4, 0.2))
    surface = Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    lattice = lattice_of(surface)
    turning = np.cross([0.0, 0.0, 1.0], surface.vertices)
    found = footing_of(lattice, surface).velocities(turning)
    top = round((0.1 - lattice.origin[2]) / lattice.spacing)
    for i, j in ((8, 12), (15, 10), (22, 14)):
        place = lattice.origin + lattice.spacing * np.array([i, j, top])
        assert np.abs(place[:2]).max() < 0.3 and abs(place[2] - 0.1) < 1e-6 and abs(place[1]) < 0.2
        assert found[i, j, top] == pytest.approx(np.cross([0, 0, 1.0], place), abs=0.34 * lattice.spacing)
    assert (found[0, 0, 0] == 0).all(), "far from the surface"
