# SPDX-License-Identifier: MIT
"""Splats follow particles: Σ' = F Σ Fᵀ, exactly for affine motion, whatever single particles do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.gaussians.splats import (
    MAX_STRETCH,
    Splats,
    bind_splats,
    deformed_half_axes,
    from_half_axes,
    half_axes,
    transform_splats,
)
from scipy.spatial.transform import Rotation

SEEDS = st.integers(0, 2**32 - 1)


def some(count=60, seed=0):
    random = np.random.default_rng(seed)
    return Splats(
        centres=random.uniform(0, 0.2, (count, 3)),
        scales=10 ** random.uniform(-4, -2, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        opacities=random.uniform(0.1, 0.9, count),
        colours=random.uniform(0, 1, (count, 3)),
    )


def particles(count=2000):
    return np.random.default_rng(1).uniform(0, 0.2, (count, 3))


def everywhere(matrix, count):
    return np.broadcast_to(matrix, (count, 3, 3))


def deformed(splats, *motion):
    return from_half_axes(splats, *deformed_half_axes(splats, *motion))


def assert_covariances(splats, wanted):
    """To rounding of each splat's own size."""
    size = np.linalg.norm(wanted, axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(splats.covariances() / size, wanted / size, atol=1e-12)


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_affine_motion_is_exact(seed):
    random = np.random.default_rng(seed)
    a, shift = Rotation.random(random_state=seed).as_matrix() + random.uniform(-0.5, 0.5, (3, 3)), random.normal(size=3)
    if np.linalg.det(a) <= 1e-3:
        return
    splats, rest = some(seed=seed), particles()
    found = deformed(splats, bind_splats(splats, rest), rest @ a.T + shift, everywhere(a, len(rest)))
    np.testing.assert_allclose(found.centres, splats.centres @ a.T + shift, atol=1e-12)
    assert_covariances(found, a @ splats.covariances() @ a.T)
    assert np.array_equal(found.opacities, splats.opacities) and np.array_equal(found.colours, splats.colours)


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_rigid_motion_keeps_scales_in_their_order(seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    splats, rest = some(seed=seed), particles()
    found = deformed(splats, bind_splats(splats, rest), rest @ turn.T, everywhere(turn, len(rest)))
    np.testing.assert_allclose(found.scales, splats.scales, rtol=1e-10)
    np.testing.assert_allclose(found.axes(), turn @ splats.axes(), atol=1e-10)


def test_axes_stay_themselves_while_another_becomes_the_longest():
    """A sorted decomposition would swap them where they are equally long."""
    splats = some().changed(scales=np.tile([3e-3, 2e-3, 1e-3], (60, 1)))
    before = splats
    for share in np.linspace(1.0, 3.0, 41):
        squeeze = splats.axes() @ np.diag([1 / share, 1.0, share]) @ splats.axes().transpose(0, 2, 1)
        now = from_half_axes(splats, splats.centres, squeeze @ half_axes(splats))
        steps = np.abs(np.einsum("nij,nij->nj", now.axes(), before.axes()))
        assert steps.min() > 0.999
        before = now
    np.testing.assert_allclose(before.scales, np.tile([1e-3, 2e-3, 3e-3], (60, 1)), rtol=1e-9)


def test_bending_turns_each_splat_with_its_place():
    """A bar rolled onto a circle: R S at the splat's own angle, to first order in the particles' spacing."""
    radius, rest = 0.2, particles(6000)

    def rolled(points):
        angle, r = points[:, 0] / radius, radius - points[:, 2]
        places = np.stack([r * np.sin(angle), points[:, 1], radius - r * np.cos(angle)], axis=1)
        f = np.zeros((len(points), 3, 3))
        f[:, 0, 0], f[:, 0, 2] = np.cos(angle) * r / radius, -np.sin(angle)
        f[:, 1, 1] = 1.0
        f[:, 2, 0], f[:, 2, 2] = np.sin(angle) * r / radius, np.cos(angle)
        return places, f

    splats = some()
    found = deformed(splats, bind_splats(splats, rest), *rolled(rest))
    places, f = rolled(splats.centres)
    spacing = 0.2 / len(rest) ** (1 / 3)
    assert np.abs(found.centres - places).max() < spacing**2 / radius * 2
    wanted = f @ splats.covariances() @ f.transpose(0, 2, 1)
    errors = np.linalg.norm(found.covariances() - wanted, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    assert errors.max() < 2 * spacing / radius


def test_floaters_and_broken_gradients_do_not_count():
    splats, rest = some(), particles()
    positions, gradients = rest.copy(), np.tile(np.eye(3), (len(rest), 1, 1))
    random = np.random.default_rng(3)
    lost = random.permutation(len(rest))[:160]
    positions[lost[:40]] += random.normal(size=(40, 3))
    positions[lost[40:60]] = np.nan
    gradients[lost[60:100]] = np.nan
    gradients[lost[100:130]] = -np.eye(3)
    gradients[lost[130:]] = 0.0
    found = deformed(splats, bind_splats(splats, rest), positions, gradients)
    assert_covariances(found, splats.covariances())
    np.testing.assert_allclose(found.centres, splats.centres, atol=2e-3)


@pytest.mark.parametrize("gradient", [np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
def test_splats_keep_their_shape_without_valid_gradients(gradient):
    splats, rest = some(), particles()
    found = deformed(splats, bind_splats(splats, rest), rest, everywhere(gradient, len(rest)))
    assert_covariances(found, splats.covariances())


def test_torn_matter_makes_no_needles():
    splats, rest = some(), particles()
    stretch = np.diag([100.0, 1.0, 1.0])
    _, axes = deformed_half_axes(splats, bind_splats(splats, rest), rest @ stretch, everywhere(stretch, len(rest)))
    wanted = np.diag([MAX_STRETCH, 1.0, 1.0]) @ half_axes(splats)
    np.testing.assert_allclose(axes, wanted, rtol=1e-9, atol=1e-15)


def test_placing_stretches_shears_and_mirrors():
    splats = some()
    matrix = np.array([[-2.0, 0.3, 0.0, 1.0], [0.0, 1.0, 0.5, 2.0], [0.0, 0.0, 0.7, 3.0], [0.0, 0.0, 0.0, 1.0]])
    found, a = transform_splats(splats, matrix), matrix[:3, :3]
    np.testing.assert_allclose(found.centres, splats.centres @ a.T + [1.0, 2.0, 3.0])
    assert_covariances(found, a @ splats.covariances() @ a.T)
    np.testing.assert_allclose(np.linalg.det(found.axes()), 1.0, atol=1e-9)


def test_a_binding_of_other_splats_is_refused():
    with pytest.raises(InputError, match="bind these"):
        deformed(some(3), bind_splats(some(4), particles()), particles(), everywhere(np.eye(3), 2000))
