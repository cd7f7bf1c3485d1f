# SPDX-License-Identifier: MIT
"""Segmentation and the filled background, on drawn photos with known answers."""

import cv2
import numpy as np
import pytest
from physgen.sim.composite.inpaint import FillOptions, inpaint
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.segmentation.box_crop import crop_around_box
from physgen.sim.reconstruct.segmentation.box_segmentation import check_distinct, pixel_box, segment
from physgen.sim.reconstruct.segmentation.ground_shade import without_ground
from physgen.sim.reconstruct.segmentation.mask_cleanup import drop_ground_shadow, fill_holes, settle_outline
from physgen.sim.reconstruct.segmentation.mask_geometry import largest_component
from scipy import ndimage

WIDTH, HEIGHT = 320, 240


def ground(seed=0):
    """Streaky, noisy boards."""
    rng = np.random.default_rng(seed)
    streaks = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), (0.7, 12)) * 60
    grain = rng.normal(scale=4, size=(HEIGHT, WIDTH))
    return np.clip(np.array([180.0, 150, 110]) + (streaks + grain)[..., None], 0, 255)


def disc(x, y, radius):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def paint(shapes, shadows=(), seed=0):
    """Photo with ``shapes`` (mask, colour) on the ground, darkened in ``shadows``."""
    image = ground(seed)
    for shadow in shadows:
        image[shadow] *= 0.45
    for mask, colour in shapes:
        noise = np.random.default_rng(seed + 1).normal(scale=6, size=(HEIGHT, WIDTH, 1))
        image = np.where(mask[..., None], np.asarray(colour, float) + noise, image)
    return np.clip(ndimage.gaussian_filter(image, (0.5, 0.5, 0)), 0, 255).astype(np.uint8)


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


@pytest.mark.parametrize("slack", [4, 25, 45])
def test_disc_is_found_in_tight_and_loose_boxes(slack):
    truth = disc(150, 120, 45)
    mask = segment(paint([(truth, (40, 80, 190))]), (105 - slack, 75 - slack, 195 + slack, 165 + slack), "ball")
    assert overlap(mask, truth) > 0.96


def test_same_photo_gives_the_same_mask():
    photo = paint([(disc(150, 120, 45), (40, 80, 190))])
    assert (segment(photo, (90, 60, 210, 180), "a") == segment(photo, (90, 60, 210, 180), "a")).all()


def test_print_is_filled_and_a_see_through_hole_stays():
    truth = disc(150, 120, 60)
    opening = disc(165, 120, 18)
    label = disc(120, 120, 12)
    photo = paint([(truth & ~opening, (40, 80, 190)), (label, (20, 200, 40))])
    mask = segment(photo, (80, 50, 220, 190), "ring")
    assert mask[label].all()
    assert mask[opening].mean() < 0.1


def test_pinholes_are_filled_whatever_their_colour():
    mask = disc(150, 120, 60)
    pierced = mask & ~disc(140, 110, 2)
    assert (fill_holes(paint([]), pierced) == mask).all()


def drawn(corners):
    filled = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillConvexPoly(filled, np.array(corners, np.int32), 1)
    return filled > 0


def test_a_slot_between_back_and_seat_stays_open_and_a_printed_line_does_not():
    chair = drawn([(100, 30), (220, 30), (220, 110), (100, 110)]) | drawn(
        [(80, 110), (240, 110), (240, 190), (80, 190)]
    )
    slot = drawn([(115, 104), (205, 104), (205, 108), (115, 108)])
    line = drawn([(115, 60), (205, 60), (205, 64), (115, 64)])
    photo = np.full((HEIGHT, WIDTH, 3), 250.0) + np.random.default_rng(6).normal(scale=1, size=(HEIGHT, WIDTH, 1))
    photo[chair & ~slot] = (95, 55, 40)
    photo[line] = (228, 222, 205)
    photo = np.clip(ndimage.gaussian_filter(photo, (0.5, 0.5, 0)), 0, 255).astype(np.uint8)
    filled = fill_holes(photo, chair & ~slot & ~line)
    assert filled[line].all() and not filled[slot].any()


