# SPDX-License-Identifier: MIT
"""Pieces of one thing are joined, and things of a kind are not."""

import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.joined_pieces import in_one_piece, joined_pieces
from scipy import ndimage

HEIGHT, WIDTH = 120, 160
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH] + 0.5
ORANGE, PALE, GREY = (200.0, 110, 40), (236.0, 232, 225), (150.0, 160, 172)


def ellipse(x, y, across, down):
    return ((COLUMNS - x) / across) ** 2 + ((ROWS - y) / down) ** 2 < 1


HEAD, FLANK = ellipse(66, 34, 20, 16), ellipse(96, 86, 12, 20)
BREAST = ellipse(76, 70, 27, 36)


def picture(*things):
    """A grey backdrop with ``things``, pairs of a mask and its colour, back to front; (H, W, 3) sRGB."""
    image = np.full((HEIGHT, WIDTH, 3), GREY)
    for mask, colour in things:
        image[mask] = colour
    noise = np.random.default_rng(0).normal(scale=2.5, size=(HEIGHT, WIDTH, 1))
    return np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)) + noise, 0, 255).astype(np.uint8)


def test_a_head_and_a_flank_that_a_pale_breast_joins_are_one():
    found = joined_pieces(picture((BREAST, PALE), (HEAD, ORANGE), (FLANK, ORANGE)), [HEAD, FLANK])
    assert found is not None and found[1] == [0, 1]
    whole = HEAD | BREAST | FLANK
    # The outline of what is drawn is smoothed over a pixel: 4 % of this area.
    assert (found[0] & whole).sum() > 0.92 * (found[0] | whole).sum()


@pytest.mark.parametrize("shade", [1.0, 0.6])
def test_two_of_a_kind_on_one_floor_are_two_also_where_a_shadow_lies_between(shade):
    left, right = ellipse(50, 70, 18, 18), ellipse(110, 70, 18, 18)
    between = ellipse(80, 80, 46, 8)
    image = picture((between, tuple(v * shade for v in GREY)), (left, ORANGE), (right, ORANGE))
    assert joined_pieces(image, [left, right]) is None


def test_two_on_a_board_stay_two():
    left, right, board = ellipse(50, 60, 18, 18), ellipse(110, 60, 18, 18), ellipse(80, 78, 60, 12)
    assert joined_pieces(picture((board, PALE), (left, ORANGE), (right, ORANGE)), [left, right]) is None


def test_pieces_of_different_colours_stay_apart():
    image = picture((BREAST, PALE), (HEAD, ORANGE), (FLANK, (40.0, 60, 150)))
    assert joined_pieces(image, [HEAD, FLANK]) is None


def test_what_lies_in_the_whole_is_no_thing_beside_it_and_what_is_left_aside_joins_nothing():
    image = picture((BREAST, PALE), (HEAD, ORANGE), (FLANK, ORANGE))
    paw, far = ellipse(70, 96, 6, 5), ellipse(140, 30, 8, 8)
    masks, scores = in_one_piece(image, [HEAD, FLANK, paw, far], [0.98, 0.99, 0.6, 0.7], 0.79)
    assert len(masks) == 2 and scores == [0.99, 0.7] and (masks[1] == far).all()
    masks, scores = in_one_piece(image, [HEAD, FLANK], [0.98, 0.7], 0.79)
    assert len(masks) == 2 and scores == [0.98, 0.7]


def test_single_things_and_many_things_are_not_searched():
    image = picture((HEAD, ORANGE))
    assert joined_pieces(image, [HEAD]) is None
    assert joined_pieces(image, [ellipse(20 + 30 * i, 60, 8, 8) for i in range(4)]) is None
