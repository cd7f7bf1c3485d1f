# SPDX-License-Identifier: MIT
"""The background behind what is taken out, on drawn surfaces whose hidden part is known."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.composite.inpaint import FillOptions
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.background.background_inpainting import blend, fill_background
from physgen.sim.reconstruct.background.surface_edges import edges_behind
from physgen.sim.reconstruct.background.surface_inpainting import logarithms
from physgen.sim.reconstruct.background.texture_prediction import conditional_mean, predict_texture
from physgen.sim.reconstruct.background.top_view import to_photo, to_top_view, top_views, visible_in_photo
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground

WIDTH, HEIGHT = 240, 180


def camera(pitch=40.0):
    return camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(pitch))


def tiles(view, side=0.22, samples=3):
    """A tiled floor under slanting light, as ``view`` sees it, (H, W, 3) uint8."""
    x, y = np.meshgrid((np.arange(WIDTH * samples) + 0.5) / samples, (np.arange(HEIGHT * samples) + 0.5) / samples)
    at = on_ground(view, np.stack([x, y], axis=-1))
    odd = (np.floor(at[..., 0] / side) + np.floor(at[..., 1] / side)) % 2 > 0
    light = 0.75 + 0.2 * x / WIDTH
    fine = np.where(odd, 190.0, 90.0) * light
    grey = fine.reshape(HEIGHT, samples, WIDTH, samples).mean(axis=(1, 3))
    noise = np.random.default_rng(0).normal(scale=1.5, size=grey.shape)
    return np.clip(np.stack([grey + noise, 0.9 * grey + noise, 0.8 * grey + noise], axis=-1), 0, 255).astype(np.uint8)


def disc(x, y, radius, shape=(HEIGHT, WIDTH)):
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def decibels(first, second, where):
    return -10.0 * np.log10(np.mean(np.square((first[where].astype(float) - second[where]) / 255.0)))


@pytest.mark.long
def test_tiles_go_on_behind_an_object_better_than_any_diffusion():
    view = camera()
    truth = tiles(view)
    thing, hole = disc(120, 100, 24), disc(120, 100, 30)
    photo = truth.copy()
    photo[thing] = (30, 60, 200)
    found = fill_background(photo, hole, thing, view)
    assert (found[~hole] == photo[~hole]).all()
    flat = max(
        decibels(cv2.inpaint(photo, hole.astype(np.uint8), 5, kind), truth, hole)
        for kind in (cv2.INPAINT_NS, cv2.INPAINT_TELEA)
    )
    assert decibels(found, truth, hole) > flat + 4.0
    again = fill_background(photo, hole, thing, view)
    assert (again == found).all()


def test_a_floor_ends_at_its_wall_behind_the_object():
    rows = np.mgrid[:HEIGHT, :WIDTH][0] + 0.5
    columns = np.mgrid[:HEIGHT, :WIDTH][1] + 0.5
    floor = rows > 80.0 + 0.05 * columns
    grain = np.random.default_rng(1).normal(scale=2.0, size=(HEIGHT, WIDTH, 1))
    truth = np.where(floor[..., None], (150.0, 110.0, 70.0), (190.0, 200.0, 205.0)) + grain
    truth = np.clip(truth, 0, 255).astype(np.uint8)
    thing, hole = disc(120, 86, 24), disc(120, 86, 30)
    photo = truth.copy()
    photo[thing] = 20
    edges = edges_behind(logarithms(photo.astype(np.float32)), hole, hole)
    assert len(edges) == 1
    assert (edges[0].below(hole.shape) != floor)[hole].mean() < 0.02
    found = fill_background(photo, hole, thing, camera(20.0))
    flat = decibels(cv2.inpaint(photo, hole.astype(np.uint8), 5, cv2.INPAINT_NS), truth, hole)
    assert decibels(found, truth, hole) > flat + 4.0
    # On one surface there is no edge to be found.
    plain = np.full((HEIGHT, WIDTH, 3), 120.0, np.float32) + grain.astype(np.float32)
    assert edges_behind(logarithms(plain), hole, hole) == []


def test_both_edges_of_a_skirting_go_on_behind_the_object():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    lower, upper = 90.0 + 0.08 * columns, 81.0 + 0.07 * columns
    rng = np.random.default_rng(4)
    boards = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), sigmaX=12, sigmaY=1)[..., None] * 60.0
    photo = np.where((rows > lower)[..., None], np.array((150.0, 112.0, 76.0)) + boards, (176.0, 182.0, 190.0))
    photo = np.where(((rows > upper) & (rows <= lower))[..., None], (232.0, 230.0, 224.0), photo)
    photo = photo * (0.9 + 0.2 * columns / WIDTH)[..., None] + rng.normal(scale=1.5, size=photo.shape)
    hole = disc(120, 92, 34)
    edges = edges_behind(logarithms(np.clip(photo, 0, 255).astype(np.float32)), hole, hole)
    found = sorted(edges, key=lambda edge: edge.c)
    assert len(found) == 2
    for edge, line in zip(found, (upper, lower), strict=True):
        assert (edge.below(hole.shape) != (rows > line))[hole].mean() < 0.02


def test_excluded_pixels_are_not_copied():
    view = camera()
    photo = np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    hole = disc(100, 100, 20)
    other = disc(150, 100, 26) & ~hole
    photo[other] = (255, 0, 0)
    found = fill_background(photo, hole, hole, view, barred=other)
    assert np.abs(found[hole].astype(int) - 150).max() < 12
    assert (found[other] == photo[other]).all()


def test_no_object_shows_through_the_border():
    photo = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    thing, hole = disc(120, 90, 30), disc(120, 90, 34)
    photo[disc(120, 90, 31.5)] = 250
    blended = blend(photo, np.full_like(photo, 100), hole, thing)
    assert (blended[~hole] == photo[~hole]).all()
    # The filling is led up to the photo's level at the border, and nothing is brighter than that.
    assert blended[hole].max() <= 121
    assert blended[disc(120, 90, 5)].min() >= 117
    # Nor is it led up to the thing.
    dark = blend(photo, np.full_like(photo, 20), hole, thing)
    assert dark[disc(120, 90, 26)].max() <= 21
    assert blended[hole & ~disc(120, 90, 33)].mean() > 112


def test_a_view_from_above_and_back_is_the_photo():
    view = camera(30.0)
    photo = cv2.GaussianBlur(tiles(view), (0, 0), 1.0).astype(np.float32)
    hole = disc(120, 130, 25)
    ((above, part),) = top_views(view, hole, 400_000)
    assert (part == hole).all()
    rows, columns = slice(100, 160), slice(90, 150)
    back = to_photo(to_top_view(photo, above), above, rows, columns)
    inner = hole[rows, columns]
    assert np.abs(back - photo[rows, columns])[inner].mean() < 2.0
    assert not visible_in_photo(above, hole).all()


def test_waves_are_foreseen_and_noise_is_not():
    rows, columns = np.mgrid[:90, :110]
    wave = np.sin(rows / 3.0 + columns / 5.0)
    values = np.repeat(wave[..., None], 3, axis=2).astype(np.float32) * np.array([1.0, 0.5, 0.2], np.float32)
    hole = disc(55, 45, 14, wave.shape)
    found, certain = predict_texture(np.where(hole[..., None], 9.0, values), ~hole, hole)
    assert certain > 0.8
    assert np.square(found - values)[hole].mean() < 0.15 * np.square(values[hole]).mean()
    noise = np.random.default_rng(2).normal(size=values.shape).astype(np.float32)
    found, certain = predict_texture(noise, ~hole, hole)
    assert certain < 0.1
    assert np.abs(found[hole]).mean() < 0.3
    assert (conditional_mean(noise, np.zeros_like(hole), 0.5) == 0).all()


def test_a_photo_without_background_is_refused():
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    everything = np.ones((HEIGHT, WIDTH), bool)
    with pytest.raises(InputError, match="no background"):
        fill_background(photo, everything, everything, camera())
    with pytest.raises(InputError, match="hole is"):
        fill_background(photo, everything[:9], everything, camera(), FillOptions())
    nothing = np.zeros_like(everything)
    assert (fill_background(photo, nothing, nothing, camera()) == photo).all()


@pytest.mark.parametrize("start", [0, 260])
def test_an_edge_beside_a_small_thing_only_does_not_pass_behind_a_large_one(start):
    """A mat that ends between both at column 260 is no far edge of the floor."""
    logs = np.random.default_rng(0).normal(-1.0, 0.01, (360, 480, 3)).astype(np.float32)
    logs[200:, start:] -= np.float32([0.15, 0.25, 0.5])
    hidden = np.zeros((360, 480), bool)
    hidden[80:260, 60:200] = hidden[160:240, 330:400] = True
    found = edges_behind(logs, hidden, hidden)
    assert [round(edge.c) for edge in found] == ([200] if start == 0 else [])


@pytest.mark.parametrize("white", [True, False], ids=["white", "studio"])
def test_behind_a_thing_a_plain_backdrop_goes_on_without_a_stain_or_an_edge(white):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    floor = 1.0 / (1.0 + np.exp(-(rows - 0.7 * HEIGHT) / (0.08 * HEIGHT)))
    level = np.full((HEIGHT, WIDTH), 253.0) if white else 150.0 + 45.0 * floor
    truth = level[..., None] + np.random.default_rng(3).normal(0.0, 0.8, (HEIGHT, WIDTH, 3))
    x, y = 0.5 * WIDTH, 0.8 * HEIGHT
    shade = 0.5 * np.exp(-(((columns - x) / (0.2 * WIDTH)) ** 2) - ((rows - y) / (0.06 * HEIGHT)) ** 2)
    thing = disc(x, 0.55 * HEIGHT, 0.25 * HEIGHT)
    picture = np.where(thing[..., None], (60.0, 170.0, 190.0), truth * (1.0 - shade)[..., None])
    picture = np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8), 0, 255).astype(np.uint8)
    hole = cv2.dilate((thing | (shade > 0.02)).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    filled = fill_background(picture, hole, thing, camera(20.0))
    assert decibels(filled, np.clip(truth, 0, 255), hole) > 36.0


def hill(sag, seed=2):
    """A pale stone before dark water: photo uint8, rows of its outline (W,), truth below, and what stands before it."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    outline = 62.0 + sag * np.square((columns[0] - 95.0) / 50.0) + 0.05 * columns[0]
    stone = rows > outline
    truth = np.where(stone[..., None], (190.0, 165.0, 140.0), (40.0, 48.0, 36.0))
    truth = truth + rng.normal(scale=np.where(stone, 6.0, 1.5)[..., None], size=truth.shape)
    thing = (np.abs(columns - 100.0) < 22.0) & (rows > 30.0) & (rows < 110.0)
    photo = np.clip(truth, 0, 255).astype(np.uint8)
    photo[thing] = (60, 150, 200)
    return photo, outline, stone, thing


