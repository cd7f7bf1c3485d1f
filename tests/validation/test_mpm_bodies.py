# SPDX-License-Identifier: MIT
"""Bodies that deform against each other: gap, friction, momentum; many worlds at once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial
from physgen.sim.errors import SimulationError
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World, Worlds
from physgen.sim.mpm.world_setup import WorldSetup

G = 9.81


def gap_between(world: World, low: int, high: int) -> float:
    """Distance in metres of the underside of body ``high`` over the top of body ``low``, both flat and level."""
    below, above = world.bodies[low], world.bodies[high]
    top = (world.positions(low)[:, 2] + below.contact_radii).max()
    return float((world.positions(high)[:, 2] - above.contact_radii).min() - top)


@pytest.mark.long
@pytest.mark.parametrize("height_in_cells", [0.0, 0.3, 0.7])
def test_box_rests_on_a_box_without_a_gap(box, options, similarity, cell, height_in_cells):
    """Stacked boxes, wherever the joint lies between the nodes: |gap| < 0.1 cell at rest (the issue's rest height)."""
    height = height_in_cells * cell
    bodies = [
        box(cells=(8, 8, 4), bottom=(0.0, 0.0, height), youngs_modulus=1e6, name="table"),
        box(cells=(4, 4, 4), bottom=(0.0, 0.0, height + 4 * cell), youngs_modulus=1e6, name="box"),
    ]
    world = World(bodies=bodies, ground=Ground(point=(0.0, 0.0, height)), similarity=similarity, options=options)
    for _ in range(5):
        world.advance(0.1)
        assert abs(gap_between(world, 0, 1)) < 0.1 * cell


@pytest.mark.slow
def test_dropped_box_stops_where_the_other_begins(box, options, similarity, cell):
    """Dropped by two cells onto another and left to come to rest: never more than 0.2 cells deep, no hovering."""
    viscous = {"density": 1000.0, "youngs_modulus": 2e6, "poisson_ratio": 0.3, "damping_time": 2e-3}
    bodies = [
        box(cells=(8, 8, 4), name="table"),
        box(cells=(4, 4, 4), bottom=(0.1 * cell, 0.2 * cell, 6.3 * cell), name="box"),
    ]
    bodies = [dataclasses.replace(body, material=ElasticMaterial(**viscous)) for body in bodies]
    world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
    gaps = []
    for _ in range(80):
        world.advance(0.01)
        gaps.append(gap_between(world, 0, 1) / cell)
    assert min(gaps) > -0.2
    assert np.abs(gaps[-10:]).max() < 0.1


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_box_slides_on_a_box(box, options, similarity, cell, friction):
    """Started at 0.5 m/s on a box that the ground holds: it slows down by mu g within 5 % (Coulomb)."""
    contacts = ContactTable().with_pair("table", "ground", SurfaceContact(friction=5.0, mode="sticky"))
    contacts = contacts.with_pair("table", "box", SurfaceContact(friction=friction))
    bodies = [
        box(cells=(16, 8, 3), youngs_modulus=5e6, name="table"),
        box(cells=(4, 4, 3), bottom=(-5 * cell, 0.0, 3 * cell), velocity=(0.5, 0.0, 0.0), name="box"),
    ]
    world = World(bodies=bodies, ground=Ground(), contacts=contacts, similarity=similarity, options=options)
    track = []
    for _ in range(15):
        world.advance(0.01)
        track.append((world.time, float(world.velocities(1)[:, 0].mean())))
    slope = np.polyfit(*np.array(track).T, 1)[0]
    assert slope == pytest.approx(-friction * G, rel=0.05, abs=0.02 * G)


def test_bodies_that_touched_come_apart(box, options, similarity, cell):
    """Lifted off, the upper box leaves the lower one behind: the lower one is not carried along."""
    bodies = [
        box(cells=(6, 6, 3), youngs_modulus=1e6, name="below"),
        box(cells=(6, 6, 3), bottom=(0.0, 0.0, 3 * cell), youngs_modulus=1e6, velocity=(0.0, 0.0, 1.0), name="above"),
    ]
    world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
    world.advance(0.1)
    rise = 0.1 - 0.5 * G * 0.01
    assert gap_between(world, 0, 1) == pytest.approx(rise, abs=0.1 * cell)
    assert abs(world.velocities(0)[:, 2].mean()) < 0.02


def test_elastic_bars_swap_their_velocities(box, options, similarity, cell):
    """Two equal bars with nu = 0 that meet end on are a one-dimensional problem: after 2 L / c they have swapped their
    velocities and no wave is left in them (St. Venant). Velocities and energy within 5 %, momentum to 1e-5 and angular
    momentum to 1e-4 of the collision's."""
    common = {"cells": (16, 4, 4), "youngs_modulus": 1e6, "poisson_ratio": 0.0}
    bodies = [
        box(**common, bottom=(-8.13 * cell, 0.0, 0.0), velocity=(1.0, 0.0, 0.0), name="a"),
        box(**common, bottom=(8.87 * cell, 0.0, 0.0), velocity=(-1.0, 0.0, 0.0), name="b"),
    ]
    contacts = ContactTable(default=SurfaceContact(restitution=1.0))
    world = World(bodies=bodies, gravity=(0.0, 0.0, 0.0), contacts=contacts, similarity=similarity, options=options)
    one = bodies[0].masses.sum() * 1.0
    before, spin_before = world.energy().total, world.angular_momentum()
    world.advance(0.1)
    assert np.abs(world.linear_momentum()).max() < 1e-5 * one
    assert np.abs(world.angular_momentum() - spin_before).max() < 1e-4 * one * 16 * cell
    assert world.velocities(0)[:, 0].mean() == pytest.approx(-1.0, rel=0.05)
    assert world.velocities(1)[:, 0].mean() == pytest.approx(1.0, rel=0.05)
    assert world.energy().total == pytest.approx(before, rel=0.05)


def _variants(box, cell) -> list[WorldSetup]:
    """Worlds that differ in stiffness, speed, gravity and friction."""
    setups = []
    for i in range(4):
        bodies = (
            box(cells=(4, 4, 3), bottom=(0.0, 0.0, 0.5 * cell), youngs_modulus=10 ** (5 + 0.7 * i), name="a"),
            box(
                cells=(3, 3, 3),
                bottom=(0.3 * i * cell, 0.0, 5 * cell),
                youngs_modulus=3e5,
                velocity=(0.2 * i, 0.0, -1.0),
                spin=(0.0, 3.0, float(i)),
                start_time=0.01 * i,
                name="b",
            ),
        )
        if i == 2:
            # Another set of laws, hence other kernels.
            viscous = dataclasses.replace(bodies[0].material, damping_time=1e-4)
            bodies = (dataclasses.replace(bodies[0], material=viscous), bodies[1])
        setups.append(WorldSetup(bodies=bodies, ground=Ground(friction=0.2 * i), gravity=(0.0, 0.5 * i, -9.81)))
    return setups


@pytest.mark.usefixtures("repeatable")
def test_worlds_together_are_worlds_alone(box, options, similarity, cell):
    """Every world among others: the same bytes as alone, though each takes its own substeps."""
    setups = _variants(box, cell)
    together = Worlds(setups, similarity=similarity, options=options)
    for _ in range(3):
        together.advance(0.02)
    steps = [together[i].substeps for i in range(len(setups))]
    assert len(set(steps)) > 1
    for i, setup in enumerate(setups):
        alone = Worlds([setup], similarity=similarity, options=options)
        for _ in range(3):
            alone.advance(0.02)
        assert alone[0].substeps == steps[i]
        for body in range(2):
            assert np.array_equal(alone[0].positions(body), together[i].positions(body))
            assert np.array_equal(alone[0].velocities(body), together[i].velocities(body))


def test_a_world_that_is_lost_is_named(box, options, similarity, cell):
    setups = _variants(box, cell)[:2]
    wrong = dataclasses.replace(setups[1].bodies[0], velocity=(1e9, 0.0, 0.0))
    setups[1] = dataclasses.replace(setups[1], bodies=(wrong, setups[1].bodies[1]))
    worlds = Worlds(setups, similarity=similarity, options=options)
    with pytest.raises(SimulationError, match="'a' of world 1"):
        worlds.advance(0.01)
