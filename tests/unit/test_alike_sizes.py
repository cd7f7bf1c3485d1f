# SPDX-License-Identifier: MIT
"""The camera's pitch from things of alike size."""

import math

import numpy as np
import pytest
import skimage.data
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.reconstruct.camera.camera_estimate import pitch_from_alike_sizes
from physgen.sim.reconstruct.camera.ground_camera import focal_of_fov
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes

WIDTH, HEIGHT, USUAL = 640, 480, 13.0
FOCAL = focal_of_fov(WIDTH, HEIGHT, 50.0)


def boxes_seen(pitch_deg, count, variation, seed, width_px=40.0):
    """Boxes of ``count`` things of alike size on the ground, as a camera at ``pitch_deg`` sees them."""
    rng = np.random.default_rng(seed)
    pitch = math.radians(pitch_deg)
    rows, columns = np.linspace(60, HEIGHT - 60, count), rng.uniform(60, WIDTH - 60, count)
    near = np.maximum(math.sin(pitch) + (rows - HEIGHT / 2) / FOCAL * math.cos(pitch), 0.05)
    side = width_px * near / near.mean() * np.exp(rng.normal(0, variation, count)) / 2
    return [(x - s, y - s, x + s, y + s) for x, y, s in zip(columns, rows, side, strict=True)]


@given(st.floats(66, 88), st.integers(9, 20), st.floats(0, 0.07), st.integers(0, 999))
def test_alike_things_seen_from_above_tell_it(pitch_deg, count, variation, seed):
    found = pitch_from_alike_sizes(boxes_seen(pitch_deg, count, variation, seed), (WIDTH, HEIGHT), FOCAL, USUAL)
    assert found is not None
    assert abs(math.degrees(found.mean) - pitch_deg) < 3.0 * math.degrees(found.sigma)


@given(st.floats(15, 35), st.integers(5, 20), st.floats(0, 0.2), st.integers(0, 999))
def test_a_usual_view_is_not_taken_for_one_from_above(pitch_deg, count, variation, seed):
    assert pitch_from_alike_sizes(boxes_seen(pitch_deg, count, variation, seed), (WIDTH, HEIGHT), FOCAL, USUAL) is None


@given(st.floats(62, 88), st.integers(0, 999))
def test_few_things_or_things_of_all_sizes_tell_nothing(pitch_deg, seed):
    few = boxes_seen(pitch_deg, 4, 0.02, seed)
    assert pitch_from_alike_sizes(few, (WIDTH, HEIGHT), FOCAL, USUAL) is None
    unlike = boxes_seen(pitch_deg, 8, 0.8, seed, width_px=20.0)
    sizes = np.log([box[2] - box[0] for box in unlike])
    if sizes.std() > 0.6:
        assert pitch_from_alike_sizes(unlike, (WIDTH, HEIGHT), FOCAL, USUAL) is None


def test_what_the_border_cuts_does_not_count():
    whole = boxes_seen(80.0, 4, 0.0, 1)
    cut = [(0.0, y, 40.0, y + 40.0) for y in (50.0, 150.0, 250.0, 350.0)]
    assert pitch_from_alike_sizes(whole + cut, (WIDTH, HEIGHT), FOCAL, USUAL) is None


def test_a_photo_of_coins_is_one_from_above():
    pixels = np.repeat(skimage.data.coins()[..., None], 3, axis=2)
    height, width = pixels.shape[:2]
    boxes = [item.box for item in propose_boxes(pixels)]
    found = pitch_from_alike_sizes(boxes, (width, height), focal_of_fov(width, height, 50.0), USUAL)
    assert found is not None and math.degrees(found.mean) > 60.0


@pytest.mark.parametrize("boxes", [[], [(5.0, 5.0, 9.0, 9.0)] * 6, [(300.0, 470.0, 310.0, 478.0)] * 9])
def test_degenerate_boxes_raise_nothing(boxes):
    pitch_from_alike_sizes(boxes, (WIDTH, HEIGHT), FOCAL, USUAL)
