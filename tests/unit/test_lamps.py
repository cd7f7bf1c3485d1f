# SPDX-License-Identifier: MIT
"""Lamps from the shadows of a ball, whose shadows and whose share of the sky are known in closed form."""

import math

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground
from physgen.sim.reconstruct.lighting.ground_lighting import MAX_SHARE
from physgen.sim.reconstruct.lighting.ground_observation import ground_axes
from physgen.sim.reconstruct.lighting.lamps import LampEstimate, estimate_lamps
from physgen.sim.reconstruct.lighting.light_estimate import KEY_SHARE, KEY_SPREAD, with_soft_key, with_spots
from physgen.sim.reconstruct.lighting.standing_surface import ground_before, standing_surface
from physgen.sim.scene.environment import ground_light, lamps_in
from physgen.sim.scene.model import Ground
from physgen.sim.srgb import bytes_to_linear

WIDTH, HEIGHT, RADIUS = 320, 240, 0.13
CAMERA = camera_above_ground(WIDTH, HEIGHT, 300.0, math.radians(40.0))
BALL = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def towards(azimuth, elevation):
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def photo(lamps, seed=0):
    """(H, W, 3) sRGB of a ball on grainy ground under a sky and ``lamps`` (direction, share), its mask and its mesh."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([x, y], axis=-1)
    ground = on_ground(CAMERA, pixels)
    middle = np.array([*on_ground(CAMERA, np.array([170.0, 130.0]))[:2], RADIUS])
    rays = CAMERA.rays(pixels)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    off = middle - CAMERA.position
    along = rays @ off
    mask = np.square(off).sum() - along**2 < RADIUS**2
    apart = middle - ground
    distance = np.linalg.norm(apart, axis=-1)
    # The ball fills this share of the sky of a point of the ground (a sphere's form factor).
    light = (1.0 - sum(share for _, share in lamps)) * (1.0 - 0.85 * (RADIUS / distance) ** 3)
    for direction, share in lamps:
        beside = distance**2 - np.square(apart @ direction)
        light = light + share * np.clip((np.sqrt(np.maximum(beside, 0.0)) / RADIUS - 1.0) / 0.1 + 0.5, 0.0, 1.0)
    grain = 1.0 + 0.03 * np.random.default_rng(seed).normal(size=light.shape)
    linear = np.where(mask, 0.5, 0.4 * light * grain)
    srgb = np.clip(1.055 * np.maximum(linear, 0.0031) ** (1 / 2.4) - 0.055, 0.0, 1.0)
    body = BALL.vertices + middle
    return np.repeat((255.0 * srgb + 0.5).astype(np.uint8)[..., None], 3, axis=2), mask, (body, BALL.faces)


def found(lamps):
    pixels, mask, mesh = photo(lamps)
    return estimate_lamps(CAMERA, Ground(), pixels, [mask], [mesh])


def test_two_lamps_are_two_and_not_one_between_them():
    true = [(towards(200.0, 42.0), 0.35), (towards(310.0, 50.0), 0.25)]
    lamps = found(true)
    assert len(lamps) == 2
    for lamp, (direction, share) in zip(lamps, true, strict=True):
        assert math.degrees(math.acos(min(1.0, float(np.dot(lamp.direction, direction))))) < 10.0
        assert lamp.share == pytest.approx(share, abs=0.12)


def test_one_lamp_stays_one():
    direction = towards(215.0, 45.0)
    (lamp,) = found([(direction, 0.5)])
    assert math.degrees(math.acos(min(1.0, float(np.dot(lamp.direction, direction))))) < 8.0
    assert lamp.share == pytest.approx(0.5, abs=0.15)
    assert lamp.share <= MAX_SHARE


def test_a_spot_gives_the_ground_what_its_lamp_gives():
    even = np.full((32, 64, 3), 1.0, np.float32)
    lamp = LampEstimate((0.0, 0.6, 0.8), 0.3, 0.1, 10.0)
    lit = with_spots(even, Ground(), [(lamp, 0.5)])
    ways, weights = ground_light(lit, ground_axes(Ground()))
    near = ways @ ground_axes(Ground()) @ np.array(lamp.direction) > math.cos(0.09)
    assert weights[near].sum() / weights[~near].sum() == pytest.approx(0.5, rel=0.06)
    assert with_spots(even, Ground(), []) is even


def test_a_spot_in_a_map_is_found_again_and_an_even_or_overcast_sky_has_none():
    even = np.full((32, 64, 3), 1.0, np.float32)
    normal = np.array([0.0, 0.0, 1.0])
    lamps = [(LampEstimate(d, 0.3, a, 10.0), 0.4) for d, a in (((0.0, 0.6, 0.8), 0.1), ((0.48, 0.6, 0.64), 0.2))]
    found = sorted(lamps_in(with_spots(even, Ground(), lamps), normal), key=lambda lamp: lamp[1])
    assert len(found) == 2
    for (lamp, _), (direction, angle) in zip(lamps, found, strict=True):
        assert math.degrees(math.acos(min(1.0, float(direction @ np.array(lamp.direction))))) < 1.0
        assert angle == pytest.approx(lamp.angle, abs=0.04)
    height = np.clip(np.sin(np.linspace(math.pi / 2, -math.pi / 2, 32)), 0.0, 1.0)[:, None, None]
    overcast = np.broadcast_to((1.0 + 2.0 * height) / 3.0, even.shape).astype(np.float32)
    assert lamps_in(even, normal) == [] and lamps_in(overcast, normal) == []


def on_white(lamps, exposure=1.6):
    """``photo`` of white paper that the camera clips wherever it is lit."""
    pixels, mask, mesh = photo(lamps)
    white = np.clip(np.round(pixels.astype(np.float64) * exposure), 0, 255).astype(np.uint8)
    assert (white[~mask].min(axis=-1) >= 254).mean() > 0.9
    return white, mask, mesh


@pytest.mark.parametrize(("azimuth", "elevation", "share"), [(150.0, 50.0, 0.7), (300.0, 40.0, 0.5)])
def test_a_lamp_is_found_by_its_shadow_on_clipped_white(azimuth, elevation, share):
    direction = towards(azimuth, elevation)
    white, mask, mesh = on_white([(direction, share)])
    (lamp,) = estimate_lamps(CAMERA, Ground(), white, [mask], [mesh])
    assert math.degrees(math.acos(min(1.0, float(np.dot(lamp.direction, direction))))) < 20.0


def test_a_soft_light_on_clipped_white_is_no_more_than_a_weak_lamp_above():
    white, mask, mesh = on_white([])
    for lamp in estimate_lamps(CAMERA, Ground(), white, [mask], [mesh]) or ():
        assert lamp.share < 0.2 and lamp.direction[2] > math.sin(math.radians(70.0)) and lamp.angle > 0.4


@pytest.mark.parametrize("size", [1.0, 2.5])
def test_white_without_any_shadow_says_nothing(size):
    pixels, mask, (body, faces) = photo([])
    white = np.where(mask[..., None], pixels, np.uint8(255))
    # A body of another size than its mask's hides other parts of the page.
    assert estimate_lamps(CAMERA, Ground(), white, [mask], [(body * size, faces)]) is None


def test_other_things_on_the_ground_are_no_ground():
    direction = towards(215.0, 45.0)
    pixels, mask, mesh = photo([(direction, 0.5)])
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    things = ((columns // 24 + rows // 24) % 4 == 0) & ~mask
    pixels[things] = np.random.default_rng(1).integers(0, 120, (int(things.sum()), 1), dtype=np.uint8)
    (lamp,) = estimate_lamps(CAMERA, Ground(), pixels, [mask], [mesh], things=things)
    assert math.degrees(math.acos(min(1.0, float(np.dot(lamp.direction, direction))))) < 8.0
    assert lamp.share == pytest.approx(0.5, abs=0.15)


def before_water(lamps):
    """``photo`` whose ground is a pale stone that ends behind the ball, in a wavy edge, at dark green water."""
    pixels, mask, mesh = photo(lamps)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    stone = rows > 105.0 + 12.0 * np.sin(columns / 25.0)
    water = np.clip(np.random.default_rng(2).normal((38, 50, 30), 3.0, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
    pale = (pixels * np.array([1.0, 0.93, 0.86])).astype(np.uint8)
    return np.where((stone | mask)[..., None], pale, water), mask, mesh, stone


def test_a_lamp_is_found_on_a_stone_that_ends_before_water():
    direction = towards(350.0, 40.0)
    pixels, mask, mesh, _ = before_water([(direction, 0.5)])
    (lamp,) = estimate_lamps(CAMERA, Ground(), pixels, [mask], [mesh])
    assert math.degrees(math.acos(min(1.0, float(np.dot(lamp.direction, direction))))) < 8.0
    assert lamp.share == pytest.approx(0.5, abs=0.15)
    pixels, mask, mesh, _ = before_water([])
    assert estimate_lamps(CAMERA, Ground(), pixels, [mask], [mesh]) == ()


@pytest.mark.parametrize("azimuth", [80.0, 350.0])
def test_a_surface_ends_where_its_tint_does_and_not_in_a_shadow(azimuth):
    pixels, mask, (body, _), stone = before_water([(towards(azimuth, 35.0), 0.8)])
    colour = np.log(np.maximum(bytes_to_linear(pixels), 1e-3).astype(np.float64))
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    places = on_ground(CAMERA, np.stack([x, y], axis=-1))[..., :2]
    before = ground_before(places.reshape(-1, 2), CAMERA.position[:2], [body]).reshape(mask.shape) & ~mask
    surface = standing_surface(colour, ~mask, before)
    assert surface[stone & ~mask].mean() > 0.98
    assert surface[~stone & ~mask].mean() < 0.03
    # With nothing before the objects it cannot be told.
    assert (standing_surface(colour, ~mask, np.zeros_like(mask)) == ~mask).all()


def test_a_soft_key_gives_its_share_of_the_grounds_light_from_around_the_zenith():
    even = np.full((32, 64, 3), 1.0, np.float32) * np.array([0.9, 1.0, 1.1], np.float32)
    lit = with_soft_key(even, Ground())
    axes = ground_axes(Ground())
    ways, weights = ground_light(lit, axes)
    near = (ways @ axes)[:, 2] > math.cos(3.0 * KEY_SPREAD)
    before_ways, before = ground_light(even, axes)
    near_before = before[(before_ways @ axes)[:, 2] > math.cos(3.0 * KEY_SPREAD)].sum() / before.sum()
    assert weights[near].sum() / weights.sum() == pytest.approx(KEY_SHARE + (1 - KEY_SHARE) * near_before, abs=0.03)
    # White balance and exposure stay.
    assert lit[16:].mean(axis=(0, 1)) / lit[16:].mean() == pytest.approx(even[0, 0] / even[0, 0].mean(), rel=1e-3)
