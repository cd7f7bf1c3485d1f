# SPDX-License-Identifier: MIT
"""Contact points, mass and soundness of surfaces."""

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
from physgen.sim.mpm.geometry.inside_test import bounding_faces
from physgen.sim.mpm.geometry.mass_properties import MassProperties, mass_properties
from physgen.sim.mpm.geometry.mesh_checks import check_surface, thickness_of, thin_share
from physgen.sim.mpm.geometry.triangles import validated
from physgen.sim.mpm.rigid.collision_shapes import surface_points
from scipy.spatial import cKDTree

from .geometry_meshes import ball, box, inverted, joined, mixed, solid_angle_winding, surface, turned

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


def test_a_thin_solid_says_how_thick_it_should_be():
    """One line with thickness, cells and remedy, and none where its contact is right; other bodies as ever."""
    cell = 0.05
    for thing in (box((1, 1, 0.01)), turned(box((1, 0.01, 0.01)))):
        (line,) = check_surface(surface(thing), name="leaf", cell_size=cell, least_thickness=0.5 * cell)
        assert line.startswith("leaf: 0.01 m thick, 0.2 grid cells of 0.05 m")
        assert "make it 0.025 m thick or more" in line and "cells 0.4 times as large or less" in line
    sheet = surface(box((1, 1, 0.03)))
    assert check_surface(sheet, name="leaf", cell_size=cell, least_thickness=0.5 * cell) == ()
    both = joined(box((1, 1, 1)), box((1, 1, 0.01), at=(0, 0, 2)))
    (line,) = check_surface(both, name="thing", cell_size=cell, least_thickness=0.5 * cell)
    assert "thinner than a grid cell" in line


def test_the_thickness_is_that_of_sheets_and_rods_and_no_other_body():
    def thick(thing, limit):
        points, triangles = validated(thing.vertices, thing.faces)
        return thickness_of(points, bounding_faces(points, triangles).triangles, limit)

    assert thick(surface(turned(box((1, 1, 0.03)))), 0.1) == pytest.approx(0.03, rel=1e-6)
    assert thick(surface(turned(box((1, 0.04, 0.04)))), 0.1) == pytest.approx(0.04, rel=1e-6)
    tube = surface(trimesh.creation.annulus(0.45, 0.5, 1.0, sections=64))
    assert thick(tube, 0.08) == pytest.approx(0.05, rel=0.02)
    assert thick(surface(box((1, 1, 0.03))), 0.02) is None
    assert thick(surface(ball()), 0.3) is None
    assert thick(joined(box((1, 1, 1)), box((1, 1, 0.02), at=(0, 0, 2))), 0.1) is None


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
