# SPDX-License-Identifier: MIT
"""How a hole's filling is chosen, where the ground ends, and what a filling may not do."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.composite.inpaint import FillOptions
from physgen.sim.reconstruct.background.background_inpainting import blend, fill_background, leftover_shadow
from physgen.sim.reconstruct.background.inpainting_methods import (
    METHODS,
    VIEW_PIXELS,
    InpaintingTask,
    lay_grain,
    match_grain,
)
from physgen.sim.reconstruct.background.method_choice import choose_method, similarity, trial_holes
from physgen.sim.reconstruct.background.surface_edges import edges_behind
from physgen.sim.reconstruct.background.surface_inpainting import clamp_to_surroundings, logarithms
from physgen.sim.reconstruct.background.top_view import top_views, visible_in_photo
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground

WIDTH, HEIGHT = 200, 150


def camera(pitch=40.0):
    return camera_above_ground(WIDTH, HEIGHT, 220.0, math.radians(pitch))


def disc(x, y, radius):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def checks(side=0.25, samples=3):
    """A chequered floor, float32."""
    x, y = np.meshgrid((np.arange(WIDTH * samples) + 0.5) / samples, (np.arange(HEIGHT * samples) + 0.5) / samples)
    at = on_ground(camera(), np.stack([x, y], axis=-1))
    odd = (np.floor(at[..., 0] / side) + np.floor(at[..., 1] / side)) % 2 > 0
    grey = np.where(odd, 180.0, 80.0).reshape(HEIGHT, samples, WIDTH, samples).mean(axis=(1, 3))
    return np.repeat(grey[..., None], 3, axis=2).astype(np.float32)


def wood(seed, mean):
    """Grain along the rows, float32."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH, 1)).astype(np.float32)
    return np.float32(mean) + 60.0 * cv2.GaussianBlur(noise, (0, 0), sigmaX=6.0, sigmaY=1.0)[..., None] * np.ones(
        3, np.float32
    )


