# SPDX-License-Identifier: MIT
"""Signed distances, contact points, mass and soundness of surfaces."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry import mesh_checks
from physgen.sim.mpm.geometry import signed_distance as distance
from physgen.sim.mpm.geometry.mass_properties import MassProperties, mass_properties
from physgen.sim.mpm.geometry.mesh_checks import check_surface, thin_share
from physgen.sim.mpm.geometry.signed_distance import DistanceLattice, overlap, signed_distance
from physgen.sim.mpm.geometry.triangles import bounding_faces, validated
from physgen.sim.mpm.rigid.collision_shapes import surface_points
from scipy.spatial import cKDTree

EPS32 = float(np.finfo(np.float32).eps)


def surface(mesh):
    return Surface(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces))


def joined(*meshes):
    return surface(trimesh.util.concatenate(meshes))


def box(size, at=(0, 0, 0)):
    return trimesh.creation.box(size).apply_translation(at)


def ball(radius=0.5, subdivisions=3, at=(0, 0, 0)):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def inverted(mesh):
    mesh = mesh.copy()
    mesh.invert()
    return mesh


def turned(mesh, angle=0.7, axis=(1, 2, 3)):
    return mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(angle, axis))


def mixed(mesh):
    """Every third face looks the wrong way."""
    third = np.arange(len(mesh.faces))[:, None] % 3 == 0
    return Surface(vertices=np.array(mesh.vertices), faces=np.where(third, mesh.faces[:, ::-1], mesh.faces))


def nodes(lattice):
    index = np.stack(np.meshgrid(*[np.arange(n) for n in lattice.distances.shape], indexing="ij"), axis=-1)
    return (lattice.origin + lattice.spacing * index).reshape(-1, 3)


def brute_distance(places, mesh):
    """To the nearest of all triangles, by trimesh's closest points."""
    triangles = np.asarray(mesh.triangles)
    best = np.full(len(places), np.inf)
    for triangle in triangles:
        # Only where the triangle's corners are near enough.
        least = np.linalg.norm(places - triangle[0], axis=1) - np.linalg.norm(triangle - triangle[0], axis=1).max()
        near = least < best
        close = trimesh.triangles.closest_point(np.repeat(triangle[None], near.sum(), axis=0), places[near])
        best[near] = np.minimum(best[near], np.linalg.norm(close - places[near], axis=1))
    return best


def solid_angle_winding(places, mesh):
    """Winding number by solid angles (van Oosterom and Strackee), nothing to do with lines."""
    total = np.zeros(len(places))
    for triangle in np.asarray(mesh.triangles):
        a, b, c = (corner - places for corner in triangle)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        top = np.einsum("ni,ni->n", a, np.cross(b, c))
        low = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total += 2 * np.arctan2(top, low)
    return total / (4 * np.pi)


def longest_edge(mesh):
    return mesh.edges_unique_length.max()


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


# Contact points


