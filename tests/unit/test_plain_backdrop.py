# SPDX-License-Identifier: MIT
"""Things before white paper and studio backdrops: found whole, and with what colour alone would leave behind."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.reconstruct_options import Proposal
from physgen.sim.reconstruct.segmentation.box_segmentation import segment
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes
from physgen.sim.reconstruct.segmentation.plain_backdrop import (
    missing_parts,
    on_blank_page,
    plain_backdrop,
    remnants,
    things_before_backdrop,
)

HEIGHT, WIDTH = 240, 320
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
WHITE = (252, 252, 252)


def ellipse(x, y, across, down):
    return ((COLUMNS - x) / across) ** 2 + ((ROWS - y) / down) ** 2 < 1


def sweep():
    """A studio's grey sweep: a wall that grows darker, a paler floor, and a soft edge between them."""
    floor = 1.0 / (1.0 + np.exp(-(ROWS - 170.0) / 12.0))
    return (150.0 + 45.0 * floor - 0.05 * COLUMNS)[..., None] * np.array([1.0, 1.0, 0.99])


def photo(background, things, seed=0):
    """``background`` (H, W, 3) or a colour with ``things`` (mask, colour) on it, blurred and noisy as by a camera."""
    picture = np.broadcast_to(np.asarray(background, float), (HEIGHT, WIDTH, 3)).copy()
    for mask, colour in things:
        picture[mask] = colour
    noise = np.random.default_rng(seed).normal(0.0, 1.0, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8) + noise, 0, 255).astype(np.uint8)


def soft_shadow(background, x, y):
    """``background`` with a soft shadow around (x, y)."""
    depth = 0.5 * np.exp(-(((COLUMNS - x) / 60.0) ** 2) - ((ROWS - y) / 14.0) ** 2)
    return np.broadcast_to(np.asarray(background, float), (HEIGHT, WIDTH, 3)) * (1.0 - depth)[..., None]