@pytest.mark.parametrize("sag", [12.0, -9.0], ids=["hill", "hollow"])
def test_a_curved_outline_joins_both_of_its_ends_behind_the_object(sag):
    photo, outline, stone, thing = hill(sag)
    hole = cv2.dilate(thing.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    (edge,) = edges_behind(logarithms(photo.astype(np.float32)), hole, thing)
    columns = np.flatnonzero(hole.any(axis=0))
    behind = (edge.height(hole.shape) <= 0.0).sum(axis=0)[columns]
    # A straight line through both ends is off by 3 pixels or more, in the middle.
    chord = np.interp(columns, columns[[0, -1]], outline[columns[[0, -1]]])
    assert np.abs(chord - outline[columns]).max() > 1.5 * np.abs(behind - outline[columns]).max()
    assert np.abs(np.diff(behind)).max() <= 2.0
    found = fill_background(photo, hole, thing, camera(20.0)).astype(float).mean(axis=-1)
    assert ((found > 100.0) != stone)[hole].mean() < 0.03


def test_an_outline_that_is_straight_stays_a_line():
    for seed in range(4):
        photo, _, _, thing = hill(0.0, seed)
        hole = cv2.dilate(thing.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        (edge,) = edges_behind(logarithms(photo.astype(np.float32)), hole, thing)
        assert edge.bend is None
