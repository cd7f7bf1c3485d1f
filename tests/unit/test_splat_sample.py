# SPDX-License-Identifier: MIT
"""Splats on meshes: on the surface, along it, evenly, closed, and in its colours."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.gaussians.mesh_to_splats import Texture, splats_on_mesh
from physgen.sim.scene.textured_mesh import TexturedMesh
from PIL import Image
from scipy.spatial import cKDTree


def ball(subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def plane(width=2.0, height=1.0):
    vertices = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


GREY = np.full((4, 3), 0.5)


def test_splats_lie_flat_on_the_surface():
    vertices, faces = ball()
    splats = splats_on_mesh(vertices, faces, vertices * 0.5 + 0.5, 1500)
    radii = np.linalg.norm(splats.centres, axis=1)
    assert radii.max() <= 1 + 1e-12 and radii.min() > 0.98
    outward = splats.centres / radii[:, None]
    assert np.einsum("ni,ni->n", splats.axes()[:, :, 2], outward).min() > 0.98
    assert (splats.scales[:, 0] == splats.scales[:, 1]).all() and (
        splats.scales[:, 2] < 0.2 * splats.scales[:, 0]
    ).all()
    # Colours are the vertices' own, blended: here a straight function of the place.
    np.testing.assert_allclose(splats.colours, splats.centres * 0.5 + 0.5, atol=0.03)
    again = splats_on_mesh(vertices, faces, vertices * 0.5 + 0.5, 1500)
    assert (again.centres == splats.centres).all()
    assert (splats_on_mesh(vertices, faces, vertices * 0.5 + 0.5, 1500, seed=1).centres != splats.centres).any()


def test_splats_are_spread_by_area_and_more_evenly_than_by_chance():
    vertices, faces = plane()
    # One half of thousands of triangles, the other of two.
    fine = trimesh.Trimesh(vertices, faces, process=False).subdivide_loop(0)
    for _ in range(5):
        left = np.asarray(fine.triangles_center)[:, 0] < 1
        fine = fine.subdivide(face_index=np.flatnonzero(left))
    vertices, faces = np.asarray(fine.vertices), np.asarray(fine.faces)
    splats = splats_on_mesh(vertices, faces, np.full(vertices.shape, 0.5), 800)
    assert (splats.centres[:, 0] < 1).mean() == pytest.approx(0.5, abs=0.02)
    nearest = cKDTree(splats.centres).query(splats.centres, k=2)[0][:, 1]
    # By chance the nearest neighbour is at half of 1/sqrt(density) on average, and some are at nearly nothing.
    spacing = np.sqrt(2 / 800)
    assert nearest.mean() > 0.7 * spacing and np.quantile(nearest, 0.01) > 0.35 * spacing
    assert len(np.unique(splats.centres, axis=0)) == 800


@pytest.mark.parametrize("count", [50, 1000])
def test_the_surface_is_closed(count):
    splats = splats_on_mesh(*plane(), GREY, count)
    edge = 1.5 / np.sqrt(count)
    random = np.random.default_rng(0)
    at = np.column_stack([random.uniform(edge, 2 - edge, 4000), random.uniform(edge, 1 - edge, 4000), np.zeros(4000)])
    # What a ray straight through the plane leaves of the light: the product over all splats.
    through = np.ones(len(at))
    for centre, scale, opacity in zip(splats.centres, splats.scales, splats.opacities, strict=True):
        through *= 1 - opacity * np.exp(-0.5 * ((at - centre) ** 2).sum(axis=1) / scale[0] ** 2)
    assert through.mean() < 0.02 and through.max() < 0.2


def test_both_sides_of_a_thin_sheet_have_splats():
    sheet = trimesh.creation.box((1, 1, 0.001))
    vertices, faces = np.asarray(sheet.vertices), np.asarray(sheet.faces)
    splats = splats_on_mesh(vertices, faces, np.full((8, 3), 0.5), 400)
    upper = splats.centres[:, 2] > 0
    assert upper.mean() == pytest.approx(0.5, abs=0.05)
    assert (np.sign(splats.axes()[:, 2, 2]) == np.where(upper, 1, -1))[np.abs(splats.axes()[:, 2, 2]) > 0.5].all()


def test_textures_are_taken_the_right_way_up_and_repeat():
    vertices, faces = plane(1, 1)
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0, 0], picture[0, 1], picture[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    large = picture.repeat(40, axis=0).repeat(40, axis=1)
    for shift in (0.0, 3.0):
        splats = splats_on_mesh(vertices, faces, Texture(vertices[:, :2] + shift, large), 400)
        x, y, _ = splats.centres.T
        clear = (np.abs(x - 0.5) > 0.05) & (np.abs(y - 0.5) > 0.05)
        clear &= (np.minimum(x, y) > 0.05) & (np.maximum(x, y) < 0.95)
        wanted = np.stack([(x < 0.5) & (y > 0.5), (x > 0.5) & (y > 0.5), (x < 0.5) & (y < 0.5)], axis=1)
        np.testing.assert_allclose(splats.colours[clear], wanted[clear], atol=1e-6)


def test_textures_of_mesh_files():
    buffer = io.BytesIO()
    Image.fromarray(np.full((4, 4, 3), 51, np.uint8)).save(buffer, "PNG")
    vertices, faces = plane()
    texture = Texture.of(TexturedMesh(vertices, faces, vertices[:, :2], buffer.getvalue()))
    np.testing.assert_allclose(splats_on_mesh(vertices, faces, texture, 9).colours, 0.2)
    assert Texture.of(TexturedMesh(vertices, faces)) is None
    with pytest.raises(InputError, match="not a readable image"):
        Texture.of(TexturedMesh(vertices, faces, vertices[:, :2], b"\x89PNG garbage"))


@pytest.mark.parametrize(
    "vertices, faces, colours, count, said",
    [
        (*plane(), GREY, 0, "count is 0"),
        (*plane(), GREY, 10**9, "count is 1000000000"),
        (*plane(), GREY[:3], 5, r"shape \(3, 3\)"),
        (*plane(), GREY * np.nan, 5, "not finite"),
        (*plane(), Texture(np.zeros((3, 2)), np.zeros((1, 1, 3), np.uint8)), 5, "texture with uv"),
        (plane()[0] * 0, plane()[1], GREY, 5, "area is 0 m²"),
        (plane()[0] * np.nan, plane()[1], GREY, 5, "area is nan"),
        (plane()[0], plane()[1] + 1, GREY, 5, "refer to vertex 4 of 4"),
        (plane()[0], plane()[1][:0], GREY, 5, r"give \(V, 3\) and \(T, 3\)"),
    ],
)
def test_invalid_surfaces_are_refused(vertices, faces, colours, count, said):
    with pytest.raises(InputError, match=said):
        splats_on_mesh(vertices, faces, colours, count)
