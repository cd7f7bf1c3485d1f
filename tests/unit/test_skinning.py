# SPDX-License-Identifier: MIT
"""Vertices follow their particles: exactly for affine motion, smoothly for bending, never after a floater."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.skinning import bind, deform, deform_locally


def a_body(seed=0, count=3000):
    rng = np.random.default_rng(seed)
    particles = rng.random((count, 3)) * [0.2, 0.1, 0.1]
    side = rng.random((400, 3)) * [0.2, 0.1, 0.1]
    side[:, 2] = 0.1  # vertices on a face, outside the particles' hull
    return particles, side


def still(count):
    return np.broadcast_to(np.eye(3), (count, 3, 3))


def test_rest_is_rest():
    particles, vertices = a_body()
    assert np.abs(deform(bind(vertices, particles), particles, still(len(particles))) - vertices).max() < 1e-12


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_affine_motion_is_exact(seed):
    particles, vertices = a_body()
    rng = np.random.default_rng(seed)
    matrix = np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3))
    shift = rng.uniform(-1, 1, 3)
    moved = deform(
        bind(vertices, particles), particles @ matrix.T + shift, np.broadcast_to(matrix, (len(particles), 3, 3))
    )
    assert np.abs(moved - (vertices @ matrix.T + shift)).max() < 1e-12


def bend(points, radius=0.15):
    """Roll the x axis onto a circle; returns positions and deformation gradients."""
    angle = points[:, 0] / radius
    r = radius - points[:, 2]
    moved = np.stack([r * np.sin(angle), points[:, 1], radius - r * np.cos(angle)], axis=1)
    gradient = np.zeros((len(points), 3, 3))
    gradient[:, 0, 0] = np.cos(angle) * r / radius
    gradient[:, 0, 2] = -np.sin(angle)
    gradient[:, 1, 1] = 1.0
    gradient[:, 2, 0] = np.sin(angle) * r / radius
    gradient[:, 2, 2] = np.cos(angle)
    return moved, gradient


def test_bending_is_followed_to_second_order():
    errors, spacings = [], []
    for count in (1000, 8000):
        particles, vertices = a_body(count=count)
        binding = bind(vertices, particles)
        positions, gradients = bend(particles)
        errors.append(np.abs(deform(binding, positions, gradients) - bend(vertices)[0]).max())
        spacings.append(binding.spacing.mean())
    # Second order: half the spacing, about a quarter of the error.
    assert errors[1] < errors[0] * (spacings[1] / spacings[0]) ** 1.5
    assert errors[1] < 0.25 * spacings[1]


@pytest.mark.parametrize("share", [0.01, 0.1])
@pytest.mark.parametrize("throw", [5.0, 0.3, np.nan])
def test_floaters_never_drag_a_vertex(share, throw):
    particles, vertices = a_body()
    positions = particles.copy()
    rng = np.random.default_rng(1)
    floaters = rng.choice(len(particles), int(share * len(particles)), replace=False)
    positions[floaters] += throw
    gradients = still(len(particles)).copy()
    gradients[floaters] *= 7.0
    assert np.abs(deform(bind(vertices, particles), positions, gradients) - vertices).max() < 1e-9


def test_a_wholly_lost_body_stays_finite():
    particles, vertices = a_body()
    lost = np.full_like(particles, np.nan)
    assert np.isfinite(deform(bind(vertices, particles), lost, still(len(particles)))).all()


def test_too_few_particles_are_refused():
    with pytest.raises(InputError, match="3 particles"):
        bind(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(InputError, match="finite"):
        bind(np.full((2, 3), np.nan), np.random.default_rng(0).random((10, 3)))


def test_local_gradients_are_those_of_the_motion():
    """Of a bar rolled onto a circle, at the vertices' own places; the places are those of ``deform``."""
    particles, vertices = a_body(count=8000)
    inner = vertices * [1.0, 1.0, 0.5]
    binding = bind(inner, particles)
    places, gradients = deform_locally(binding, *bend(particles))
    assert np.array_equal(places, deform(binding, *bend(particles)))
    assert np.abs(gradients - bend(inner)[1]).max() < 2 * binding.spacing.max() / 0.15
