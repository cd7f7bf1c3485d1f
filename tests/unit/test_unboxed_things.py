# SPDX-License-Identifier: MIT
"""Things on the ground that nobody boxed stay, and are not copied into holes."""

import math

import cv2
import numpy as np
import pytest
import skimage.data
from physgen.sim.reconstruct.background.background_inpainting import fill_background
from physgen.sim.reconstruct.background.unboxed_things import unboxed_things
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.lighting.shadow_masks import cast_shadows, object_holes
from scipy import ndimage

WIDTH, HEIGHT = 240, 180
CAMERA = camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(50.0))
BOXED = ((102, 124, 23), (204, 125, 22), (154, 196, 21))
"""Three coins of scikit-image's photo: x, y, radius."""
NEIGHBOURS = ((153, 127, 15), (103, 196, 15), (212, 193, 17), (45, 124, 16))


def disc(x, y, radius, shape=(HEIGHT, WIDTH)):
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def plain(seed=0):
    noise = np.random.default_rng(seed).normal(scale=2.0, size=(HEIGHT, WIDTH, 1))
    return np.full((HEIGHT, WIDTH, 3), (150.0, 120.0, 90.0)) + noise


@pytest.mark.long
def test_coins_that_nobody_boxed_stay_and_are_no_source():
    grey = skimage.data.coins()
    pixels = np.repeat(grey[..., None], 3, axis=2)
    masks = [disc(*coin, grey.shape) for coin in BOXED]
    view = camera_above_ground(grey.shape[1], grey.shape[0], 410.0, math.radians(35.0))
    found = unboxed_things(pixels, masks, view)
    for coin in NEIGHBOURS:
        core = disc(*coin, grey.shape)
        assert (found.stay & core).sum() > 0.95 * core.sum()
        assert (found.whole & core).sum() > 0.95 * core.sum()
    assert not found.stay[np.logical_or.reduce(masks)].any()
    cast = cast_shadows(pixels, masks, view, found.stay)
    holes = object_holes(masks, [c.penumbra | c.expected for c in cast], 7.5, found.stay)
    union = np.logical_or.reduce(holes)
    assert not any((union & disc(*coin, grey.shape)).any() for coin in NEIGHBOURS)
    for mask, hole in zip(masks, holes, strict=True):
        assert (hole & mask).sum() == mask.sum()
    # One hole is filled: no coin grows in it.
    plate = fill_background(pixels, holes[0], masks[0], view, barred=found.whole | union & ~holes[0])
    around = cv2.dilate(holes[0].astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    ground = around & ~holes[0] & ~cv2.dilate(found.stay.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    assert np.percentile(plate[masks[0]], 99.0) < np.percentile(plate[ground], 99.0) + 15.0


def test_a_shadow_does_not_take_a_dark_thing_beside_the_object():
    picture = plain()
    thing, pen = disc(100, 90, 24), disc(146, 96, 12)
    picture[disc(122, 104, 22)] *= 0.5
    picture[thing], picture[pen] = (200.0, 60.0, 40.0), (40.0, 45.0, 120.0)
    found = unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [thing], CAMERA)
    assert (found.stay & pen).sum() > 0.9 * pen.sum()
    # The object's own shadow is no thing.
    shade = disc(122, 104, 22) & ~disc(146, 96, 16) & ~disc(100, 90, 27)
    assert (found.stay & shade).mean() == 0.0


def table_beside_a_ball():
    """A ball before a wall, and beside it a red table, of which the range that is looked at may cut a side: photo,
    masks of ball, table, and wall."""
    picture = plain()
    wall, table, ball = np.zeros((3, HEIGHT, WIDTH), bool)
    wall[:34] = True
    table[60:72, 132:], table[60:140, 132:142], table[60:140, 200:210] = True, True, True
    ball = disc(100, 96, 24)
    picture[wall], picture[table], picture[ball] = (90.0, 130.0, 170.0), (200.0, 40.0, 30.0), (40.0, 150.0, 60.0)
    return np.clip(picture, 0, 255).astype(np.uint8), ball, table, wall


def test_furniture_beside_an_object_stays_and_lends_no_colour():
    picture, ball, table, wall = table_beside_a_ball()
    found = unboxed_things(picture, [ball], CAMERA)
    assert (found.whole & table).sum() > 0.9 * table.sum()
    # Neither the ground under it nor the wall, which may go on behind the ball.
    around = cv2.dilate(table.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert not (found.stay & ~around).any() and not (found.stay & wall).any()
    # A hole that would take a leg.
    (hole,) = object_holes([ball], [disc(122, 110, 30)], 4.0, found.stay)
    assert not (hole & table).any()


def test_ground_beside_a_thing_has_the_ground_s_level_and_not_the_thing_s():
    picture, bar, hole = plain()[:72, :96], np.zeros((72, 96), bool), disc(36, 36, 16, (72, 96))
    bar[8:66, 48:56] = True
    picture[bar] = (200.0, 40.0, 30.0)
    view = camera_above_ground(96, 72, 100.0, math.radians(50.0))
    nothing = np.zeros_like(hole)
    plate = fill_background(np.clip(picture, 0, 255).astype(np.uint8), hole & ~bar, nothing, view, barred=bar)
    redder = plate[..., 0].astype(int) - plate[..., 1] - (150 - 120)
    assert redder[hole & ~bar].max() < 12


@pytest.mark.parametrize("pattern", ["checks", "stripes", "noise", "gradient"])
def test_the_pattern_of_the_ground_is_no_thing(pattern):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    value = {
        "checks": 60.0 * ((rows // 26 + columns // 26) % 2),
        "stripes": 60.0 * ((rows // 22) % 2),
        "noise": cv2.GaussianBlur(np.random.default_rng(1).normal(size=rows.shape), (0, 0), 4.0) * 150.0,
        "gradient": 0.3 * columns,
    }[pattern]
    picture = plain() + value[..., None] - 30.0
    thing = disc(120, 90, 22)
    picture[thing] = (30.0, 160.0, 60.0)
    assert not unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [thing], CAMERA).stay.any()


def test_what_an_object_hides_partly_goes_on_behind_it():
    picture = plain()
    saucer, cup = disc(120, 96, 40), disc(120, 84, 26)
    picture[saucer] = (235.0, 235.0, 240.0)
    picture[cup] = (60.0, 40.0, 160.0)
    found = unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [cup], CAMERA)
    assert (found.stay & saucer).sum() > 0.8 * (saucer & ~disc(120, 84, 29)).sum()
    assert not found.whole.any()


@pytest.mark.parametrize("horizon", [-60.0, 20.0])
def test_a_wall_is_no_thing_even_below_a_wrong_horizon(horizon):
    picture = plain()
    wall = np.mgrid[:HEIGHT, :WIDTH][0] < 62
    picture[wall] = (90.0, 110.0, 160.0)
    thing = disc(120, 80, 30)
    picture[thing] = (30.0, 160.0, 60.0)
    pitch = math.atan((90.0 - horizon) / 260.0)
    view = camera_above_ground(WIDTH, HEIGHT, 260.0, pitch)
    assert not unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [thing], view).stay.any()


def test_a_picture_of_one_tint_holds_nothing():
    """Rounding errors are no range of brightness: a filter so many bins wide takes 22 GB."""
    pixels = np.full((HEIGHT, WIDTH, 3), (128, 130, 140), np.uint8)
    view = camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(27.0))
    assert not unboxed_things(pixels, [disc(120, 90, 30)], view).stay.any()


def test_nothing_is_looked_for_without_an_object():
    found = unboxed_things(np.clip(plain(), 0, 255).astype(np.uint8), [np.zeros((HEIGHT, WIDTH), bool)], CAMERA)
    assert not found.stay.any()
    assert found.count == 0


def test_things_that_touch_are_things_one_by_one():
    # A chain of four, longer than any thing, from near the object to the border of the picture.
    picture = plain()
    places = ((104, 90, 20), (142, 78, 20), (172, 100, 17), (209, 92, 20))
    colours = ((40, 45, 120), (30, 110, 40), (200, 180, 30), (20, 20, 20))
    thing = disc(60, 90, 20)
    picture[thing] = (200.0, 60.0, 40.0)
    for place, colour in zip(places, colours, strict=True):
        picture[disc(*place)] = colour
    found = unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [thing], CAMERA)
    for place in places[:3]:
        assert (found.stay & disc(*place)).sum() > 0.9 * disc(*place).sum()
    # The ground between them is none.
    assert not (found.stay & ~np.logical_or.reduce([disc(x, y, r + 3) for x, y, r in places])).any()


def test_a_thing_on_the_border_of_the_range_stays_whole():
    picture = plain()
    thing, far = disc(40, 90, 12), disc(108, 90, 22)
    picture[thing], picture[far] = (200.0, 60.0, 40.0), (40.0, 45.0, 120.0)
    found = unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [thing], CAMERA)
    assert (found.stay & far).sum() > 0.9 * far.sum()


