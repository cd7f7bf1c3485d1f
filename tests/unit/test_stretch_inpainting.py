# SPDX-License-Identifier: MIT
"""Irregular ground inpainted with large copies of itself: as sharp, as strong, from the same height; and when."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.composite.inpaint import FillOptions
from physgen.sim.reconstruct.background.background_inpainting import GROUND_WAYS, PHOTO_WAYS
from physgen.sim.reconstruct.background.inpainting_methods import BY_STRETCHES, InpaintingTask, lay_grain
from physgen.sim.reconstruct.background.method_choice import choose_method
from physgen.sim.reconstruct.background.stretch_inpainting import fill_stretches
from physgen.sim.reconstruct.background.texture_prediction import stretches
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground

WIDTH, HEIGHT = 320, 200


def grass(seed=0):
    """Blades that grow from row to row, (H, W, 3) float32: nothing foretells where one is."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((HEIGHT, WIDTH), np.float32)
    noise = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    for row in range(HEIGHT):
        blur = 0.4 + 0.8 * row / HEIGHT
        blades = cv2.GaussianBlur(noise, (0, 0), sigmaX=blur, sigmaY=2.0 * blur)[row]
        picture[row] = blades / blades.std()
    return (np.array([60.0, 110.0, 40.0]) * np.exp(0.35 * picture)[..., None]).astype(np.float32)


def disc(x, y, radius):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def strength(picture, where):
    """Standard deviation of the finest detail."""
    fine = np.log(picture) - cv2.GaussianBlur(np.log(picture), (0, 0), 1.0)
    return float(fine[where].std())


def test_grass_is_as_sharp_in_the_hole_as_beside_it_at_each_height():
    truth, hole = grass(), disc(150, 105, 60)
    photo = np.where(hole[..., None], 200.0, truth).astype(np.float32)
    found = fill_stretches(photo, hole, np.zeros_like(hole), FillOptions())
    assert (found[~hole] == photo[~hole]).all()
    inner = disc(150, 105, 56)
    for rows in (slice(55, 90), slice(120, 155)):
        band = np.zeros_like(hole)
        band[rows] = True
        # Fields of one make differ by a sixth between such places.
        assert strength(found, band & inner) == pytest.approx(strength(truth, band), rel=0.2)
    assert np.log(found)[hole].mean() == pytest.approx(np.log(truth)[~hole].mean(), abs=0.05)


def test_nothing_comes_from_where_nothing_may_be_copied():
    photo, hole = grass(), disc(110, 100, 40)
    barred = np.zeros_like(hole)
    barred[:, 200:] = True
    photo[barred] = (250.0, 10.0, 10.0)
    photo[hole] = (10.0, 10.0, 250.0)
    found = fill_stretches(photo, hole, barred, FillOptions())
    assert (found[hole, 0] < 2.0 * found[hole, 1]).all()
    assert (found[hole, 2] < 2.0 * found[hole, 1]).all()


def test_stretches_are_for_what_nothing_foretells():
    hole, nothing, ways = disc(150, 105, 40), np.zeros((HEIGHT, WIDTH), bool), PHOTO_WAYS + GROUND_WAYS
    view = camera_above_ground(WIDTH, HEIGHT, 350.0, math.radians(35.0))
    assert choose_method(InpaintingTask(grass(), hole, nothing, view, FillOptions()), ways).way == BY_STRETCHES
    # Seams of soft clouds would be seen.
    clouds = np.stack([cv2.GaussianBlur(channel, (0, 0), 4.0) for channel in np.moveaxis(grass(), -1, 0)], axis=-1)
    assert choose_method(InpaintingTask(clouds, hole, nothing, view, FillOptions()), ways).way != BY_STRETCHES
    # A cloth with a check of lines that lie askew: copies would break them.
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    lines = ((rows + columns // 3) % 24 < 5) | ((columns - rows // 3) % 24 < 5)
    cloth = np.where(lines[..., None], (70.0, 60.0, 90.0), (190.0, 180.0, 170.0)).astype(np.float32)
    assert choose_method(InpaintingTask(cloth, hole, nothing, view, FillOptions()), ways).way != BY_STRETCHES


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0.0, 3.0))
def test_stretches_never_overlap_and_copy_known_pixels_only(height, width, seed, level):
    rng = np.random.default_rng(seed)
    hole = rng.random((height, width)) < 0.3
    source = (rng.random((height, width)) < 0.6) & ~hole
    covered = np.zeros_like(hole)
    for stretch in stretches(hole, source, most=5, level=level):
        assert not (stretch.new & covered).any()
        assert not (stretch.new & ~stretch.there).any()
        assert not (stretch.there & ~hole).any()
        assert stretch.copied(source)[stretch.there].all()
        covered |= stretch.new


def most_alike(detail, pattern):
    """Largest correlation of ``pattern`` with a part of ``detail`` of its size, at any place."""
    found = cv2.matchTemplate(detail.astype(np.float32), pattern.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    return float(found.max())


@pytest.mark.parametrize("tree", [False, True])
def test_bark_is_not_laid_as_grain_into_grass(tree):
    """A tree's bark was seen in green where a boot had stood beside it."""
    big = cv2.resize(np.tile(grass(3), (2, 2, 1)), (640, 400))
    if tree:
        big[:, 430:560] *= np.float32(2.5)
    hole = np.zeros(big.shape[:2], bool)
    hole[90:310, 120:340] = True
    smooth = np.where(hole[..., None], cv2.GaussianBlur(big, (0, 0), 4.0), big)
    laid = lay_grain(smooth, hole, ~hole)
    detail, given = (
        picture.mean(axis=-1) - cv2.GaussianBlur(picture.mean(axis=-1), (0, 0), 1.5) for picture in (laid, big)
    )
    inside = detail[90:310, 120:340]
    # Grass alone has its grain from beside the hole; with a tree there, nothing of that comes over.
    alike = max(most_alike(inside, given[r : r + 60, c : c + 60]) for r in (120, 180, 240) for c in (440, 480))
    assert (alike > 0.7) != tree
