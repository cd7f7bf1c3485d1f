# SPDX-License-Identifier: MIT
"""Losses between pictures: against scikit-image, and their derivatives against finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from physgen.sim.composite.image_metrics import WINDOW, psnr, ssim, ssim_and_slope
from physgen.sim.errors import InputError
from physgen.sim.gaussians.image_loss import fit_loss, image_loss, l1_loss
from skimage.metrics import structural_similarity


def pictures(*size, seed=0):
    """Two pictures that are alike but nowhere equal: the L1 loss has no derivative where they are."""
    random = np.random.default_rng(seed)
    target = random.uniform(0.2, 0.8, size)
    return target + random.choice([-1, 1], size) * random.uniform(0.02, 0.2, size), target


def assert_is_derivative(value, slope, picture, step=1e-6):
    """``slope`` against central differences of ``value`` in a random direction and at single pixels, borders too."""
    random = np.random.default_rng(1)
    directions = [random.normal(size=picture.shape)]
    for index in [(0, 0, 0), (picture.shape[0] - 1, 2, 1), tuple(n // 2 for n in picture.shape)]:
        directions.append(np.zeros_like(picture))
        directions[-1][index[: picture.ndim]] = 1
    for direction in directions:
        along = (value(picture + step * direction) - value(picture - step * direction)) / (2 * step)
        assert along == pytest.approx((slope * direction).sum(), rel=1e-6, abs=1e-11)


def test_ssim_is_that_of_others_away_from_the_border():
    a, b = pictures(40, 30, 3)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    inner = structural_similarity(a, b, channel_axis=2, full=True, **settings)[1]
    margin = WINDOW // 2
    inner = inner[margin:-margin, margin:-margin]
    # Embedded in zeros, a picture's border is an interior: so the whole of ours is checked by the same judge.
    around = ((2 * WINDOW, 2 * WINDOW), (2 * WINDOW, 2 * WINDOW), (0, 0))
    whole = structural_similarity(np.pad(a, around), np.pad(b, around), channel_axis=2, full=True, **settings)[1]
    whole = whole[2 * WINDOW : -2 * WINDOW, 2 * WINDOW : -2 * WINDOW]
    np.testing.assert_allclose(whole[margin:-margin, margin:-margin], inner, atol=1e-12)
    assert ssim(a, b) == pytest.approx(whole.mean(), abs=1e-12)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)


def test_slope_of_ssim():
    a, b = pictures(17, 13, 3)
    assert_is_derivative(lambda x: ssim(x, b), ssim_and_slope(a, b)[1], a)


@pytest.mark.parametrize("masked", [False, True])
def test_slopes_of_the_whole_loss(masked):
    rendered, target = pictures(16, 18, 3)
    random = np.random.default_rng(3)
    alpha, true_alpha = random.uniform(0, 1, (2, 16, 18))
    counted = random.uniform(size=(16, 18)) < 0.7 if masked else None
    settings = {"ssim_share": 0.3, "alpha_weight": 0.7, "counted": counted}
    _, by_colour, by_alpha = fit_loss(rendered, alpha, target, true_alpha, **settings)
    assert_is_derivative(lambda x: fit_loss(x, alpha, target, true_alpha, **settings)[0], by_colour, rendered)
    assert_is_derivative(lambda x: fit_loss(rendered, x, target, true_alpha, **settings)[0], by_alpha, alpha)


def test_values_that_can_be_counted():
    black, grey = np.zeros((20, 20, 3)), np.full((20, 20, 3), 0.1)
    assert l1_loss(grey, black)[0] == pytest.approx(0.1)
    assert image_loss(grey, grey) == (pytest.approx(0, abs=1e-12), pytest.approx(np.zeros((20, 20, 3)), abs=1e-12))
    assert image_loss(grey, black, ssim_share=0)[0] == pytest.approx(0.1)
    half = np.zeros((20, 20))
    half[:, :10] = 1
    value, _, by_alpha = fit_loss(grey, np.full((20, 20), 0.5), grey, half, alpha_weight=2.0)
    assert value == pytest.approx(2 * 0.5 / 2), "half a picture, half covered, at twice the price"
    np.testing.assert_array_equal(by_alpha > 0, half == 0)
    assert psnr(grey, black, peak=1.0) == pytest.approx(20.0)
    assert math.isinf(psnr(grey, grey, peak=1.0))


def test_pixels_that_do_not_count_cost_nothing():
    rendered, target = pictures(24, 24, 3)
    counted = np.zeros((24, 24), bool)
    counted[:, :12] = True
    value, slope = image_loss(rendered, target, counted=counted)
    rendered[:, 12:] = 0
    again, slope_again = image_loss(rendered, target, counted=counted)
    assert value == again and value > 0
    np.testing.assert_array_equal(slope, slope_again)
    assert not slope[:, 12:].any()


def test_single_precision_is_kept():
    rendered, target = (picture.astype(np.float32) for picture in pictures(32, 32, 3))
    value, slope = image_loss(rendered, target)
    exact, exact_slope = image_loss(rendered.astype(float), target.astype(float))
    assert slope.dtype == np.float32
    assert value == pytest.approx(exact, rel=1e-5)
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-3, atol=1e-4 * np.abs(exact_slope).max())


def test_other_shapes_are_named():
    with pytest.raises(InputError, match="the target has shape"):
        image_loss(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