def test_a_floor_in_perspective_is_filled_from_above_and_a_flat_picture_is_not():
    hole = disc(100, 85, 22)
    nothing = np.zeros_like(hole)
    floor = choose_method(InpaintingTask(checks(), hole, nothing, camera(), FillOptions()), ("by rows", "as ground"))
    assert floor.way == "as ground"
    assert floor.scores["as ground"] > floor.scores["by rows"] + 1.0
    assert floor.certain > 1.0
    # Stripes that are equal all over the photo are no pattern of a plane in perspective.
    columns = np.arange(WIDTH)[None, :] * np.ones((HEIGHT, 1))
    stripes = np.where((columns // 6) % 2 > 0, 180.0, 80.0)[..., None] * np.ones(3)
    flat = choose_method(
        InpaintingTask(stripes.astype(np.float32), hole, nothing, camera(), FillOptions()), ("by rows", "as ground")
    )
    assert flat.way == "by rows"


def test_without_room_for_a_trial_the_photo_is_filled_by_rows_and_the_user_is_told():
    said = []
    photo = np.clip(wood(0, 120.0), 0, 255).astype(np.uint8)
    hole = np.ones((HEIGHT, WIDTH), dtype=bool)
    hole[:, :14] = False
    assert trial_holes(hole, ~hole) == []
    found = fill_background(photo, hole, hole, camera(), notice=said.append)
    assert (found[~hole] == photo[~hole]).all()
    assert len(said) == 1
    assert "guess" in said[0]
    assert "columns 14 to 200" in said[0]


def test_trial_holes_lie_in_what_is_known_and_apart():
    hole = disc(60, 75, 20)
    known = ~hole & ~disc(150, 40, 15)
    first, second = trial_holes(hole, known)
    assert not (first & ~known).any()
    assert not (second & ~known).any()
    assert not (first & second).any()
    assert min(first.sum(), second.sum()) >= 0.5 * hole.sum()


def test_softness_and_glow_lose_against_the_right_texture():
    truth = wood(1, 120.0)
    hole = disc(100, 75, 30)
    soft = np.where(hole[..., None], cv2.GaussianBlur(truth, (0, 0), 8.0), truth)
    other = np.where(hole[..., None], np.roll(truth, 1, axis=1), truth)
    assert similarity(truth, truth, hole) > similarity(other, truth, hole) > similarity(soft, truth, hole)
    # Of equal squared error, the one without details loses.
    error = float(np.sqrt(np.square(soft - truth)[hole].mean()))
    shifted = np.where(hole[..., None], truth + error, truth)
    assert similarity(shifted, truth, hole) > similarity(soft, truth, hole) + 1.0


@pytest.mark.parametrize("border", [50, pytest.param(62, marks=pytest.mark.slow)])
def test_a_table_ends_before_a_cluttered_room(border):
    table = wood(2, 110.0)
    blocks = np.random.default_rng(3).uniform(20, 240, size=(10, 12, 3)).astype(np.float32)
    room = cv2.resize(blocks, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    room[border - 6 : border] = 225.0
    photo = np.where(np.arange(HEIGHT)[:, None, None] < border, room, table).astype(np.float32)
    hole = np.zeros((HEIGHT, WIDTH), dtype=bool)
    hole[25:105, 80:130] = True
    edge, *others = edges_behind(logarithms(photo), hole, hole)
    line = (edge.c - edge.a * np.array([80.0, 130.0])) / edge.b
    assert np.abs(line - border).max() < 2.5
    # The bright band over it is the only other thing that goes on behind the hole.
    for other in others:
        line = (other.c - other.a * np.array([80.0, 130.0])) / other.b
        assert np.abs(line - (border - 6)).max() < 2.5
    found = fill_background(np.clip(photo, 0, 255).astype(np.uint8), hole, hole, camera(25.0)).astype(float)
    # The wood does not climb up the room, nor the other way round.
    assert np.abs(found[border + 4 : 100, 85:125].mean() - 110.0) < 15.0
    assert np.abs(found[border - 5 : border - 2, 85:125].mean() - 225.0) < 25.0


def test_grain_of_wood_is_no_border():
    hole = disc(100, 75, 35)
    for seed in range(3):
        assert edges_behind(logarithms(wood(seed, 120.0)), hole, hole) == []


def test_no_glow_and_no_gloom_that_is_not_seen_around():
    hole = disc(100, 75, 30)
    around = 120.0 + 10.0 * np.linspace(-1, 1, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    for colour in ((1.8, 1.0, 0.6), (0.4, 0.4, 0.4), (1.0, 1.0, 1.0)):
        filled = np.where(hole[..., None], around * np.array(colour), around).astype(np.float32)
        kept = np.exp(clamp_to_surroundings(np.log(filled), hole, ~hole))
        assert np.abs(kept[~hole] - filled[~hole]).max() < 1e-3
        deep = disc(100, 75, 20)
        assert kept[deep].min() > 100.0
        assert kept[deep].max() < 140.0
    assert np.abs(kept - filled).max() < 1.5


def test_shadow_outside_of_the_hole_is_no_source():
    photo = wood(4, 130.0)
    hole = disc(100, 60, 32)
    shade = disc(100, 66, 34) & ~hole
    photo[shade] *= 0.25
    found = leftover_shadow(logarithms(photo), hole, hole)
    assert (found & shade).sum() > 0.8 * shade.sum()
    assert (found & ~shade).sum() < 0.5 * shade.sum()
    filled = fill_background(np.clip(photo, 0, 255).astype(np.uint8), hole, hole, camera(60.0))
    assert filled[hole].mean() > 110.0
    assert (filled[disc(100, 60, 30)] < 60).mean() < 0.01
    # Dark checks are part of the floor: they are seen farther away as well.
    assert leftover_shadow(logarithms(checks()), hole, hole).sum() == 0


def test_fill_is_not_extended_into_shade():
    photo = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    hole = disc(100, 75, 30)
    shade = ~hole & disc(100, 75, 40)
    filling = np.full_like(photo, 120)
    inner, thing = disc(100, 75, 26), disc(100, 75, 15)
    photo[shade] = 95
    assert blend(photo, filling, hole, thing)[inner].max() < 110
    assert blend(photo, filling, hole, thing, shade)[inner].min() == 120
    # So dark beside the hole is a thing, and no difference of level.
    photo[shade] = 20
    assert blend(photo, filling, hole, thing)[inner].min() == 120


def test_a_soft_filling_becomes_as_grainy_as_its_surroundings():
    photo = wood(5, 120.0)
    hole = disc(100, 75, 30)
    deep = disc(100, 75, 24)
    soft = np.where(hole[..., None], 120.0 + 0.6 * (photo - 120.0), photo).astype(np.float32)

    def detail(picture):
        return float((picture - cv2.GaussianBlur(picture, (0, 0), 1.0))[deep].std())

    matched = match_grain(soft, hole, ~hole)
    assert abs(detail(matched) / detail(photo) - 1.0) < 0.25
    assert detail(soft) < 0.65 * detail(photo)
    flat = np.where(hole[..., None], np.float32(120.0), photo)
    assert np.isfinite(match_grain(flat, hole, ~hole)).all()


@pytest.mark.parametrize("way", list(METHODS))
def test_every_way_fills_and_leaves_the_rest(way):
    picture = checks()
    hole = disc(100, 85, 18)
    task = InpaintingTask(
        np.where(hole[..., None], np.float32(-500.0), picture), hole, disc(30, 30, 10), camera(), FillOptions()
    )
    filled, again = METHODS[way](task), METHODS[way](task)
    assert (filled[hole] > 20.0).all()
    assert (filled == again).all()


def test_a_floor_of_which_little_shows_is_still_filled_from_above():
    # A trial hole lies among objects; the view from above reaches far beside the photo, so little of it is known.
    hole = disc(100, 85, 26)
    closed = ~disc(100, 85, 31) & ~hole
    task = InpaintingTask(checks(), hole, closed, camera(), FillOptions())
    ((view, _),) = top_views(camera(), hole, VIEW_PIXELS)
    share = visible_in_photo(view, closed | hole).mean()
    assert 0.02 < share < 0.06
    filled, rows = METHODS["as ground"](task), METHODS["by rows"](task)
    assert not np.array_equal(filled[hole], rows[hole])


def test_detail_of_a_large_hole_comes_in_stretches_from_beside_it():
    height, width = 420, 620
    rng = np.random.default_rng(6)
    # Grain that becomes coarser towards the camera.
    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), blur) for blur in (0.6, 2.0))
    near = np.linspace(0.0, 1.0, height)[:, None]
    grain = (1.0 - near) * fine / fine.std() + near * coarse / coarse.std()
    photo = np.repeat((120.0 + 12.0 * grain)[..., None], 3, axis=2).astype(np.float32)
    hole = np.zeros((height, width), dtype=bool)
    hole[80:340, 180:420] = True
    blurred = np.where(hole[..., None], cv2.GaussianBlur(photo, (0, 0), 6.0), photo)
    laid = lay_grain(blurred, hole, ~hole)
    assert np.abs(laid - photo)[~hole].max() < 1e-2

    def slope(picture, rows):
        """Step from pixel to pixel over the contrast: how fine the grain is."""
        part = picture[rows, 200:400].mean(axis=-1)
        return float(np.diff(part, axis=1).std() / part.std())

    for rows in (slice(90, 170), slice(250, 330)):
        assert abs(slope(laid, rows) / slope(photo, rows) - 1.0) < 0.25
        assert laid[rows, 200:400].std() > 0.7 * photo[rows, 200:400].std()
    assert blurred[90:170, 200:400].std() < 0.4 * photo[90:170, 200:400].std()


def shaded_table(seed, tilt, up):
    """A table before a cluttered room, its left side slanting away, with an object over its far edge and shadow around,
    ``up`` the room as well: logarithms, the object, the hole with the shadow, the edge's rows by columns."""
    rng, (height, width) = np.random.default_rng(seed), (240, 300)
    y, x = np.mgrid[:height, :width] + 0.5
    edge = 95.0 + tilt * (x - width / 2)
    grain = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigmaX=15, sigmaY=1.2)
    table = np.array((120.0, 75.0, 45.0)) * (1.0 + 0.06 * grain / grain.std())[..., None]
    room = cv2.resize(rng.uniform(20, 240, size=(8, 9, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
    photo = np.where(((y > edge) & (y - edge > 0.45 * (70.0 - x)))[..., None], table, room)
    photo += rng.normal(scale=1.5, size=photo.shape)
    thing = (np.abs(x - 160) < 36) & (y > 60) & (y < 165)
    shade = ((np.abs(x - 160) < 40) & (y > 100)) | ((x < 160) & (x > 20) & (y > 135) & (y < 175))
    if up:
        shade |= (x > 150) & (x < 225) & (y > 70) & (y < 165)
    photo *= 1.0 - 0.4 * cv2.GaussianBlur(shade.astype(float), (0, 0), 2)[..., None]
    photo[thing] = 30.0
    hole = cv2.dilate((thing | shade).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return logarithms(np.clip(photo, 1, 255).astype(np.float32)), thing, hole, edge[0]


@pytest.mark.parametrize(("seed", "tilt", "up"), [(1, 0.03, False), (3, -0.08, False), (3, 0.1, True)])
def test_a_shadow_hides_no_edge(seed, tilt, up):
    logs, thing, hole, true = shaded_table(seed, tilt, up)
    hidden = cv2.dilate(thing.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    (edge,) = edges_behind(logs, hole, hidden, hole)
    columns = np.flatnonzero(thing.any(axis=0))
    # A pixel: the edge is sharp, and the photo is all that is known of it.
    assert np.abs((edge.c - edge.a * (columns + 0.5)) / edge.b - true[columns]).max() < 1.0


def test_the_border_of_a_shadow_is_no_edge():
    shade = np.zeros((HEIGHT, WIDTH), dtype=bool)
    shade[70:] = True
    thing = disc(100, 75, 24)
    photo = wood(5, 130.0) * (1.0 - 0.5 * cv2.GaussianBlur(shade.astype(np.float32), (0, 0), 0.7))[..., None]
    hole = cv2.dilate((thing | shade).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert len(edges_behind(logarithms(photo), hole, thing)) == 1
    assert edges_behind(logarithms(photo), hole, thing, hole) == []


def test_brighter_on_one_side_of_the_hole_and_darker_on_the_other_is_no_edge():
    # As the mirror images of a door on a floor of boards are; opposed by 0.2 in logarithms.
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    opposed = cv2.GaussianBlur(((y < 78) == (x < 100)).astype(np.float32), (0, 0), 1.0)[..., None]
    colour = 150.0 * np.array([1.0, 0.8, 0.5])
    noise = np.random.default_rng(0).normal(scale=3.0, size=(HEIGHT, WIDTH, 1))
    thing = disc(100, 75, 24)
    assert edges_behind(logarithms((colour * np.exp(-0.2 * opposed) + noise).astype(np.float32)), thing, thing) == []
    # The same step alike on both sides is one.
    alike = cv2.GaussianBlur((y < 78).astype(np.float32), (0, 0), 1.0)[..., None]
    (edge,) = edges_behind(logarithms((colour * np.exp(-0.2 * alike) + noise).astype(np.float32)), thing, thing)
    assert abs((edge.c - edge.a * 100.0) / edge.b - 78.0) < 1.0


def test_grain_is_laid_without_what_lies_beyond_the_edge():
    rng = np.random.default_rng(6)
    photo = np.repeat(120.0 + rng.normal(scale=12.0, size=(420, 620, 1)), 3, axis=2).astype(np.float32)
    hole, known = np.zeros((2, 420, 620), dtype=bool)
    hole[80:340, 180:420], known[80:] = True, True
    known &= ~hole
    seen = np.where((hole | known)[..., None], photo, np.float32(15.0))
    laid = lay_grain(seen, hole, known)
    assert (laid[:80] == 15.0).all()
    # The mean of 3 rows of 240 pixels: 0.45 by chance.
    assert abs(laid[80:83, 180:420].mean() - 120.0) < 3.0


def test_a_floor_filled_from_above_takes_nothing_from_beyond_its_edge():
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    below = y - (50.0 + 0.05 * x)
    noise = np.random.default_rng(1).normal(scale=2.0, size=(HEIGHT, WIDTH, 1))
    thing = disc(100, 56, 26)
    photo = np.where(((below > 0) & ~thing)[..., None], 150.0, 20.0) + noise
    task = InpaintingTask(
        np.repeat(photo, 3, axis=2).astype(np.float32), thing & (below > 0), below <= 0, camera(), FillOptions()
    )
    filled = METHODS["as ground"](task)
    assert abs(filled[thing & (below > 0) & (below <= 1)].mean() - 150.0) < 2.0
