# SPDX-License-Identifier: MIT
"""Primitives found again from outlines that known cameras see of them."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape.inflate import crop_mask
from physgen.sim.reconstruct.shape.primitive_choice import Carver, choose_primitive
from physgen.sim.reconstruct.shape.primitive_fit import InnerEdges, fit_box, fit_cylinder, fit_sphere
from physgen.sim.reconstruct.shape.primitives import (
    Box,
    Sphere,
    SurfaceOfRevolution,
    distance_to_convex,
    hull_polygon,
    outline_of,
    polygons,
    rasterize,
)
from physgen.sim.reconstruct.shape.shape_kinds import shape_of_kind
from physgen.sim.scene.model import Camera

WIDTH, HEIGHT = 480, 360
CASES = settings(max_examples=12, deadline=None)


def view_from(pitch_deg, focal, roll_deg, pixel, share):
    """A camera, and the place (2,) and size of a thing on the ground at ``pixel``; None near or above the horizon.

    focal: focal length in picture widths; share: size of the thing over its distance.
    """
    level = camera_above_ground(WIDTH, HEIGHT, WIDTH * focal, math.radians(pitch_deg))
    roll = math.radians(roll_deg)
    pose = np.array(level.world_from_camera)
    turn = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    pose[:3, :3] = pose[:3, :3] @ turn
    rows = tuple(tuple(float(v) for v in row) for row in pose)
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=WIDTH * focal, fy=WIDTH * focal, cx=240.0, cy=180.0, world_from_camera=rows
    )
    ray = camera.rays(np.array(pixel))
    if ray[2] >= -0.05:
        return None
    place = camera.position - ray / ray[2]
    return camera, place[:2], float(np.linalg.norm(place - camera.position)) * share


def views():
    """A camera, maybe rolled, and the place (2,) and size of a thing that it sees."""
    return st.builds(
        view_from,
        pitch_deg=st.floats(12.0, 50.0),
        focal=st.floats(0.8, 1.6),
        roll_deg=st.floats(-8.0, 8.0),
        pixel=st.tuples(st.floats(170.0, 310.0), st.floats(200.0, 280.0)),
        share=st.floats(0.08, 0.16),
    ).filter(lambda view: view is not None)


def mask_of(camera, primitive):
    corners = np.concatenate([*polygons(primitive, camera), np.zeros((0, 2))])
    assume(len(corners) > 0)
    assume(corners.min() > 4 and corners[:, 0].max() < WIDTH - 4 and corners[:, 1].max() < HEIGHT - 4)
    mask = rasterize(primitive, camera, (HEIGHT, WIDTH), 0, 0)
    assume(mask.sum() > 1500)
    return mask


def painted(camera, box, seed=0):
    """The box with faces of different brightness, and a little noise."""
    random = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    corners = box.corners()
    pixels = camera.project(corners)[:, :2]
    for axis, tone in enumerate((90.0, 150.0, 210.0)):
        for end in (0, 1):
            face = [c for c in range(8) if (c >> axis & 1) == end]
            middle = corners[face].mean(axis=0)
            if (middle - box.centre) @ (camera.position - middle) > 0:
                polygon = np.round(hull_polygon(pixels[face]) * 16 - 8).astype(np.int32)
                cv2.fillConvexPoly(image, polygon, (tone, 0.8 * tone, 0.5 * tone), shift=4)
    return np.clip(image + random.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


@CASES
@given(view=views())
def test_balls_are_found_again(view):
    camera, place, size = view
    ball = Sphere(place[0], place[1], size)
    found, _ = fit_sphere(camera, outline_of(mask_of(camera, ball)))
    assert found.radius == pytest.approx(size, rel=0.03)
    assert found.squash == pytest.approx(1.0, abs=0.03)
    assert np.hypot(found.x - place[0], found.y - place[1]) < 0.15 * size


@CASES
@given(view=views(), height=st.floats(0.5, 3.0), taper=st.floats(0.4, 1.3))
# Stumps whose top lies within the outline of their base: a disc of no height has the same outline.
@example(view=view_from(49.0, 1.0, 0.0, (240.0, 240.0), 0.1), height=0.5, taper=0.5)
@example(view=view_from(42.0, 1.6, 3.0, (200.0, 260.0), 0.1), height=0.5, taper=0.4)
@example(view=view_from(34.0, 0.8, -5.0, (300.0, 270.0), 0.12), height=0.5, taper=0.4)
# All but one of the usual starts end in a tall narrow cone.
@example(view=view_from(37.6, 0.855, -6.4, (226.0, 253.0), 0.148), height=3.0, taper=1.198)
def test_cylinders_and_cones_are_found_again(view, height, taper):
    camera, place, size = view
    low, high = size, size * taper
    body = SurfaceOfRevolution(place[0], place[1], (0.0, height * size), (low, high))
    mask = mask_of(camera, body)
    found, _ = fit_cylinder(camera, outline_of(mask))
    volume = body.height * (low**2 + low * high + high**2)
    a, b = found.radii
    # The wanted quarter: of a low stump seen from above, the outline shows little but its base.
    assert found.height * (a**2 + a * b + b**2) == pytest.approx(volume, rel=0.25)
    # What an outline has to reach; of a mask of 1,500 pixels, 2 % are a quarter of a pixel all round.
    assert overlap(rasterize(found, camera, mask.shape, 0, 0), mask) > 0.97


@CASES
@given(
    view=views(),
    yaw=st.floats(0.2, 1.3),
    shape=st.tuples(st.floats(0.5, 2.0), st.floats(0.5, 2.0), st.floats(0.3, 2.0)),
)
def test_boxes_that_show_three_faces_are_found_again(view, yaw, shape):
    camera, place, size = view
    box = Box(place[0], place[1], yaw, *(size * extent for extent in shape))
    eye = camera.position - box.centre
    local = np.array([eye[:2] @ box.axes[0], eye[:2] @ box.axes[1], eye[2]])
    # Each face as more than a sliver, or its extent is anybody's guess.
    half = np.array([box.width, box.depth, box.height]) / 2.0
    assume((np.abs(local) - half > 0.2 * np.linalg.norm(eye)).all())
    mask = mask_of(camera, box)
    found, _ = fit_box(camera, outline_of(mask), InnerEdges(painted(camera, box), mask, mask))
    assert found.width * found.depth * found.height == pytest.approx(box.width * box.depth * box.height, rel=0.15)
    assert np.sort([found.width, found.depth]) == pytest.approx(np.sort([box.width, box.depth]), rel=0.15)
    assert overlap(rasterize(found, camera, mask.shape, 0, 0), mask) > 0.97


def test_inner_edges_tell_depth_where_the_outline_does_not():
    """Straight from the front and far away, a box' outline is a rectangle: how much of it is the top?"""
    camera = camera_above_ground(WIDTH, HEIGHT, 1600.0, math.radians(30.0))
    box = Box(0.0, camera.position[2] / math.tan(math.radians(31.0)), 0.0, 0.2, 0.12, 0.1)
    mask = rasterize(box, camera, (HEIGHT, WIDTH), 0, 0)
    found, _ = fit_box(camera, outline_of(mask), InnerEdges(painted(camera, box), mask, mask))
    assert found.height == pytest.approx(0.1, rel=0.1)
    shown = InnerEdges(painted(camera, box), mask, mask)
    low = Box(box.x, box.y, 0.0, 0.2, 0.15, 0.075)
    assert shown.missing(camera, box).max() < 0.3 < shown.missing(camera, low).max()


