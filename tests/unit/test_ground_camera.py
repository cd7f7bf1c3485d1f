# SPDX-License-Identifier: MIT
"""Geometry of a camera with roll above the ground, and the scale of its world."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.camera import ground_camera as cameras
from physgen.sim.reconstruct.camera.camera_estimate import CameraEstimate, metres_per_unit

from .horizon_formulas import horizon_row, pitch_of_horizon

pitches = st.floats(-15, 80).map(math.radians)
rolls = st.floats(-40, 40).map(math.radians)
focals = st.floats(150, 4000)


@given(pitch=pitches, roll=rolls)
def test_pitch_and_roll_come_back_from_the_normal(pitch, roll):
    camera = cameras.camera_above_ground(640, 480, 700.0, pitch, roll)
    assert cameras.pitch_and_roll(cameras.up_in_camera(camera)) == pytest.approx((pitch, roll), abs=1e-9)
    axes = cameras.camera_from_world(pitch, roll)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    # Right is level, away is level, up is up: the world's axes as they were promised.
    pose = np.asarray(camera.world_from_camera)[:3, :3]
    assert pose == pytest.approx(axes.T)
    assert pose[0, 2] == pytest.approx(0.0, abs=1e-12)


@given(pitch=pitches, roll=rolls, focal=focals)
def test_the_horizon_is_where_the_ground_ends(pitch, roll, focal):
    camera = cameras.camera_above_ground(640, 480, focal, pitch, roll)
    left, right = cameras.horizon_at_edges(camera)
    assert (left + right) / 2 == pytest.approx(horizon_row(480, focal, pitch, roll), rel=1e-9, abs=1e-6)
    assert (right - left) / 640 == pytest.approx(math.tan(roll), abs=1e-9)
    middle = (left + right) / 2
    assert pitch_of_horizon(480, focal, middle, roll) == pytest.approx(pitch, abs=1e-9)
    edges = np.array([[0.0, left], [640.0, right]])
    assert cameras.declination(camera, edges) == pytest.approx([0.0, 0.0], abs=1e-9)
    below = edges + np.array([0.0, 5.0])
    assert np.isfinite(cameras.ground_depth(camera, camera.rays(below))).all()
    assert np.isinf(cameras.ground_depth(camera, camera.rays(edges - np.array([0.0, 5.0])))).all()


@given(pitch=st.floats(5, 80).map(math.radians), roll=rolls, x=st.floats(0, 640), down=st.floats(10, 400))
def test_ground_points_project_back(pitch, roll, x, down):
    camera = cameras.camera_above_ground(640, 480, 600.0, pitch, roll)
    left, right = cameras.horizon_at_edges(camera)
    pixel = np.array([x, left + (right - left) * x / 640 + down])
    point = cameras.on_ground(camera, pixel)
    assert abs(point[2]) < 1e-9
    assert camera.project(point)[:2] == pytest.approx(pixel, abs=1e-5)


def test_a_positive_roll_lets_the_horizon_fall_to_the_right():
    left, right = cameras.horizon_at_edges(cameras.camera_above_ground(640, 480, 600.0, 0.3, math.radians(10)))
    assert right > left


@given(fov=st.floats(5, 150), width=st.integers(32, 4000), height=st.integers(32, 4000))
def test_angle_of_view_round_trip(fov, width, height):
    assert cameras.fov_of_focal(width, height, cameras.focal_of_fov(width, height, fov)) == pytest.approx(fov)


def test_objects_above_a_tilted_horizon_do_not_stand_below_it():
    camera = cameras.camera_above_ground(640, 480, 600.0, math.radians(5), math.radians(15))
    row = horizon_row(480, 600.0, math.radians(5), math.radians(15)) + 60
    assert [cameras.stands_below(camera, np.array([column, row])) for column in (320.0, 20.0, 620.0)] == [1, 1, 0]


def estimate(metres=None):
    camera = cameras.camera_above_ground(640, 480, 600.0, 0.4)
    source = "" if metres is None else "a depth map"
    return CameraEstimate(camera, "", "", 1.0, 1.0, (0.0, 0.0), metres_per_unit=metres, scale_source=source)


def test_scale_by_sizes_depth_or_default():
    said = []
    assert metres_per_unit([0.5, 0.2], [None, 0.1], estimate(), 0.15, said.append) == pytest.approx(0.5)
    assert not said
    assert metres_per_unit([0.5, 0.2], [None, None], estimate(), 0.15, said.append) == pytest.approx(0.3)
    assert "size_m" in said.pop()
    assert metres_per_unit([0.5, 0.2], [None, None], estimate(0.8), 0.15, said.append) == pytest.approx(0.8)
    assert "depth map" in said.pop()
    assert metres_per_unit([0.5, 0.2], [None, 0.1], estimate(0.8), 0.15, said.append) == pytest.approx(0.5)
    assert "size_m is used" in said.pop()


def test_sizes_that_contradict_each_other_are_said():
    said = []
    scale = metres_per_unit([1.0, 0.5, 0.5], [0.4, 0.2, 0.9], estimate(), 0.15, said.append)
    assert scale == pytest.approx(0.4)
    assert "contradict" in said.pop()
    metres_per_unit([1.0, 0.5], [0.4, 0.22], estimate(), 0.15, said.append)
    assert not said
    with pytest.raises(InputError, match="extent"):
        metres_per_unit([0.0], [0.4], estimate(), 0.15, said.append)


@given(
    scale=st.floats(1e-3, 1e3),
    extents=st.lists(st.floats(0.01, 10), min_size=1, max_size=6),
)
def test_sizes_that_agree_give_their_scale(scale, extents):
    said = []
    found = metres_per_unit(extents, [e * scale for e in extents], estimate(), 0.15, said.append)
    assert found == pytest.approx(scale)
    assert not said
