# SPDX-License-Identifier: MIT
"""Ground in shadow keeps its own grain, and the level of a filling is that of its border."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.background.background_inpainting import blend, fill_background
from physgen.sim.reconstruct.background.relit_ground import continued, membrane, relit
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground

WIDTH, HEIGHT = 240, 180


def disc(x, y, radius):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def wood(seed, mean=130.0):
    """Brown grain along the rows, float32."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    grain = 60.0 * cv2.GaussianBlur(noise, (0, 0), sigmaX=5.0, sigmaY=0.8)
    return (np.float32(mean) + grain)[..., None] * np.array([1.1, 1.0, 0.7], np.float32)


def soft(mask, blur):
    return cv2.GaussianBlur(mask.astype(np.float32), (0, 0), blur)[..., None]


def correlation(first, second, where):
    parts = [(image - cv2.GaussianBlur(image, (0, 0), 4.0)).mean(axis=-1)[where] for image in (first, second)]
    return float(np.corrcoef(*parts)[0, 1])


def shaded_table():
    """A dark thing on wood with a soft shadow beside it: photo, truth, hole, thing, float32."""
    truth = wood(1) * np.linspace(0.8, 1.2, WIDTH, dtype=np.float32)[None, :, None]
    thing = disc(90, 80, 26)
    photo = truth * (1.0 - 0.3 * soft(disc(140, 105, 34), 6.0))
    photo[thing] = (20.0, 40.0, 120.0)
    return photo, truth, disc(140, 105, 54) | disc(90, 80, 36), thing


def test_light_is_not_put_back_in_colours_that_are_nowhere_around():
    """Above a plain table the room turns from grey to orange; a polynomial goes on from there to blue."""
    rows = np.arange(HEIGHT, dtype=np.float32)[:, None, None]
    turn = np.clip((60.0 - rows) / 60.0, 0.0, 1.0)
    truth = 130.0 * np.exp(turn * np.array([0.3, 0.0, -0.8], np.float32)).repeat(WIDTH, axis=1)
    truth += np.random.default_rng(0).normal(scale=2.0, size=(HEIGHT, WIDTH, 1)).astype(np.float32)
    hole, thing = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), bool)
    hole[62:, 24:], thing[62:150, 110:180] = True, True
    photo = truth * (1.0 - 0.15 * soft(hole, 5.0))
    photo[thing] = (200.0, 200.0, 205.0)
    given, left = relit(photo, hole, np.zeros_like(hole), thing)
    # The shadow itself is 20 of 255, and the noise at most 8.
    assert np.abs(given - truth)[hole & ~left].max(initial=0.0) < 28.0


def test_a_membrane_continues_a_slope_and_stays_away_from_what_touches_nothing():
    slope = (0.3 * np.arange(40)[None, :] + 0.1 * np.arange(30)[:, None]).astype(np.float32)[..., None]
    free = np.zeros((30, 40), dtype=bool)
    free[8:20, 10:30] = True
    known = ~free
    given = np.where(known[..., None], slope, np.float32(0.0))
    assert np.abs(membrane(given, known, free) - slope).max() < 1e-3
    # Alone, with nothing to continue from.
    assert np.abs(membrane(given, np.zeros_like(free), free)[free]).max() < 1e-3


def test_a_membrane_over_a_large_picture_is_that_of_the_small_one():
    rows, columns = np.mgrid[:600, :800]
    slope = (1e-3 * columns + 5e-4 * rows).astype(np.float32)[..., None]
    free = (rows - 300) ** 2 + (columns - 400) ** 2 < 200**2
    rim = free & (cv2.erode(free.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0)
    found = continued(np.where(rim[..., None], slope, np.float32(0.0)), rim, free)
    assert np.abs(found - slope)[free].max() < 0.02


@pytest.mark.long
def test_ground_in_shadow_keeps_its_grain():
    photo, truth, hole, thing = shaded_table()
    given, left = relit(photo, hole, np.zeros_like(hole), thing)
    assert left[thing].all()
    assert not left[~hole].any()
    assert np.array_equal(given[~hole], photo[~hole])
    kept = hole & ~left
    assert kept.sum() > 0.5 * (hole & ~disc(90, 80, 36)).sum()
    assert correlation(given, truth, kept) > 0.85
    shaded = kept & disc(140, 105, 30)
    assert np.abs(photo - truth)[shaded].mean() > 25.0
    assert np.abs(given - truth)[shaded].mean() < 10.0
    camera = camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(40.0))
    whole = fill_background(np.clip(photo, 0, 255).astype(np.uint8), hole, thing, camera).astype(np.float32)
    assert correlation(whole, np.clip(truth, 0, 255), kept) > 0.8


def test_what_no_light_explains_is_inpainted():
    photo, _, hole, thing = shaded_table()
    # A blue thing of which no mask knows, within the hole; and ground without any light.
    photo[disc(160, 110, 8)] = (40.0, 60.0, 200.0)
    photo[disc(125, 130, 9)] = 4.0
    _, left = relit(photo, hole, np.zeros_like(hole), thing)
    assert left[disc(160, 110, 6)].mean() > 0.95
    assert left[disc(125, 130, 7)].mean() > 0.95


def test_ground_without_surroundings_is_left_to_be_inpainted():
    photo, _, hole, thing = shaded_table()
    given, left = relit(photo, hole, ~hole, thing)
    assert (left == hole).all()
    assert given is photo


