# SPDX-License-Identifier: MIT
"""Ground that shows an object's colour is not the object; and handles of other colours are."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.box_crop import crop_around_box
from physgen.sim.reconstruct.segmentation.box_segmentation import segment
from physgen.sim.reconstruct.segmentation.reflected_colour import tinted_ground
from physgen.sim.srgb import linear_to_srgb

SHAPE = (220, 260)
BOX = (60, 22, 210, 180)


def photo_of(linear, seed):
    noise = np.random.default_rng(seed).normal(0.0, 1.5, linear.shape)
    pixels = 255.0 * linear_to_srgb(np.clip(linear, 0.0, 1.0)) + noise
    return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def disc_of(x, y, radius):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    return np.hypot(columns - x, rows - y) < radius


def tinted_scene(colour, seed, strength=0.9, depth=0.08):
    """A ball in its light on a pale sheet, whose folds vary its light: linear light (h, w, 3), ball, how much of its
    colour each pixel of the sheet shows."""
    rng = np.random.default_rng(seed)
    folds = cv2.GaussianBlur(rng.normal(0.0, 1.0, SHAPE).astype(np.float32), (0, 0), 14.0)
    sheet = 0.62 * np.exp(depth * folds / folds.std())
    ball = disc_of(135.0, 105.0, 45.0)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    beside = np.hypot((columns - 135.0) / 62.0, (rows - 132.0) / 22.0)
    added = strength * np.clip(1.25 - beside, 0.0, 1.0) * 0.62
    linear = sheet[..., None] * (0.9 + added[..., None] * (np.array(colour) - 0.9))
    shading = 0.55 + 0.45 * np.clip((150.0 - rows) / 90.0, 0.0, 1.0)
    linear[ball] = (shading[..., None] * np.array(colour))[ball]
    return linear, ball, np.where(ball, 0.0, added)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("colour", [(0.9, 0.5, 0.02), (0.8, 0.05, 0.05), (0.05, 0.2, 0.75)])
def test_what_fades_into_the_sheet_is_the_sheet(colour, seed):
    linear, ball, added = tinted_scene(colour, seed)
    view = crop_around_box(photo_of(linear, seed), BOX, np.zeros(SHAPE, bool))
    patch = (added > 0.15) & (np.mgrid[: SHAPE[0], : SHAPE[1]][1] < 135)
    found = tinted_ground(view, ball | patch)
    inner = cv2.erode(patch.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inner.sum() > 200 and found[inner].mean() > 0.8
    assert found[disc_of(135.0, 105.0, 42.0)].mean() < 0.01


def test_a_pale_part_with_an_outline_of_its_own_stays():
    linear, ball, _ = tinted_scene((0.9, 0.5, 0.02), 1, strength=0.0)
    label = disc_of(180.0, 120.0, 22.0) & ~ball
    linear[label] = (0.45, 0.38, 0.2)
    view = crop_around_box(photo_of(linear, 1), BOX, np.zeros(SHAPE, bool))
    assert not tinted_ground(view, ball | label).any()


def test_a_grey_thing_has_no_colour_to_throw():
    linear, ball, added = tinted_scene((0.3, 0.3, 0.3), 2)
    view = crop_around_box(photo_of(linear, 2), BOX, np.zeros(SHAPE, bool))
    assert not tinted_ground(view, ball | (added > 0.2)).any()


@pytest.mark.filterwarnings("error")
def test_far_from_what_has_colour_nothing_is_tinted():
    pixels, pole = np.full((280, 280, 3), 170, np.uint8), np.zeros((280, 280), bool)
    pole[2:278, 139:141] = True
    pixels[pole] = 120
    pixels[218:278, 139:141] = (230, 20, 5)
    view = crop_around_box(pixels, (100, 2, 180, 278), np.zeros((280, 280), bool))
    assert not tinted_ground(view, pole).any()


def test_what_the_user_keeps_is_no_tint():
    linear, ball, added = tinted_scene((0.9, 0.5, 0.02), 0)
    patch = added > 0.15
    view = crop_around_box(photo_of(linear, 0), BOX, np.zeros(SHAPE, bool), keep=patch)
    assert not tinted_ground(view, ball | patch).any()


@pytest.mark.parametrize("thickness", [3, 4])
def test_a_steel_handle_is_found_and_the_sheet_within_it_is_not(thickness):
    linear, ball, _ = tinted_scene((0.9, 0.5, 0.02), 0, strength=0.0, depth=0.03)
    drawn = (cv2.ellipse(np.zeros(SHAPE, np.uint8), (135, 72), (30, 38), 0, 180, 360, 1, n) for n in (thickness, 1))
    wide, middle = (picture > 0 for picture in drawn)
    within = disc_of(135.0, 48.0, 8.0)
    assert not (within & (ball | wide)).any()
    linear[wide & ~ball] = 0.2
    mask = segment(photo_of(linear, 0), BOX, "clock")
    assert mask[middle & ~ball].mean() > 0.9
    assert not mask[within].any()
