# SPDX-License-Identifier: MIT
"""Signed distance lattices and overlaps against brute force and closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry import signed_distance as distance
from physgen.sim.mpm.geometry.mesh_checks import check_surface
from physgen.sim.mpm.geometry.signed_distance import DistanceLattice, overlap, signed_distance
from physgen.sim.mpm.rigid.collision_shapes import surface_points

from .geometry_meshes import (
    EPS32,
    ball,
    box,
    brute_distance,
    inverted,
    joined,
    longest_edge,
    mixed,
    nodes,
    solid_angle_winding,
    surface,
    turned,
)

# The lattice


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), spacing=st.floats(0.01, 2.0), shape=st.tuples(*[st.integers(2, 5)] * 3))
def test_the_gradient_is_the_derivative_inside_and_out(seed, spacing, shape):
    rng = np.random.default_rng(seed)
    lattice = DistanceLattice(origin=rng.normal(size=3), spacing=spacing, distances=rng.normal(size=shape))
    local = rng.uniform(-1.5, np.array(shape) + 0.5, (60, 3))
    step = 1e-6
    # Not beside a plane of the lattice, where the derivative jumps.
    local = local[(np.abs(local - np.rint(local)) > 10 * step).all(axis=1)]
    points = lattice.origin + spacing * local
    _, gradient = lattice.at(points)
    for axis in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[:, axis] += step * spacing
        behind[:, axis] -= step * spacing
        slope = (lattice.at(ahead)[0] - lattice.at(behind)[0]) / (2 * step * spacing)
        # Rounding 1e-16 over the step; curvature of the distance to a corner at least 1e-5 away: (step / 1e-5)².
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-6 * (1 + 1 / spacing), rtol=0.01)


def test_a_lattice_returns_its_own_values_and_any_linear_function():
    rng = np.random.default_rng(3)
    slope = np.array([0.3, -0.5, 0.25])
    lattice = DistanceLattice(origin=np.array([1.0, 2.0, 3.0]), spacing=0.5, distances=np.zeros((4, 5, 6)))
    values = (nodes(lattice) @ slope).reshape(4, 5, 6)
    lattice = DistanceLattice(origin=lattice.origin, spacing=0.5, distances=values)
    np.testing.assert_array_equal(lattice.at(nodes(lattice))[0], lattice.distances.reshape(-1).astype(float))
    places = rng.uniform(lattice.origin, lattice.high, (100, 3))
    value, gradient = lattice.at(places)
    np.testing.assert_allclose(value, places @ slope, atol=4 * EPS32)
    np.testing.assert_allclose(gradient, np.tile(slope, (100, 1)), atol=20 * EPS32)
    value, gradient = lattice.at(lattice.high[None] + [[0.0, 0.0, 2.0]])
    assert value[0] == pytest.approx(lattice.high @ slope + 2.0, abs=1e-6)
    np.testing.assert_allclose(gradient[0], [0.3, -0.5, 1.0], atol=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"origin": np.zeros(2)},
        {"origin": np.array([0, np.nan, 0])},
        {"spacing": 0.0},
        {"spacing": np.inf},
        {"distances": np.zeros((1, 2, 2))},
        {"distances": np.zeros((2, 2))},
        {"distances": np.full((2, 2, 2), np.nan)},
    ],
)
def test_bad_lattices_are_input_errors(change):
    with pytest.raises(InputError, match="distance lattice"):
        DistanceLattice(**{"origin": np.zeros(3), "spacing": 1.0, "distances": np.zeros((2, 2, 2)), **change})


# Signed distance


def check_against_brute_force(mesh, lattice):
    places, h = nodes(lattice), lattice.spacing
    true = brute_distance(places, mesh)
    found = lattice.distances.reshape(-1).astype(float)
    scale = np.abs(mesh.bounds).max()
    near = true <= 3 * h
    assert near.any()
    # float32, and what is within a hundred-thousandth of a spacing is 0.
    np.testing.assert_allclose(np.abs(found[near]), true[near], atol=1e-5 * h + 8 * EPS32 * scale)
    assert np.abs(np.abs(found) - true).max() < h
    clear = true > 2e-5 * h
    inside = np.abs(solid_angle_winding(places[clear], mesh)) > 0.5
    np.testing.assert_array_equal(found[clear] < 0, inside)


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    rough=st.floats(0.0, 0.35),
    stretch=st.tuples(*[st.floats(0.3, 2.0)] * 3),
    angle=st.floats(0, 3),
)
def test_any_ragged_ball_has_exact_distances_nearby_and_good_ones_farther_away(seed, rough, stretch, angle):
    mesh = ball(subdivisions=2)
    mesh.vertices *= (1 + np.random.default_rng(seed).uniform(-rough, rough, (len(mesh.vertices), 1))) * stretch
    mesh = turned(mesh, angle)
    lattice = signed_distance(surface(mesh), float(mesh.extents.max()) / 16, margin=0.05 * float(mesh.extents.max()))
    check_against_brute_force(mesh, lattice)


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(box((1, 0.7, 0.4)), id="box"),
        pytest.param(turned(box((1, 0.7, 0.05))), id="tilted plate"),
        pytest.param(trimesh.creation.annulus(0.3, 0.5, 0.3, sections=24), id="ring"),
        pytest.param(trimesh.creation.cone(0.3, 1.0, sections=12), id="cone"),
        pytest.param(trimesh.util.concatenate([box((0.3,) * 3), box((0.2,) * 3, at=(0.6, 0.1, 0))]), id="two"),
        pytest.param(trimesh.util.concatenate([box((1,) * 3), inverted(box((0.5,) * 3))]), id="hollow"),
        pytest.param(trimesh.util.concatenate([box((0.5,) * 3), box((0.5,) * 3, at=(0.5, 0.5, 0))]), id="common edge"),
    ],
)
def test_sharp_shapes_agree_with_brute_force(mesh):
    check_against_brute_force(mesh, signed_distance(surface(mesh), 0.06, margin=0.3))


def test_a_balls_distance_is_as_good_as_trilinear_interpolation_allows():
    mesh, radius, h = ball(subdivisions=5), 0.5, 1 / 30
    lattice = signed_distance(surface(mesh), h, margin=4 * h)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5000, 3))
    away = rng.uniform(-2 * h, 2 * h, 5000)
    points *= ((radius + away) / np.linalg.norm(points, axis=1))[:, None]
    value, gradient = lattice.at(points)
    # Interpolation: h²/8 times the second derivatives along the axes, which add up to 2/r; faces: their sagitta.
    bound = h**2 / 8 * 2 / (radius - 2 * h - 2 * h) + longest_edge(mesh) ** 2 / (6 * radius)
    assert np.abs(value - away).max() < bound
    direction = points / np.linalg.norm(points, axis=1)[:, None]
    # First order in the gradient: h/2 per axis times the curvature, sqrt(3) axes; and the angle of the faces.
    assert np.linalg.norm(gradient - direction, axis=1).max() < h / (radius - 4 * h) + longest_edge(mesh) / radius


def test_a_torus_has_its_distance_and_its_hole():
    major, minor, h = 0.4, 0.15, 0.02
    mesh = trimesh.creation.torus(major, minor, major_sections=160, minor_sections=80)
    lattice = signed_distance(surface(mesh), h, margin=3 * h)
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 2 * np.pi, (2, 4000))
    away = rng.uniform(-2 * h, 2 * h, 4000)
    ring = major + (minor + away) * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), (minor + away) * np.sin(v)], axis=1)
    curvature = 1 / (minor - 4 * h) + 1 / (major - minor - 4 * h)
    bound = h**2 / 8 * curvature + longest_edge(mesh) ** 2 / 6 * (1 / minor + 1 / (major - minor))
    assert np.abs(lattice.at(points)[0] - away).max() < bound
    assert lattice.at(np.zeros((1, 3)))[0][0] == pytest.approx(major - minor, abs=h)


@settings(max_examples=12, deadline=None)
@given(
    size=st.tuples(*[st.floats(0.3, 1.0)] * 3),
    at=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    cells=st.floats(9.0, 16.0),
    seed=st.integers(0, 99),
)
def test_flat_faces_of_any_box_are_exact(size, at, cells, seed):
    size, at = np.array(size), np.array(at)
    asked = float(size.min()) / cells
    lattice = signed_distance(surface(box(size, at)), asked, margin=3 * asked)
    h = lattice.spacing
    assert asked / distance.FINEST_FIT * (1 - 1e-9) <= h <= asked * (1 + 1e-9)
    rng = np.random.default_rng(seed)
    for axis, side in itertools.product(range(3), (-1, 1)):
        away = rng.uniform(-2 * h, 2 * h, 50)
        points = rng.uniform(-1, 1, (50, 3)) * (size / 2 - 4.1 * h)
        points[:, axis] = side * (size[axis] / 2 + away)
        value, gradient = lattice.at(points + at)
        np.testing.assert_allclose(value, away, atol=1e-5 * h + 4 * EPS32 * h)
        np.testing.assert_allclose(gradient, np.tile(side * np.eye(3)[axis], (50, 1)), atol=5e-5)


@settings(max_examples=20, deadline=None)
@given(
    cells=st.tuples(*[st.integers(2, 14)] * 3),
    spacing=st.floats(0.02, 0.2),
    at=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    seed=st.integers(0, 99),
)
def test_a_box_of_whole_spacings_is_exact_to_its_very_edges(cells, spacing, at, seed):
    size = np.array(cells) * spacing
    lattice = signed_distance(surface(box(size, at)), spacing, margin=2 * spacing)
    assert lattice.spacing == pytest.approx(spacing, rel=1e-9)
    rng = np.random.default_rng(seed)
    for axis, side in itertools.product(range(3), (-1, 1)):
        points = rng.uniform(-0.5, 0.5, (50, 3)) * size
        points[:, axis] = side * size[axis] / 2
        assert np.abs(lattice.at(points + at)[0]).max() < 1e-9
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    assert np.abs(lattice.at(corners + at)[0]).max() < 1e-9


def test_a_slightly_finer_lattice_is_taken_where_it_fits_more_faces():
    lattice = signed_distance(surface(box((1, 0.7, 0.4))), 0.06, margin=0.1)
    assert lattice.spacing == pytest.approx(0.05, rel=1e-12)
    planes = (np.array([0.5, 0.35, 0.2]) - lattice.origin) / lattice.spacing
    np.testing.assert_allclose(planes, np.rint(planes), atol=1e-9)


def test_orientation_and_seams_do_not_matter():
    mesh = turned(ball(subdivisions=2))
    whole = signed_distance(surface(mesh), 0.07, margin=0.1)
    for other in (
        surface(inverted(mesh)),
        Surface(vertices=mesh.vertices[mesh.faces].reshape(-1, 3), faces=np.arange(3 * len(mesh.faces)).reshape(-1, 3)),
        mixed(mesh),
    ):
        found = signed_distance(other, 0.07, margin=0.1).distances
        near = np.abs(whole.distances) < 3 * whole.spacing
        np.testing.assert_allclose(found[near], whole.distances[near], atol=1e-6)
        # Farther away it depends on which of equally near lattice points is asked.
        np.testing.assert_allclose(found, whole.distances, atol=whole.spacing)


def test_buried_parts_do_not_count():
    outer = turned(box((1, 1, 1)), 0.3)
    clean = signed_distance(surface(outer), 0.05, margin=0.1)
    nested = signed_distance(joined(outer, ball(0.3)), 0.05, margin=0.1)
    np.testing.assert_allclose(nested.distances, clean.distances, atol=0.05)
    assert nested.at(np.zeros((1, 3)))[0][0] == pytest.approx(-0.5, abs=0.05)
    hollow = signed_distance(joined(outer, inverted(ball(0.3))), 0.05, margin=0.1)
    assert hollow.at(np.zeros((1, 3)))[0][0] == pytest.approx(0.3, abs=0.05)


def test_overlapping_parts_are_one_body():
    lattice = signed_distance(joined(box((1, 0.6, 0.6)), box((1, 0.6, 0.6), at=(0.5, 0, 0))), 0.05, margin=0.1)
    whole = signed_distance(surface(box((1.5, 0.6, 0.6), at=(0.25, 0, 0))), 0.05, margin=0.1)
    # Half a spacing of the faces within stays along the line where they meet; nothing changes outside.
    np.testing.assert_allclose(lattice.distances, whole.distances, atol=0.4 * lattice.spacing + 1e-6)
    outside = whole.distances >= 0
    np.testing.assert_allclose(lattice.distances[outside], whole.distances[outside], atol=1e-6)
    touching = signed_distance(joined(box((1, 0.6, 0.6)), box((0.5, 0.6, 0.6), at=(0.75, 0, 0))), 0.05, margin=0.1)
    np.testing.assert_allclose(touching.distances, whole.distances, atol=1e-6)


def test_a_plate_thinner_than_the_spacing_keeps_its_distances():
    lattice = signed_distance(surface(box((1, 1, 0.01))), 0.05, margin=0.2)
    places = nodes(lattice)
    near = np.abs(places[:, :2]).max(axis=1) < 0.4
    near &= np.abs(places[:, 2]) < 0.1
    true = np.abs(places[near, 2]) - 0.005
    np.testing.assert_allclose(lattice.distances.reshape(-1)[near], true, atol=1e-6)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(4, 15))
def test_garbage_that_is_closed_has_finite_distances(seed, count):
    """Tetrahedra at random: they cross, lie in each other and look either way."""
    rng = np.random.default_rng(seed)
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    vertices = rng.uniform(-1, 1, (4 * count, 3))
    vertices[: 4 * (count // 3)] *= rng.choice([1e-9, 1e-4, 1], (4 * (count // 3), 3))
    faces = np.concatenate([tetrahedron + 4 * n for n in range(count)])
    garbage = Surface(vertices=vertices, faces=faces)
    lattice = signed_distance(garbage, 0.2, margin=0.2)
    assert np.isfinite(lattice.distances).all()
    assert (lattice.distances < 0).any()
    assert isinstance(check_surface(garbage, name="garbage", cell_size=0.1), tuple)
    points, normals = surface_points(garbage, 0.3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    assert (np.abs(points) <= np.abs(vertices).max()).all()


def test_bad_surfaces_and_spacings_are_input_errors():
    good = surface(box((1, 1, 1)))
    for spacing in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="spacing is"):
            signed_distance(good, spacing, margin=0.1)
        with pytest.raises(InputError, match="spacing is"):
            surface_points(good, spacing)
    for margin in (-0.1, np.nan, np.inf):
        with pytest.raises(InputError, match="margin is"):
            signed_distance(good, 0.1, margin=margin)
    for spacing, margin in ((1 / 400, 0.0), (1e-12, 0.0), (1e-320, 0.0), (0.1, 1e3), (0.1, 1e300)):
        with pytest.raises(InputError, match="larger spacing or a smaller margin"):
            signed_distance(good, spacing, margin=margin)
    flat = Surface(vertices=good.vertices * [1, 1, 0], faces=good.faces)
    for act in (lambda s: signed_distance(s, 0.1, margin=0.1), lambda s: surface_points(s, 0.1)):
        with pytest.raises(InputError, match="not closed"):
            act(Surface(vertices=good.vertices, faces=good.faces[1:]))
        with pytest.raises(InputError, match="no volume"):
            act(flat)
    with pytest.raises(InputError, match="pieces"):
        surface_points(good, 1e-4)


# Overlap


@settings(max_examples=20, deadline=None)
@given(gap=st.floats(-0.3, 0.3), size=st.floats(0.3, 1.0))
def test_overlap_of_a_box_on_a_table_is_how_deep_it_sinks(gap, size):
    table = signed_distance(surface(box((2, 2, 1))), 0.1, margin=0.2)
    thing = surface(box((size,) * 3, at=(0.1, -0.2, 0.5 + size / 2 + gap)))
    assert overlap(thing, table) == pytest.approx(max(0.0, -gap), abs=1e-6)
    assert overlap(thing.vertices, table) == pytest.approx(max(0.0, -gap), abs=1e-6)


def test_overlap_is_found_between_a_large_faces_vertices():
    ball_lattice = signed_distance(surface(ball(0.1)), 0.02, margin=0.02)
    table = surface(box((1000, 1000, 1), at=(0, 0, -0.55)))
    depth = overlap(table, ball_lattice)
    # The table's top is 0.05 up in the ball; deepest is where the face passes the ball's middle, within a spacing.
    assert 0.05 - 0.02 < depth <= 0.05 + 0.02
    assert overlap(surface(box((1, 1, 1), at=(5, 0, 0))), ball_lattice) == 0
    assert overlap(np.zeros((0, 3)), ball_lattice) == 0
    with pytest.raises(InputError, match="points"):
        overlap(np.array([[0, np.nan, 0]]), ball_lattice)
