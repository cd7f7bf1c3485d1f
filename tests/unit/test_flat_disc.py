# SPDX-License-Identifier: MIT
"""Coins seen from above lie, balls do not: the same outline, told apart by shading."""

import math

import numpy as np
import pytest
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape.flat_disc import is_disc, smooth_share
from physgen.sim.reconstruct.shape.inflate import crop_mask
from physgen.sim.reconstruct.shape.primitive_choice import choose_primitive
from physgen.sim.reconstruct.shape.primitives import Sphere, SurfaceOfRevolution, rasterize

WIDTH, HEIGHT = 320, 240


def camera(pitch):
    return camera_above_ground(WIDTH, HEIGHT, 400.0, math.radians(pitch))


def ahead(view, row):
    """The place on the ground that ``view`` sees in the middle of ``row``."""
    ray = view.rays(np.array([WIDTH / 2, row]))
    place = view.position - ray * view.position[2] / ray[2]
    return float(place[0]), float(place[1])


def painted(mask, *, shaded, relief, seed=0):
    """A photo of the round ``mask``: shading of a ball under a lamp from the upper left, and a coin's relief."""
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(mask)
    v, u = ((np.array([rows, columns]).T - [rows.mean(), columns.mean()]) / (0.5 * np.ptp(rows))).T
    image = np.full((HEIGHT, WIDTH, 3), 220.0)
    light = np.full(len(rows), 0.5)
    if shaded:
        up = np.sqrt(np.clip(1.0 - u**2 - v**2, 0.0, 1.0))
        light *= 0.3 + 0.7 * np.clip((-0.4 * u - 0.4 * v + 0.82 * up), 0.0, 1.0)
    light *= 1.0 + relief * np.sign(np.sin(17 * u + rng.uniform(0, 6)) * np.sin(13 * v + rng.uniform(0, 6)))
    image[rows, columns] = (255.0 * np.clip(light, 0, 1) ** (1 / 2.2))[:, None] * np.array([1.0, 0.9, 0.7])
    return np.clip(image + rng.normal(scale=2, size=image.shape), 0, 255).astype(np.uint8)


def chosen(view, body, **look):
    mask = rasterize(body, view, (HEIGHT, WIDTH), 0, 0)
    return choose_primitive(view, crop_mask(mask), mask, mask, painted(mask, **look))


@pytest.mark.parametrize("pitch", [76.0, 88.0])
def test_what_is_struck_and_not_shaded_lies(pitch):
    view = camera(pitch)
    x, y = ahead(view, 130.0)
    coin = SurfaceOfRevolution(x, y, (0.0, 0.03), (0.15, 0.15))
    found = chosen(view, coin, shaded=False, relief=0.35).primitive
    assert isinstance(found, SurfaceOfRevolution) and found.height < 0.3 * max(found.radii)
    assert max(found.radii) == pytest.approx(0.15, rel=0.03)
    assert np.hypot(found.x - x, found.y - y) < 0.02


@pytest.mark.parametrize("relief", [0.0, 0.15])
def test_what_is_shaded_is_a_ball(relief):
    view = camera(76.0)
    ball = Sphere(*ahead(view, 130.0), 0.15, 1.0)
    assert isinstance(chosen(view, ball, shaded=True, relief=relief).primitive, Sphere)


def test_a_circle_seen_at_a_slant_is_a_ball_whatever_is_on_it():
    view = camera(30.0)
    ball = Sphere(*ahead(view, 150.0), 0.2, 1.0)
    assert isinstance(chosen(view, ball, shaded=False, relief=0.35).primitive, Sphere)


def test_nothing_is_told_by_nothing():
    pixels = np.full((20, 20, 3), 128, np.uint8)
    empty, dot = np.zeros((20, 20), bool), np.zeros((20, 20), bool)
    dot[5:8, 5:8] = True
    assert smooth_share(pixels, empty) == smooth_share(pixels, dot) == 1.0
    assert not is_disc(pixels, dot)


def test_most_of_many_decide():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    masks = [np.hypot(columns - x, rows - y) < 30 for y in (60, 160) for x in (50, 125, 200, 275)]
    picture = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    for i, mask in enumerate(masks):
        own = painted(mask, shaded=i == 0, relief=0.0 if i == 0 else 0.35, seed=i)
        picture[mask] = own[mask]
    assert smooth_share(picture, masks[0]) > 0.8
    assert is_disc(picture, masks[0]) and is_disc(picture, masks[1])
    alone = np.where(masks[0][..., None], picture, np.uint8(40))
    assert not is_disc(alone, masks[0])
