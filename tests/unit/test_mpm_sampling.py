# SPDX-License-Identifier: MIT
"""Filling meshes with particles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.mpm.geometry.interior_sampling import sample_interior


def test_a_box_gets_its_lattice():
    mesh = trimesh.creation.box((0.2, 0.3, 0.1))
    sample = sample_interior(mesh.vertices, mesh.faces, 0.02)
    assert len(sample.positions) == 10 * 15 * 5
    assert sample.positions.dtype == np.float64
    np.testing.assert_allclose(sample.volumes, 0.02**3)
    outer = np.isclose(np.abs(sample.positions[:, 2]), 0.04)
    np.testing.assert_allclose(sample.contact_radii[outer], 0.01)


def test_a_sphere_is_filled_evenly_and_keeps_its_volume_and_inertia():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    sample = sample_interior(mesh.vertices, mesh.faces, 0.05)
    radius = np.linalg.norm(sample.positions, axis=1)
    assert radius.max() < 0.5
    assert sample.volumes.sum() == pytest.approx(mesh.volume, rel=1e-12)
    inertia = float(sample.volumes @ (sample.positions[:, :2] ** 2).sum(axis=1))
    assert inertia == pytest.approx(0.4 * mesh.volume * 0.25, rel=0.02)
    true = 0.5 - radius
    near = true < 0.02
    assert np.abs(sample.contact_radii[near] - true[near]).max() < 0.003


def test_a_hollow_stays_empty():
    outer, inner = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((0.5, 0.5, 0.5))
    inner.invert()
    mesh = trimesh.util.concatenate([outer, inner])
    sample = sample_interior(mesh.vertices, mesh.faces, 0.05)
    assert (np.abs(sample.positions).max(axis=1) > 0.25).all()
    assert sample.volumes.sum() == pytest.approx(0.875)


@pytest.mark.parametrize("thickness", [0.004, 0.01, 0.03])
def test_a_tilted_plate_thinner_than_the_spacing_is_filled(thickness):
    mesh = trimesh.creation.box((1.0, 1.0, thickness))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, (1, 2, 0)))
    sample = sample_interior(mesh.vertices, mesh.faces, 0.05)
    back = sample.positions @ trimesh.transformations.rotation_matrix(0.5, (1, 2, 0))[:3, :3]
    assert (np.abs(back[:, 2]) <= thickness / 2).all()
    cells = set(map(tuple, np.floor((back[:, :2] + 0.5) / 0.2).astype(int)))
    assert len(cells) == 25, "every fifth of the plate has particles"
    assert sample.volumes.sum() == pytest.approx(thickness)


def test_seams_and_mixed_orientation_do_no_harm():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    split = mesh.vertices[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(split)).reshape(-1, 3)
    whole = sample_interior(mesh.vertices, mesh.faces, 0.08)
    np.testing.assert_array_equal(sample_interior(split, faces, 0.08).positions, whole.positions)
    faces[::3] = faces[::3, ::-1]
    mixed = sample_interior(split, faces, 0.08)
    np.testing.assert_array_equal(mixed.positions, whole.positions)
    assert mixed.volumes.sum() == pytest.approx(mesh.volume, rel=0.02)


def test_jitter_is_repeatable_and_stays_inside():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    one = sample_interior(mesh.vertices, mesh.faces, 0.08, jitter=0.4, seed=3)
    two = sample_interior(mesh.vertices, mesh.faces, 0.08, jitter=0.4, seed=3)
    other = sample_interior(mesh.vertices, mesh.faces, 0.08, jitter=0.4, seed=4)
    np.testing.assert_array_equal(one.positions, two.positions)
    assert not np.array_equal(one.positions, other.positions)
    assert np.linalg.norm(one.positions, axis=1).max() < 0.52


@settings(max_examples=25, deadline=None)
@example(size=(1.0, 0.75, 0.625), axis=(0.0, 1.0, 0.0), angle=0.125, spacing=0.1875)
@given(
    size=st.tuples(*[st.floats(0.6, 3.0)] * 3),
    axis=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    angle=st.floats(0.0, 3.0),
    spacing=st.floats(0.08, 0.2),
)
def test_any_box_keeps_its_volume_and_holds_its_particles(size, axis, angle, spacing):
    rotation = trimesh.transformations.rotation_matrix(angle, (*axis[:2], axis[2] + 1.5))
    mesh = trimesh.creation.box(size).apply_transform(rotation)
    sample = sample_interior(mesh.vertices, mesh.faces, spacing)
    local = sample.positions @ rotation[:3, :3]
    assert (np.abs(local) <= np.array(size) / 2 + 1e-9).all()
    assert sample.volumes.sum() == pytest.approx(mesh.volume, rel=1e-6)
    assert (sample.volumes > 0).all()
    # A lattice of whole cells across the bounding box; of the cells that the surface cuts, each counts or does not.
    extent = np.ptp(mesh.vertices, axis=0)
    step = extent / np.maximum(1, np.rint(extent / spacing))
    assert abs(len(sample.positions) - mesh.volume / step.prod()) <= mesh.area / (2 * step.min() ** 2) + 8


def test_bad_meshes_are_input_errors():
    box = trimesh.creation.box((1, 1, 1))
    broken = box.vertices.copy()
    broken[3, 1] = np.nan
    with pytest.raises(InputError, match=r"vertices\[3\]"):
        sample_interior(broken, box.faces, 0.1)
    with pytest.raises(InputError, match="not closed"):
        sample_interior(box.vertices, box.faces[1:], 0.1)
    with pytest.raises(InputError, match="vertices has shape"):
        sample_interior(np.zeros((0, 3)), box.faces, 0.1)
    with pytest.raises(InputError, match="faces has shape"):
        sample_interior(box.vertices, np.zeros((0, 3), dtype=int), 0.1)
    with pytest.raises(InputError, match="the mesh has 8"):
        sample_interior(box.vertices, box.faces + 5, 0.1)
    with pytest.raises(InputError, match="spacing"):
        sample_interior(box.vertices, box.faces, 0.0)
    with pytest.raises(InputError, match="larger spacing"):
        sample_interior(box.vertices, box.faces, 1e-4)
    with pytest.raises(InputError, match="finer grid"):
        sample_interior(box.vertices, box.faces, 0.9)
    with pytest.raises(InputError, match="no volume"):
        sample_interior(box.vertices * [1, 1, 0], box.faces, 0.1)
