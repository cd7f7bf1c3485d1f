# SPDX-License-Identifier: MIT
"""Many round things of a kind, found by their outlines: coins that touch and overlap, drawn."""

import numpy as np
import pytest
from physgen.sim.app.propose import best_proposals
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes
from physgen.sim.reconstruct.segmentation.round_things import CUT_SCORE, circles_of_a_kind, round_things
from scipy import ndimage

WIDTH, HEIGHT = 480, 360


def coins(places, seed=0):
    """Coins x, y, radius with a rim and a print on white paper; later ones lie on earlier ones."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = np.full((HEIGHT, WIDTH, 3), 235.0)
    for x, y, radius in places:
        away = np.hypot(columns - x, rows - y)
        disc = away < radius
        image[disc] = rng.uniform(110, 170, 3) + rng.normal(scale=8, size=(int(disc.sum()), 1))
        image[(away < radius) & (away > 0.85 * radius)] -= 30
        image[(abs(columns - x) < 0.15 * radius) & (abs(rows - y) < 0.5 * radius)] += 40
    image += rng.normal(scale=2, size=image.shape)
    return np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)


ROWS = [(60 + 70 * i, 70, 34) for i in range(6)] + [(70 + 110 * i, 190, 40) for i in range(4)]
LAPPED = [(100, 290, 42), (160, 295, 42), (300, 290, 40)]


@pytest.mark.parametrize("seed", range(3))
def test_coins_that_touch_are_found_one_by_one(seed):
    pixels = coins(ROWS + LAPPED, seed)
    found = round_things(pixels, [], 0.8)
    assert len(found) == len(ROWS) + len(LAPPED)
    for x, y, radius in ROWS:
        box = min((item.box for item in found), key=lambda b: np.hypot((b[0] + b[2]) / 2 - x, (b[1] + b[3]) / 2 - y))
        # The rim's inner edge may be what is found; the box has room for that.
        assert box[0] <= x - radius and box[1] <= y - radius and box[2] >= x + radius and box[3] >= y + radius
        assert max(box[2] - box[0], box[3] - box[1]) < 1.3 * 2 * radius


def test_those_with_room_come_first_and_those_that_overlap_are_not_used():
    pixels = coins(ROWS + LAPPED)
    found = round_things(pixels, [], 0.8)
    middles = [((item.box[0] + item.box[2]) / 2, (item.box[1] + item.box[3]) / 2) for item in found]
    used = [middles[i] for i in best_proposals(found)]
    assert len(used) == 3 and all(abs(y - 190) < 5 or np.hypot(x - 300, y - 290) < 5 for x, y in used)
    scores = {round(x / 10): item.score for (x, y), item in zip(middles, found, strict=True) if y > 250}
    assert scores[10] == scores[16] == CUT_SCORE and scores[30] > 0.9


def test_a_photo_of_one_thing_with_round_parts_is_not_of_these():
    buttons = [(240, 100 + 34 * i, 18) for i in range(6)]
    pixels = coins(buttons)
    # Six discs of 18 pixels cover 3.5 % of it.
    assert circles_of_a_kind(pixels) == []
    pixels = coins(ROWS)
    coat, group = np.zeros((2, HEIGHT, WIDTH), dtype=bool)
    coat[10:350, 10:470] = group[30:235, 20:460] = True
    pixels[coat & (pixels.min(axis=2) > 220)] = (90, 60, 120)
    assert round_things(pixels, [(coat, 0.97)], 0.8) == []
    assert len(round_things(pixels, [(coat, 0.7)], 0.8)) == len(ROWS)
    assert len(round_things(coins(ROWS), [(group, 0.97)], 0.8)) == len(ROWS)


def test_what_is_between_those_of_a_group_may_be_their_ground():
    spread = [(60 + 120 * i, 60 + 110 * j, 22) for i in range(4) for j in range(3)]
    group = np.zeros((HEIGHT, WIDTH), dtype=bool)
    group[30:310, 30:450] = True
    assert len(round_things(coins(spread), [(group, 0.97)], 0.8)) == len(spread)


def test_four_circles_are_not_many():
    assert circles_of_a_kind(coins(ROWS[6:])) == []
    assert circles_of_a_kind(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)) == []
    assert circles_of_a_kind(np.full((1, 1, 3), 128, np.uint8)) == []


def test_photos_without_a_box_go_on_with_coins_and_not_with_all_of_them_as_one():
    found = propose_boxes(coins(ROWS + LAPPED))
    for i in best_proposals(found):
        x0, y0, x1, y1 = found[i].box
        assert max(x1 - x0, y1 - y0) < 2.4 * 42
