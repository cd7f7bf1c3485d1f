# SPDX-License-Identifier: MIT
"""How safely bodies stand: margins of known shapes, and what counts as their base."""

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.geometry.triangles import area_normals
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape import inflated_mesh as meshes
from physgen.sim.reconstruct.shape.built_body import silhouette_overlap
from physgen.sim.reconstruct.shape.inflate import inflate
from physgen.sim.reconstruct.shape.inflated_mesh import inflated_mesh
from physgen.sim.reconstruct.shape.primitive_mesh import primitive_mesh
from physgen.sim.reconstruct.shape.primitives import Box
from physgen.sim.reconstruct.shape.stability import footed, support_of
from physgen.sim.scene.bake_quality import COARSEST, load_quality, quality_names


def support(mesh):
    return support_of(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))


def facing(camera, body):
    """Of each vertex, whether the surface there faces the camera: above 0."""
    return np.einsum("ij,ij->i", area_normals(body.vertices, body.faces), camera.position - body.vertices)


def test_a_box_and_a_cone_stand_as_geometry_says():
    """A box by half its width; a cone by its radius, its centre of mass a quarter up; on its tip it has no base."""
    box = support(trimesh.creation.box((0.2, 0.3, 0.5)))
    assert (box.margin, box.inradius, box.height, box.volume) == pytest.approx((0.1, 0.1, 0.5, 0.03))
    assert box.wanted == pytest.approx(max(0.15 * 0.5, 2.0 * (0.03 * 8 / 6000) ** (1 / 3)))
    cone = trimesh.creation.cone(radius=0.1, height=0.3, sections=360)
    assert support(cone).margin == pytest.approx(0.1, rel=1e-3)
    cone.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    assert support(cone).margin == -np.inf


def test_a_leaning_body_topples_by_as_much_as_it_leans():
    leaning = trimesh.creation.box((0.2, 0.2, 0.4))
    vertices = np.asarray(leaning.vertices).copy()
    vertices[:, 0] += 0.7 * (vertices[:, 2] + 0.2)
    assert support_of(vertices, np.asarray(leaning.faces)).margin == pytest.approx(0.1 - 0.7 * 0.2)


def test_a_film_on_the_ground_is_no_base():
    """A disc of 0.2 mm around the foot of a box of 10 cm, cells of 1.1 cm: the box stands on its own foot only."""
    box = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide()
    box.apply_translation((0, 0, 0.05))
    film = trimesh.creation.cylinder(radius=0.2, height=2e-4, sections=64)
    film.apply_translation((0.15, 0, 1e-4))
    both = support(trimesh.util.concatenate([box, film]))
    # The film's own weight moves the centre of mass by 2.5 % of 15 cm.
    assert both.margin == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize(("pitch", "least", "most", "settles"), [(12.0, 3.0, 1.4, True), (30.0, 7.0, 1.9, False)])
def test_an_inflated_body_gets_a_broad_base_that_the_photo_does_not_show(pitch, least, most, settles, monkeypatch):
    """A pear on its thin end, 60 by 110 pixels, stands by a seventh of what is wanted; then by several times that, at
    less than twice its volume. What the photo shows stays where it was, and hides the rest. Seen from farther above,
    its thicker back reaches the ground by itself."""
    camera = camera_above_ground(400, 300, 430.0, np.radians(pitch))
    mask = np.zeros((300, 400), np.uint8)
    corners = [(170, 120), (200, 90), (230, 120), (225, 150), (208, 200), (192, 200), (175, 150)]
    cv2.fillPoly(mask, [np.array(corners)], 1)
    silhouette = inflate(mask > 0)
    body = inflated_mesh(camera, silhouette, 3000)[0]
    monkeypatch.setattr(
        meshes, "footed", lambda camera, silhouette, places, faces, **_: (places, np.zeros(len(places), bool))
    )
    plain = inflated_mesh(camera, silhouette, 3000)[0]
    before, after = (support_of(each.vertices, each.faces) for each in (plain, body))
    assert 0.1 < before.share < 0.2 and after.share > least * before.share
    assert after.volume < most * before.volume
    assert silhouette_overlap(camera, body, mask > 0) > 0.97
    np.testing.assert_allclose(camera.project(body.vertices)[:, :2], body.pixels, atol=1e-6)
    moved = (body.vertices != plain.vertices).any(axis=1)
    np.testing.assert_array_equal(body.pixels[~moved], plain.pixels[~moved])
    assert (facing(camera, plain)[moved] < 0.0).all(), "what the photo shows stays"
    settled = np.abs(body.pixels - plain.pixels).max(axis=1) > 1e-6
    at = np.floor(body.pixels[settled]).astype(int)
    assert settled.any() == settles and cv2.erode(mask, np.ones((3, 3)))[at[:, 1], at[:, 0]].all(), "the front hides it"


