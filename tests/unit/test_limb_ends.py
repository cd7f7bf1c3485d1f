# SPDX-License-Identifier: MIT
"""Feet of another colour at the ends of limbs come back; leaves at a side, shadows and lines that go on do not."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.limb_ends import limb_ends

HEIGHT, WIDTH = 320, 320
BOX = (60, 30, 260, 300)
GROUND, RED, WHITE = (150, 148, 145), (200, 30, 40), (228, 228, 224)
NOTHING = np.zeros((HEIGHT, WIDTH), dtype=bool)


def drawn(*shapes):
    """Mask (h, w) of discs (x, y, radius) and of limbs (x, y, x, y, half their width)."""
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    for shape in shapes:
        if len(shape) == 3:
            cv2.circle(image, shape[:2], shape[2], 1, -1)
        else:
            cv2.line(image, shape[:2], shape[2:4], 1, 2 * shape[4])
    return image > 0


TOY = drawn((160, 110, 60), (140, 150, 120, 240, 10), (180, 150, 215, 240, 10))
FEET = drawn((119, 250, 13), (217, 250, 13)) & ~TOY


def photo(*parts):
    """A red toy on grey ground with ``parts`` (mask, colour)."""
    pixels = np.empty((HEIGHT, WIDTH, 3))
    pixels[:] = GROUND
    for part, colour in (*parts, (TOY, RED)):
        pixels[part] = colour
    pixels += np.random.default_rng(2).normal(0.0, 2.0, (HEIGHT, WIDTH, 1))
    return np.clip(cv2.GaussianBlur(pixels, (0, 0), 0.8), 0, 255).astype(np.uint8)


def found(*parts, others=NOTHING):
    return limb_ends(photo(*parts), BOX, TOY, others)


def test_white_feet_of_a_red_toy_come_back_and_are_joined_to_it():
    added = found((FEET, WHITE))
    whole = TOY | FEET
    assert ((TOY | added) & whole).sum() / ((TOY | added) | whole).sum() > 0.99
    assert cv2.connectedComponents((TOY | added).astype(np.uint8))[0] == 2


@pytest.mark.parametrize(
    ("part", "colour"),
    [
        (drawn((98, 110, 13)), WHITE),  # a leaf at its side
        (FEET, tuple(int(0.7 * v) for v in GROUND)),  # the shadows of its legs
        (drawn((119, 248, 119, 318, 13)), WHITE),  # a line on the ground that goes on
    ],
)
def test_what_ends_no_limb_is_not_added(part, colour):
    assert not found((part & ~TOY, colour)).any()


def test_another_object_at_a_foot_is_none():
    assert not found((FEET, WHITE), others=FEET).any()


def test_nothing_is_added_where_nothing_lies():
    assert not found().any()
