# SPDX-License-Identifier: MIT
"""What both sides of a thing show: parts that its mask lacks come back, shadows and patterns of the ground do not."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.mirrored_outline import mirrored_outline

HEIGHT, WIDTH = 360, 320
BOX = (80, 40, 240, 330)
GROUND, METAL = (150, 146, 140), (168, 164, 158)
NOTHING = np.zeros((HEIGHT, WIDTH), dtype=bool)


def drawn(*shapes):
    """Mask (H, W) of ellipses and rectangles x0, y0, x1, y1."""
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    for kind, x0, y0, x1, y1 in shapes:
        if kind == "disc":
            cv2.ellipse(image, ((x0 + x1) // 2, (y0 + y1) // 2), ((x1 - x0) // 2, (y1 - y0) // 2), 0, 0, 360, 1, -1)
        else:
            image[y0:y1, x0:x1] = 1
    return image > 0


BODY = drawn(("disc", 100, 60, 220, 84), ("box", 100, 72, 221, 270), ("disc", 100, 258, 220, 282))
FOOT = drawn(("box", 112, 270, 209, 290), ("disc", 112, 282, 208, 300)) & ~BODY
BADGE = drawn(("box", 196, 110, 222, 170)) & BODY


def photo(*, grain=0.0):
    """A blue can with a dark badge at its right side, before a dark wall, on a foot of the ground's tone."""
    random = np.random.default_rng(3)
    pixels = np.empty((HEIGHT, WIDTH, 3))
    pixels[:], pixels[:200] = GROUND, (44, 46, 42)
    pixels += random.normal(0.0, 2.0 + grain, (HEIGHT, WIDTH, 1))
    for part, colour in ((BODY, (60, 140, 200)), (FOOT, METAL), (BADGE, (92, 88, 92))):
        pixels[part] = colour
    foot = cv2.morphologyEx(FOOT.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    pixels[foot & ~BODY] = (96, 92, 90)
    return pixels


def camera_of(pixels):
    return np.clip(cv2.GaussianBlur(pixels, (0, 0), 0.8), 0, 255).astype(np.uint8)


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


def found(pixels, mask):
    return mirrored_outline(camera_of(pixels), BOX, mask, NOTHING, NOTHING)


@pytest.mark.parametrize("lost", ["badge", "foot", "both"])
def test_parts_that_colours_lose_come_back(lost):
    whole = BODY | FOOT
    mask = whole & ~(BADGE if lost != "foot" else NOTHING) & ~(FOOT if lost != "badge" else NOTHING)
    assert overlap(mask, whole) < 0.965
    assert overlap(found(photo(), mask), whole) > 0.98


def test_much_that_one_side_lacks_comes_back_and_a_hole_does_not_hinder_it():
    """A can whose shoulder mirrors the ground: half of it is outside of the mask, some of the rest a hole in it."""
    whole, hole = BODY | FOOT, drawn(("box", 124, 160, 150, 200))
    mask = whole & ~drawn(("box", 160, 60, 222, 120)) & ~hole
    assert overlap(mask, mask[:, ::-1]) < 0.7
    assert overlap(found(photo(), mask) | hole, whole) > 0.98


def test_a_whole_mask_stays_as_it_is():
    whole = BODY | FOOT
    assert (found(photo(), whole) == whole).all()


def test_a_shadow_on_one_side_is_not_added():
    pixels, whole = photo(), BODY | FOOT
    shadow = drawn(("disc", 20, 262, 180, 312)) & ~whole
    pixels[shadow] *= 0.45
    assert not (found(pixels, whole) & shadow).any()


def test_no_outline_is_sought_on_a_rough_ground():
    """A mask that lacks its foot stays without it where edges like its outline lie everywhere."""
    pixels = photo(grain=60.0)
    pixels[FOOT] = pixels[FOOT][np.random.default_rng(5).permutation(int(FOOT.sum()))]
    assert overlap(found(pixels, BODY), BODY) > 0.99


def test_what_is_not_alike_left_and_right_stays_as_it_is():
    handle = drawn(("disc", 190, 120, 236, 230)) & ~drawn(("disc", 204, 140, 222, 210))
    boot = drawn(("box", 100, 60, 150, 300), ("box", 100, 250, 236, 300))
    pixels = photo()
    pixels[boot] = (200, 190, 150)
    assert (found(pixels, boot) == boot).all()
    pixels = photo()
    pixels[handle] = (60, 140, 200)
    cup = BODY | FOOT | handle
    assert (found(pixels, cup) & handle).sum() > 0.98 * handle.sum()