def test_only_what_the_photo_does_not_show_moves_and_no_farther_than_the_ground():
    camera = camera_above_ground(400, 300, 430.0, np.radians(25.0))
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.25)
    ball.apply_translation((0.0, 2.0, 0.25))
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    mask = np.zeros((300, 400), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(camera.project(vertices)[:, :2].astype(np.float32)).astype(int), 1)
    after, moved = footed(camera, inflate(mask > 0), vertices, faces)
    assert (after[~moved] == vertices[~moved]).all()
    now, before = (camera.project(each)[:, :2] for each in (after, vertices))
    at = np.floor(now[np.abs(now - before).max(axis=1) > 1e-6]).astype(int)
    assert len(at) and mask[at[:, 1], at[:, 0]].all(), "the near side hides what has settled"
    assert moved.any() and after[:, 2].min() >= 0.0
    assert (camera.project(after)[moved, 2] > camera.project(vertices)[moved, 2]).all()
    towards, normals = camera.position - vertices[moved], vertices[moved] - (0.0, 2.0, 0.25)
    assert (np.einsum("ij,ij->i", towards, normals) < 0.01).all(), "the near side stays"
    stands = support_of(after, faces)
    assert 1.0 <= stands.share < 1.2
    again, more = footed(camera, inflate(mask > 0), after, faces)
    assert again is after and not more.any(), "what stands stays as it is"


def test_a_body_stands_on_a_seat_and_no_curtain_hangs_from_it():
    """A pebble of 1 by 0.8 needs a seat as broad as the margin of 0.11. Its unseen underside as a whole, 0.81 wide,
    would add 9 % to its volume."""
    camera = camera_above_ground(400, 300, 430.0, np.radians(20.0))
    pebble = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    pebble.apply_scale((0.5, 0.4, 0.15)).apply_translation((0.0, 2.5, 0.15))
    vertices, faces = np.asarray(pebble.vertices), np.asarray(pebble.faces)
    mask = np.zeros((300, 400), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(camera.project(vertices)[:, :2].astype(np.float32)).astype(int), 1)
    after, _ = footed(camera, inflate(mask > 0), vertices, faces)
    stands = support_of(after, faces)
    assert stands.share >= 1.0
    base = np.abs(after[after[:, 2] < 1e-9, 0]).max()
    assert 0.7 * stands.wanted < base < 1.5 * stands.wanted
    assert stands.volume < 1.02 * support_of(vertices, faces).volume


@pytest.mark.parametrize("turn", [0.0, 25.0])
def test_a_thin_box_gets_a_back_farther_away_and_stays_the_same_in_the_photo(turn):
    """A board of 0.5 × 0.12 × 0.6, whose own margin is 0.1 of its height."""
    camera = camera_above_ground(400, 300, 430.0, np.radians(15.0))
    angle = np.radians(turn)
    vertices, faces = primitive_mesh(Box(0.0, 2.0, angle, 0.5, 0.12, 0.6), 4000)
    before = support_of(vertices, faces)
    assert before.margin / before.height == pytest.approx(0.1, abs=0.001) and before.share < 0.7
    mask = np.zeros((300, 400), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(camera.project(vertices)[:, :2].astype(np.float32)).astype(int), 1)
    after, moved = footed(camera, inflate(mask > 0, 1.0), vertices, faces, flat=True)
    assert 1.0 <= support_of(after, faces).share < 1.2
    normals = area_normals(vertices, faces)
    assert (np.einsum("ij,ij->i", camera.position - vertices, normals)[moved] < 0).all(), "what is seen stays"
    at = np.floor(camera.project(after[moved])[:, :2]).astype(int)
    # Corners drawn in whole pixels cut off up to one.
    assert cv2.dilate(mask, np.ones((3, 3)))[at[:, 1], at[:, 0]].all(), "the seen sides hide what has moved"
    assert after[:, 2].min() >= 0.0
    # Its back is as upright as it was: at half and at most of the height it lies about as far behind.
    back = moved & (np.abs(camera.project(vertices)[:, 0] - 200) < 40)
    depth = after[back] - vertices[back]
    height = vertices[back, 2]
    middle, high = (depth[(height > low) & (height < low + 0.1), 1].mean() for low in (0.25, 0.45))
    assert high == pytest.approx(middle, rel=0.15)


def test_the_coarsest_quality_is_the_coarsest():
    coarse = [quality for quality in map(load_quality, quality_names()) if quality.grid is None]
    assert min(quality.particles for quality in coarse) == load_quality(COARSEST).particles
    assert min(quality.smallest_cells for quality in coarse) == load_quality(COARSEST).smallest_cells