def holds(box, mask):
    """Whether ``box`` is a loose one around all of ``mask``, and around little more."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    x0, y0, x1, y1 = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    around = box[0] <= x0 and box[1] <= y0 and box[2] >= x1 and box[3] >= y1
    return around and (box[2] - box[0]) * (box[3] - box[1]) < 1.6 * (x1 - x0) * (y1 - y0)


BODY, HEAD = ellipse(160, 150, 55, 60), ellipse(160, 75, 70, 45)
TOY = BODY | HEAD


def toy(background=WHITE):
    """A plush toy: its pale face and its dark band stand out from it more than some of it does from the page."""
    things = [(BODY, (120, 190, 200)), (HEAD, (60, 170, 190)), (ellipse(160, 88, 40, 24), (245, 205, 185))]
    return photo(background, [*things, (ellipse(160, 150, 25, 12), (40, 40, 50))])


@pytest.mark.parametrize("background", [WHITE, sweep(), soft_shadow(WHITE, 160, 212)], ids=["white", "studio", "shade"])
def test_a_thing_before_a_backdrop_is_found_whole_not_as_its_face(background):
    found = propose_boxes(toy(background))
    assert holds(found[0].box, TOY)
    assert all(item.score < 0.8 for item in found[1:])


def test_a_tiled_wall_and_a_room_are_no_backdrop():
    tiles = np.where(((ROWS // 24 + COLUMNS // 24) % 2)[..., None] > 0, 200.0, 150.0) * np.ones(3)
    assert plain_backdrop(toy(tiles)) is None
    grain = cv2.GaussianBlur(np.random.default_rng(1).normal(150.0, 60.0, (HEIGHT, WIDTH)), (0, 0), 1.0)
    assert plain_backdrop(toy(grain[..., None] * np.ones(3))) is None
    assert things_before_backdrop(toy(tiles), []) == []


def test_sweets_that_touch_are_told_apart_and_crumbs_are_none():
    sweets = [ellipse(x, 120, 26, 26) for x in (80, 130, 180)]
    colours = [(200, 40, 30), (30, 60, 190), (240, 200, 40)]
    picture = photo(WHITE, [*zip(sweets, colours, strict=True), (ellipse(280, 40, 5, 5), (30, 30, 30))])
    boxes = [Proposal((float(x - 28), 92.0, float(x + 28), 148.0), 0.9) for x in (80, 130, 180)]
    assert things_before_backdrop(picture, boxes) == boxes
    # Without them it is one contour.
    (one,) = things_before_backdrop(picture, [])
    assert holds(one.box, np.logical_or.reduce(sweets))


def test_a_thing_that_fills_the_photo_has_a_box_within_it():
    tall = ellipse(160, 120, 152, 112)
    picture = photo(WHITE, [(tall, (60, 90, 160))])
    (one,) = things_before_backdrop(picture, [])
    x0, y0, x1, y1 = (int(v) for v in one.box)
    assert (x1 - x0) * (y1 - y0) < 0.98 * WIDTH * HEIGHT
    mask = segment(picture, (x0, y0, x1, y1), "thing")
    assert (mask & tall).sum() > 0.95 * (mask | tall).sum()


EAR = ellipse(110, 45, 16, 26)
SHADOW = ellipse(225, 205, 60, 9) & ~TOY


def lacking(ear, shadow=(90, 90, 90), box=(60, 5, 300, 225)):
    """What a mask without the ear lacks before a grey sweep with a hard shadow."""
    picture = photo(sweep(), [(SHADOW, shadow), (EAR, ear), (TOY, (200, 110, 40))])
    return missing_parts(picture, TOY, box, plain_backdrop(picture))


@pytest.mark.parametrize("ear", [(45, 42, 40), (95, 95, 95), (235, 235, 235)], ids=["black", "grey", "white"])
def test_an_ear_of_the_backdrops_shade_is_added_and_its_shadow_is_not(ear):
    added, part = lacking(ear), EAR & ~TOY
    assert (added & part).sum() > 0.9 * part.sum()
    assert (added & ~cv2.dilate(part.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)).sum() == 0


def test_a_coloured_foot_is_added_and_what_leaves_the_box_is_not():
    assert (lacking((45, 42, 40), shadow=(40, 60, 160)) & SHADOW).sum() > 0.8 * SHADOW.sum()
    assert not (lacking((45, 42, 40), shadow=(40, 60, 160), box=(60, 5, 260, 225)) & SHADOW).any()


@pytest.mark.parametrize(("inset", "taken"), [(2, True), (12, False)])
def test_a_strap_that_goes_on_to_the_photos_border_is_added_where_the_box_ends_there_too(inset, taken):
    body = (np.abs(COLUMNS - 150) < 80) & (ROWS > 60) & (ROWS < 225)
    strap = (np.abs(np.hypot(COLUMNS - 226, ROWS - 130) - 84) < 10) & (COLUMNS > 226)
    leather = np.random.default_rng(1).normal((60, 40, 35), 25.0, (int(strap.sum()), 3))
    picture = photo(WHITE, [(strap, leather), (body, (110, 70, 50))])
    assert strap[:, -1].any()
    box = (60, 20, WIDTH - inset, 235)
    added = missing_parts(picture, body, box, plain_backdrop(picture))
    assert ((added & strap).sum() > 0.9 * (strap & ~body).sum()) == taken
    assert ((added & strap).sum() > 0.1 * strap.sum()) == taken


LEG = (np.abs(COLUMNS - 160) < 20) & (ROWS >= 40)
SOCK, SHOE = LEG & (ROWS >= 150) & (ROWS < 165), LEG & (ROWS >= 165) & (ROWS < 215)
DOLL = LEG & (ROWS < 215)


def doll(background=WHITE, gap=None):
    """A doll with a highlight, white socks, and shoes of an uneven grey as a shadow's; a ``gap`` shows the page."""
    grey = np.random.default_rng(2).normal(110.0, 20.0, (int(SHOE.sum()), 1)) * np.ones(3)
    things = [(DOLL, (190, 120, 90)), (SOCK, (236, 236, 238)), (SHOE, grey), (ellipse(160, 80, 9, 14), (247, 246, 245))]
    return photo(background, things if gap is None else [*things, (gap, background)])


def test_all_that_hangs_together_on_a_blank_page_is_the_thing_but_for_gaps():
    gap = (np.abs(COLUMNS - 160) < 8) & (np.abs(ROWS - 125) < 12)
    picture, seen = doll(gap=gap), DOLL & (ROWS < 145) & ~gap
    found = on_blank_page(picture, seen, (120, 30, 200, 225), plain_backdrop(picture))
    assert found is not None
    assert (found & DOLL & ~gap).sum() > 0.99 * (DOLL & ~gap).sum()
    assert (found & cv2.erode(gap.astype(np.uint8), np.ones((5, 5))).astype(bool)).sum() == 0
    assert (found & ~cv2.dilate(DOLL.astype(np.uint8), np.ones((7, 7))).astype(bool)).sum() == 0


