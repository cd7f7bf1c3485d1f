# SPDX-License-Identifier: MIT
"""The ground: rest, penetration, Coulomb friction."""

from __future__ import annotations

import numpy as np
import pytest
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.world import World

G = 9.81


def tilt(angle: float) -> np.ndarray:
    """Rotation about y that tips the z axis towards +x by ``angle``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.long
@pytest.mark.parametrize("height_in_cells", [0.0, 0.23, 0.5, 0.81])
@pytest.mark.parametrize("youngs_modulus", [5e4, 2e6])
def test_box_at_rest_has_its_underside_on_the_ground(box, options, similarity, cell, height_in_cells, youngs_modulus):
    """Within 0.1 cell wherever the ground lies between the nodes: it neither hovers nor sinks nor jumps."""
    height = height_in_cells * cell
    body = box(bottom=(0.0, 0.0, height), youngs_modulus=youngs_modulus)
    world = World(bodies=[body], ground=Ground(point=(0.0, 0.0, height)), similarity=similarity, options=options)
    for _ in range(6):
        world.advance(0.05)
        assert abs(world.ground_gap(0)) < 0.1 * cell


@pytest.mark.parametrize("height_in_cells", [0.1, 0.6])
def test_dropped_box_comes_to_rest_on_the_ground(box, options, similarity, cell, height_in_cells):
    """After a fall of one cell, bounces and half a second, the underside lies within 0.1 cell of the ground."""
    height = height_in_cells * cell
    body = box(bottom=(0.0, 0.0, height + cell), youngs_modulus=1e5, cells=(6, 6, 3))
    world = World(bodies=[body], ground=Ground(point=(0.0, 0.0, height)), similarity=similarity, options=options)
    world.advance(1.0)
    assert abs(world.ground_gap(0)) < 0.1 * cell


@pytest.mark.parametrize("angle", [0.0, 0.35])
@pytest.mark.parametrize("youngs_modulus, speed", [(1e4, 4.0), (1e6, 8.0)])
def test_hard_drop_never_sinks_into_the_ground(box, options, similarity, cell, angle, youngs_modulus, speed):
    """No particle more than 0.1 cell under the ground, on a level and on a tilted plane, at any time."""
    rotation = tilt(angle)
    normal = rotation[:, 2]
    body = box(
        bottom=tuple(0.5 * cell * normal),
        rotation=rotation,
        youngs_modulus=youngs_modulus,
        cells=(6, 6, 4),
        velocity=tuple(-speed * normal),
    )
    world = World(bodies=[body], ground=Ground(normal=tuple(normal)), similarity=similarity, options=options)
    for _ in range(40):
        world.advance(0.002)
        assert (world.positions(0) @ normal).min() > -0.1 * cell
        assert world.ground_gap(0) > -0.1 * cell


@pytest.mark.parametrize("friction", [0.1, 0.3])
@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_block_slides_down_a_slope(box, options, similarity, friction, degrees):
    """a = g (sin th - mu cos th) within 3 % (Coulomb)."""
    angle = np.radians(degrees)
    rotation = tilt(angle)
    body = box(cells=(6, 6, 3), rotation=rotation, youngs_modulus=1e6)
    ground = Ground(normal=tuple(rotation[:, 2]), friction=friction)
    world = World(bodies=[body], ground=ground, similarity=similarity, options=options)
    downhill = rotation[:, 0]
    track = []
    for _ in range(14):
        world.advance(0.025)
        track.append((world.time, float(world.velocities(0).mean(axis=0) @ downhill)))
    # The block starts without stress and bounces on itself: a line through the track evens that out.
    slope = np.polyfit(*np.array(track).T, 1)[0]
    assert slope == pytest.approx(G * (np.sin(angle) - friction * np.cos(angle)), rel=0.03)


def test_block_sticks_below_the_friction_angle(box, options, similarity, cell):
    """mu = 0.5 holds on 20 degrees (tan 20 = 0.36): less than 0.02 cells of creep in half a second."""
    rotation = tilt(np.radians(20.0))
    body = box(cells=(6, 6, 3), rotation=rotation, youngs_modulus=1e6)
    ground = Ground(normal=tuple(rotation[:, 2]), friction=0.5)
    world = World(bodies=[body], ground=ground, similarity=similarity, options=options)
    world.advance(0.1)
    bottom = np.arange(body.count)[(body.positions @ rotation[:, 2]) < 0.3 * cell]
    before = world.positions(0)[bottom].mean(axis=0)
    world.advance(0.5)
    creep = (world.positions(0)[bottom].mean(axis=0) - before) @ rotation[:, 0]
    assert abs(creep) < 0.02 * cell


def test_sliding_on_ice_keeps_its_speed(box, options, similarity):
    """Without friction the ground takes no tangential momentum: within 0.1 %."""
    body = box(velocity=(0.5, 0.0, 0.0), youngs_modulus=2e5)
    world = World(bodies=[body], ground=Ground(friction=0.0), similarity=similarity, options=options)
    world.advance(0.4)
    assert world.velocities(0).mean(axis=0)[0] == pytest.approx(0.5, rel=1e-3)


def test_bounce_gains_no_energy(box, options, similarity, cell):
    """An elastic body may lose energy to the ground's inelastic contact, never gain more than 1 % of the drop's."""
    body = box(bottom=(0.0, 0.0, 2 * cell), youngs_modulus=2e5)
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    start = world.energy().total
    drop = body.masses.sum() * G * 2 * cell
    for _ in range(30):
        world.advance(0.02)
        assert world.energy().total < start + 0.01 * drop


def test_body_that_starts_slightly_sunk_is_not_launched(box, options, similarity, cell):
    """Half a cell under the ground at the start: it comes up without leaving the ground by more than 0.2 cell."""
    body = box(bottom=(0.0, 0.0, -0.5 * cell), youngs_modulus=1e6)
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    gaps = []
    for _ in range(40):
        world.advance(0.01)
        gaps.append(world.ground_gap(0) / cell)
    assert max(gaps) < 0.2
    assert abs(gaps[-1]) < 0.1