def test_nothing_shows_through_a_box_whatever_the_colour_of_its_label():
    box = drawn([(70, 60), (130, 40), (250, 62), (240, 180), (215, 200), (80, 170)])
    label = drawn([(90, 80), (150, 86), (150, 130), (92, 122)])
    # The label is exactly as the ground is.
    photo = paint([(box & ~label, (40, 80, 190))])
    assert (fill_holes(photo, box & ~label) == box).all()
    # The opening of a frame is larger, and something round is no box.
    opening = drawn([(95, 75), (225, 85), (205, 170), (100, 150)])
    assert not fill_holes(paint([(box & ~opening, (40, 80, 190))]), box & ~opening)[opening].any()
    ring, hole = disc(150, 120, 60), disc(150, 120, 20)
    assert not fill_holes(paint([(ring & ~hole, (40, 80, 190))]), ring & ~hole)[hole].any()


def test_contact_shadow_is_not_part_of_the_object():
    truth = disc(150, 100, 45)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    # Darkest where it meets the object, fading away from it, as under anything that stands on a floor.
    away = ndimage.distance_transform_edt(~truth)
    cast = (((columns - 155) / 48) ** 2 + ((rows - 138) / 16) ** 2 < 1) & ~truth & (rows > 118)
    image = ground(2)
    image[cast] *= np.clip(0.2 + away[cast] / 25.0, 0, 0.8)[:, None]
    image[truth] = (60, 90, 200)
    photo = np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)
    cleaned = drop_ground_shadow(photo, truth | cast, most=0.3)
    assert cleaned[truth].mean() > 0.97
    # The crease itself may stay with the object, the shadow beyond it may not.
    beyond = cast & (away > 7) & (np.abs(columns - 150) < 35)
    assert cleaned[beyond].mean() < 0.3
    # Without a crease nothing is taken away.
    assert (drop_ground_shadow(paint([(truth, (40, 80, 190))]), truth) == truth).all()


def test_brown_legs_under_a_seat_on_white_are_no_shadow():
    seat, front = (
        drawn([(90, 20), (230, 20), (230, 158), (90, 158)]),
        drawn([(92, 150), (106, 150), (104, 220), (94, 220)]),
    )
    behind = drawn([(120, 150), (136, 150), (126, 204), (114, 204)])
    truth = seat | front | front[:, ::-1] | behind
    photo = np.full((HEIGHT, WIDTH, 3), 253.0)
    # The crease between the seat and its legs is dark.
    photo[truth] = (120, 80, 62)
    photo[152:159, 90:230] = (30, 19, 15)
    photo = np.clip(ndimage.gaussian_filter(photo, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)
    assert overlap(drop_ground_shadow(photo, truth), truth) > 0.995


def test_granite_around_a_smooth_top_is_no_shadow_on_ice():
    rng = np.random.default_rng(5)
    image = 232.0 + rng.normal(scale=2, size=(HEIGHT, WIDTH, 1)) + np.zeros(3)
    stone, top = disc(160, 120, 60), disc(160, 120, 44)
    image[stone] = np.clip(105.0 + 45 * rng.normal(size=(HEIGHT, WIDTH, 1)), 20, 220)[stone]
    image[top] = (225, 185, 30)
    photo = np.clip(ndimage.gaussian_filter(image, (0.6, 0.6, 0)), 0, 255).astype(np.uint8)
    assert overlap(segment(photo, (90, 50, 230, 190), "stone"), stone) > 0.95


def test_outline_settles_where_the_colours_mix_half_and_half():
    truth = disc(150, 120, 45)
    photo = paint([(truth, (40, 80, 190))])
    wide = ndimage.binary_dilation(truth, iterations=2)
    assert overlap(wide, truth) < 0.93
    assert overlap(settle_outline(photo, wide), truth) > 0.98


def test_largest_component_of_nothing_is_nothing():
    assert not largest_component(np.zeros((20, 20), bool)).any()


def test_objects_of_the_grounds_colour_fall_back_with_a_warning():
    told = []
    photo = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    mask = segment(photo, (100, 80, 200, 180), "ghost", warn=told.append)
    assert told
    assert 0.6 < mask.sum() / 1e4 < 0.9


def test_a_box_that_cuts_the_object_is_told():
    photo = paint([(disc(150, 120, 45), (40, 80, 190))])
    told = []
    segment(photo, (80, 100, 220, 200), "ball", warn=told.append)
    assert len(told) == 1
    assert "top" in told[0]
    told.clear()
    segment(photo, (80, 60, 220, 200), "ball", warn=told.append)
    assert not told


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((500, 10, 600, 60), "outside the photo"),
        ((-90, -90, -10, -10), "outside the photo"),
        ((50, 50, 50, 90), "no area"),
        ((90, 50, 50, 90), "no area"),
        ((50, 50, 52, 90), "too thin"),
    ],
)
def test_impossible_boxes(box, message):
    with pytest.raises(InputError, match=message):
        pixel_box(box, 1.0, WIDTH, HEIGHT, "thing")


