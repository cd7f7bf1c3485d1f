# SPDX-License-Identifier: MIT
"""The smooth step: its ends, its symmetry, its slope."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.smoothstep import smoothstep


@given(st.floats(-10, 10), st.floats(0.01, 10))
def test_it_rises_from_0_to_1_symmetrically_and_falls_when_its_ends_are_swapped(start, width):
    values = np.linspace(start - width, start + 2 * width, 301)
    risen = smoothstep(values, start, start + width)
    assert (np.diff(risen) >= 0).all()
    assert (risen[values <= start] == 0).all()
    assert (risen[values >= start + width] == 1).all()
    assert risen + risen[::-1] == pytest.approx(np.ones(301), abs=1e-9)
    assert smoothstep(values, start + width, start) == pytest.approx(1 - risen, abs=1e-9)


def test_it_starts_and_ends_level_and_keeps_the_type():
    t = np.linspace(0, 1, 1001)
    slope = np.gradient(smoothstep(t), t)
    assert slope[1:-1] == pytest.approx(6 * t[1:-1] * (1 - t[1:-1]), abs=1e-5)
    assert smoothstep(t.astype(np.float32)).dtype == np.float32
