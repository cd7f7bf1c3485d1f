# SPDX-License-Identifier: MIT
"""The nearest surface wins, its places are true, and large meshes are drawn as smaller ones."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.report.mesh_raster import View, rasterise, simplified
from physgen.sim.diagnose.report.object_heatmaps import colours, hex_colour

FRONT = View(azimuth=0, elevation=0)


def drawn(mesh, view=FRONT, **changes):
    options = {"width": 120, "height": 100, "centre": np.zeros(3), "pixels_per_m": 40.0} | changes
    return rasterise(np.asarray(mesh.vertices), np.asarray(mesh.faces), view, **options)


def test_a_box_covers_its_own_area_and_is_seen_from_the_front():
    raster = drawn(trimesh.creation.box((2, 1, 1)))
    assert (raster.face >= 0).sum() == 80 * 40
    # Azimuth 0 looks along +y, so the side at y = -0.5 is the one in view.
    covered = raster.face >= 0
    np.testing.assert_allclose(raster.place[covered][:, 1], -0.5)
    np.testing.assert_allclose(raster.normal[covered], np.tile([0, -1, 0], (80 * 40, 1)), atol=1e-12)
    # The first row is the top, the first column the left.
    rows, columns = np.nonzero(covered)
    assert raster.place[rows[0], columns[0], 2] > 0 > raster.place[rows[0], columns[0], 0]


@given(st.floats(-180, 180), st.floats(-80, 80))
@settings(max_examples=8, deadline=None)
def test_a_ball_looks_the_same_from_everywhere(azimuth, elevation):
    view = View(azimuth=azimuth, elevation=elevation)
    raster = drawn(trimesh.creation.icosphere(2), view)
    covered = raster.face >= 0
    assert covered.sum() == pytest.approx(np.pi * 40**2, rel=0.04)
    assert (raster.place[covered] @ view.axes[2] > -0.2).all()
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.axes) == pytest.approx(1.0)


def test_the_nearer_of_two_wins_in_whatever_order():
    near, far = trimesh.creation.box((1, 0.1, 1)), trimesh.creation.box((1, 0.1, 1))
    near.apply_translation((0, -1, 0))
    far.apply_translation((0, 1, 0))
    for pair in ([near, far], [far, near]):
        raster = drawn(trimesh.util.concatenate(pair))
        np.testing.assert_allclose(raster.place[raster.face >= 0][:, 1], -1.05)


def test_edges_are_outlines_and_creases_only():
    assert drawn(trimesh.creation.box((2, 1, 1))).edge.sum() < 2 * (2 * 80 + 2 * 40)
    turned = drawn(trimesh.creation.box((1, 1, 1)), View(azimuth=45, elevation=0))
    assert turned.edge[50, 60] or turned.edge[50, 59]
    ball = drawn(trimesh.creation.icosphere(3))
    assert not ball.edge[35:65, 45:75].any()


def test_large_meshes_are_merged_and_keep_their_extent():
    mesh = trimesh.creation.icosphere(5)
    vertices, faces = simplified(np.asarray(mesh.vertices), np.asarray(mesh.faces), limit=3000)
    assert 200 < len(faces) <= 3000
    np.testing.assert_allclose(np.ptp(vertices[faces], axis=(0, 1)), 2.0, atol=0.2)
    small = trimesh.creation.box((1, 1, 1))
    assert simplified(np.asarray(small.vertices), np.asarray(small.faces))[1] is not None


def test_a_mesh_without_area_draws_nothing():
    raster = rasterise(
        np.zeros((3, 3)), np.array([[0, 1, 2]]), FRONT, width=10, height=10, centre=np.zeros(3), pixels_per_m=1.0
    )
    assert (raster.face == -1).all() and not raster.edge.any()


def test_equal_steps_are_equal_steps_of_lightness():
    rgb = colours(np.linspace(0, 1, 65))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lms = np.cbrt(
        linear
        @ np.array(
            [
                [0.4122214708, 0.2119034982, 0.0883024619],
                [0.5363325363, 0.6806995451, 0.2817188376],
                [0.0514459929, 0.1073969566, 0.6299787005],
            ]
        )
    )
    lightness = lms @ [0.2104542553, 0.7936177850, -0.0040720468]
    steps = np.diff(lightness)
    assert steps.min() > 0.8 * steps.mean() and steps.max() < 1.2 * steps.mean()
    assert hex_colour(float("nan")) == "#999999"