def test_boxes_are_in_pixels_of_the_original():
    assert pixel_box((100, 200, 300, 400), 0.5, WIDTH, HEIGHT, "thing") == (50, 100, 150, 200)


def test_a_box_over_everything_is_refused():
    with pytest.raises(InputError, match="whole photo"):
        segment(paint([]), (0, 0, WIDTH, HEIGHT), "everything")


def test_the_same_object_twice_is_refused_and_neighbours_are_not():
    first, second = disc(100, 120, 40), disc(104, 122, 38)
    with pytest.raises(InputError, match="same object"):
        check_distinct([first, second], ["a", "b"])
    # A thing on another one lies within its outline.
    check_distinct([first, disc(100, 120, 10)], ["a", "b"])
    check_distinct([first, disc(170, 120, 38)], ["a", "b"])


@pytest.mark.parametrize("by_row", [False, True])
@pytest.mark.parametrize("limit", [2_800_000, 10_000])
def test_background_equals_the_photo_outside_the_hole(by_row, limit):
    mask = disc(150, 110, 35)
    photo = paint([(mask, (200, 30, 40))])
    hole = disc(150, 110, 45)
    options = FillOptions(by_row=by_row, limit=limit)
    result = inpaint(photo, hole, mask, options)
    assert (result[~hole] == photo[~hole]).all()
    # Nothing red is left, and the filling is as bright as the ground around it.
    assert (result[mask][:, 0].astype(int) - result[mask][:, 1]).max() < 90
    beside = disc(150, 110, 60) & ~hole
    assert np.abs(result[mask].mean(axis=0) - photo[beside].mean(axis=0)).max() < 15
    assert (inpaint(photo, hole, mask, options) == result).all()


def test_a_large_hole_keeps_the_grain():
    whole = np.kron(ground(3), np.ones((3, 3, 1)))
    whole = np.clip(whole + np.random.default_rng(5).normal(scale=8, size=whole.shape), 0, 255).astype(np.uint8)
    hole = np.zeros(whole.shape[:2], bool)
    hole[200:560, 300:700] = True
    result = inpaint(whole, hole, hole, FillOptions())

    def grain(pixels):
        grey = pixels.astype(float).mean(axis=2)
        return (grey - ndimage.gaussian_filter(grey, 1.5)).std()

    assert grain(result[220:540, 320:680]) > 0.6 * grain(whole[600:, 300:700])


def test_no_hole_and_no_background():
    photo = paint([])
    empty = np.zeros((HEIGHT, WIDTH), bool)
    assert (inpaint(photo, empty, empty) == photo).all()
    with pytest.raises(InputError, match="no background"):
        inpaint(photo, ~empty, ~empty)


def test_object_behind_another_keeps_both_its_parts_and_nothing_of_the_other():
    bar = disc(150, 120, 60) & (np.abs(np.arange(WIDTH) - 150) < 14)
    truth = disc(150, 120, 60) & ~bar
    photo = paint([(truth, (40, 80, 190)), (bar, (200, 60, 50))])
    mask = segment(photo, (75, 45, 225, 195), "ball", others=bar)
    assert not (mask & bar).any()
    assert overlap(mask, truth) > 0.95


