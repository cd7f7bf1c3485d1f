# SPDX-License-Identifier: MIT
"""Least total variation against its closed form for a disc: a contrast c becomes c − 2 λ / r, or nothing."""

import numpy as np
import pytest
from physgen.sim.reconstruct.background.piecewise_light import _least_variation, piecewise_smooth

SIDE, RADIUS = 96, 20.0


def disc(contrast, radius=RADIUS):
    rows, columns = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2.0
    inside = rows**2 + columns**2 < radius**2
    return np.where(inside, contrast, 0.0).astype(np.float32)[..., None], inside


@pytest.mark.parametrize("penalty", [0.2, 0.5, 1.0])
def test_a_disc_loses_what_theory_says_and_gets_it_back(penalty):
    values, inside = disc(0.3)
    everywhere = np.ones((SIDE, SIDE), np.float32)
    lost = 2.0 * penalty / RADIUS
    once = _least_variation(values, everywhere, penalty)
    # The frame is finite: what the disc loses, the ground around it gains, by the ratio of their areas.
    step = once[inside].mean() - once[~inside].mean()
    share = inside.mean()
    # A grid's discs are longer around than round ones.
    assert step == pytest.approx(0.3 - lost / (1.0 - share), abs=0.1 * lost + 0.002)
    assert piecewise_smooth(values, everywhere, penalty)[inside].mean() == pytest.approx(0.3, abs=0.02)


def test_a_small_disc_vanishes():
    values, inside = disc(0.3, 4.0)
    # Below r = λ / c not even twice the contrast, which the second step is given, is left; a tenth, as the
    # rounds end before the rest is spread over the ground.
    found = piecewise_smooth(values, np.ones((SIDE, SIDE), np.float32), 2.0 * 0.3 * 4.0)
    assert found[inside].mean() - found[~inside].mean() < 0.03


def test_what_is_unknown_is_continued_from_around():
    values, _ = disc(0.3)
    rows = np.arange(SIDE)
    # Nothing is known of the disc's middle, whatever is written there.
    weight = np.ones((SIDE, SIDE), np.float32)
    middle = (np.abs(rows - SIDE / 2) < 8)[:, None] & (np.abs(rows - SIDE / 2) < 8)
    weight[middle], values[middle] = 0.0, 5.0
    found = piecewise_smooth(values, weight, 0.2)
    assert found[middle] == pytest.approx(0.3, abs=0.03)
