# SPDX-License-Identifier: MIT
"""Parts of an object that its mask lacks are distinguished from its shadow by the clean plate."""

import cv2
import numpy as np
from physgen.sim.composite.disocclusion import remains

HEIGHT, WIDTH = 120, 160
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]


def disc(x, y, radius):
    return (COLUMNS - x) ** 2 + (ROWS - y) ** 2 < radius**2


def scene(noise=0.0):
    """A pale toy on grey with a tuft and a dark stem that its mask lacks, and a shadow: photo, plate, mask, tuft, stem,
    shadow; linear light."""
    plate = np.full((HEIGHT, WIDTH, 3), 0.3, np.float32)
    toy, tuft = disc(60, 60, 25), disc(86, 48, 6)
    stem = (np.abs(COLUMNS - 60) < 2) & (ROWS > 20) & (ROWS < 35)
    shadow = disc(90, 84, 20) & ~toy
    photo = plate * (1.0 - 0.4 * cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), 2.0))[..., None]
    photo[toy | tuft], photo[stem] = 0.7, 0.05
    photo = photo + np.random.default_rng(0).normal(0.0, noise, photo.shape).astype(np.float32)
    outside = ~cv2.dilate((toy | tuft | stem | shadow).astype(np.uint8), np.ones((13, 13))).astype(bool)
    return photo, np.where(outside[..., None], photo, plate), toy, tuft & ~toy, stem & ~toy, shadow


def test_tufts_and_stems_leave_with_the_object_and_its_shadow_does_not():
    photo, plate, toy, tuft, stem, shadow = scene(0.005)
    (left,) = remains(photo, plate, [toy], shadow)
    beside = cv2.dilate((toy | tuft | stem).astype(np.uint8), np.ones((7, 7))).astype(bool)
    assert left[tuft].min() == 1.0 and left[stem].min() == 1.0
    assert not left[toy].any()
    assert left[shadow & ~beside].mean() < 0.02


def test_each_part_leaves_with_the_nearest_object_and_the_photo_itself_with_none():
    photo, plate, toy, tuft, stem, shadow = scene()
    far = disc(140, 30, 10)
    first, second = remains(photo, plate, [toy, far], shadow)
    assert first[tuft].min() == 1.0 and not second[tuft | stem].any()
    assert not any(part.any() for part in remains(photo, photo, [toy, far], shadow))
