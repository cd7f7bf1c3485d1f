# SPDX-License-Identifier: MIT
"""Bodies thinner than a grid cell against others that deform: sheets and rods of half and a quarter of a cell.

Requirements are those of thick bodies (``test_mpm_bodies``): 0.2 cells deep at most on impact, 0.1 cell at rest.
Without ``BodyParticles.thickness`` the thrown blocks go through rod and sheet, or 1 cell deep into a sheet of half a
cell.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.world import World
from scipy.spatial import cKDTree

SOFT = ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3)
TAUT = ElasticMaterial(density=1000.0, youngs_modulus=4e5, poisson_ratio=0.3)


CELL = 1.0 / 32.0
"""Metres, as in ``options`` and ``similarity``."""


def slab(cell: float, cells, bottom, name: str, material=SOFT, **fields) -> BodyParticles:
    """Box of ``cells`` (3) along its sides, its underside's centre on ``bottom`` (cells): particles half a cell apart,
    one layer where it is thinner; thin if it is below a cell high."""
    counts = [max(1, round(2 * n)) for n in cells]
    steps = np.array([n / k for n, k in zip(cells, counts, strict=True)]) * cell
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    places = (index + 0.5) * steps - np.array([cells[0], cells[1], 0]) * cell / 2 + np.asarray(bottom) * cell
    if cells[2] < 1:
        fields["thickness"] = cells[2] * cell
    return BodyParticles(
        name=name,
        positions=places,
        volumes=np.full(len(places), float(np.prod(steps))),
        contact_radii=np.full(len(places), float(steps.min()) / 2),
        material=material,
        **fields,
    )


def clearance(world: World, upper: int, lower: int, within: float = 9.0) -> float:
    """Least height in m of the surface of body ``upper`` over that of ``lower`` right below, negative in it; of what is
    ``within`` that many m of its middle along x and y."""
    start = world.bodies[upper].positions
    middle = np.abs(start - start.mean(axis=0))[:, :2].max(axis=1) < within
    above, below = world.positions(upper), world.positions(lower)
    beside, nearest = cKDTree(below[:, :2]).query(above[:, :2])
    tops = below[:, 2] + world.bodies[lower].contact_radii
    heights = above[:, 2] - world.bodies[upper].contact_radii - tops[nearest]
    return float(heights[middle & (beside < 0.5 * CELL)].min())


@pytest.mark.parametrize(("thickness", "speed", "deepest"), [(0.25, 1.1, 0.5), (0.5, 1.1, 0.2), (0.5, 1.5, 0.2)])
def test_a_block_thrown_on_a_held_sheet_does_not_go_through(options, similarity, cell, thickness, speed, deepest):
    """At the speed of a fall by two cells and more. Of half a cell the middle of its underside stays within 0.2 cells
    of the sheet (edges count as rounded); of a quarter, thinner than what is promised, it does not go through."""
    sheet = slab(cell, (9, 9, thickness), (0, 0, 4), "sheet", TAUT)
    sheet = dataclasses.replace(sheet, pins=np.abs(sheet.positions[:, :2]).max(axis=1) > 4 * cell)
    block = slab(cell, (3, 3, 3), (0.1, 0.2, 5), "block", velocity=(0.0, 0.0, -speed))
    world = World(bodies=[sheet, block], ground=Ground(), similarity=similarity, options=options)
    gaps = []
    for _ in range(9):
        world.advance(0.016)
        gaps.append(clearance(world, 1, 0, within=cell) / cell)
    assert min(gaps) > -deepest
    assert world.velocities(1)[:, 2].mean() > 0.3, "the sheet throws it back"
    assert gaps[-1] > 0


def test_a_block_thrown_across_a_held_rod_is_thrown_back(options, similarity, cell):
    """A rod of half a cell by half a cell, held at its ends, whose particles stay apart from those of the block within
    0.1 cells of the sum of their radii. How far it dents the block's face is not judged."""
    rod = slab(cell, (9, 0.5, 0.5), (0, 0, 4), "rod", dataclasses.replace(TAUT, youngs_modulus=2e6))
    rod = dataclasses.replace(rod, pins=np.abs(rod.positions[:, 0]) > 2.5 * cell)
    block = slab(cell, (3, 3, 3), (0.1, 0.2, 5), "block", velocity=(0.0, 0.0, -1.0))
    world = World(bodies=[rod, block], gravity=(0, 0, 0), similarity=similarity, options=options)
    nearest = 9.0
    for _ in range(25):
        world.advance(0.004)
        nearest = min(nearest, cKDTree(world.positions(0)).query(world.positions(1))[0].min())
    assert nearest > 2 * 0.25 * cell - 0.1 * cell
    assert world.velocities(1)[:, 2].mean() > 0.3


def test_a_thin_sheet_lies_on_a_block_and_under_one(options, similarity, cell):
    """Half a cell thick, between a table and a block: no gap and no depth of more than 0.1 cell at rest."""
    bodies = [
        slab(cell, (6, 6, 2), (0, 0, 0), "table"),
        slab(cell, (5, 5, 0.5), (0.1, 0.2, 2.0), "sheet"),
        slab(cell, (3, 3, 2), (0.3, 0.1, 2.5), "block"),
    ]
    world = World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)
    for _ in range(3):
        world.advance(0.1)
        assert abs(clearance(world, 1, 0)) < 0.1 * cell
        assert abs(clearance(world, 2, 1)) < 0.1 * cell


def test_thin_sheets_that_meet_in_flight_keep_both_momenta(options, similarity, cell):
    """To 1e-5 and 1e-4 of the collision's, as bars do; and neither goes through the other."""
    bodies = [
        slab(cell, (5, 5, 0.5), (0.0, 0.0, 0.0), "low", velocity=(0.0, 0.0, 0.5)),
        slab(cell, (5, 5, 0.5), (0.7, 0.3, 1.1), "high", velocity=(0.2, 0.0, -0.5)),
    ]
    world = World(bodies=bodies, gravity=(0, 0, 0), similarity=similarity, options=options)
    before, spin_before = world.linear_momentum(), world.angular_momentum()
    one = float(bodies[0].masses.sum()) * 0.5
    world.advance(0.06)
    low, high = (world.velocities(i)[:, 2].mean() for i in (0, 1))
    assert low < 0.05 and high > -0.05, "they met"
    assert clearance(world, 1, 0) > -0.2 * cell
    assert np.abs(world.linear_momentum() - before).max() < 1e-5 * one
    assert np.abs(world.angular_momentum() - spin_before).max() < 1e-4 * one * 5 * cell
