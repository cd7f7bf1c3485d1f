# SPDX-License-Identifier: MIT
"""Best rigid alignment of points: motions that are known, weights, mirror images, and a search as the reference."""

import numpy as np
import pytest
from physgen.sim.rigid_alignment import nearest_pose, nearest_rotation
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def test_a_motion_is_found_again_whatever_the_weights():
    random = np.random.default_rng(1)
    rest = random.normal(size=(9, 3))
    seen = rest @ TURN.T + (0.3, -2.0, 0.7)
    for weights in (None, random.uniform(0.1, 5.0, 9)):
        turn, shift = nearest_pose(rest, seen, weights=weights)
        assert turn == pytest.approx(TURN, abs=1e-12) and shift == pytest.approx([0.3, -2.0, 0.7], abs=1e-12)


def test_equal_weights_are_none_and_a_weight_of_two_is_the_point_twice():
    random = np.random.default_rng(2)
    rest, seen = random.normal(size=(2, 6, 3))
    plain, equal = nearest_pose(rest, seen), nearest_pose(rest, seen, weights=np.full(6, 3.0))
    assert np.hstack([plain[0].ravel(), plain[1]]) == pytest.approx(np.hstack([equal[0].ravel(), equal[1]]), abs=1e-12)
    heavy = nearest_pose(rest, seen, weights=np.array([2.0, 1, 1, 1, 1, 1]))
    twice = nearest_pose(rest[[0, 0, 1, 2, 3, 4, 5]], seen[[0, 0, 1, 2, 3, 4, 5]])
    assert np.hstack([heavy[0].ravel(), heavy[1]]) == pytest.approx(np.hstack([twice[0].ravel(), twice[1]]), abs=1e-12)


def test_no_other_motion_is_nearer():
    random = np.random.default_rng(3)
    rest = random.normal(size=(12, 3))
    seen = rest @ TURN.T + 0.3 * random.normal(size=(12, 3))
    weights = random.uniform(0.1, 5.0, 12)
    turn, shift = nearest_pose(rest, seen, weights=weights)

    def squares(motion):
        moved = Rotation.from_rotvec(motion[:3]).apply(rest) + motion[3:]
        return float((weights[:, None] * (moved - seen) ** 2).sum())

    found = squares(np.hstack([Rotation.from_matrix(turn).as_rotvec(), shift]))
    best = min(minimize(squares, np.hstack([start, 0, 0, 0])).fun for start in random.normal(size=(4, 3)))
    assert found == pytest.approx(best, rel=1e-6)


def test_mirrored_points_are_turned_unless_a_reflection_is_asked_for():
    rest = np.random.default_rng(4).normal(size=(8, 3))
    rest -= rest.mean(axis=0)
    seen = rest * (1.0, 1.0, -1.0)
    assert np.linalg.det(nearest_rotation(seen.T @ rest)) == pytest.approx(1.0)
    assert nearest_rotation(seen.T @ rest, hand=-1.0) == pytest.approx(np.diag([1.0, 1.0, -1.0]), abs=1e-12)
