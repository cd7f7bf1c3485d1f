# SPDX-License-Identifier: MIT
"""Grains of millimetre size around simulated particles: how many, where, without flicker and without a lattice."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim import grains
from physgen.sim.errors import InputError
from physgen.sim.grains import DensityField, GrainCloud, GrainSize, grain_size
from physgen.sim.mpm.geometry.interior_sampling import sample_interior

SPACING = 0.004
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
SCATTERED = sample_interior(BALL.vertices, BALL.faces, SPACING, scattered=True).positions
LATTICE = sample_interior(BALL.vertices, BALL.faces, SPACING).positions


def cloud(ground=None):
    size = grain_size(particles=len(SCATTERED), spacing=SPACING, wanted=0.001)
    return GrainCloud(SCATTERED, spacing=SPACING, size=size, ground=ground)


def spread(seed, far):
    """The particles where a ball has fallen apart: pressed flat, stirred by ``far`` spacings."""
    table = np.random.default_rng(seed)
    flat = SCATTERED * [1.6, 1.6, 0.35] + [0.05, 0.02, 0.011]
    return flat + table.normal(0.0, far * SPACING, flat.shape)


def everyone(shape):
    parents = np.repeat(np.arange(len(SCATTERED)), shape.size.children)
    return parents, np.tile(np.arange(shape.size.children), len(SCATTERED))


def sharpest_peak(points, spacing):
    """The largest structure factor |Σ exp(i k·x)|² / N near the first Bragg vectors of a lattice: N for a lattice."""
    near = np.linspace(0.8, 1.2, 21) * 2.0 * np.pi / spacing
    factors = [np.abs(np.exp(1j * k * points[:, axis]).sum()) ** 2 / len(points) for k in near for axis in range(3)]
    return max(factors)


@given(
    particles=st.integers(4, 10**7),
    spacing=st.floats(1e-5, 1.0),
    wanted=st.floats(1e-6, 1.0),
)
def test_grains_fill_their_share_of_the_space_and_are_bounded_in_number(particles, spacing, wanted):
    size = grain_size(particles=particles, spacing=spacing, wanted=wanted)
    assert 1 <= size.children <= grains.MOST_CHILDREN
    assert 0 < size.diameter <= 0.9 * spacing
    volume = size.children * math.pi / 6.0 * size.diameter**3
    assert volume <= grains.PACKING * spacing**3 * (1 + 1e-9)
    assert size.diameter == 0.9 * spacing or volume == pytest.approx(grains.PACKING * spacing**3)
    seen = min(particles, grains.SURFACE_SHARE * particles ** (2 / 3))
    assert size.children == 1 or size.children * seen <= grains.MOST_CANDIDATES


def test_grains_are_as_small_as_wanted_where_that_is_affordable():
    assert grain_size(particles=2000, spacing=0.004, wanted=0.001).diameter == pytest.approx(0.001, rel=0.01)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), far=st.floats(0.0, 6.0))
def test_every_grain_stays_by_its_particle_above_the_ground_and_their_number_is_bounded(seed, far):
    plane = (np.zeros(3), np.array([0.0, 0.0, 1.0]))
    shape = cloud(plane)
    state = shape.state(spread(seed, far))
    shown = shape.shown(state, np.array([0.0, -1.0, 0.5]))
    assert len(shown.parents) <= grains.MOST_SHOWN + len(SCATTERED)
    inner = shown.children < 0
    np.testing.assert_array_equal(shown.positions[inner], state.positions[shown.parents[inner]])
    strayed = np.linalg.norm(shown.positions - state.positions[shown.parents], axis=1)
    above = state.positions[shown.parents][:, 2] > 0
    assert (strayed[above] <= shape.reach).all()
    assert (shown.positions[:, 2] >= shown.radii * (1 - 1e-9))[above & ~inner].all()
    again = cloud(plane).shown(cloud(plane).state(spread(seed, far)), np.array([0.0, -1.0, 0.5]))
    for one, two in ((shown.positions, again.positions), (shown.radii, again.radii), (shown.shades, again.shades)):
        np.testing.assert_array_equal(one, two)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), far=st.floats(0.0, 3.0))
def test_nothing_jumps_when_particles_move_a_little(seed, far):
    """Positions are continuous, and no grain moves much farther than the particles around it: nothing flickers."""
    shape = cloud((np.zeros(3), np.array([0.0, 0.0, 1.0])))
    before = spread(seed, far)
    step = np.random.default_rng(seed + 1).normal(0.0, 1e-3 * SPACING, before.shape)
    who = everyone(shape)
    start = shape.places(shape.state(before), *who)
    moved = np.linalg.norm(shape.places(shape.state(before + step), *who) - start, axis=1)
    assert moved.max() < 12 * np.linalg.norm(step, axis=1).max()
    assert np.median(moved) < np.linalg.norm(step, axis=1).max()


def test_undisturbed_grains_move_with_their_body():
    shape = cloud()
    turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 0.5))[:3, :3]
    who = everyone(shape)
    rest = shape.places(shape.state(SCATTERED), *who)
    turned = shape.places(shape.state(SCATTERED @ turn.T + 0.2), *who)
    # The ridge of A holds back a twelfth of the turn of their offsets, and the density's grid another part.
    assert np.linalg.norm(turned - (rest @ turn.T + 0.2), axis=1).max() < 0.35 * SPACING
    filled = np.linalg.norm(rest, axis=1)
    assert np.quantile(filled, 0.999) < 0.03 + 0.5 * SPACING, "they fill the ball"
    cells = np.unique(np.floor(rest[filled < 0.02] / (0.5 * SPACING)).astype(int), axis=0)
    assert len(cells) > 0.9 * 4 / 3 * math.pi * (0.02 / (0.5 * SPACING)) ** 3, "and leave no holes of half a spacing"


def test_neither_scattered_particles_nor_grains_have_a_lattice():
    assert sharpest_peak(LATTICE, SPACING) > 0.5 * len(LATTICE), "the statistic sees one"
    # Noise has a mean of 1, exponentially distributed: the largest of 63 independent ones is above 15 once in 50,000.
    assert sharpest_peak(SCATTERED, SPACING) < 15
    shape = cloud()
    some = shape.places(shape.state(SCATTERED), *everyone(shape))[::7]
    assert sharpest_peak(some, SPACING) < 15
    apart = np.linalg.norm(SCATTERED[:, None] - SCATTERED[None], axis=2) + np.eye(len(SCATTERED))
    assert apart.min() > 0.4 * SPACING, "nor are they crowded"


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.tuples(*[st.floats(0.02, 0.05)] * 3))
def test_scattered_particles_keep_the_volume_and_stay_inside(seed, size):
    mesh = trimesh.creation.box(size)
    sample = sample_interior(mesh.vertices, mesh.faces, SPACING, scattered=True, seed=seed)
    assert (np.abs(sample.positions) <= np.array(size) / 2).all()
    assert sample.volumes.sum() == pytest.approx(mesh.volume)
    assert sample.volumes.min() > 0.2 * sample.volumes.mean()
    first, second, _ = np.sort(np.array(size) / 2 - np.abs(sample.positions), axis=1).T
    # By the nearest of points on the faces, a third of a spacing apart: beside an edge it may be the other face's.
    near = (first < 0.4 * SPACING) & (second > 0.6 * SPACING)
    np.testing.assert_allclose(sample.contact_radii[near], first[near], atol=1e-9)
    again = sample_interior(mesh.vertices, mesh.faces, SPACING, scattered=True, seed=seed)
    np.testing.assert_array_equal(again.positions, sample.positions)


def test_the_density_is_one_inside_half_at_the_surface_and_its_surface_is_the_bodys():
    field = DensityField(SCATTERED, SPACING)
    inside = np.linalg.norm(SCATTERED, axis=1) < 0.016
    assert field.at(SCATTERED[inside]).mean() == pytest.approx(1.0, abs=0.03)
    vertices, faces = field.surface(0.5)
    made = trimesh.Trimesh(vertices, faces, process=False)
    assert made.is_watertight and made.volume == pytest.approx(BALL.volume, rel=0.12)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.03, atol=0.4 * SPACING)
    assert len(DensityField(SCATTERED[:1], SPACING).surface(0.5)[0]) == 0, "a lone particle has none"


def test_far_fliers_and_lost_particles_cost_no_memory():
    places = SCATTERED.copy()
    places[0], places[1] = (1e6, 0.0, 0.0), (np.nan, 0.0, 0.0)
    shape = cloud()
    shown = shape.shown(shape.state(places))
    assert np.isfinite(shown.positions).all()


def test_what_cannot_have_grains_is_an_input_error():
    size = GrainSize(diameter=0.001, children=4)
    with pytest.raises(InputError, match="3 particles"):
        GrainCloud(SCATTERED[:3], spacing=SPACING, size=size)
    with pytest.raises(InputError, match="wanted"):
        grain_size(particles=10, spacing=0.01, wanted=math.nan)


def test_grains_come_evenly_and_at_once_where_matter_parts():
    shape = cloud()
    still = shape.state(SCATTERED)
    shown = shape.shown(still)
    turns = shape.turns(shown)
    assert ((turns >= 0) & (turns < 1)).all()
    # Evenly in time over all of the surface, and over any part of it.
    for part in (turns, turns[shown.positions[:, 0] > 0.02]):
        counts = np.histogram(part, bins=10, range=(0, 1))[0]
        assert counts.max() < 1.25 * counts.mean() and counts.min() > 0.75 * counts.mean()
    np.testing.assert_allclose(shape.parted(still), 1.0)
    # A cut through the middle: only particles along it have parted.
    right = SCATTERED[:, 0] > 0
    cut = shape.parted(shape.state(SCATTERED + np.where(right, 5.0 * SPACING, 0.0)[:, None] * [1.0, 0.0, 0.0]))
    near = np.abs(SCATTERED[:, 0]) < 0.4 * SPACING
    far = np.abs(SCATTERED[:, 0]) > 3.0 * SPACING
    assert cut[near].min() > 1.3 and cut[far].max() == pytest.approx(1.0)
