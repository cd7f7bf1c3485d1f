# SPDX-License-Identifier: MIT
"""Floors whose pattern repeats in two directions, seen in perspective, under a camera that is only roughly known."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.background.background_inpainting import fill_background
from physgen.sim.reconstruct.background.lattice_pattern import Lattice, find_lattice
from physgen.sim.reconstruct.background.surface_inpainting import logarithms
from physgen.sim.reconstruct.background.unboxed_things import unboxed_things
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground

WIDTH, HEIGHT, FOCAL, SAMPLES = 480, 360, 520.0, 3


def camera(pitch):
    return camera_above_ground(WIDTH, HEIGHT, FOCAL, math.radians(pitch))


def floor(kind, pitch, turn=17.0):
    """The photo (H, W, 3) of a floor of ``kind`` from ``pitch`` degrees above, with light that falls off and noise."""
    steps = (np.arange(WIDTH * SAMPLES) + 0.5) / SAMPLES, (np.arange(HEIGHT * SAMPLES) + 0.5) / SAMPLES
    places = on_ground(camera(pitch), np.stack(np.meshgrid(*steps), axis=-1))
    angle = math.radians(turn)
    x = places[..., 0] * math.cos(angle) + places[..., 1] * math.sin(angle)
    y = places[..., 1] * math.cos(angle) - places[..., 0] * math.sin(angle)
    with np.errstate(invalid="ignore"):
        if kind == "dots":
            dark = np.hypot((x / 0.14) % 1.0 - 0.5, (y / 0.14) % 1.0 - 0.5) < 0.28
        elif kind == "large dots":
            dark = np.hypot((x / 0.25) % 1.0 - 0.5, (y / 0.25) % 1.0 - 0.5) < 0.2
        elif kind == "checks":
            dark = (np.floor(x / 0.13) + np.floor(y / 0.13)) % 2 == 0
        elif kind == "tiles":
            dark = (x / 0.15) % 1.0 < 0.07
            dark |= (y / 0.15) % 1.0 < 0.07
        else:
            rng = np.random.default_rng(5)
            noise = cv2.GaussianBlur(rng.normal(size=(700, 700)).astype(np.float32), (0, 0), 6.0)
            at = [np.nan_to_num(part * 120.0 + 350.0).clip(0, 699).astype(int) for part in (x, y)]
            dark = noise[at[1], at[0]] > 0.0
    seen = np.where(dark[..., None], (96.0, 104.0, 108.0), (196.0, 214.0, 204.0))
    small = cv2.resize(seen, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    light = np.linspace(0.85, 1.1, WIDTH)[None, :, None] * np.linspace(0.9, 1.05, HEIGHT)[:, None, None]
    noisy = small * light + np.random.default_rng(0).normal(scale=2.0, size=small.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def hole():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot((columns - 230) / 60.0, (rows - 200) / 75.0) < 1.0


def error(plate, photo, where):
    return float(np.sqrt(np.square(plate[where].astype(float) - photo[where]).mean()))


@pytest.mark.parametrize("kind", ["dots", "checks", "tiles"])
@pytest.mark.parametrize("off", [-9.0, 8.0])
def test_the_pattern_goes_on_behind_the_object_under_a_camera_that_is_off(kind, off):
    photo, where = floor(kind, 42.0), hole()
    covered = photo.copy()
    covered[where] = (150, 60, 40)
    plate = fill_background(covered, where, where, camera(42.0 + off))
    assert (plate[~where] == covered[~where]).all()
    # Without the lattice it is off by 11 to 21; the noise that nothing foretells by 2.
    assert error(plate, photo, where) < 8.0


def test_what_does_not_repeat_has_no_lattice():
    photo = floor("spots", 42.0)
    logs = logarithms(photo.astype(np.float32))
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    assert find_lattice(logs, hole(), nothing, camera(42.0)) is None
    plain = np.full_like(photo, 180)
    assert find_lattice(logarithms(plain.astype(np.float32)), hole(), nothing, camera(42.0)) is None
    assert find_lattice(logs, hole(), ~hole(), camera(42.0)) is None


def test_a_lattice_says_how_much_it_foretells_and_fits_copies_of_the_photo():
    logs = logarithms(floor("dots", 42.0).astype(np.float32))
    found = find_lattice(logs, hole(), np.zeros((HEIGHT, WIDTH), dtype=bool), camera(42.0))
    assert found is not None and 0.7 < found.share <= 1.0
    places = np.array([[230.0, 200.0], [210.0, 230.0]])
    whole, weights = found.foretold(logs, ~hole(), places)
    assert (weights > 0.0).all()
    half = cv2.resize(logs, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
    small, _ = found.scaled(0.5, 0.5).foretold(half, ~hole()[::2, ::2], places / 2.0)
    moved, _ = found.moved(30.0, 20.0).foretold(logs[20:, 30:], ~hole()[20:, 30:], places - (30.0, 20.0))
    assert np.abs(small - whole).max() < 0.15 and np.abs(moved - whole).max() < 0.15


def test_places_that_repeat_nowhere_in_sight_are_not_foretold():
    far = Lattice(np.eye(3), np.array([1e5, 0.0]), np.array([0.0, 1e5]))
    values, weights = far.foretold(np.ones((9, 9, 3), np.float32), np.ones((9, 9), bool), np.array([[4.0, 4.0]]))
    assert (weights == 0.0).all() and np.isfinite(values).all()


def test_dots_of_a_cloth_are_no_things_that_stay():
    photo = floor("large dots", 42.0)
    where = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([190, 220])[:, None, None])) < 45
    photo[where] = (150, 60, 40)
    assert not unboxed_things(photo, [where], camera(33.0)).stay.any()
    # What lies on the cloth does, though it hides some dots.
    thing = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([210, 370])[:, None, None])) < 42
    photo[thing] = (40, 90, 170)
    found = unboxed_things(photo, [where], camera(33.0))
    assert (found.stay & thing).sum() > 0.9 * thing.sum()


@pytest.mark.parametrize("pitch", [90.0, 89.99, 2.0])
def test_a_camera_straight_down_or_level_is_answered(pitch):
    logs = logarithms(floor("checks", 42.0).astype(np.float32))
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    found = find_lattice(logs, hole(), nothing, camera(pitch))
    assert found is None or np.isfinite(found.photo_from_plane).all()
    # Nothing is known beside the hole.
    near = cv2.dilate(hole().astype(np.uint8), np.ones((121, 121), np.uint8)) > 0
    assert find_lattice(logs, hole(), near & ~hole(), camera(pitch)) is None
