# SPDX-License-Identifier: MIT
"""Strokes beside a box: what they change, and strokes that contradict it."""

import argparse

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.commands.flags import parse_stroke
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import ObjectRequest
from physgen.sim.reconstruct.photo import Photo
from physgen.sim.reconstruct.segmentation.box_segmentation import segment
from physgen.sim.reconstruct.segmentation.strokes import Strokes, drawn_strokes, require_apart
from scipy import ndimage

WIDTH, HEIGHT = 240, 180
BOX = (60, 30, 190, 150)


def painted(*shapes):
    """Even ground with noise, and rectangles x0, y0, x1, y1 of a colour on it."""
    rng = np.random.default_rng(3)
    image = np.full((HEIGHT, WIDTH, 3), (150.0, 140.0, 120.0)) + rng.normal(scale=3, size=(HEIGHT, WIDTH, 1))
    for (x0, y0, x1, y1), colour in shapes:
        image[y0:y1, x0:x1] = colour
    return np.clip(ndimage.gaussian_filter(image, (0.5, 0.5, 0)), 0, 255).astype(np.uint8)


def strokes(keep=(), drop=(), box=BOX, told=None):
    photo = Photo(painted(), scale=1.0, original_size=(WIDTH, HEIGHT), focal_35mm=None)
    item = ObjectRequest(name="thing", box=box, keep=keep, drop=drop)
    return drawn_strokes(item, photo, box, (told if told is not None else []).append)


def test_a_kept_stroke_brings_back_a_part_of_the_ground_s_colour():
    dark, pale = (90, 45, 150, 135), (75, 45, 90, 135)
    photo = painted((dark, (40, 40, 60)), (pale, (158, 150, 132)))
    plain = segment(photo, BOX, "book")
    told = segment(photo, BOX, "book", strokes=strokes(keep=(((82, 55), (82, 125)),)))
    x0, y0, x1, y1 = pale
    assert plain[y0:y1, x0 : x1 - 2].mean() < 0.2
    assert told[y0 + 4 : y1 - 4, x0 + 2 : x1 - 2].mean() > 0.9
    assert told[y0:y1, 60:72].mean() < 0.2
    assert told[dark[1] + 2 : dark[3] - 2, dark[0] + 2 : dark[2] - 2].mean() > 0.97


def test_a_dropped_stroke_takes_a_part_away_and_nothing_else():
    body, arm = (85, 45, 145, 135), (145, 70, 180, 95)
    photo = painted((body, (180, 60, 40)), (arm, (60, 90, 180)))
    assert segment(photo, BOX, "toy")[75:90, 150:175].mean() > 0.9
    told = segment(photo, BOX, "toy", strokes=strokes(drop=(((150, 82), (176, 82)),)))
    assert told[75:90, 152:175].mean() < 0.1
    assert told[50:130, 90:140].mean() > 0.97


def test_every_pixel_of_a_stroke_is_obeyed():
    photo = painted(((85, 45, 145, 135), (180, 60, 40)))
    marks = strokes(keep=(((150, 60), (170, 60)),), drop=(((100, 60), (130, 120)),))
    mask = segment(photo, BOX, "toy", strokes=marks)
    assert mask[marks.keep].all()
    assert not mask[marks.drop].any()


@pytest.mark.parametrize(
    ("keep", "drop", "message"),
    [
        ((((20, 20), (100, 100)),), (), "20,20 lies outside its box"),
        ((((300, 20),),), (), "outside the photo of 240x180"),
        ((((100, 60), (100, 120)),), (((80, 90), (130, 90)),), r"cross at \d+,\d+"),
    ],
)
def test_strokes_that_contradict_the_box_or_each_other_are_refused(keep, drop, message):
    with pytest.raises(InputError, match=message):
        strokes(keep=keep, drop=drop)


def test_a_drop_stroke_beside_the_box_is_told_to_change_nothing():
    told = []
    assert strokes(drop=(((5, 5), (20, 20)),), told=told).drop.any()
    assert len(told) == 1 and "change nothing" in told[0]


def test_a_box_that_is_dropped_whole_is_refused():
    lines = tuple(((60, y), (190, y)) for y in range(30, 152))
    with pytest.raises(InputError, match="fill its whole box"):
        strokes(drop=lines)


def test_two_objects_cannot_keep_one_pixel():
    first, second = strokes(keep=(((100, 60), (100, 120)),)), strokes(keep=(((80, 90), (130, 90)),))
    with pytest.raises(InputError, match="keep strokes of a and b cross"):
        require_apart([first, second], ["a", "b"], 1.0)
    require_apart([first, Strokes(second.drop, second.drop)], ["a", "b"], 1.0)


def test_strokes_beside_a_mask_are_refused(tmp_path):
    photo = Photo(painted(), scale=1.0, original_size=(WIDTH, HEIGHT), focal_35mm=None)
    item = ObjectRequest(name="thing", mask=tmp_path / "m.png", keep=(((100, 60),),))
    with pytest.raises(InputError, match="a mask and strokes"):
        drawn_strokes(item, photo, BOX, [].append)


@pytest.mark.parametrize("stroke", [(), ((1.0, float("nan")),), ((1.0,),)])
def test_a_stroke_without_places_or_with_other_numbers_is_refused(stroke):
    with pytest.raises(InputError, match="keep"):
        ObjectRequest(box=(0, 0, 9, 9), keep=(stroke,))


@given(st.lists(st.tuples(st.integers(-9, 99999), st.integers(-9, 99999)), min_size=1, max_size=40))
def test_a_stroke_is_read_back_as_written(places):
    assert parse_stroke(",".join(f"{x},{y}" for x, y in places)) == tuple(places)


@given(st.text(max_size=60))
def test_any_text_is_a_stroke_or_one_clear_line(text):
    try:
        found = parse_stroke(text)
    except argparse.ArgumentTypeError as error:
        assert "stroke" in str(error) and "\n" not in str(error).replace(repr(text), "")
    else:
        assert found and all(len(place) == 2 and np.isfinite(place).all() for place in found)