def test_silver_coins_on_white_that_touch_stay_each():
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:300, :400] + 0.5
    pixels = np.full((300, 400, 3), 244.0)
    discs = [np.hypot(columns - x, rows - y) < 37 for y in (70, 146) for x in (60, 135, 210, 285)]
    for mask in discs:
        pixels[mask] = 225 + 25 * np.sign(np.sin(0.5 * columns[mask]))[:, None]
        pixels[mask & ~ndimage.binary_erosion(mask, iterations=3)] = 120
    pixels = ndimage.gaussian_filter(pixels + rng.normal(scale=2, size=pixels.shape), (0.7, 0.7, 0))
    view = camera_above_ground(400, 300, 400.0, np.radians(80))
    found = unboxed_things(np.clip(pixels, 0, 255).astype(np.uint8), [discs[1]], view)
    for mask in discs[:1] + discs[2:]:
        # Circles are found on a grid of 1.5 pixels: a sickle of that width is 4 % of the coin.
        assert min((found.stay & mask).sum(), (found.whole & mask).sum()) > 0.95 * mask.sum()
    assert not (found.stay & discs[1]).any()


def test_dominoes_that_stand_before_a_wall_stay_whole():
    """The shadow of each reaches the next."""
    rows = np.mgrid[:HEIGHT, :WIDTH][0]
    picture = np.where((rows > 120)[..., None], (46.0, 48.0, 58.0), (6.0, 8.0, 9.0))
    picture[128:140, 28:] = (8.0, 9.0, 11.0)
    masks = []
    for i in range(6):
        mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        corners = [(20 + 36 * i, 70), (30 + 36 * i, 72), (28 + 36 * i, 142), (18 + 36 * i, 140)]
        cv2.fillPoly(mask, [np.asarray(corners, np.int32)], 1)
        masks.append(mask > 0)
        picture[masks[-1]] = (205.0, 200.0, 182.0)
    noise = np.random.default_rng(0).normal(scale=1.5, size=picture.shape)
    pixels = np.clip(cv2.GaussianBlur(picture + noise, (0, 0), 0.7), 0, 255).astype(np.uint8)
    view = camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(8.0))
    found = unboxed_things(pixels, [masks[1], masks[4]], view)
    for i in (0, 2, 3, 5):
        assert (found.stay & masks[i]).sum() > 0.9 * masks[i].sum()
    assert not found.stay[masks[1] | masks[4]].any()


@pytest.mark.parametrize("upside_down", [True, False])
def test_a_mirror_image_in_polished_ground_is_no_thing(upside_down):
    """A can's image in ice stayed in the photo when the can had left; another can before it stays."""
    picture = plain()
    can, below = np.zeros((2, HEIGHT, WIDTH), bool)
    can[40:90, 100:130], below[92:142, 100:130] = True, True
    label = np.zeros((50, 30, 3))
    label[:16], label[16:34], label[34:] = (210.0, 205.0, 60.0), (30.0, 120.0, 200.0), (200.0, 60.0, 40.0)
    picture[can] = label.reshape(-1, 3)
    image = label[::-1] if upside_down else label
    picture[below] = 0.6 * picture[below] + 0.4 * image.reshape(-1, 3)
    stay = unboxed_things(np.clip(picture, 0, 255).astype(np.uint8), [can], CAMERA).stay
    assert (stay & below).sum() == 0 if upside_down else (stay & below).sum() > 0.5 * below.sum()
