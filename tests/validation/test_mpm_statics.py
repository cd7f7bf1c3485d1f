# SPDX-License-Identifier: MIT
"""Bodies that hang and bend under their weight, held by pins, against the theory of bars and beams.

The weight grows over one period of the lowest mode, which leaves that mode hardly swinging (a ramp as long as a period
leaves nothing), and the next period is averaged.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial
from physgen.sim.mpm.colliders import Track
from physgen.sim.mpm.world import World

G, DENSITY = 9.81, 1000.0


@pytest.fixture
def sag(similarity, options):
    """Mean displacement (N, 3) in metres of a body that comes under its weight."""

    def measure(body, period: float) -> np.ndarray:
        ramp = Track(times=[0.0, period], values=[[0.0, 0.0, 0.0], [0.0, 0.0, -G]])
        world = World(bodies=[body], gravity_track=ramp, similarity=similarity, options=options)
        world.advance(period)
        total = np.zeros((body.count, 3))
        for _ in range(20):
            world.advance(period / 20)
            total += world.positions(0) - body.positions
        return total / 20

    return measure


@pytest.fixture
def hanging(block, sag, cell):
    """Stretch of a hanging bar over rho g L^2 / 2E, 4 cells thick and ``cells`` long, with nu = 0."""

    def measure(cells: int) -> float:
        length, strain = cells * cell, 0.01
        modulus = DENSITY * G * length / (2 * strain)
        bar = block(
            ElasticMaterial(density=DENSITY, youngs_modulus=modulus, poisson_ratio=0.0),
            (4, 4, cells + 3),
            bottom=(0.0, 0.0, -length),
            pins=lambda places: places[:, 2] > 0,
        )
        moved = sag(bar, 4 * length / math.sqrt(modulus / DENSITY))[:, 2]
        assert np.abs(moved[bar.pins]).max() < 0.02 * cell, "pins creep no more than friction that sticks"
        foot = bar.positions[:, 2] < -length + 0.3 * cell
        below = -bar.positions[foot, 2]
        return float((-moved[foot]).mean() / (DENSITY * G / modulus * (below * length - below**2 / 2)).mean())

    return measure


def test_a_hanging_bar_stretches_by_its_weight(hanging):
    """rho g L^2 / 2E within 5 % (the issue's tolerance) on three grids, nearer on each finer one. Pins hold particles,
    whose lowest layer begins half a spacing above the clamp: that is an error of the first order."""
    errors = [abs(hanging(cells) - 1) for cells in (12, 24, 36)]
    assert max(errors) < 0.05
    assert errors[0] > errors[1] > errors[2]


@pytest.fixture
def cantilever(block, sag, cell):
    """Sag of the end of a clamped beam ``cells`` high, half as wide and five times as long, over that of theory."""

    def measure(cells: int) -> float:
        height, length, poisson, stub = cells * cell, 5 * cells * cell, 0.3, 2
        # Euler and Bernoulli: w = rho g A L^4 / 8 E I at the end; with the modulus such that this is L / 50.
        modulus = 1.5 * DENSITY * G * length**4 / (height**2 * 0.02 * length)
        # Timoshenko adds the shear, rho g L^2 / 2 kappa G, kappa as Cowper has it for a rectangle: 4 %.
        kappa, shear = 10 * (1 + poisson) / (12 + 11 * poisson), modulus / (2 * (1 + poisson))
        bending = 0.02 * length
        theory = bending + DENSITY * G * length**2 / (2 * kappa * shear)
        beam = block(
            ElasticMaterial(density=DENSITY, youngs_modulus=modulus, poisson_ratio=poisson),
            (5 * cells + stub, cells // 2, cells),
            bottom=((length - stub * cell) / 2, 0.0, 0.0),
            pins=lambda places: places[:, 0] < 0,
        )
        lowest = 3.516 * math.sqrt(modulus * height**2 / (12 * DENSITY * length**4) * bending / theory)
        moved = sag(beam, 2 * math.pi / lowest)[:, 2]
        end = beam.positions[:, 0] > length - 0.3 * cell
        x = beam.positions[end, 0].mean() / length
        return float(-moved[end].mean() / theory / ((x**4 - 4 * x**3 + 6 * x**2) / 3))

    return measure


def test_a_cantilever_bends_by_its_weight(cantilever):
    """Theory within 5 % (the issue's tolerance), 4 cells high."""
    assert cantilever(4) == pytest.approx(1.0, rel=0.05)


@pytest.mark.slow
def test_a_cantilevers_sag_converges_as_the_cells_shrink(cantilever):
    """Within 5 % with 4, 6 and 8 cells across the height, and what each finer grid changes falls as of an order above
    1 (the issue's): a first-order error would give (1/4 - 1/6) / (1/6 - 1/8) = 2 for the two changes' ratio. What is
    left to one-dimensional theory, which knows nothing of the clamp holding the beam's width, is not counted."""
    sags = [cantilever(cells) for cells in (4, 6, 8)]
    assert sags == pytest.approx([1.0] * 3, rel=0.05)
    assert abs(sags[0] - sags[1]) > 2 * abs(sags[1] - sags[2])
