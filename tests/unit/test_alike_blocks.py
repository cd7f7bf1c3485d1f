# SPDX-License-Identifier: MIT
"""Many straight-sided things of a kind, drawn: blocks that are stacked, dominoes in a row."""

import cv2
import numpy as np
import pytest
from physgen.sim.app.propose import best_proposals
from physgen.sim.reconstruct.segmentation.alike_blocks import LOADED, alike_blocks, blocks_of_a_kind
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes

WIDTH, HEIGHT = 480, 360


def drawn(shapes, *, ground=(225, 222, 216), seed=0):
    """Polygons of their own wood-like colours on plain ground, with noise, slightly blurred."""
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH, 3), ground, dtype=np.uint8)
    for corners in shapes:
        colour = (rng.uniform(150, 200), rng.uniform(90, 130), rng.uniform(50, 80))
        cv2.fillPoly(image, [np.asarray(corners, np.int32)], colour)
    noisy = image + rng.normal(scale=2, size=image.shape)
    return cv2.GaussianBlur(np.clip(noisy, 0, 255).astype(np.uint8), (0, 0), 0.7)


def square(x, y, side=46):
    return [(x, y), (x + side, y), (x + side, y + side), (x, y + side)]


PYRAMID = [(90 + 25 * row + 52 * i, 270 - 48 * row) for row in range(4) for i in range(5 - row)]
LEANING = [[(60 + 62 * i, 120), (78 + 62 * i, 122), (70 + 62 * i, 262), (52 + 62 * i, 260)] for i in range(6)]


@pytest.mark.parametrize("seed", range(3))
def test_blocks_of_a_stack_are_found_one_by_one(seed):
    found = alike_blocks(drawn([square(x, y) for x, y in PYRAMID], seed=seed), [], 0.8)
    assert len(found) == len(PYRAMID)
    for x, y in PYRAMID:
        box = min((item.box for item in found), key=lambda b: np.hypot(b[0] - x, b[1] - y))
        assert box[0] <= x and box[1] <= y and box[2] >= x + 46 and box[3] >= y + 46
        assert max(box[2] - box[0], box[3] - box[1]) < 1.3 * 46


def test_what_carries_another_is_not_moved_from_under_it():
    found = alike_blocks(drawn([square(x, y) for x, y in PYRAMID]), [], 0.8)
    top = min(y for _, y in PYRAMID)
    for item in found:
        assert (item.score > LOADED) == (abs(item.box[1] - top) < 8), item


def test_leaning_dominoes_in_a_row_are_used_one_by_one():
    found = propose_boxes(drawn(LEANING, ground=(20, 22, 24)))
    used = [found[i].box for i in best_proposals(found)]
    assert len(used) == 3
    assert all(x1 - x0 < 55 and y1 - y0 > 130 for x0, y0, x1, y1 in used)


def test_windows_of_a_house_are_parts_of_it():
    house = np.zeros((HEIGHT, WIDTH), dtype=bool)
    house[60:330, 80:400] = True
    windows = [square(x, y, 40) for x in (110, 220, 330) for y in (90, 170, 250)]
    pixels = drawn([[(80, 60), (399, 60), (399, 329), (80, 329)]])
    pixels[house] = (180, 60, 50)
    for corners in windows:
        cv2.fillPoly(pixels, [np.asarray(corners, np.int32)], (40, 60, 110))
    assert len(blocks_of_a_kind(pixels)[0]) == len(windows)
    assert alike_blocks(pixels, [(house, 0.95)], 0.8) == []
    assert len(alike_blocks(pixels, [(house, 0.7)], 0.8)) == len(windows)


def test_four_blocks_round_things_and_tiles_to_the_border_are_not_many():
    assert blocks_of_a_kind(drawn([square(60 + 90 * i, 150) for i in range(4)]))[0] == []
    discs = [cv2.ellipse2Poly((70 + 68 * i, 150), (26, 26), 0, 0, 360, 5) for i in range(6)]
    assert blocks_of_a_kind(drawn(discs))[0] == []
    assert blocks_of_a_kind(np.full((HEIGHT, WIDTH, 3), 128, np.uint8))[0] == []
    assert blocks_of_a_kind(np.full((1, 1, 3), 128, np.uint8))[0] == []


def test_tiles_of_a_floor_are_its_pattern():
    """Seen at a slant, some are cut by the border, others too small."""
    tiles = np.zeros((40 * 16, 40 * 16, 3), np.uint8)
    rows, columns = np.mgrid[: len(tiles), : len(tiles)] // 40
    tiles[...] = np.where(((rows + columns) % 2 == 0)[..., None], (210, 205, 200), (150, 140, 150))
    seen = np.float32([[-120, 360], [600, 360], [400, 90], [80, 90]])
    corners = np.float32([[0, 640], [640, 640], [640, 0], [0, 0]])
    floor = cv2.warpPerspective(tiles, cv2.getPerspectiveTransform(corners, seen), (WIDTH, HEIGHT))
    floor[:90] = (225, 222, 216)
    assert blocks_of_a_kind(floor)[0] == []
    assert alike_blocks(floor, [], 0.8) == []
