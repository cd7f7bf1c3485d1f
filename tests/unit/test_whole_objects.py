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


def bark(mask, colour, seed=1):
    """A ``mask`` with its colours (h, w, 3): those of a rough surface of the mean ``colour``."""
    grain = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, SHAPE), (0, 0), 0.7)
    rough = np.array(colour) * (1.0 + 0.5 * grain[..., None])
    return mask, np.clip(rough, 0, 255).astype(np.uint8)[mask]


def test_a_tree_behind_that_goes_on_is_no_part_of_it_and_a_dark_top_is():
    """The rest of a candidate has edges along its outline wherever bark has them, but bark lies beyond it, too."""
    plush, tree = block(40, 40, 60, 102) | block(40, 82, 100, 102), block(56, 0, 150, 84)
    piece = block(60, 30, 110, 82)
    colours = [bark(tree, (110, 100, 90)), (plush, RED)]
    assert chosen([plush | piece, plush], colours, [0.96, 0.99]) == [1]
    # One that ends there belongs to it, and so does the pale wall around a print.
    assert chosen([plush | piece, plush], [bark(piece, (110, 100, 90)), (plush, RED)], [0.96, 0.99]) == [0]
    box, print_ = block(40, 30, 110, 110), block(50, 50, 100, 90)
    assert chosen([box, print_], [(box, (205, 186, 156)), (print_, RED)], [0.96, 0.99]) == [0]


def test_one_amid_what_the_border_cuts_is_the_thing():
    around = block(30, 0, 110, 90) | FRONT
    colours = [(around, (90, 110, 60)), (FRONT, RED)]
    assert chosen([around, FRONT], colours, [0.9, 0.98]) == [1]
    # A thing that the border does not cut has parts; and what the border cuts, clearer than those in it, too.
    whole = block(30, 10, 110, 90) | FRONT
    assert chosen([whole, FRONT], [(whole, (90, 110, 60)), (FRONT, RED)], [0.9, 0.98]) == [0]
    assert chosen([around, FRONT], colours, [0.98, 0.9]) == [0]


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
