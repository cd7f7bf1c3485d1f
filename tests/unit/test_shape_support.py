# SPDX-License-Identifier: MIT
"""What stands on what, and where it is then."""

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, declination
from physgen.sim.reconstruct.shape.object_placement import (
    SEEN_FROM_DEG,
    first_hit,
    hung,
    place_on_supports,
    resting_on,
    turned_view,
)

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


@pytest.mark.parametrize("column", [40, 200, 350])
def test_what_hangs_is_made_in_a_turned_view_and_stays_where_the_photo_shows_it(column):
    """A ball of 1 unit whose middle lies 0.3 above the camera, 3 away: made on the turned view's ground, and hung."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    middle = VIEW.position + 3.0 * VIEW.rays(np.array([column, 0.0])) + (0.0, 0.0, 1.2)
    low = camera_above_ground(WIDTH, HEIGHT, 350.0, np.radians(-10.0))
    seen = low.project(np.asarray(ball.vertices) + middle)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:60, column - 20 : column + 20] = True
    turned = turned_view(low, mask)
    foot = np.array([float(column), 60.0])
    assert np.degrees(declination(turned, foot)) == pytest.approx(SEEN_FROM_DEG, abs=0.1)
    assert turned_view(VIEW, mask | (np.arange(HEIGHT) > 200)[:, None]) is None, "what stands below the horizon"
    made = turned.position + 0.5 * seen[:, 2:] * turned.rays(seen[:, :2])
    others = [low.position + 4.0 * low.rays(np.array([[200.0, 290.0]])), np.array([[0.0, 2.0, 0.0]])]
    placed = hung(low, turned, made, others)
    np.testing.assert_allclose(low.project(placed)[:, :2], seen[:, :2], atol=1e-6)
    nearest = low.project(others[1])[0, 2]
    assert np.median(low.project(placed)[:, 2]) == pytest.approx(nearest)
    assert placed[:, 2].min() > 0.0
    assert np.median(low.project(hung(low, turned, made, []))[:, 2]) == pytest.approx(3.0)


def test_what_stands_above_the_horizon_on_something_tall_is_put_there():
    """A cube on a cupboard that is taller than the camera is high: its foot meets the cupboard's upper edge."""
    low = camera_above_ground(WIDTH, HEIGHT, 350.0, np.radians(5.0))
    cupboard, faces = box((0.6, 0.3, 1.1), (0, 3.0, 0.55))
    cube, _ = box((0.2, 0.2, 0.2), (0, 2.95, 1.2))
    masks = []
    for vertices in (cube, cupboard):
        corners = low.project(vertices)[:, :2]
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        inside = (columns > corners[:, 0].min()) & (columns < corners[:, 0].max())
        masks.append(inside & (rows > corners[:, 1].min()) & (rows < corners[:, 1].max()))
    seen = [masks[0] & ~masks[1], masks[1]]
    assert turned_view(low, seen[0]) is not None and resting_on(seen) == {0: 1}
    away = low.position + 1.7 * (cube - low.position)
    (found,) = place_on_supports(low, seen, [(away, faces), (cupboard, faces)])
    placed = low.position + found.factor * (away - low.position)
    assert placed[:, 1].mean() == pytest.approx(2.95, abs=0.2)
