# SPDX-License-Identifier: MIT
"""Lamps found from the colours of ground that they shade, computed for a ball in closed form."""

import math

import numpy as np
import pytest
from physgen.sim.reconstruct.lighting.ground_lighting import overcast_sky, sun_disc
from physgen.sim.reconstruct.lighting.ground_pixels import GroundPixels, ProxyBody
from physgen.sim.reconstruct.lighting.shadow_lamps import direction_of, fit_light

SIDE = 72
RADIUS = 0.2
COUNT = 20_000
"""Points on the ball: enough to leave no gaps in its shadow."""
CENTRE = np.array([0.0, 0.0, RADIUS])
WARM, COOL = np.array([1.0, 0.88, 0.72]), np.array([0.8, 0.93, 1.0])


def towards(azimuth_deg, height_deg):
    azimuth, height = math.radians(azimuth_deg), math.radians(height_deg)
    return np.array([math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)])


def reaching(places, directions, weights):
    """Share (N,) of the light from ``directions`` that passes the ball."""
    apart = CENTRE - np.column_stack([places, np.zeros(len(places))])
    along = apart @ directions.T
    off = np.sqrt(np.maximum((apart**2).sum(axis=1)[:, None] - along**2, 0.0))
    return 1.0 - ((off < RADIUS) & (along > 0.0)) @ (weights / weights.sum())


def lit_ground(lamps, *, tiles=False):
    """Ground around the ball under ``lamps`` (direction, share), warm beside a cool sky."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    places = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) / SIDE * 2.0 - 1.0
    use = np.hypot(*places.T) > RADIUS
    rows, columns, places = rows.ravel()[use], columns.ravel()[use], places[use]
    rest = 1.0 - sum(share for _, share in lamps)
    light = rest * (1.0 - 0.8 * (1.0 - reaching(places, *overcast_sky(300))))[:, None] * COOL
    for direction, share in lamps:
        light = light + share * reaching(places, *sun_disc(direction, 0.05, 60))[:, None] * WARM
    albedo = np.full((len(places), 1), 0.4)
    if tiles:
        albedo[(np.floor(places[:, 0] / 0.15) + np.floor(places[:, 1] / 0.15)) % 2 > 0] = 0.15
    noise = np.random.default_rng(3).normal(scale=0.02, size=light.shape)
    known = np.zeros((SIDE, SIDE), np.float32)
    known[rows, columns] = 1.0
    return GroundPixels(
        rows=rows,
        columns=columns,
        places=places,
        colour=np.log(albedo * light) + noise,
        weight=np.ones(len(rows)),
        known=known,
        object_side=RADIUS * SIDE,
    )


def ball():
    number = np.arange(COUNT)
    height = 1.0 - 2.0 * (number + 0.5) / COUNT
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    surface = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    return ProxyBody(points=CENTRE + RADIUS * surface, foot=np.zeros(2), height=2.0 * RADIUS)


def off_deg(lamp, direction):
    return math.degrees(math.acos(min(1.0, float(direction_of(lamp.slide) @ direction))))


@pytest.mark.parametrize("tiles", [False, True])
def test_a_warm_sun_whose_deep_shadow_is_cool(tiles):
    """Its chromas change by a third of the depth's logarithm, which is no other texture."""
    sun = towards(200.0, 40.0)
    light = fit_light(lit_ground([(sun, 0.75)], tiles=tiles), [ball()])
    # Half a step of the first search, of 15°.
    assert off_deg(light.lamps[0], sun) < 7.5


def test_two_lamps_are_two_and_a_soft_sky_has_none_that_counts():
    first, second = towards(20.0, 38.0), towards(130.0, 50.0)
    light = fit_light(lit_ground([(first, 0.4), (second, 0.25)]), [ball()])
    assert len(light.lamps) == 2
    for lamp in (first, second):
        assert min(off_deg(found, lamp) for found in light.lamps) < 7.5
    assert fit_light(lit_ground([]), [ball()]).share < 0.35
