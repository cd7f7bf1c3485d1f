# SPDX-License-Identifier: MIT
"""Parts of the ground's tone, gaps and rods: on drawn photos with known answers."""

import numpy as np
import pytest
from physgen.batch.demo import shipped_photo
from physgen.sim.reconstruct.segmentation.box_segmentation import segment
from PIL import Image
from scipy import ndimage

WIDTH, HEIGHT = 320, 240


def table(seed=0):
    """A wall of pale plaster above brown boards."""
    rng = np.random.default_rng(seed)
    streaks = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), (0.7, 12)) * 40
    image = np.array([120.0, 80, 55]) + (streaks + rng.normal(scale=3, size=(HEIGHT, WIDTH)))[..., None]
    image[:90] = np.array([208.0, 203, 192]) + rng.normal(scale=2, size=(90, WIDTH, 1))
    return image


def finished(image):
    return np.clip(ndimage.gaussian_filter(image, (0.6, 0.6, 0)), 0, 255).astype(np.uint8)


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


def book(spine):
    """A dark cover, and beside it a spine of the colour ``spine``."""
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[98:210, 110:230] = True
    image = table()
    image[98:210, 130:230] = (35, 32, 40)
    image[98:210, 110:130] = spine
    image[130:160, 160:200] = (180, 60, 40)
    return finished(image), truth


@pytest.mark.parametrize("spine", [(212.0, 205, 192), (225.0, 220, 212)])
def test_a_spine_of_the_wall_s_colour_is_kept(spine):
    photo, truth = book(spine)
    told = []
    mask = segment(photo, (95, 75, 245, 222), "book", warn=told.append)
    assert mask[102:206, 113:128].mean() > 0.95
    assert overlap(mask, truth) > 0.96
    assert not any("contour of its own" in line for line in told)


def test_a_neighbour_is_not_swallowed_and_a_shadow_neither():
    image = table()
    image[60:200, 130:230] = (35, 32, 40)
    image[150:198, 100:130] = (214, 206, 195)
    # A shadow with a sharp border beside it on the other side.
    image[160:205, 230:262] *= 0.6
    mask = segment(finished(image), (88, 48, 275, 215), "book")
    assert mask[155:195, 103:126].mean() < 0.1
    assert mask[165:200, 236:258].mean() < 0.1
    assert mask[64:196, 134:226].mean() > 0.97


def chair():
    """A frame with slats; the wall and the boards show between them."""
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[40:210, 100:108] = truth[40:210, 212:220] = True
    truth[40:50, 100:220] = truth[120:135, 100:220] = True
    for x in range(122, 210, 18):
        truth[50:120, x : x + 6] = True
    image = table(2)
    image[truth] = (70, 95, 130)
    return finished(image), truth


def test_the_gaps_between_slats_stay_open():
    photo, truth = chair()
    mask = segment(photo, (85, 28, 235, 222), "chair")
    between = ndimage.binary_erosion(~truth[54:116, 110:210], iterations=2)
    below = ~truth[140:205, 112:208]
    assert mask[54:116, 110:210][between].mean() < 0.1
    assert mask[140:205, 112:208][below].mean() < 0.05
    assert overlap(mask, truth) > 0.85
    assert mask[ndimage.binary_erosion(truth)].mean() > 0.95


def test_the_inside_of_a_cup_is_no_gap_though_it_has_the_tables_colour():
    photo = np.asarray(Image.open(shipped_photo("coffee")).convert("RGB"))
    mask = segment(photo, (70, 12, 488, 392), "cup")
    assert not (ndimage.binary_fill_holes(mask) & ~mask).any()
    assert mask[40:180, 190:390].mean() > 0.97


def test_letters_of_the_ground_s_colour_are_no_gaps():
    image = table(3)
    image[60:200, 110:230] = (45, 60, 110)
    for row in range(5):
        for column in range(6):
            y, x = 80 + 22 * row, 122 + 17 * column
            image[y : y + 10, x : x + 4] = (122, 82, 57)
    mask = segment(finished(image), (95, 48, 245, 212), "poster")
    assert mask[64:196, 114:226].mean() > 0.98


def test_a_thin_rod_survives():
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[150:205, 120:200] = True
    truth[60:150, 158:162] = True
    image = table(4)
    image[truth] = (40, 110, 60)
    mask = segment(finished(image), (100, 45, 220, 218), "lamp")
    assert mask[64:148, 159:161].mean() > 0.9
    assert overlap(mask, truth) > 0.93


