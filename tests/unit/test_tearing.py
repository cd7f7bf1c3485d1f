# SPDX-License-Identifier: MIT
"""A skin is torn where it is stretched, not where it moves."""

import numpy as np
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.skinning import TORN_STRETCH, first_torn

BALL = trimesh.creation.icosphere(subdivisions=2)


def rotation(angles):
    return trimesh.transformations.euler_matrix(*angles)[:3, :3]


@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(-5, 5), min_size=3, max_size=3),
    st.floats(1 / 1.5, 1.5),
)
def test_rigid_motion_and_small_stretch_do_not_tear(angles, shift, stretch):
    moved = (BALL.vertices * [1, 1, stretch]) @ rotation(angles).T + shift
    assert first_torn([BALL.vertices, moved], BALL.faces) is None


@given(st.integers(1, 5), st.floats(1.05, 4))
def test_tearing_starts_at_the_first_overstretched_sample(at, factor):
    samples = [BALL.vertices] * at + [BALL.vertices * [1, 1, TORN_STRETCH * factor]] * 2

    def stream():
        yield from samples
        raise AssertionError("asked for more than was needed")

    assert first_torn(stream(), BALL.faces) == at
    assert first_torn([BALL.vertices] * 3, BALL.faces) is None


def test_a_single_long_edge_is_not_a_tear():
    one = BALL.vertices.copy()
    one[0] += 20.0
    fine = trimesh.creation.icosphere(subdivisions=4)
    far = fine.vertices.copy()
    far[0] += 20.0
    assert first_torn([BALL.vertices, one], BALL.faces) == 1  # six of 480 edges
    assert first_torn([fine.vertices, far], fine.faces) is None


def test_a_mesh_without_size_is_no_error():
    flat = np.zeros((3, 3))
    assert first_torn([flat, flat], np.array([[0, 1, 2]])) is None
