# SPDX-License-Identifier: MIT
"""Splats as data."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.gaussians.splats import Splats, joined
from scipy.spatial.transform import Rotation


def some(count=3, **changes):
    random = np.random.default_rng(count)
    arrays = {
        "centres": random.normal(size=(count, 3)),
        "scales": random.uniform(0.01, 0.1, (count, 3)),
        "rotations": random.normal(size=(count, 4)),
        "opacities": random.uniform(0.1, 0.9, count),
        "colours": random.uniform(0, 1, (count, 3)),
    }
    return Splats(**{**arrays, **changes})


@given(st.integers(0, 2**32 - 1))
def test_axes_are_the_quaternions_rotation(seed):
    quaternion = np.random.default_rng(seed).normal(size=(4, 4))
    splats = some(4, rotations=quaternion)
    wanted = Rotation.from_quat(np.roll(quaternion, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(splats.axes(), wanted, atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(splats.covariances()), np.sort(splats.scales**2), rtol=1e-6)


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"scales": np.ones((2, 3))}, "scales have shape"),
        ({"centres": np.full((3, 3), np.nan)}, "centres of splat 0"),
        ({"scales": np.zeros((3, 3))}, "scales go from 0"),
        ({"rotations": np.zeros((3, 4))}, "rotation of splat 0"),
        ({"opacities": np.full(3, 1.5)}, "opacities go from 1.5"),
    ],
)
def test_bad_numbers_are_named(changes, said):
    with pytest.raises(InputError, match=said):
        some(3, **changes)


def test_parts_are_chosen_and_joined():
    splats = some(5)
    halves = splats.subset(np.arange(5) < 2), splats.subset(np.arange(2, 5))
    again = joined(halves)
    np.testing.assert_array_equal(again.centres, splats.centres)
    np.testing.assert_allclose(again.rotations, splats.rotations, atol=1e-15)
    with pytest.raises(InputError, match="nothing to join"):
        joined([])
    with pytest.raises(ValueError, match="read-only"):
        splats.centres[0] = 0.0


def test_none_is_fine():
    assert len(some(0)) == 0
