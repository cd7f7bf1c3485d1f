# SPDX-License-Identifier: MIT
"""A printed face of the background's colour is no hole, and a ring before a plain background has one."""

import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.mask_cleanup import fill_holes
from scipy import ndimage

ROWS, COLUMNS = np.mgrid[:200, :240] + 0.5
SHEET, YELLOW, INK = (238.0, 236, 232), (240.0, 190, 20), (40.0, 40, 45)


def disc(x, y, radius):
    return (COLUMNS - x) ** 2 + (ROWS - y) ** 2 < radius**2


WHOLE, FACE = disc(120, 100, 70), disc(120, 100, 54)
NUMERALS = [disc(120 + 40 * np.cos(a), 100 + 40 * np.sin(a), 4) for a in np.arange(12) * np.pi / 6]


def drawn(marks):
    """A yellow ring on a white sheet with ``marks`` numerals in it, (H, W, 3) sRGB."""
    image = np.full((200, 240, 3), SHEET)
    image[WHOLE] = YELLOW
    image[FACE] = SHEET
    for mark in NUMERALS[:marks]:
        image[mark] = INK
    image = ndimage.gaussian_filter(image, (0.7, 0.7, 0)) + np.random.default_rng(0).normal(scale=2, size=(200, 240, 1))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("marks", "is_open"), [(12, False), (0, True), (2, True)])
def test_a_white_dial_with_numerals_on_a_white_sheet_is_no_hole_and_an_empty_ring_is_one(marks, is_open):
    inside = disc(120, 100, 30)
    assert (not fill_holes(drawn(marks), WHOLE & ~FACE)[inside].any()) == is_open
