# SPDX-License-Identifier: MIT
"""The holes that objects leave together with their shadows."""

import numpy as np
from physgen.sim.reconstruct.lighting.shadow_masks import PENUMBRA_DILATION, object_holes
from scipy import ndimage

WIDTH, HEIGHT = 320, 240


def disc(x, y, radius):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def test_holes_hold_mask_and_shadow_but_no_neighbour():
    first, second = disc(100, 120, 30), disc(165, 120, 30)
    shadow = disc(100, 160, 12)
    holes = object_holes([first, second], [shadow, np.zeros_like(first)], 21)
    assert holes[0][first].all()
    assert holes[0][shadow].all()
    assert not holes[0][second].any()
    assert not holes[1][first].any()
    assert holes[0].sum() > (first | shadow).sum()


def test_an_outline_is_covered_by_three_pixels():
    mask = disc(150, 120, 40)
    # At a quarter of the size that the dilation is meant for, three pixels are less than one.
    for dilation, covered in ((PENUMBRA_DILATION, 3), (PENUMBRA_DILATION / 4, 1)):
        hole = object_holes([mask], [np.zeros_like(mask)], dilation)[0]
        assert hole[ndimage.binary_dilation(mask, iterations=covered)].all()


def test_background_enclosed_by_a_strap_moves_with_it():
    ring = disc(150, 120, 20) & ~disc(150, 120, 8)
    hole = object_holes([ring], [np.zeros_like(ring)], 13)[0]
    assert hole[disc(150, 120, 20)].all()
