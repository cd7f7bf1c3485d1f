# SPDX-License-Identifier: GPL-3.0-or-later
"""The horizon over the photo and the camera of the reconstruction are the same thing, said in two ways."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.physgen_addon.photo import photo_consent
from physgen.physgen_addon.photo.photo_maths import (
    HIGHEST,
    LOWEST,
    dragged,
    ends,
    fov_of_camera,
    of_camera,
    of_ends,
    pitch_of_camera,
    usual,
)
from physgen.sim.reconstruct.camera.ground_camera import (
    camera_above_ground,
    focal_of_fov,
    horizon_at_edges,
)
from physgen.sim.reconstruct.reconstruct_options import ReconstructOptions

from .horizon_formulas import pitch_of_horizon

sizes = st.sampled_from([(640, 480), (480, 640), (500, 500)])
rolls = st.floats(math.radians(-40), math.radians(40))


@settings(deadline=None)
@given(sizes, st.floats(20, 100), st.floats(math.radians(-15), math.radians(70)), rolls)
def test_the_line_is_where_the_reconstruction_sees_the_horizon(size, fov, pitch, roll):
    camera = camera_above_ground(*size, focal_of_fov(*size, fov), pitch, roll)
    middle, found_roll = of_camera(camera)
    left, right = horizon_at_edges(camera)
    if HIGHEST < middle < LOWEST:
        assert ends(middle, found_roll, size[0] / size[1]) == pytest.approx((left / size[1], right / size[1]), abs=1e-6)
        back = pitch_of_horizon(size[1], camera.fy, middle * size[1], found_roll)
        assert back == pytest.approx(pitch, abs=1e-6)
    assert found_roll == pytest.approx(roll, abs=1e-6)
    assert pitch_of_camera(camera) == pytest.approx(pitch, abs=1e-6)
    assert math.degrees(fov_of_camera(camera)) == pytest.approx(fov, abs=1e-6)
    ReconstructOptions(horizon_y=middle, roll_deg=math.degrees(found_roll))


def test_straight_down_there_is_no_horizon_to_be_seen():
    for pitch in (math.radians(90), math.radians(89.9999)):
        assert of_camera(camera_above_ground(640, 480, 500.0, pitch))[0] == HIGHEST


@given(st.floats(-9, 0.9), rolls, st.floats(0.3, 3))
def test_ends_and_middle_are_one_line(horizon, roll, aspect):
    assert of_ends(*ends(horizon, roll, aspect), aspect) == pytest.approx((horizon, roll), abs=1e-6)


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(0.3, 3))
def test_command_accepts_any_dragged_horizon(left, right, aspect):
    horizon, roll = of_ends(left, right, aspect)
    ReconstructOptions(horizon_y=horizon, roll_deg=math.degrees(roll))
    assert abs(roll) <= math.radians(45)


def test_the_middle_moves_the_line_and_the_outer_thirds_turn_it():
    assert dragged(0.2, 0.4, 0.1, 0.05) == pytest.approx((0.25, 0.4))
    assert dragged(0.2, 0.4, 0.5, 0.05) == pytest.approx((0.25, 0.45))
    assert dragged(0.2, 0.4, 0.9, 0.05) == pytest.approx((0.2, 0.45))


def test_a_usual_photo_is_one_that_looks_down_at_a_table():
    camera = camera_above_ground(640, 480, focal_of_fov(640, 480, 50), math.radians(20))
    assert usual(640 / 480) == pytest.approx(of_camera(camera)[0])
    camera = camera_above_ground(480, 640, focal_of_fov(480, 640, 50), math.radians(20))
    assert usual(480 / 640) == pytest.approx(of_camera(camera)[0])


@pytest.mark.parametrize(
    "url, here",
    [
        ("http://127.0.0.1:11434", True),
        ("http://localhost/v1", True),
        ("https://[::1]:8000/v1", True),
        ("https://host/v1", False),
        ("http://127.0.0.1.example.com", False),
        ("http://127.0.0.1@example.com/v1", False),
        ("http://localhost.example.com", False),
        ("http://192.168.0.2", False),
        ("127.0.0.1:11434", False),
        ("http://[::1", False),
        ("", False),
    ],
)
def test_only_this_machine_may_be_asked_offline(url, here):
    assert photo_consent.is_allowed(url, online=False) is here
    assert photo_consent.is_allowed(url, online=True)


def test_an_agreement_is_about_one_scene_and_one_address():
    photo_consent.agree(7, "https://a", agreed=True)
    assert photo_consent.is_agreed(7, "https://a") and not photo_consent.is_agreed(8, "https://a")
    photo_consent.agree(7, "https://b", agreed=True)
    assert photo_consent.is_agreed(7, "https://b") and not photo_consent.is_agreed(7, "https://a")
    photo_consent.agree(7, "https://b", agreed=False)
    assert not photo_consent.is_agreed(7, "https://b")
