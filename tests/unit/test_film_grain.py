# SPDX-License-Identifier: MIT
"""The photo's grain: measured on pictures with known grain, and given back where it is missing."""

import cv2
import numpy as np
import pytest
from physgen.sim import srgb
from physgen.sim.composite import film_grain

HEIGHT, WIDTH = 240, 320


def picture() -> np.ndarray:
    """8-bit steps, not rounded: a gradient, a bright patch and a patch of fine texture that is no noise."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = np.stack([60 + 100 * x / WIDTH, 50 + 90 * y / HEIGHT, np.full(x.shape, 110.0)], axis=-1)
    image[40:100, 40:150] = 200
    image[150:220, 180:300] += 40 * np.sin(x[150:220, 180:300] / 2.0)[..., None]
    return image


def noise(seed: int, image: np.ndarray, grain_px: float) -> np.ndarray:
    """Grain that rises with brightness, ``grain_px`` coarse."""
    field = np.random.default_rng(seed).standard_normal(image.shape)
    if grain_px:
        field = cv2.GaussianBlur(field, (0, 0), grain_px)
    return field / field.std() * (1.5 + 3.0 * image.mean(axis=-1, keepdims=True) / 255)


def linear(image: np.ndarray) -> np.ndarray:
    return srgb.bytes_to_linear(np.clip(np.rint(image), 0, 255).astype(np.uint8))


def octave_sigmas(frame: np.ndarray, truth: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Standard deviation of what ``frame`` has over ``truth`` (8-bit steps), by octave, in luma."""
    planes = film_grain._planes(frame) - film_grain._planes(srgb.srgb_to_linear(truth / 255))
    return np.array([band[..., 0][where].std() for band in film_grain._octaves(planes)[0]])


@pytest.mark.parametrize("grain_px", [0.0, 0.7])
def test_smoothed_pixels_get_the_photos_grain(grain_px):
    clean = picture()
    photo = linear(clean + noise(1, clean, grain_px))
    model = film_grain.estimate_noise(photo)
    changed = np.zeros((HEIGHT, WIDTH), np.float32)
    changed[:, 160:] = 1.0
    flat = np.zeros_like(changed, dtype=bool)
    flat[10:140, 170:310] = True
    lost = {
        "inpainted": srgb.srgb_to_linear(clean / 255),
        "averaged": srgb.srgb_to_linear(cv2.GaussianBlur(clean + noise(1, clean, grain_px), (0, 0), 0.8) / 255),
    }
    wanted = octave_sigmas(photo, clean, flat)
    for frame in lost.values():
        given = film_grain.Grain(model, (WIDTH, HEIGHT), seed=0).add(frame, changed)
        assert octave_sigmas(given, clean, flat) == pytest.approx(wanted, rel=0.15)
        assert np.array_equal(given[:, :160], frame[:, :160])
        again = film_grain.Grain(model, (WIDTH, HEIGHT), seed=0).add(frame, changed)
        assert np.array_equal(given, again)


def test_photo_pixels_get_almost_no_grain():
    clean = picture()
    photo = linear(clean + noise(1, clean, 0.0))
    given = film_grain.Grain(film_grain.estimate_noise(photo), (WIDTH, HEIGHT), seed=0).add(
        photo, np.ones((HEIGHT, WIDTH), np.float32)
    )
    added = (film_grain._planes(given) - film_grain._planes(photo))[..., 0]
    assert added.std() < 0.3 * noise(1, clean, 0.0).std()


@pytest.mark.parametrize("jpeg", [False, True])
def test_clean_pictures_have_no_grain(jpeg):
    clean = np.rint(cv2.GaussianBlur(picture(), (0, 0), 2)).astype(np.uint8)
    if jpeg:
        clean = cv2.imdecode(cv2.imencode(".jpg", clean, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], cv2.IMREAD_COLOR)
    model = film_grain.estimate_noise(srgb.bytes_to_linear(clean))
    frame = srgb.bytes_to_linear(clean)
    assert model.is_clean
    assert film_grain.Grain(model, (WIDTH, HEIGHT), seed=0).add(frame, np.ones((HEIGHT, WIDTH), np.float32)) is frame


def test_pictures_too_small_to_measure_are_clean():
    assert film_grain.estimate_noise(np.random.default_rng(0).random((20, 30, 3), dtype=np.float32)).is_clean


def test_a_smooth_thing_before_rough_ground_bears_little_of_its_grain():
    clean = picture()
    rough = clean + noise(1, clean, 0.0)
    smooth = np.zeros((HEIGHT, WIDTH), dtype=bool)
    smooth[10:90, 200:300] = True
    rough[smooth] = clean[smooth]
    photo = linear(rough)
    model = film_grain.estimate_noise(photo)
    assert not model.is_clean
    assert film_grain.noise_share(model, photo, smooth) < 0.25
    assert film_grain.noise_share(model, photo, np.roll(smooth, 120, axis=0)) > 0.85
    assert film_grain.noise_share(model, photo, np.zeros_like(smooth)) == 1.0
