# SPDX-License-Identifier: MIT
"""Lamps from the shadows of a ball, whose shadows and whose share of the sky are known in closed form."""

import math

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground
from physgen.sim.reconstruct.lighting.ground_lighting import MAX_SHARE
from physgen.sim.reconstruct.lighting.lamps import LampEstimate, estimate_lamps, ground_axes
from physgen.sim.reconstruct.lighting.light_estimate import with_spots
from physgen.sim.scene.environment import ground_light, lamps_in
from physgen.sim.scene.model import Ground

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
