# SPDX-License-Identifier: GPL-3.0-or-later
"""Brush strokes in a mask, against the geometry that they stand for."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.physgen_addon.photo.photo_maths import MOST_SHOWN, Painting, ellipse, extent, resized, stamp, tint

WIDTH, HEIGHT = 40, 30
inside_x, inside_y = st.floats(-20, 60, width=32), st.floats(-20, 50, width=32)
places, radii = st.tuples(inside_x, inside_y), st.floats(0.0, 15.0, width=32)


def distances(start, end):
    """Of every pixel's centre from the segment, one by one."""
    found = np.empty((HEIGHT, WIDTH))
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    for row in range(HEIGHT):
        for column in range(WIDTH):
            x, y = column + 0.5, row + 0.5
            ahead = 0.0
            if length > 0:
                ahead = ((x - start[0]) * (end[0] - start[0]) + (y - start[1]) * (end[1] - start[1])) / length
            ahead = min(max(ahead, 0.0), length)
            share = ahead / length if length > 0 else 0.0
            nearest = (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
            found[row, column] = math.hypot(x - nearest[0], y - nearest[1])
    return found


@settings(max_examples=40, deadline=None)
@given(places, places, radii, st.booleans())
def test_a_stroke_is_all_that_lies_within_the_brush_of_its_line(start, end, radius, adds):
    mask = np.full((HEIGHT, WIDTH), not adds)
    stamp(mask, start, end, radius, value=adds)
    away, radius = distances(start, end), max(radius, 0.75)
    assert (mask[away < radius - 1e-6] == adds).all()
    assert (mask[away > radius + 1e-6] != adds).all()


@given(st.floats(0, WIDTH, exclude_max=True), st.floats(0, HEIGHT, exclude_max=True))
def test_the_finest_brush_hits_the_pixel_under_it(x, y):
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    stamp(mask, (x, y), (x, y), 0.0, value=True)
    assert mask[int(y), int(x)]


def test_an_ellipse_fills_its_box():
    mask = ellipse(400, 300, (50, 60, 250, 200))
    assert extent(mask) == (50, 60, 250, 200)
    assert mask.sum() == pytest.approx(math.pi * 100 * 70, rel=0.01)
    assert not ellipse(10, 10, (3, 3, 3, 9)).any() and extent(np.zeros((4, 5), dtype=bool)) is None


@pytest.mark.parametrize("size", [(7, 5), (80, 60), (40, 30), (3, 61)])
def test_another_size_shows_the_same_places(size):
    mask = ellipse(WIDTH, HEIGHT, (5, 3, 33, 28))
    found = resized(mask, *size)
    assert found.shape == size[::-1]
    for row in range(size[1]):
        for column in range(size[0]):
            x, y = (column + 0.5) * WIDTH / size[0], (row + 0.5) * HEIGHT / size[1]
            assert found[row, column] == mask[int(y), int(x)]


def test_strokes_are_taken_back_one_by_one():
    painting = Painting(ellipse(WIDTH, HEIGHT, (5, 5, 20, 20)))
    first = painting.mask.copy()
    painting.move((30, 20), 5.0)
    assert (painting.mask == first).all() and not painting.changed
    painting.press((30, 20), 5.0, adds=True)
    assert painting.is_in_stroke and painting.mask[20, 30]
    painting.move((35, 20), 5.0)
    painting.release()
    second = painting.mask.copy()
    painting.press((12, 12), 3.0, adds=False)
    painting.release()
    assert not painting.mask[12, 12] and painting.changed
    revision = painting.revision
    assert painting.undo() and (painting.mask == second).all() and painting.revision != revision
    assert painting.undo() and (painting.mask == first).all()
    assert not painting.undo() and not painting.changed


def test_a_painting_leaves_what_it_began_with():
    first = ellipse(WIDTH, HEIGHT, (5, 5, 20, 20))
    before = first.copy()
    painting = Painting(first)
    painting.press((0, 0), 100.0, adds=True)
    assert painting.mask.all() and (first == before).all()


def test_the_tint_tells_inside_outside_and_border():
    picture = tint(ellipse(100, 80, (20, 20, 80, 60)))
    assert picture.shape == (80, 100, 4) and picture.dtype == np.float32
    assert 0 < picture[40, 50, 3] < 1 and picture[5, 5, 3] == 0
    # From the outside to the inside: nothing, black, white, tint.
    row = picture[40]
    assert row[18, 3] == 0 and tuple(row[19]) == (0, 0, 0, 1) and tuple(row[20]) == (1, 1, 1, 1) and row[21, 3] < 1
    large = tint(np.ones((1500, 2200), dtype=bool))
    assert max(large.shape) <= MOST_SHOWN and (large == large[0, 0]).all()
