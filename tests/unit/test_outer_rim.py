# SPDX-License-Identifier: MIT
"""Pages around a cover belong to the book, also where a wall is as white; halos, shadows and mirror images do not."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.outer_rim import outer_rim

SIZE = (300, 260)
COVER = (slice(80, 250), slice(60, 200))
PAGES = (slice(74, 250), slice(60, 206))
WHITE, WALL, TABLE, BLACK = (252, 251, 250), (240, 230, 218), (120, 70, 40), (40, 36, 34)


def room():
    """A brown table before a wall that is nearly as white as paper, right of the middle."""
    photo = np.full((*SIZE, 3), TABLE, np.uint8)
    photo[:110, 150:] = WALL
    return photo


def as_seen(photo):
    noise = np.random.default_rng(0).normal(0.0, 1.5, photo.shape)
    blurred = cv2.GaussianBlur(photo, (0, 0), 0.7).astype(np.float64)
    return np.clip(blurred + noise, 0, 255).astype(np.uint8)


def cover():
    mask = np.zeros(SIZE, bool)
    mask[COVER] = True
    return mask


def test_pages_around_a_cover_are_its_rim_also_before_a_white_wall():
    photo = room()
    photo[PAGES] = WHITE
    photo[COVER] = BLACK
    true = np.zeros(SIZE, bool)
    true[PAGES] = True
    true &= ~cover()
    found = outer_rim(as_seen(photo), cover(), np.zeros(SIZE, bool))
    assert (found & true).sum() > 0.85 * true.sum()
    # Along its border two pixels have mixed colours.
    around = cv2.dilate((true | cover()).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not (found & ~around).any()


@pytest.mark.parametrize("what", ["nothing", "halo", "shadow", "mirror image", "half of the table"])
def test_what_is_no_rim_is_not_added(what):
    photo = room().astype(np.float64)
    rows = np.arange(SIZE[0])[:, None, None]
    if what == "halo":
        photo[79:251, 59:201] = photo[79:251, 59:201] * 0.5 + 120.0
    elif what == "shadow":
        photo[80:250, 200:208] *= 0.45
    elif what == "mirror image":
        below = np.exp(-np.maximum(rows - 250, 0) / 25.0) * (rows >= 250)
        photo[:, 60:200] += (90.0 * below)[:, :1]
    elif what == "half of the table":
        photo[:, 200:] = (60, 120, 60)
    photo[COVER] = BLACK
    found = outer_rim(as_seen(np.clip(photo, 0, 255).astype(np.uint8)), cover(), np.zeros(SIZE, bool))
    assert not found.any()


def test_a_rim_is_not_taken_from_pixels_that_are_closed():
    photo = room()
    photo[PAGES] = WHITE
    photo[COVER] = BLACK
    closed = np.zeros(SIZE, bool)
    closed[:, 200:] = True
    found = outer_rim(as_seen(photo), cover(), closed)
    assert found.any()
    assert not (found & closed).any()