def armchair(leg):
    """A seat of blue cloth before a pale wall and floor, on legs 5 pixels wide and 30 long of the colour ``leg``."""
    legs = np.zeros((HEIGHT, WIDTH), bool)
    for x in (114, 160, 206):
        legs[160:190, x : x + 5] = True
    image = np.full((HEIGHT, WIDTH, 3), (214.0, 212, 218))
    image[150:] = (203, 202, 208)
    image += np.random.default_rng(5).normal(scale=2, size=(HEIGHT, WIDTH, 1))
    image[60:160, 105:220] = (58, 84, 128)
    image[legs] = leg
    return image, legs


@pytest.mark.parametrize("leg", [(176, 140, 96), (150, 100, 60)])
def test_legs_of_a_colour_that_the_seat_has_nowhere_carry_it(leg):
    image, legs = armchair(leg)
    mask = segment(finished(image), (90, 45, 236, 202), "chair")
    assert mask[ndimage.binary_erosion(legs)].mean() > 0.9
    assert mask[165:185, 125:155].mean() < 0.05
    assert mask[64:156, 110:215].mean() > 0.97


def test_a_strip_of_shade_and_a_post_beside_are_no_legs():
    image, _ = armchair((112, 111, 114))
    # A post that stands behind goes on above the seat's foot.
    image[90:190, 222:227] = (176, 140, 96)
    mask = segment(finished(image), (90, 45, 236, 202), "seat")
    assert mask[164:190].mean() < 0.01


def winged(seed=0):
    """A yellow body with a grey wing that reaches its outline at the left, on grey ground in whose shade the wing would
    not stand out, and the body's shadow."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    image = np.full((HEIGHT, WIDTH, 3), (176.0, 174, 178)) + rng.normal(scale=2, size=(HEIGHT, WIDTH, 1))
    body = ((columns - 165) / 62) ** 2 + ((rows - 115) / 52) ** 2 < 1
    # Below the body, with a soft border as a wide lamp makes it.
    shadow = ((columns - 150) / 80) ** 2 + ((rows - 172) / 16) ** 2 < 1
    image *= 1.0 - 0.45 * ndimage.gaussian_filter(shadow.astype(float), 9.0)[..., None]
    image[body] = (226, 186, 62)
    wing = body & (((columns - 128) / 62) ** 2 + ((rows - 118) / 28) ** 2 < 1)
    image[wing] = (112, 112, 120)
    image += rng.normal(scale=1.0, size=(HEIGHT, WIDTH, 1))
    return finished(image), body, wing, shadow & ~body


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wing_of_the_shaded_ground_s_colour_is_kept_and_the_shadow_below_is_not(seed):
    photo, body, wing, shadow = winged(seed)
    mask = segment(photo, (88, 48, 250, 195), "bird")
    assert mask[wing].mean() > 0.95
    assert mask[shadow].mean() < 0.1
    assert overlap(mask, body) > 0.95


def shoe(seed, *, lined):
    """A cream shoe on asphalt; its opening (h, w) within a pale rim is lined in the asphalt's grey, but smooth,
    or shows asphalt."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    grain = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 0.8)
    image = np.full((HEIGHT, WIDTH, 3), (108.0, 107, 110)) + 28.0 * (grain / grain.std())[..., None]
    body = ((columns - 160) / 95) ** 2 + ((rows - 130) / 50) ** 2 < 1
    opening = ((columns - 120) / 42) ** 2 + ((rows - 88) / 22) ** 2 < 1
    image[body] = (214, 204, 186)
    if lined:
        rim = ndimage.binary_dilation(opening, iterations=8) & ~body
        image[rim] = (230, 228, 224)
        image[opening] = (104, 103, 106)
    else:
        image[opening & body] = np.roll(image, 110, axis=0)[opening & body]
    image += rng.normal(scale=1.0, size=(HEIGHT, WIDTH, 1))
    return finished(image), body, opening


@pytest.mark.parametrize("seed", [0, 1])
def test_a_smooth_lining_of_the_asphalt_s_grey_belongs_to_the_shoe(seed):
    photo, body, opening = shoe(seed, lined=True)
    mask = segment(photo, (52, 52, 268, 194), "shoe")
    assert mask[opening].mean() > 0.9
    assert overlap(mask, body | opening) > 0.93


@pytest.mark.parametrize("seed", [0, 1])
def test_asphalt_in_a_bay_of_a_shoe_stays_asphalt(seed):
    photo, body, opening = shoe(seed, lined=False)
    mask = segment(photo, (52, 52, 268, 194), "shoe")
    assert mask[opening].mean() < 0.15
    assert overlap(mask, body & ~opening) > 0.9