def test_a_box_keeps_its_corners_and_has_points_between():
    points, normals = surface_points(surface(box((1, 0.6, 0.4))), 0.1)
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * [1, 0.6, 0.4]
    first = points[:8]
    assert {tuple(np.round(p, 9)) for p in first} == {tuple(np.round(c, 9)) for c in corners}
    assert (np.einsum("ij,ij->i", np.sign(first), normals[:8]) > 0).all()
    assert ((normals[:8] * np.sign(first)) > 0.1).all()
    on_top = np.isclose(points[:, 2], 0.2) & (np.abs(points[:, :2]) < [0.499, 0.299]).all(axis=1)
    np.testing.assert_allclose(normals[on_top], np.tile([0, 0, 1.0], (on_top.sum(), 1)), atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(
    shape=st.sampled_from(["box", "ball", "cylinder", "capsule", "torus"]),
    size=st.tuples(*[st.floats(0.3, 2.0)] * 3),
    angle=st.floats(0, 3),
    spacing=st.floats(0.06, 0.5),
)
def test_any_shape_is_covered_evenly_and_keeps_its_extremes(shape, size, angle, spacing):
    mesh = {
        "box": lambda: box((1, 1, 1)),
        "ball": lambda: ball(),
        "cylinder": lambda: trimesh.creation.cylinder(0.5, 1.0, sections=48),
        "capsule": lambda: trimesh.creation.capsule(1.0, 0.3, count=[16, 16]),
        "torus": lambda: trimesh.creation.torus(0.4, 0.1),
    }[shape]()
    mesh.vertices *= size
    mesh = turned(mesh, angle)
    points, normals = surface_points(surface(mesh), spacing)
    sample = mesh.sample(2000, seed=0)
    gap = cKDTree(points).query(sample)[0].max()
    assert gap < spacing
    if len(points) > 1:
        assert cKDTree(points).query(points, k=2)[0][:, 1].min() >= 0.35 * spacing * (1 - 1e-6)
    # Thinning out may take an extreme vertex only for another hull vertex beside it.
    assert np.abs(points.min(axis=0) - mesh.bounds[0]).max() < 0.35 * spacing
    few = slice(0, 200)
    ahead, behind = (points[few] + side * 1e-5 * normals[few] for side in (1, -1))
    np.testing.assert_allclose(solid_angle_winding(ahead, mesh), 0, atol=1e-6)
    np.testing.assert_allclose(solid_angle_winding(behind, mesh), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    again, _ = surface_points(surface(mesh), spacing)
    np.testing.assert_array_equal(points, again)


def test_neighbouring_points_of_a_coarse_face_are_a_spacing_apart_at_most():
    points, _ = surface_points(surface(box((1, 1, 1))), 0.3)
    top = points[np.isclose(points[:, 2], 0.5), :2]
    links = cKDTree(top).query_pairs(0.3 + 1e-9, output_type="ndarray")
    assert len(top) < 50
    degree = np.bincount(links.reshape(-1), minlength=len(top))
    assert degree.min() >= 2
    assert cKDTree(top).query(np.random.default_rng(0).uniform(-0.5, 0.5, (1000, 2)))[0].max() <= 0.3 / np.sqrt(3)


def test_a_dense_ball_keeps_its_lowest_point_and_few_others():
    mesh = ball(subdivisions=5)
    points, normals = surface_points(surface(mesh), 0.25)
    assert points[:, 2].min() == mesh.vertices[:, 2].min()
    assert len(points) < 1000 < len(mesh.vertices)
    np.testing.assert_allclose(normals, points / np.linalg.norm(points, axis=1)[:, None], atol=0.01)


def test_normals_point_outward_whichever_way_the_faces_look():
    mesh = ball(subdivisions=3)
    for thing in (surface(mesh), surface(inverted(mesh)), mixed(mesh)):
        points, normals = surface_points(thing, 0.1)
        assert (np.einsum("ij,ij->i", points, normals) > 0.45).all()
    points, normals = surface_points(joined(ball(1.0), inverted(ball(0.5))), 0.2)
    hollow = np.linalg.norm(points, axis=1) < 0.75
    assert hollow.any()
    assert (np.einsum("ij,ij->i", points[hollow], normals[hollow]) < 0).all()
    points, _ = surface_points(joined(ball(1.0), ball(0.5)), 0.2)
    assert np.linalg.norm(points, axis=1).min() > 0.9, "what lies inside touches nothing"


# Mass


@settings(max_examples=30, deadline=None)
@given(
    counts=st.tuples(*[st.integers(1, 6)] * 3),
    at=st.tuples(*[st.floats(-10.0, 10.0)] * 3),
    angle=st.floats(0, 3),
    density=st.floats(10, 1e4),
)
def test_mass_of_any_box_of_particles(counts, at, angle, density):
    """Cubes that are turned with the box do not change its inertia, so particles may be cubes along the axes."""
    step = 0.1
    turn = trimesh.transformations.rotation_matrix(angle, (1, 2, 3))[:3, :3]
    cells = (
        np.stack(np.meshgrid(*[np.arange(n) + 0.5 - n / 2 for n in counts], indexing="ij"), -1).reshape(-1, 3) * step
    )
    masses = np.full(len(cells), density * step**3)
    found = mass_properties(cells @ turn.T + at, masses, volumes=np.full(len(cells), step**3))
    mass, squares = density * step**3 * len(cells), (np.array(counts) * step) ** 2
    inertia = turn @ np.diag(mass / 12 * (squares.sum() - squares)) @ turn.T
    assert found.mass == pytest.approx(mass, rel=1e-9)
    np.testing.assert_allclose(found.center, at, atol=1e-9)
    np.testing.assert_allclose(found.inertia, inertia, atol=1e-9 * np.trace(inertia))
    points = mass_properties(cells, masses)
    cubes = mass_properties(cells, masses, volumes=np.full(len(cells), step**3))
    np.testing.assert_allclose(cubes.inertia - points.inertia, mass * step**2 / 6 * np.eye(3), rtol=1e-9, atol=1e-9)


def test_bad_masses_are_input_errors():
    places = np.zeros((3, 3))
    for masses in (np.ones(2), np.zeros(3), np.full(3, np.nan)):
        with pytest.raises(InputError, match="masses"):
            mass_properties(places, masses)
    with pytest.raises(InputError, match="volumes"):
        mass_properties(places, np.ones(3), volumes=np.zeros(3))
    with pytest.raises(InputError, match="points"):
        mass_properties(np.zeros((3, 2)), np.ones(3))
    with pytest.raises(InputError, match="mass is"):
        MassProperties(mass=0.0, center=np.zeros(3), inertia=np.eye(3))
    with pytest.raises(InputError, match="inertia"):
        MassProperties(mass=1.0, center=np.zeros(3), inertia=np.eye(2))


# Soundness


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(ball(subdivisions=4), id="ball"),
        pytest.param(box((1, 1, 1)), id="box"),
        pytest.param(trimesh.creation.torus(0.4, 0.1), id="torus"),
        pytest.param(trimesh.creation.annulus(0.3, 0.5, 0.3), id="ring"),
        pytest.param(trimesh.util.concatenate([box((1, 1, 1)), inverted(box((0.5,) * 3))]), id="hollow"),
        pytest.param(trimesh.util.concatenate([box((1, 1, 1)), box((1, 1, 1), at=(2, 0, 0))]), id="two boxes"),
        pytest.param(trimesh.util.concatenate([box((1, 1, 1)), box((1, 1, 1), at=(0.2, 0.1, 1))]), id="stacked boxes"),
        pytest.param(trimesh.util.concatenate([box((1, 1, 1)), box((1, 1, 1), at=(1, 1, 0))]), id="common edge"),
    ],
)
def test_sound_surfaces_give_no_notice(mesh):
    for angle in (0.0, 0.7):
        assert check_surface(surface(turned(mesh, angle)), name="thing", cell_size=0.01) == ()


