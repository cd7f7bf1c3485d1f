# SPDX-License-Identifier: MIT
"""The camera's pitch from the round feet of upright things."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, focal_of_fov
from physgen.sim.reconstruct.camera.round_feet import SIGMA_DEG, pitch_from_round_feet, round_foot
from physgen.sim.reconstruct.shape.primitives import Box, Sphere, SurfaceOfRevolution, rasterize

WIDTH, HEIGHT = 640, 480
FOCAL = focal_of_fov(WIDTH, HEIGHT, 50.0)


def seen(body, pitch_deg):
    """Picture (H, W) of ``body`` from a camera at ``pitch_deg``, whole and at least 60 pixels wide; else skipped."""
    camera = camera_above_ground(WIDTH, HEIGHT, FOCAL, math.radians(pitch_deg))
    mask = rasterize(body, camera, (HEIGHT, WIDTH), 0, 0)
    assume(mask.any(axis=0).sum() >= 60 and not (mask[0].any() or mask[-1].any()))
    assume(not (mask[:, 0].any() or mask[:, -1].any()))
    return mask


@given(st.floats(8, 45), st.floats(-8, 12), st.floats(0.1, 0.25), st.floats(1.5, 4), st.floats(0.9, 1.15))
def test_a_can_tells_the_pitch(below_deg, above_middle_deg, radius, slender, taper):
    pitch_deg = below_deg - above_middle_deg
    distance = 1.0 / math.tan(math.radians(below_deg))
    low = radius * min(distance, 1.0)
    mask = seen(SurfaceOfRevolution(0.0, distance, (0.0, slender * low), (low, low * taper)), pitch_deg)
    found = pitch_from_round_feet([mask], (WIDTH, HEIGHT), FOCAL)
    if found is not None:
        assert abs(math.degrees(found.mean) - pitch_deg) < 0.75 * SIGMA_DEG
    elif below_deg > 10 and slender > 2 and abs(taper - 1) < 0.1:
        pytest.fail(f"no foot of a can seen at {below_deg:.0f}°")


@given(st.floats(6, 45), st.floats(-8, 12), st.floats(0, math.pi / 2), st.floats(0.5, 2), st.floats(0.6, 3))
def test_a_box_has_no_round_foot(below_deg, above_middle_deg, yaw, deep, tall):
    distance = 1.0 / math.tan(math.radians(below_deg))
    side = 0.25 * min(distance, 1.0)
    mask = seen(Box(0.0, distance, yaw, side, deep * side, tall * side), below_deg - above_middle_deg)
    assert round_foot(mask) is None


@given(st.floats(6, 60), st.floats(0.8, 1.1))
def test_a_ball_has_no_foot(below_deg, squash):
    distance = 1.0 / math.tan(math.radians(below_deg))
    mask = seen(Sphere(0.0, distance, 0.2 * min(distance, 1.0), squash), below_deg)
    assert round_foot(mask) is None


@pytest.mark.parametrize("mask", [np.zeros((50, 60), bool), np.ones((50, 60), bool), np.eye(60, dtype=bool)])
def test_degenerate_masks_tell_nothing(mask):
    assert pitch_from_round_feet([mask], (60, 50), 60.0) is None


def test_what_the_photo_cuts_tells_nothing():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.rectangle(mask, (200, 100), (400, HEIGHT - 1), 1, -1)
    assert round_foot(mask > 0) is None
