# SPDX-License-Identifier: MIT
"""What stands on what, and where it is then."""

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape.object_supports import first_hit, place_on_supports, resting_on

HEIGHT, WIDTH = 300, 400
VIEW = camera_above_ground(WIDTH, HEIGHT, 350.0, np.radians(25.0))


def outline(vertices):
    """The mask of a convex body in the view."""
    import cv2

    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    points = VIEW.project(vertices)[:, :2].astype(np.float32)
    cv2.fillConvexPoly(mask, cv2.convexHull(points).round().astype(np.int32), 1)
    return mask > 0


def box(extents, centre):
    mesh = trimesh.creation.box(extents=extents)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def test_a_cube_on_a_table_is_put_where_it_stands():
    table, faces = box((0.8, 0.6, 0.3), (0, 2.2, 0.15))
    cube, _ = box((0.16, 0.16, 0.16), (0, 2.2, 0.38))
    upper, whole = outline(cube), outline(table)
    seen = [upper, whole & ~upper]
    assert resting_on(seen) == {0: 1}
    # As it would be built: on the ground behind the table, larger, the same in the photo.
    position = VIEW.position
    grown = position[2] / (position[2] - cube[:, 2].min())
    (found,) = place_on_supports(VIEW, seen, [(position + grown * (cube - position), faces), (table, faces)])
    assert (found.upper, found.lower) == (0, 1)
    assert found.factor * grown == pytest.approx(1.0, rel=0.02)


def test_objects_in_front_of_others_stay_on_the_ground():
    wall, faces = box((1.0, 0.1, 0.8), (0, 3.0, 0.4))
    cube, _ = box((0.2, 0.2, 0.2), (0, 2.0, 0.1))
    front = outline(cube)
    seen = [front, outline(wall) & ~front]
    assert resting_on(seen) == {}
    assert place_on_supports(VIEW, seen, [(cube, faces), (wall, faces)]) == []


def test_a_pile_is_placed_from_below():
    low, faces = box((0.9, 0.7, 0.2), (0, 2.2, 0.1))
    middle, _ = box((0.4, 0.4, 0.2), (0, 2.2, 0.3))
    top, _ = box((0.15, 0.15, 0.15), (0, 2.2, 0.475))
    masks = [outline(body) for body in (top, middle, low)]
    seen = [masks[0], masks[1] & ~masks[0], masks[2] & ~masks[1] & ~masks[0]]
    position = VIEW.position
    grown = [position[2] / (position[2] - body[:, 2].min()) for body in (top, middle, low)]
    meshes = [(position + g * (b - position), faces) for g, b in zip(grown, (top, middle, low), strict=True)]
    found = place_on_supports(VIEW, seen, meshes)
    assert [(s.upper, s.lower) for s in found] == [(1, 2), (0, 1)]
    for support in found:
        assert support.factor * grown[support.upper] == pytest.approx(1.0, rel=0.02)


def test_things_that_seem_to_stand_on_each_other_stand_on_the_ground_in_part():
    first, second = np.zeros((2, 60, 80), bool)
    first[20:40, 10:30] = True
    second[20:41, 30:50] = True
    assert resting_on([first, second]) == {}


def test_first_hit_of_a_box():
    vertices, faces = box((1, 1, 1), (0, 5, 0))
    assert first_hit(np.zeros(3), np.array([0.01, 1.0, 0.02]), vertices, faces) == pytest.approx(4.5)
    assert first_hit(np.zeros(3), np.array([1.0, 0.0, 0.0]), vertices, faces) == np.inf