@settings(max_examples=25, deadline=None)
@given(
    shift=st.tuples(*[st.floats(-0.8, 0.8)] * 3),
    size=st.tuples(*[st.floats(0.5, 1.5)] * 3),
    angle=st.floats(0.05, 1.5),
)
def test_overlapping_boxes_are_found(shift, size, angle):
    # Whether they overlap says the separating axis theorem, by the Minkowski difference's support.
    one, two = box((1, 1, 1)), turned(box(size), angle).apply_translation(shift)
    axes = [*np.eye(3), *turned(box((1, 1, 1)), angle).face_normals]
    axes += [np.cross(a, b) for a in axes[:3] for b in axes[3:]]
    gaps = []
    for axis in (a / np.linalg.norm(a) for a in axes if np.linalg.norm(a) > 1e-6):
        p, q = one.vertices @ axis, two.vertices @ axis
        gaps.append(max(p.min() - q.max(), q.min() - p.max()))
    said = " ".join(check_surface(joined(one, two), name="boxes"))
    if max(gaps) > 1e-6:
        assert said == ""
    elif max(gaps) < -1e-6:
        assert "boxes: " in said
        assert "crosses itself" in said or "inside others" in said


@pytest.mark.parametrize("at", [(0.5, 0.5, 0.5), (0.5, 0, 0), (0.5, 0.5, 0), (0.25, 0, 0.5)])
def test_boxes_that_overlap_edge_on_edge_are_found_too(at):
    said = " ".join(check_surface(joined(box((1, 1, 1)), box((1, 1, 1), at=at)), name="boxes"))
    assert "crosses itself" in said or "overlap" in said


def test_a_ball_pushed_through_itself_is_found():
    mesh = ball(subdivisions=3)
    top = mesh.vertices[:, 2] > 0.35
    mesh.vertices[top, 2] -= 1.2
    said = check_surface(surface(mesh), name="ball")
    assert any("crosses itself" in line for line in said)