def test_a_page_with_shading_is_not_blank_and_what_leaves_the_box_is_not_cut():
    seen = DOLL & (ROWS < 145)
    for background in (sweep(), soft_shadow(WHITE, 160, 212)):
        assert on_blank_page(doll(background), seen, (120, 30, 200, 225), plain_backdrop(doll(background))) is None
    picture = doll()
    assert on_blank_page(picture, seen, (120, 30, 200, 150), plain_backdrop(picture)) is None


def test_a_doll_on_a_blank_page_keeps_socks_and_shoes():
    mask = segment(doll(), (125, 28, 195, 228), "doll")
    assert (mask & DOLL).sum() > 0.98 * DOLL.sum()
    assert (mask & ~DOLL).sum() < 0.02 * DOLL.sum()


def test_a_mask_that_lacks_nothing_is_left_alone():
    picture = photo(sweep(), [(TOY, (200, 110, 40))])
    assert not missing_parts(picture, TOY, (60, 5, 300, 225), plain_backdrop(picture)).any()


def test_what_a_mask_lacks_above_its_foot_leaves_with_it_and_a_stand_stays():
    stand, ear = ellipse(160, 216, 70, 10) & ~TOY, EAR & ~TOY
    picture = photo(sweep(), [(stand, (240, 240, 240)), (EAR, (235, 235, 235)), (TOY, (200, 110, 40))])
    (beside,) = remnants(picture, [TOY])
    assert (beside & ear).sum() > 0.95 * ear.sum()
    assert not (beside & stand).any()
    grain = photo(sweep(), [(EAR, (235, 235, 235)), (TOY, (200, 110, 40))]).astype(float)
    grain += 20.0 * np.random.default_rng(2).normal(size=grain.shape)
    (none,) = remnants(np.clip(grain, 0, 255).astype(np.uint8), [TOY])
    assert not none.any()


def test_the_line_between_wall_and_floor_is_no_part_of_what_stands_before_it():
    wall = np.where(ROWS[..., None] < 110, 150.0, 195.0) * np.ones((1, 1, 3))
    (beside,) = remnants(photo(wall, [(EAR, (235, 235, 235)), (TOY, (200, 110, 40))]), [TOY])
    line = (np.abs(ROWS - 110) < 4) & (np.abs(COLUMNS - 160) > 100)
    assert (beside & EAR & ~TOY).sum() > 0.95 * (EAR & ~TOY).sum()
    assert not (beside & line).any()


def bag(background):
    """A bag of coarse cloth that the photo's left and lower border cut, with a strap."""
    body = (np.abs(COLUMNS - 90) < 92) & (ROWS > 100)
    strap = ellipse(215, 120, 40, 90) & ~ellipse(215, 120, 30, 78)
    whole = body | strap
    cloth = 70.0 + np.random.default_rng(1).normal(0.0, 30.0, (int(whole.sum()), 1))
    return photo(background, [(whole, cloth)]), whole


def test_a_thing_that_the_border_cuts_is_found_whole_on_a_white_page():
    picture, whole = bag(WHITE)
    assert plain_backdrop(picture) is not None
    found = things_before_backdrop(picture, [Proposal((180.0, 30.0, 260.0, 215.0), 0.9)])
    assert len(found) == 1
    assert holds(found[0].box, whole)


def test_the_box_of_a_thing_that_touches_all_sides_leaves_a_rim():
    whole = ellipse(160, 120, 162, 122)
    cloth = 70.0 + np.random.default_rng(1).normal(0.0, 30.0, (int(whole.sum()), 1))
    (found,) = things_before_backdrop(photo(WHITE, [(whole, cloth)]), [])
    x0, y0, x1, y1 = found.box
    # Above 0.98 a box is refused: it leaves nothing around the object.
    assert 0.9 < (x1 - x0) * (y1 - y0) / (WIDTH * HEIGHT) < 0.98


def test_a_grey_wall_or_a_white_sky_behind_what_the_border_cuts_is_no_page():
    assert plain_backdrop(bag((170, 170, 170))[0]) is None
    street = np.where(ROWS[..., None] < 190, 252.0, 120.0) * np.ones((1, 1, 3))
    house = (COLUMNS < 120) & (ROWS > 40)
    bricks = 70.0 + np.random.default_rng(1).normal(0.0, 30.0, (int(house.sum()), 1))
    assert plain_backdrop(photo(street, [(house, bricks)])) is None
