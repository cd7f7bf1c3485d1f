# SPDX-License-Identifier: MIT
"""Which of overlapping candidates are whole objects."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.whole_objects import Candidate, stacked_parts, whole_objects

SHAPE = (120, 160)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]


def disc(x, y, radius):
    return (COLUMNS - x) ** 2 + (ROWS - y) ** 2 < radius**2


def block(x0, y0, x1, y1):
    mask = np.zeros(SHAPE, bool)
    mask[y0:y1, x0:x1] = True
    return mask


def chosen(masks, colours=(), scores=None, shade=()):
    """Masks of the whole objects among ``masks`` on an even floor with parts of other ``colours`` (mask, RGB)."""
    picture = np.full((*SHAPE, 3), (200, 180, 150), np.uint8)
    for mask, colour in colours:
        picture[mask] = colour
    lab = cv2.cvtColor(picture.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    scores = scores or [0.98] * len(masks)
    found = [Candidate(masks[i], scores[i], shade=i in shade) for i in range(len(masks))]
    return sorted(whole_objects(found, lab))


RED, BLUE = (190, 40, 30), (30, 50, 160)
FRONT, BEHIND = disc(60, 80, 22), block(70, 30, 120, 85)


def test_two_that_touch_are_two_and_one_before_another_is_not_part_of_it():
    beside = block(82, 62, 130, 100)
    assert chosen([FRONT | beside, FRONT, beside], [(FRONT, RED), (beside, BLUE)]) == [1, 2]
    hidden = BEHIND & ~FRONT
    assert chosen([FRONT | hidden, FRONT, hidden], [(hidden, BLUE), (FRONT, RED)]) == [1, 2]


def test_what_stands_on_another_part_is_a_part():
    head, body = disc(80, 40, 16), disc(80, 78, 26)
    for top, below in ((head, body & ~head), (head & ~body, body)):
        assert chosen([top | below, top, below], [(top, RED), (below, BLUE)]) == [0]


def test_the_faces_of_a_box_are_one_box():
    left, right = block(40, 40, 70, 90), block(70, 40, 120, 90)
    assert chosen([left | right, left, right], [(left, RED), (right, BLUE)]) == [0]


@pytest.mark.parametrize("shade", [0.5, 1.0])
def test_ground_beside_an_object_in_light_or_shade_is_no_part_of_it(shade):
    cast = ((COLUMNS - 100) / 40.0) ** 2 + ((ROWS - 100) / 10.0) ** 2 < 1
    shaded = tuple(int(v * shade**0.45) for v in (200, 180, 150))
    assert chosen([FRONT | cast, FRONT], [(cast & ~FRONT, shaded), (FRONT, RED)], [0.99, 0.97]) == [1]
    # The same shape of another colour belongs to it.
    assert chosen([FRONT | cast, FRONT], [(cast & ~FRONT, BLUE), (FRONT, RED)], [0.99, 0.97]) == [0]


def test_the_shadow_alone_is_no_object_beside_its_owner():
    cast = ((COLUMNS - 100) / 40.0) ** 2 + ((ROWS - 100) / 10.0) ** 2 < 1
    alone = cast & ~FRONT
    colours = [(alone, (150, 135, 112)), (FRONT, RED)]
    assert chosen([FRONT | cast, FRONT, alone], colours, [0.99, 0.97, 0.85], shade=[2]) == [1]


def test_a_lid_is_of_its_jar_and_what_stands_on_a_thing_or_beside_it_is_not():
    jar, lid, cup = block(40, 60, 90, 110), block(36, 40, 94, 60), block(50, 20, 70, 40)
    beside = block(90, 50, 120, 110)
    # A cup on a lid, a plate below a jar, and a neighbour are things of their own.
    assert stacked_parts([jar, cup, lid, beside]) == [[1], [2, 0], [3]]
    assert stacked_parts([block(20, 110, 130, 116), jar]) == [[0], [1]]
    # Three slices of one thing, in any order.
    slices = [block(40, y, 90, y + 20) for y in (60, 20, 40)]
    assert sorted(stacked_parts(slices)[0]) == [0, 1, 2]
    # A shelf's width apart they are two.
    assert stacked_parts([jar, block(40, 30, 90, 52)]) == [[0], [1]]
