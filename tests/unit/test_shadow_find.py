# SPDX-License-Identifier: MIT
"""Shadows on the ground, on pictures drawn with shadows that are known exactly."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.lighting.ground_lighting import overcast_sky, sun_disc
from physgen.sim.reconstruct.lighting.shadow_masks import cast_shadows, threshold_shadows
from physgen.sim.srgb import linear_to_bytes
from scipy import ndimage

WIDTH, HEIGHT = 240, 180
CAMERA = camera_above_ground(WIDTH, HEIGHT, 230.0, math.radians(30.0))
SUN = np.array([0.55, 0.45, 0.7]) / np.linalg.norm([0.55, 0.45, 0.7])
"""Towards a sun behind and to the right: shadows fall to the left and to the front."""


def find_shadows(pixels, masks, camera, *, fixed_threshold=None):
    """The shadow masks as the reconstruction finds them, by default or by a grey value."""
    if fixed_threshold is not None:
        return threshold_shadows(pixels, masks, fixed_threshold)
    return [cast.shadow for cast in cast_shadows(pixels, masks, camera)]


def meets(centre, radius, origins, directions):
    """How far along ``directions`` (N, 3) from ``origins`` (N, 3) a ball is met; inf where it is not."""
    apart = origins - centre
    along = (apart * directions).sum(axis=1)
    square = along**2 - (apart * apart).sum(axis=1) + radius**2
    distance = -along - np.sqrt(np.maximum(square, 0.0))
    return np.where((square > 0) & (distance > 1e-6), distance, np.inf)


@functools.cache
def draw(balls, ground, *, angle=0.05, share=0.7, seed=0):
    """Photo, masks and true shadows of ``balls`` (x, y, radius) on a plane whose albedo is ``ground(x, y)``.

    A true shadow is where the ground would be more than 1/0.9 times as bright without that ball.
    """
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1).reshape(-1, 2)
    rays = CAMERA.rays(grid)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye = np.broadcast_to(CAMERA.position, rays.shape)
    down = np.where(rays[:, 2] < -1e-9, -eye[:, 2] / np.minimum(rays[:, 2], -1e-9), np.inf)
    centres = [np.array([x, y, r]) for x, y, r in balls]
    hits = np.stack([meets(c, c[2], eye, rays) for c in centres] + [down])
    first = hits.argmin(axis=0)
    on_ground = (first == len(balls)) & np.isfinite(down)
    places = (eye + down[:, None] * rays)[on_ground]
    blocked = np.zeros((len(balls) + 1, len(places)))
    free = np.zeros(len(places))
    for part, (directions, weights) in ((share, sun_disc(SUN, angle, 10)), (1.0 - share, overcast_sky(60))):
        for direction, weight in zip(directions, weights / weights.sum(), strict=True):
            met = np.stack([np.isfinite(meets(c, c[2], places, direction[None])) for c in centres])
            free += part * weight * ~met.any(axis=0)
            for index in range(len(balls)):
                blocked[index] += part * weight * (met[index] & ~np.delete(met, index, axis=0).any(axis=0))
    light = np.full((len(rays), 3), 0.6)
    light[on_ground] = ground(places[:, 0], places[:, 1]) * free[:, None]
    truths = np.zeros((len(balls), len(rays)), dtype=bool)
    truths[:, on_ground] = free < 0.9 * (free + blocked[:-1])
    for index, centre in enumerate(centres):
        seen = first == index
        normal = (eye[seen] + hits[index][seen, None] * rays[seen] - centre) / centre[2]
        light[seen] = np.array([0.6, 0.2, 0.1]) * (0.2 + 0.8 * np.maximum(normal @ SUN, 0.0))[:, None]
    image = ndimage.gaussian_filter(light.reshape(HEIGHT, WIDTH, 3), (0.5, 0.5, 0.0))
    image *= 1.0 + np.random.default_rng(seed).normal(scale=0.02, size=image.shape)
    masks = [(first == index).reshape(HEIGHT, WIDTH) for index in range(len(balls))]
    return linear_to_bytes(image), masks, [t.reshape(HEIGHT, WIDTH) for t in truths]


def plain(x, _y):
    return np.broadcast_to([0.5, 0.45, 0.4], (len(x), 3))


def tiles(x, y):
    odd = (np.floor(x / 0.3) + np.floor(y / 0.3)) % 2
    return np.where(odd[:, None] > 0, [[0.55, 0.5, 0.45]], [[0.2, 0.12, 0.08]])


def printed(x, y):
    """A dark round print that the ball nearly touches, on the side where its shadow is not."""
    albedo = plain(x, y).copy()
    albedo[(x - 0.44) ** 2 + (y - 1.5) ** 2 < 0.16**2] *= 0.25
    return albedo


def overlap(first, second):
    return (first & second).sum() / max(1, (first | second).sum())


@pytest.mark.parametrize("ground", [plain, tiles])
def test_a_shadow_in_the_sun(ground):
    pixels, masks, truths = draw(((0.0, 1.6, 0.28),), ground)
    assert overlap(find_shadows(pixels, masks, CAMERA)[0], truths[0]) > 0.75


@functools.cache
def soft():
    """Photo, masks, true shadows and what is found of a ball under an overcast sky."""
    pixels, masks, truths = draw(((0.0, 1.6, 0.28),), plain, share=0.0)
    return pixels, masks, truths, cast_shadows(pixels, masks, CAMERA)[0]


def test_a_soft_contact_shadow_under_an_overcast_sky():
    _, _, truths, cast = soft()
    assert overlap(cast.shadow, truths[0]) > 0.75


@pytest.mark.xfail(strict=True, reason="a shadow goes on into a touching print of the ground's own chroma")
def test_a_dark_print_beside_the_object_is_no_shadow():
    pixels, masks, truths = draw(((0.0, 1.6, 0.28),), printed)
    found = find_shadows(pixels, masks, CAMERA)[0]
    print_only = dark(pixels) & ~truths[0] & ~masks[0]
    assert print_only.sum() > 200
    assert found[print_only].mean() < 0.1
    assert overlap(found, truths[0]) > 0.7


def dark(pixels):
    return ndimage.gaussian_filter(pixels.astype(float).mean(axis=2), 1.0) < 100


def test_each_shadow_belongs_to_its_own_object():
    pixels, masks, truths = draw(((-0.35, 1.6, 0.25), (0.5, 1.9, 0.25)), plain)
    found = find_shadows(pixels, masks, CAMERA)
    assert not (found[0] & found[1]).any()
    for index in (0, 1):
        assert overlap(found[index], truths[index]) > 0.7
        assert found[index][truths[1 - index] & ~truths[index]].mean() < 0.15


def test_ground_that_two_objects_darken_is_in_the_shadows_of_both():
    pixels, masks, truths = draw(((-0.26, 1.6, 0.25), (0.26, 1.6, 0.25)), plain, share=0.0)
    found = find_shadows(pixels, masks, CAMERA)
    both = truths[0] & truths[1]
    assert both.sum() > 0.2 * truths[0].sum()
    assert (found[0] & found[1])[both].mean() > 0.7
    for index in (0, 1):
        assert overlap(found[index], truths[index]) > 0.75


def test_a_soft_border_goes_around_the_shadow_and_equal_photos_give_equal_shadows():
    pixels, masks, truths, cast = soft()
    assert (cast.shadow == find_shadows(pixels, masks, CAMERA)[0]).all()
    assert not (cast.shadow & ~cast.penumbra).any()
    assert not (cast.penumbra & masks[0]).any()
    assert cast.penumbra[truths[0]].mean() > 0.97
    assert truths[0].sum() < cast.penumbra.sum() < 2.0 * truths[0].sum()


def test_a_dark_thing_far_from_every_shadow_is_left_alone():
    pixels, masks, _ = draw(((0.0, 1.6, 0.28),), plain)
    pixels = pixels.copy()
    pixels[60:120, 190:] = 10
    found = find_shadows(pixels, masks, CAMERA)[0]
    assert not found[60:120, 195:].any()


BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
GREY = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)


def rectangle(top, left, height, width):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top : top + height, left : left + width] = True
    return mask


@pytest.mark.parametrize("pixels", [BLACK, GREY], ids=["black", "grey"])
@pytest.mark.parametrize(
    "mask",
    [
        rectangle(80, 100, 40, 40),
        rectangle(80, 100, 1, 1),
        rectangle(60, 0, 120, 60),
        rectangle(0, 0, HEIGHT, WIDTH),
        rectangle(0, 0, 0, 0),
    ],
    ids=["inside", "one pixel", "cut by the border", "everything", "nothing"],
)
def test_photos_without_shadow_give_almost_none(pixels, mask):
    found = find_shadows(pixels, [mask], CAMERA)
    assert len(found) == 1
    assert found[0].shape == mask.shape
    assert not (found[0] & mask).any()
    assert found[0].sum() <= 0.3 * mask.sum()


def test_no_ground_in_view():
    level = camera_above_ground(WIDTH, HEIGHT, 230.0, math.radians(-60.0))
    found = find_shadows(GREY, [rectangle(80, 100, 40, 40)], level)
    assert not found[0].any()


def test_no_objects():
    assert find_shadows(GREY, [], CAMERA) == []
    assert find_shadows(GREY, [], CAMERA, fixed_threshold=50) == []


@settings(max_examples=5, deadline=None)
@given(
    st.lists(st.tuples(*(st.integers(0, n) for n in (100, 140, 80, 90))), min_size=1, max_size=3),
    st.one_of(st.none(), st.floats(0, 255)),
    st.integers(0, 2**31),
)
def test_shadows_never_overlap_objects_and_the_papers_not_each_other(boxes, threshold, seed):
    noise = np.random.default_rng(seed).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    pixels = np.kron(noise, np.ones((6, 6, 1), np.uint8))
    masks, taken = [], np.zeros((HEIGHT, WIDTH), bool)
    for box in boxes:
        masks.append(rectangle(*box) & ~taken)
        taken |= masks[-1]
    found = find_shadows(pixels, masks, CAMERA, fixed_threshold=threshold)
    assert len(found) == len(masks)
    assert threshold is None or not (np.sum(found, axis=0) > 1).any()
    assert not (np.logical_or.reduce(found) & taken).any()


def test_the_papers_threshold_takes_what_is_dark_and_hangs_together():
    pixels = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    mask, shadow, apart = rectangle(60, 100, 40, 40), rectangle(100, 90, 20, 60), rectangle(10, 10, 30, 30)
    pixels[shadow | apart] = 40
    pixels[mask] = (200, 30, 30)
    assert (find_shadows(pixels, [mask], CAMERA, fixed_threshold=50)[0] == shadow).all()
    assert not find_shadows(pixels, [mask], CAMERA, fixed_threshold=40)[0].any()


def test_the_papers_threshold_swallows_all_that_is_dark_and_touches():
    pixels = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    mask, wall = rectangle(60, 100, 40, 40), rectangle(0, 0, 61, WIDTH)
    pixels[wall] = 20
    assert (find_shadows(pixels, [mask], CAMERA, fixed_threshold=50)[0] == (wall & ~mask)).all()


def test_shadow_between_objects_is_split_by_distance():
    pixels = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    first, second, between = rectangle(60, 40, 40, 40), rectangle(60, 140, 40, 40), rectangle(90, 80, 10, 60)
    pixels[between] = 10
    found = find_shadows(pixels, [first, second], CAMERA, fixed_threshold=50)
    assert ((found[0] | found[1]) == between).all()
    assert found[0][:, :110].sum() == found[0].sum() == 300


def test_the_ground_around_a_contact_leaves_with_the_object_though_its_shadow_was_missed():
    """The darkest quarter of a soft shadow, at the contact, would stay as a stain while its owner flies."""
    pixels, masks, truths = draw(((0.0, 1.6, 0.28),), plain, share=0.0)
    lit = pixels.copy()
    # What a photo shows whose shadow was lightened by a flash: nothing is left to be found.
    lit[truths[0] & ~masks[0]] = np.median(pixels[~truths[0] & ~masks[0] & (np.arange(HEIGHT) > 120)[:, None]], axis=0)
    (cast,) = cast_shadows(lit, masks, CAMERA)
    assert (cast.shadow & truths[0]).sum() < 0.3 * truths[0].sum()
    foot = CAMERA.project(np.array([[0.0, 1.6, 0.0]]))[0, :2]
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    below = (
        (abs(columns - foot[0]) < 8)
        & (rows > np.flatnonzero(masks[0].any(axis=1))[-1] + 1)
        & (rows < np.flatnonzero(masks[0].any(axis=1))[-1] + 4)
    )
    assert cast.expected[below].mean() > 0.9 and not cast.expected[masks[0]].any()
    assert cast.expected.sum() < 0.6 * truths[0].sum()