def test_a_filling_of_another_level_has_no_border():
    truth = np.clip(wood(3), 0, 255).astype(np.uint8)
    hole = disc(120, 90, 45)
    darker = truth.astype(np.float32) * 0.85
    blended = blend(truth, darker, hole, np.zeros_like(hole)).astype(np.float32)
    for inner in (disc(120, 90, 40), disc(120, 90, 12)):
        assert abs(float(blended[inner].mean() - truth[inner].mean())) < 3.0
    # The edge of a thing is no difference of level.
    black = blend(truth, np.zeros_like(darker), hole, np.zeros_like(hole))
    assert black[disc(120, 90, 38)].max() < 5


def test_a_deep_shadow_at_the_border_of_the_photo_is_inpainted():
    deep = np.mgrid[:HEIGHT, :WIDTH][0] > HEIGHT - 30
    photo = wood(4) * (1.0 - 0.92 * soft(deep, 2.0))
    hole = np.mgrid[:HEIGHT, :WIDTH][0] > HEIGHT - 60
    given, left = relit(photo, hole, np.zeros_like(hole), np.zeros_like(hole))
    assert left[HEIGHT - 20 :].all(), "noise of the deepest shadow would be raised twelvefold"
    assert np.abs(np.log(np.maximum(given, 1.0)) - np.log(np.maximum(photo, 1.0))).max() < 0.7


def two_lamps(blur):
    """The share of light (H, W, 1) past a thing that throws two crisp shadows, which overlap."""
    return (1.0 - 0.15 * soft(disc(125, 100, 32), blur)) * (1.0 - 0.15 * soft(disc(160, 112, 26), blur))


def stain(given, truth, where):
    """Mean difference of the levels of two pictures within ``where``, over 9 pixels."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), 3.0)
    difference = cv2.GaussianBlur((given - truth).mean(axis=-1) * where, (0, 0), 3.0) / np.maximum(weight, 1e-3)
    return float(np.abs(difference[where]).mean())


def test_crisp_shadows_of_two_lamps_leave_no_stain():
    truth = 0.35 * wood(3) + 0.65 * wood(3).mean(axis=(0, 1))
    photo = truth * two_lamps(1.0)
    thing = disc(85, 85, 24)
    photo[thing] = (20.0, 40.0, 120.0)
    hole = cv2.dilate((thing | disc(125, 100, 32) | disc(160, 112, 26)).astype(np.uint8), np.ones((25, 25))) > 0
    given, left = relit(photo, hole, np.zeros_like(hole), thing)
    shade = hole & ~thing & (two_lamps(1.0)[..., 0] < 0.9)
    kept = shade & ~left
    # The shadows take 17 to 32 of 255, and their edges are as wide as three pixels.
    assert kept.sum() > 0.8 * shade.sum()
    assert stain(photo, truth, kept) > 15.0
    assert stain(given, truth, kept) < 1.5


def test_broad_stripes_in_a_shadow_stay():
    columns = np.arange(WIDTH, dtype=np.float32)
    stripes = 1.0 + 0.12 * np.sign(np.sin(columns * (2.0 * np.pi / 30.0)))
    truth = wood(4) * stripes[None, :, None]
    photo = truth * (1.0 - 0.2 * soft(disc(140, 105, 34), 4.0))
    thing = disc(90, 80, 26)
    photo[thing] = (20.0, 40.0, 120.0)
    hole = disc(140, 105, 50) | disc(90, 80, 36)
    given, left = relit(photo, hole, np.zeros_like(hole), thing)
    kept = hole & ~left
    light, dark = (kept & (np.abs(stripes - level) < 1e-3)[None, :] for level in (1.12, 0.88))
    assert min(light.sum(), dark.sum()) > 300
    ratio = float(given[light].mean() / given[dark].mean())
    # 1.27 by truth; stripes that are taken for shadows would be levelled.
    assert ratio > 1.2


def test_stripes_that_end_before_the_hole_leave_no_stains_in_it():
    """A striped mat, and plain rock before it: what is foreseen in the hole is not what is seen there."""
    stripes = np.sign(np.sin(np.arange(WIDTH, dtype=np.float32) * (2.0 * np.pi / 30.0)))[None, :, None]
    mat = np.clip((90.0 - np.arange(HEIGHT, dtype=np.float32)) / 10.0, 0.0, 1.0)[:, None, None]
    truth = 130.0 * np.exp(mat * stripes * np.array([0.16, 0.02, -0.12], np.float32))
    truth += np.random.default_rng(6).normal(scale=4.0, size=(HEIGHT, WIDTH, 1)).astype(np.float32)
    photo = truth * (1.0 - 0.1 * soft(disc(140, 125, 30), 6.0))
    thing = disc(90, 120, 22)
    photo[thing] = (220.0, 190.0, 20.0)
    hole = disc(140, 128, 42) | disc(90, 120, 32)
    given, left = relit(photo, hole, np.zeros_like(hole), thing)
    kept = hole & ~left & (np.arange(HEIGHT) > 95)[:, None]
    assert kept.sum() > 0.5 * (hole & ~disc(90, 120, 28)).sum()
    tint = cv2.GaussianBlur(np.log(given[..., 0] / given[..., 2]), (0, 0), 2.0)
    # The mat's stripes have 0.28, and go into the hole a little.
    assert np.abs(tint[kept]).max() < 0.14