def test_other_objects_that_fill_the_box_are_refused():
    with pytest.raises(InputError, match="fill its whole box"):
        segment(paint([]), (75, 45, 225, 195), "ball", others=np.ones((HEIGHT, WIDTH), bool))


def test_two_things_in_a_box_are_told_and_one_is_not():
    told = []
    first, second = disc(100, 120, 32), disc(200, 125, 28)
    photo = paint([(first, (40, 80, 190)), (second, (50, 90, 180))])
    mask = segment(photo, (55, 75, 245, 170), "balls", warn=told.append)
    assert any("two separate objects" in message for message in told)
    assert overlap(mask, first) > 0.9
    told.clear()
    segment(photo, (55, 75, 145, 170), "ball", warn=told.append)
    assert not told


def test_an_object_cut_by_the_photo_is_told():
    told = []
    mask = segment(paint([(disc(300, 120, 45), (40, 80, 190))]), (240, 60, 320, 180), "ball", warn=told.append)
    assert mask[:, -1].any()
    assert any("right edge of the photo" in message for message in told)
    assert not any("its box" in message for message in told)


def test_glass_is_told():
    truth = disc(150, 120, 45)
    photo = ground(4)
    rim = truth & ~disc(150, 120, 42)
    photo[rim] = 60.0
    photo = np.clip(ndimage.gaussian_filter(photo, (0.5, 0.5, 0)), 0, 255).astype(np.uint8)
    told = []
    segment(photo, (95, 65, 205, 175), "glass", warn=told.append)
    assert any("much like its surroundings" in message or "colour does not separate" in message for message in told)
    told.clear()
    segment(paint([(truth, (40, 80, 190))], seed=4), (95, 65, 205, 175), "ball", warn=told.append)
    assert not told


def test_contact_shadow_stays_on_the_ground():
    truth = disc(150, 110, 40)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    shadow = (((columns - 170) / 50) ** 2 + ((rows - 148) / 12) ** 2 < 1) & ~truth
    mask = segment(paint([(truth, (200, 60, 50))], [shadow]), (85, 55, 240, 175), "ball")
    assert overlap(mask, truth) > 0.93
    assert (mask & shadow).sum() < 0.15 * shadow.sum()