def test_thickness_from_the_user_is_kept():
    camera = camera_above_ground(WIDTH, HEIGHT, 500.0, math.radians(5.0))
    box = Box(0.0, 3.0, 0.0, 0.8, 0.3, 1.1)
    mask = rasterize(box, camera, (HEIGHT, WIDTH), 0, 0)
    found, _ = fit_box(camera, outline_of(mask), thickness=0.25)
    assert found.depth / found.width == pytest.approx(0.25, rel=0.02)


def test_a_guessed_outline_weighs_less_and_the_border_nothing():
    camera = camera_above_ground(WIDTH, HEIGHT, 500.0, math.radians(25.0))
    ball = Sphere(0.0, 2.2, 0.3)
    mask = rasterize(ball, camera, (HEIGHT, WIDTH), 0, 0)
    columns = np.flatnonzero(mask.any(axis=0))
    seen, wrong = mask.copy(), mask.copy()
    seen[:, columns[0] : columns[0] + len(columns) // 3] = False
    # What was guessed is a bulge that the ball does not have.
    rows = np.flatnonzero(seen[:, columns[0] + len(columns) // 3 + 2])
    wrong[rows[0] : rows[-1], columns[0] - 20 : columns[0] + len(columns) // 3] = True
    trusting, _ = fit_sphere(camera, outline_of(wrong))
    careful, _ = fit_sphere(camera, outline_of(wrong, seen))
    assert abs(careful.radius - 0.3) < 0.5 * abs(trusting.radius - 0.3)
    cut = np.zeros_like(mask)
    cut[100:200, :50] = True
    outline = outline_of(cut)
    assert (outline.weights[outline.points[:, 0] < 1.0] == 0).all()
    assert (outline.weights == 0).any() and (outline.weights == 1).any()


def test_a_bottle_is_carved_with_its_neck_and_a_flat_top():
    camera = camera_above_ground(WIDTH, HEIGHT, 500.0, math.radians(30.0))
    bottle = SurfaceOfRevolution(0.1, 2.0, (0.0, 0.35, 0.45, 0.65), (0.15, 0.15, 0.06, 0.06))
    mask = rasterize(bottle, camera, (HEIGHT, WIDTH), 0, 0)
    crop = crop_mask(mask)
    guess, _ = fit_cylinder(camera, outline_of(mask))
    found = Carver(camera, crop.mask, crop.distance, crop.left, crop.top).best(guess)
    assert found.height == pytest.approx(bottle.height, rel=0.06)
    for height, radius in ((0.1, 0.15), (0.25, 0.15), (0.55, 0.06)):
        assert np.interp(height, found.heights, found.radii) == pytest.approx(radius, rel=0.12)


def test_a_cup_with_a_handle_stays_straight_where_its_mask_is_ragged():
    camera = camera_above_ground(WIDTH, HEIGHT, 500.0, math.radians(20.0))
    cup = SurfaceOfRevolution(0.0, 2.0, (0.0, 0.5), (0.22, 0.22))
    mask = rasterize(cup, camera, (HEIGHT, WIDTH), 0, 0).astype(np.uint8)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    middle = (int(columns[-1]) - 2, int(rows.mean()))
    cv2.ellipse(mask, middle, (len(columns) // 4, len(rows) // 4), 0.0, -90.0, 90.0, 1, 8)
    # The rim is cut off from the rest, but for a bridge, as where a dark line runs below it.
    mask[rows[0] + len(rows) // 6, columns[0] : columns[0] + len(columns) // 3] = 0
    mask[rows[0] + len(rows) // 6, columns[-1] - len(columns) // 3 : columns[-1]] = 0
    mask = mask > 0
    found = choose_primitive(camera, crop_mask(mask), mask, mask, None)
    assert found is not None
    assert isinstance(found.primitive, SurfaceOfRevolution)
    assert len(found.primitive.radii) == 2
    assert found.primitive.height == pytest.approx(cup.height, rel=0.05)


def test_distance_to_a_convex_polygon():
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    points = np.array([[5.0, 5.0], [5.0, 1.0], [5.0, -2.0], [13.0, 14.0]])
    for polygon in (square, square[::-1]):
        assert distance_to_convex(points, polygon) == pytest.approx([5.0, 1.0, -2.0, -5.0])


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("orange", "sphere"),
        ("Books", "box"),
        ("a red coffee-mug", "cylinder"),
        ("tennis ball", "sphere"),
        ("toy car", "inflated"),
        ("cardboard box", "box"),
        ("traffic_cone", "cylinder"),
        ("thingamajig", None),
        ("", None),
        (None, None),
    ],
)
def test_kinds(kind, shape):
    found = shape_of_kind(kind)
    assert (found and found.shape) == shape
