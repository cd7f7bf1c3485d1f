# SPDX-License-Identifier: MIT
"""Alpha mattes against known ones, and a model's alpha corrected by colours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.segmentation import matting
from physgen.sim.reconstruct.segmentation.matting import (
    Trimap,
    closed_form_alpha,
    foreground_colours,
    outline_band,
    refine_alpha,
    soft_alpha,
)
from physgen.sim.srgb import linear_to_bytes, srgb_to_linear
from scipy import ndimage

HEIGHT, WIDTH = 120, 160


def over(alpha, seed=0):
    """Smoothly varying object colours over smoothly varying ground, 8 bits."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] / 160.0
    front = np.stack([0.75 + 0.1 * rows, 0.3 + 0.1 * columns, 0.2 + 0 * rows], axis=-1)
    back = np.stack([0.2 + 0.1 * columns, 0.4 + 0.15 * rows, 0.6 - 0.1 * rows], axis=-1)
    mixed = alpha[..., None] * front + (1 - alpha[..., None]) * back + rng.normal(scale=0.004, size=(HEIGHT, WIDTH, 3))
    return (np.clip(mixed, 0, 1) * 255 + 0.5).astype(np.uint8)


def furry():
    """A disc whose border is hair: coverage of a few pixels' width, uneven."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    angle = np.arctan2(rows - 60, columns - 80)
    hair = np.interp(angle, np.linspace(-np.pi, np.pi, 181), rng.uniform(0, 9, 181))
    return ndimage.gaussian_filter((np.hypot(rows - 60, columns - 80) < 34 + hair).astype(float), 1.2)


def test_hair_is_told_from_the_ground_by_colour():
    alpha = furry()
    trimap = Trimap(own=alpha > 0.995, other=ndimage.distance_transform_edt(alpha < 0.005) > 4)
    found = closed_form_alpha(over(alpha), trimap)
    unknown = trimap.unknown
    assert unknown.sum() > 2000
    # Levin et al. report mean errors of a few hundredths on synthetic composites.
    assert np.abs(found - alpha)[unknown].mean() < 0.03
    assert (found[trimap.own] == 1).all() and (found[trimap.other] == 0).all()


def test_a_large_band_is_solved_on_a_smaller_copy(monkeypatch):
    alpha = furry()
    monkeypatch.setattr(matting, "MOST_UNKNOWN", 1500)
    trimap = outline_band(alpha > 0.5, 10.0)
    found = closed_form_alpha(over(alpha), trimap)
    assert np.abs(found - alpha)[trimap.unknown].mean() < 0.12


def test_a_soft_outline_is_soft_and_a_sharp_one_stays_sharp():
    alpha = furry()
    found = soft_alpha(over(alpha), alpha > 0.5, width=8.0)
    near = ndimage.binary_dilation((alpha > 0.02) & (alpha < 0.98), iterations=3)
    assert np.abs(found - alpha)[near].mean() < 0.6 * np.abs((alpha > 0.5) - alpha)[near].mean()
    disc = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([60, 80])[:, None, None])) < 40
    sharp = soft_alpha(over(disc.astype(float)), disc, width=8.0)
    assert np.abs(sharp - disc).mean() < 0.004


def test_the_background_is_taken_out_of_a_soft_outline():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] / 160.0
    front = np.stack([0.75 + 0.1 * rows, 0.3 + 0.1 * columns, 0.2 + 0 * rows], axis=-1)
    back = np.stack([0.2 + 0.1 * columns, 0.4 + 0.15 * rows, 0.6 - 0.1 * rows], axis=-1)
    alpha = furry().astype(np.float32)
    alpha[alpha > 0.995], alpha[alpha < 0.005] = 1.0, 0.0
    # Light is what a lens mixes.
    mixed = alpha[..., None] * srgb_to_linear(front) + (1 - alpha[..., None]) * srgb_to_linear(back)
    pixels = linear_to_bytes(mixed)
    found = foreground_colours(pixels, alpha)
    assert (found[alpha == 1] == pixels[alpha == 1]).all()
    border = (alpha > 0.1) & (alpha < 0.9)
    assert border.sum() > 300
    wrong, mixed_in = (np.abs(picture / 255.0 - front)[border].mean() for picture in (found, pixels))
    assert wrong < 0.1 * mixed_in


def test_colours_of_a_hard_outline_stay():
    pixels = over(furry())
    assert (foreground_colours(pixels, np.ones((HEIGHT, WIDTH), np.float32)) == pixels).all()


def test_camouflage_keeps_its_outline():
    disc = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([60, 80])[:, None, None])) < 40
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    assert np.abs(soft_alpha(grey, disc) - disc).max() < 0.6
    assert ((soft_alpha(grey, disc) > 0.5) == disc).all()


def test_a_foot_that_the_model_missed_is_taken_back_and_ground_is_dropped():
    truth = np.zeros((HEIGHT, WIDTH))
    truth[25:95, 50:110] = 1
    truth[80:108, 62:82] = 1
    alpha = truth.copy()
    alpha[90:108] = 0
    alpha[30:60, 110:126] = 0.8
    found = refine_alpha(over(truth), ndimage.gaussian_filter(alpha, 1.0))
    assert found[92:106, 64:80].mean() > 0.9
    assert found[32:58, 114:124].mean() < 0.15
    assert np.abs(found - truth).mean() < 0.02


def test_strokes_and_boxes_bind_the_refinement():
    truth = np.zeros((HEIGHT, WIDTH))
    truth[25:95, 50:110] = 1
    keep, drop = np.zeros((2, HEIGHT, WIDTH), bool)
    keep[50, 112:118], drop[60, 60:100] = True, True
    found = refine_alpha(over(truth), truth, keep=keep, drop=drop, box=(40, 20, 120, 100))
    assert (found[keep] == 1).all() and (found[drop] == 0).all()
    assert not refine_alpha(over(truth), truth, box=(60, 20, 120, 100))[:, :60].any()


@pytest.mark.parametrize("value", [0.0, 1.0, np.nan])
def test_an_alpha_without_two_sides_stays_as_it_is(value):
    alpha = np.full((HEIGHT, WIDTH), value)
    assert (refine_alpha(over(furry()), alpha) == np.nan_to_num(alpha)).all()


@settings(max_examples=12)
@given(st.integers(6, 40), st.integers(6, 40), st.integers(0, 2**31))
def test_any_alpha_gives_an_alpha(height, width, seed):
    rng = np.random.default_rng(seed)
    alpha = ndimage.gaussian_filter(rng.normal(size=(height, width)), 1.5) * 9
    alpha[rng.random((height, width)) < 0.02] = np.nan
    pixels = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    found = refine_alpha(pixels, alpha)
    assert found.shape == (height, width) and np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