def toy_with_a_double_shadow(seed=0, height=240, width=320):
    """A pale ball on planks of warm wood under two lamps; shaded wood is redder, as it is lit by wood. Linear light."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width] + 0.5
    plank = rng.uniform(0.85, 1.15, 9)[(rows // 30).astype(int)] * (1.0 + 0.05 * np.sin(columns / 9.0 + rows / 3.0))
    wood = np.array([0.62, 0.27, 0.06]) * plank[..., None]
    shade = np.ones((height, width))
    for x, depth in ((178, 0.35), (128, 0.4)):
        dark = ((columns - x) / 62.0) ** 2 + ((rows - 176) / 26.0) ** 2
        shade *= 1.0 - (1.0 - depth) / (1.0 + np.exp(np.clip((dark - 1.0) * 14.0, -50, 50)))
    middle = np.exp(np.log(wood).mean(axis=2, keepdims=True))
    picture = middle * (wood / middle) ** (1.0 - 0.5 * np.log(shade))[..., None] * shade[..., None]
    ball = (columns - 155) ** 2 + (rows - 118) ** 2 < 58**2
    normal = np.clip(0.75 - (rows - 118) / 150.0 - (columns - 155) / 300.0, 0.2, 1.0)
    picture[ball] = (np.array([0.9, 0.78, 0.62]) * normal[..., None])[ball]
    noisy = np.clip(picture, 0.0, 1.0) ** (1.0 / 2.2) + rng.normal(0.0, 0.01, (height, width, 3))
    soft = cv2.GaussianBlur(np.clip(noisy, 0.0, 1.0), (0, 0), 0.7)
    return np.round(255.0 * soft).astype(np.uint8), ball, (shade < 0.7) & ~ball


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("box", [(88, 52, 222, 186), (70, 40, 250, 210)])
def test_a_box_around_object_and_shadow_yields_the_object(box, seed):
    pixels, ball, shadow = toy_with_a_double_shadow(seed)
    found = segment(pixels, box, "toy")
    assert (found & ball).sum() / (found | ball).sum() > 0.95
    assert (found & shadow).sum() < 0.02 * shadow.sum()


def ball_on_polished_planks(seed, height=240, width=320):
    """A white ball, its shadow, and its mirror image within that: light that the wood has not coloured. Linear."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width] + 0.5
    plank = rng.uniform(0.85, 1.15, 9)[(rows // 30).astype(int)] * (1.0 + 0.05 * np.sin(columns / 9.0 + rows / 3.0))
    wood = np.array([0.62, 0.27, 0.04]) * plank[..., None]
    dark = ((columns - 155) / 95.0) ** 2 + ((rows - 176) / 36.0) ** 2
    shade = (1.0 - 0.6 / (1.0 + np.exp(np.clip((dark - 1.0) * 14.0, -50, 50))))[..., None]
    middle = np.exp(np.log(wood).mean(axis=2, keepdims=True))
    image = ((columns - 155) / 50.0) ** 2 + ((rows - 174) / 32.0) ** 2 < 1
    mirrored = cv2.GaussianBlur(0.035 * image, (0, 0), 1.5)[..., None]
    picture = middle * (wood / middle) ** (1.0 - 0.5 * np.log(shade)) * shade + mirrored
    ball = (columns - 155) ** 2 + (rows - 108) ** 2 < 58**2
    normal = np.clip(0.75 - (rows - 108) / 150.0 - (columns - 155) / 300.0, 0.2, 1.0)
    picture[ball] = (np.array([0.9, 0.78, 0.62]) * normal[..., None])[ball]
    noisy = np.clip(picture, 0.0, 1.0) ** (1.0 / 2.2) + rng.normal(0.0, 0.01, (height, width, 3))
    soft = cv2.GaussianBlur(np.clip(noisy, 0.0, 1.0), (0, 0), 0.7)
    return np.round(255.0 * soft).astype(np.uint8), ball, image & ~ball, (shade[..., 0] < 0.7) & ~ball


@pytest.mark.parametrize(("seed", "end"), [(0, 165), (1, 185)])
def test_a_mirror_image_in_the_shade_is_ground_where_more_of_it_shows_beside(seed, end):
    pixels, ball, image, shadow = ball_on_polished_planks(seed)
    view = crop_around_box(pixels, (60, 30, 250, 225), np.zeros_like(ball))
    taken = (image | shadow) & (np.arange(320) < end)
    found = without_ground(view, ball | taken, polished=True)
    assert overlap(found, ball) > 0.98
    # The whole image, and no polish beside it: what is no shade of the ground may be a white foot.
    assert without_ground(view, ball | image | shadow, polished=True)[image].mean() > 0.95
    # It is no ground in the shade alone.
    assert without_ground(view, ball | taken)[image & taken].mean() > 0.95


def test_black_wheels_with_pale_hubs_are_no_shadow_of_the_car():
    body = drawn([(80, 110), (130, 85), (200, 85), (240, 112), (240, 150), (80, 150)])
    wheels, hubs = (disc(115, 150, r) | disc(205, 150, r) for r in (20, 9))
    cast = drawn([(72, 156), (245, 156), (245, 171), (72, 171)])
    image = np.array([105.0, 120, 135]) + (ground(3) - ground(3).mean(axis=(0, 1)))
    image[cast] *= 0.12
    image[body] = (225, 170, 20)
    image[wheels] = (12, 15, 19)
    image[hubs] = (150, 160, 170)
    photo = np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)
    mask = segment(photo, (60, 70, 260, 185), "car")
    assert mask[wheels].mean() > 0.95 and mask[body].mean() > 0.97
    # The shadow that joins them may stay, the ground beyond it may not.
    assert mask[~(body | wheels | cast)].sum() < 0.03 * mask.sum()


def test_a_hard_shadow_whose_edge_is_the_strongest_is_none_of_the_object():
    """On pale rock in the sun: the ball is dark where its shadow begins, the rock beyond it bright."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ball = disc(200, 120, 50)
    shadow = (((columns - 140) / 90) ** 2 + ((rows - 152) / 17) ** 2 < 1) & ~ball
    image = np.array([165.0, 170, 172]) + (ground(3) - ground(3).mean(axis=(0, 1)))
    image[shadow] *= np.array([0.19, 0.2, 0.22])
    side = np.clip(0.5 + (columns - 200) / 100.0 - (rows - 120) / 120.0, 0.3, 1.0)[..., None]
    image = np.where(ball[..., None], np.array([250.0, 205, 20]) * side, image)
    photo = np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)
    view = crop_around_box(photo, (45, 62, 256, 176), np.zeros_like(ball))
    assert overlap(without_ground(view, ball | shadow), ball) > 0.97
    # As dark a sole is lower than the rest.
    sole = disc(200, 155, 40) & (rows > 160) & (rows < 180)
    photo[sole] = (33, 34, 36)
    assert without_ground(view, ball | sole)[sole].mean() > 0.95


def test_a_brown_thing_on_brown_wood_is_not_given_back_to_the_ground():
    pixels, ball, _ = toy_with_a_double_shadow(2)
    # A lump of clay of nearly the wood's hue, as dark as its shadow.
    lump = np.round(pixels * np.array([0.62, 0.75, 0.9])).astype(np.uint8)
    pixels[ball] = lump[ball]
    found = segment(pixels, (88, 52, 222, 186), "clay")
    assert (found & ball).sum() / (found | ball).sum() > 0.9


def test_pale_dial_that_the_rows_beside_do_not_show_is_no_hole():
    """The colour of ground near by is not enough: what shows through goes on left and right of the object."""
    photo = np.full((HEIGHT, WIDTH, 3), (150, 150, 150), np.uint8)
    photo[120:] = (205, 200, 190)
    ring = disc(160, 100, 60)
    dial = disc(160, 90, 20)
    photo[ring] = (20, 120, 120)
    pierced = photo.copy()
    photo[dial] = (205, 200, 190)
    pierced[dial] = (150, 150, 150)
    assert (fill_holes(photo, ring & ~dial) == ring).all()
    assert not fill_holes(pierced, ring & ~dial)[dial].any()


def toy_before_a_dark_wall(dark, end, seed=0, height=240, width=320):
    """A toy of nearly the floor's hue before a dark wall, and its left side up to ``end``, in its own shade ``dark``
    (linear light)."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width] + 0.5
    hue = np.array([1.0, 0.72, 0.45])
    picture = np.where((rows < 150)[..., None], 0.02 * hue, 0.3 * hue * rng.uniform(0.8, 1.2, (height, width, 1)))
    toy = (columns - 155) ** 2 + (rows - 118) ** 2 < 58**2
    side = toy & (columns < end)
    picture = np.where(toy[..., None], 0.5 * hue * np.array([1.0, 1.1, 1.2]), picture)
    picture = np.where(side[..., None], dark * hue, picture)
    noisy = np.clip(picture, 0.0, 1.0) ** (1.0 / 2.2) + rng.normal(0.0, 0.01, (height, width, 3))
    soft = cv2.GaussianBlur(np.clip(noisy, 0.0, 1.0), (0, 0), 0.7)
    return np.round(255.0 * soft).astype(np.uint8), toy, side


@pytest.mark.parametrize(("dark", "end"), [(0.06, 125), (0.1, 125), (0.15, 140)])
def test_a_toys_shaded_side_before_a_dark_wall_is_no_shadow(dark, end):
    pixels, toy, side = toy_before_a_dark_wall(dark, end)
    view = crop_around_box(pixels, (94, 56, 216, 180), np.zeros_like(toy))
    assert without_ground(view, toy)[side].mean() > 0.97