def test_notices_name_the_object_and_the_defect():
    mesh = ball(subdivisions=2)
    for thing, words in (
        (surface(inverted(mesh)), "1 of 1 parts are inside out"),
        (joined(mesh, inverted(ball(at=(2, 0, 0)))), "1 of 2 parts are inside out"),
        (mixed(mesh), f"{-(-len(mesh.faces) // 3)} of {len(mesh.faces)} look inward"),
        (joined(box((2, 2, 2)), ball()), "1 of 2 parts lie inside others"),
        (joined(ball(), ball(at=(0.4, 0.1, 0.2))), "some parts overlap others"),
    ):
        said = check_surface(thing, name="thing")
        assert any(words in line for line in said), said
        assert all(line.startswith("thing: ") for line in said)
    plate = surface(box((1, 1, 0.01)))
    assert check_surface(plate, name="plate") == ()
    (line,) = check_surface(plate, name="plate", cell_size=0.05)
    assert "thinner than a grid cell of 0.05 m" in line


def test_unusable_surfaces_are_input_errors_that_name_the_thing():
    good = box((1, 1, 1))
    doubled = np.concatenate([good.faces[:2], good.faces[:2, ::-1], good.faces[4:6], good.faces[4:6, ::-1]])
    for thing, words in (
        (Surface(vertices=good.vertices, faces=good.faces[1:]), "not closed"),
        (Surface(vertices=good.vertices * [1, 0, 1], faces=good.faces), "no volume"),
        (Surface(vertices=good.vertices * 0, faces=good.faces), "no area"),
        (Surface(vertices=good.vertices, faces=doubled), "no volume"),
    ):
        with pytest.raises(InputError, match=f"^thing: .*{words}"):
            check_surface(thing, name="thing")


def test_too_many_pairs_are_tested_in_part_and_that_is_said(monkeypatch):
    mesh = joined(turned(ball(subdivisions=3)), ball(subdivisions=3, at=(0.1, 0, 0)))
    assert not any("were tested" in line for line in check_surface(mesh, name="balls"))
    monkeypatch.setattr(mesh_checks, "MAX_PAIRS", 100)
    said = check_surface(mesh, name="balls")
    assert any("100 of about" in line for line in said)
    assert said == check_surface(mesh, name="balls")
    monkeypatch.setattr(mesh_checks, "MAX_NEIGHBOURS", 1000)
    assert any("were tested" in line for line in check_surface(mesh, name="balls"))


def thin_part(thing, cell_size):
    points, triangles = validated(thing.vertices, thing.faces)
    return thin_share(points, bounding_faces(points, triangles).triangles, cell_size)


def test_the_thin_share_is_that_of_the_thin_part():
    plate = box((1, 1, 0.02))
    # Places closer to a side than its thickness count as any other: looked at straight inward, sides are thick.
    flat = 2 / (2 + 4 * 0.02)
    assert thin_part(surface(plate), 0.05) == pytest.approx(flat, abs=0.01)
    assert thin_part(surface(plate), 0.01) == 0
    assert thin_part(surface(turned(plate)), 0.05) == pytest.approx(flat, abs=0.01)
    assert thin_part(surface(inverted(plate)), 0.05) == pytest.approx(flat, abs=0.01)
    assert thin_part(surface(ball()), 0.3) == 0
    # A cap where the chord along the normal, the diameter, is shorter than the cell: all or nothing.
    assert thin_part(surface(ball()), 1.1) == 1
    assert thin_part(surface(ball()), 5.0) == 1
    both = joined(box((1, 1, 1)), box((1, 1, 0.02), at=(0, 0, 2)))
    assert thin_part(both, 0.05) == pytest.approx(2 / (6 + 2.08), abs=0.01)
    with pytest.raises(InputError, match="cell_size"):
        thin_part(both, 0.0)


def test_the_thin_share_does_not_depend_on_how_much_work_is_allowed(monkeypatch):
    mesh = surface(trimesh.creation.annulus(0.45, 0.5, 0.3, sections=64))
    full = thin_part(mesh, 0.08)
    monkeypatch.setattr(mesh_checks, "MAX_NEIGHBOURS", 5000)
    assert 0.3 < thin_part(mesh, 0.08) == pytest.approx(full, abs=0.15)


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
