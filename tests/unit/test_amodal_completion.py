# SPDX-License-Identifier: MIT
"""The hidden part of an object: its outline and its colours, on drawn things with known answers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.segmentation.amodal_completion import complete_colours, complete_outline

from .segmentation_scenes import HEIGHT, WIDTH, bottle, cylinder, disc, overlap, polygon

CHAIR = polygon((90, 40), (220, 40), (220, 150), (250, 180), (60, 180), (90, 150))


@pytest.mark.parametrize(
    ("full", "front"),
    [
        pytest.param(disc(150, 110, 60), disc(210, 150, 40), id="ball behind ball"),
        pytest.param(disc(150, 110, 60), polygon((80, 130), (240, 130), (240, 220), (80, 220)), id="ball in a box"),
        pytest.param(cylinder(150, 70, 150, 45), disc(190, 160, 35), id="tin behind ball"),
        pytest.param(polygon((100, 60), (200, 60), (200, 160), (100, 160)), disc(205, 165, 45), id="corner of a book"),
        pytest.param(bottle(150, 40, 170, 30), polygon((150, 120), (220, 120), (220, 200), (150, 200)), id="bottle"),
        pytest.param(polygon((150, 40), (205, 170), (95, 170)), disc(200, 165, 35), id="cone"),
        pytest.param(CHAIR, disc(155, 110, 35, 1.2), id="toy on a chair"),
    ],
)
def test_hidden_part_of_simple_things_comes_back(full, front):
    seen = full & ~front
    hidden = full & front
    completed = complete_outline(seen, front)
    assert overlap(completed & ~seen, hidden) > 0.8
    assert overlap(completed, full) > 0.93


def test_bottle_whose_foot_is_hidden_is_carried_on_but_not_through_the_table():
    full = bottle(150, 30, 170, 30)
    front = polygon((100, 120), (200, 120), (200, 220), (100, 220))
    completed = complete_outline(full & ~front, front)
    hidden = completed & front
    assert overlap(hidden, full & front) > 0.6
    # As wide as the bottle, and not down to where the thing in front stands.
    assert 50 < np.ptp(np.flatnonzero(hidden.any(axis=0))) < 72
    assert np.flatnonzero(hidden.any(axis=1))[-1] < 200


def stool(hidden_feet, foot=200):
    """A seat on three legs, and a block before the lower half of its first legs."""
    seat = polygon((85, 100), (120, 80), (262, 80), (238, 108), (85, 108))
    full = np.logical_or.reduce([seat, *(polygon((x, 100), (x + 11, 100), (x + 11, foot), (x, foot)) for x in LEGS)])
    right = LEGS[hidden_feet - 1] + 25
    return full, polygon((75, 150), (right, 150), (right, 225), (75, 225))


LEGS = (88, 148, 215)


@pytest.mark.parametrize("hidden_feet", [1, 2])
@pytest.mark.parametrize("foot", [185, 205])
def test_hidden_legs_go_on_as_long_as_the_one_that_is_seen_with_their_gaps(hidden_feet, foot):
    full, front = stool(hidden_feet, foot)
    completed = complete_outline(full & ~front, front)
    assert overlap(completed & front, full & front) > 0.8
    between = polygon((LEGS[0] + 16, 155), (LEGS[1] - 5, 155), (LEGS[1] - 5, foot), (LEGS[0] + 16, foot))
    assert not (completed & between).any()


def test_slats_that_end_at_a_thing_on_the_seat_are_no_legs():
    back = [polygon((x, 40), (x + 10, 40), (x + 10, 140), (x, 140)) for x in (95, 130, 165, 200)]
    seat = polygon((90, 130), (215, 130), (215, 180), (90, 180))
    full, front = np.logical_or.reduce([*back, seat]), disc(152, 118, 32, 1.1)
    completed = complete_outline(full & ~front, front)
    assert overlap(completed & front & seat, front & seat) > 0.95


@settings(max_examples=20, deadline=None)
@given(
    st.integers(60, 260), st.integers(50, 190), st.integers(12, 50), st.integers(0, 320), st.integers(0, 240),
    st.integers(5, 90),
)  # fmt: skip
def test_completion_only_adds_what_is_hidden(x, y, radius, front_x, front_y, front_radius):
    front = disc(front_x, front_y, front_radius)
    seen = cylinder(x, y - radius // 2, y + radius // 2, radius) & ~front
    completed = complete_outline(seen, front)
    assert (completed >= seen).all()
    assert not (completed & ~(seen | front)).any()
    assert (complete_outline(seen, front) == completed).all()


def test_nothing_is_added_without_anything_in_front():
    ball = disc(150, 110, 40)
    assert (complete_outline(ball, np.zeros_like(ball)) == ball).all()
    assert (complete_outline(ball, disc(20, 20, 15)) == ball).all()
    assert not complete_outline(np.zeros_like(ball), ball).any()


def test_second_segmentation_decides_where_the_outline_says_nothing():
    # Half of a long thing is hidden, with straight edges: the outline cannot tell how far it goes on.
    full = polygon((60, 100), (175, 100), (175, 150), (60, 150))
    front = polygon((120, 60), (300, 60), (300, 200), (120, 200))
    seen = full & ~front
    completed = complete_outline(seen, front, seen_again=full)
    assert overlap(completed, full) > 0.95


def test_hidden_colours_are_the_objects_own():
    full, front = disc(150, 110, 60), disc(190, 140, 40)
    seen = full & ~front
    photo = np.full((HEIGHT, WIDTH, 3), (40, 160, 60), np.uint8)
    rows = np.arange(HEIGHT)[:, None, None] // 8 % 2 == 0
    striped = np.where(np.broadcast_to(rows, (HEIGHT, WIDTH, 1)), (200, 40, 40), (220, 200, 60)).astype(np.uint8)
    photo[full] = striped[full]
    photo[front] = (20, 20, 220)
    result = complete_colours(photo, seen, full)
    hidden = full & front
    assert (result[~hidden] == photo[~hidden]).all()
    # No blue of the thing in front, no green of the ground: both stripes' red is at least 200.
    assert result[hidden][:, 0].min() > 150
    assert result[hidden][:, 2].max() < 110
    assert (complete_colours(photo, seen, full) == result).all()
    wrong = np.abs(result[hidden].astype(int) - striped[hidden]).max(axis=1) > 80
    assert wrong.mean() < 0.4


def test_few_visible_pixels_give_their_nearest_colour():
    full = disc(150, 110, 30)
    seen = full & (np.arange(WIDTH) < 123)
    photo = np.full((HEIGHT, WIDTH, 3), 10, np.uint8)
    photo[seen] = (90, 180, 240)
    result = complete_colours(photo, seen, full)
    assert np.abs(result[full].astype(int) - (90, 180, 240)).max() <= 2


def test_colours_of_an_object_that_is_not_seen():
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    assert (complete_colours(photo, nothing, nothing) == photo).all()
    with pytest.raises(InputError, match="visible"):
        complete_colours(photo, nothing, disc(50, 50, 20))
