# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawn pictures of known shadows: the shadows follow from geometry, and pictures repeat."""

import dataclasses
import math

import numpy as np
import pytest
from physgen.benchmarks.reconstruct_pictures import cases
from physgen.benchmarks.shadow_pictures.drawn_picture import FIRST_SEED, draw_picture
from physgen.benchmarks.shadow_pictures.plane_patterns import KINDS, albedo
from physgen.benchmarks.shadow_pictures.plane_shadows import Plane, light_on

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
GROUND = Plane(np.zeros(3), np.eye(3), np.array([-4.0, -4.0]), np.array([4.0, 4.0]))


@pytest.mark.parametrize("height_deg", [30.0, 45.0, 90.0])
def test_a_cube_shades_what_the_light_does_not_reach(height_deg):
    height = math.radians(height_deg)
    raster = GROUND.shadow([CUBE], toward=np.array([math.cos(height), 0.0, math.sin(height)]))
    # Its foot, and a strip of its width as long as it is high over the tangent of the lamp's height.
    area = 1.0 + 1.0 / math.tan(height)
    cell_along_border = 2.0 * (1.0 + area) / GROUND.scale
    assert raster.sum() / GROUND.scale**2 == pytest.approx(area, abs=cell_along_border)


def test_a_lamp_above_casts_a_larger_shadow_than_the_sun():
    lamp = GROUND.shadow([CUBE], lamp=np.array([0.0, 0.0, 2.0]))
    # From twice its height the top is projected at twice its size.
    assert lamp.sum() / GROUND.scale**2 == pytest.approx(4.0, abs=8.0 / GROUND.scale)


def test_without_things_all_of_the_light_arrives_and_things_give_some_back():
    case = dataclasses.replace(cases.draw("dev", 1), sky=(1.0, 1.0, 1.0))
    rng = np.random.default_rng
    lit, bare = light_on(GROUND, [], case, rng(0), loss=1.0, bounce=0.3)
    assert np.allclose(lit, bare, rtol=1e-5)
    dark, _ = light_on(GROUND, [CUBE], case, rng(0), loss=1.0, bounce=0.3)
    paler, _ = light_on(GROUND, [CUBE], case, rng(0), loss=0.5, bounce=0.3)
    assert dark.min() < 0.3 * bare.min() and (paler >= dark - 1e-6).all() and paler.mean() > dark.mean()


@pytest.mark.parametrize("kind", KINDS)
def test_every_pattern_is_an_albedo(kind):
    found = albedo((90, 120), 30.0, np.random.default_rng(3), kind)
    assert found.shape == (90, 120, 3) and found.min() >= 0.01 and found.max() <= 0.95


def test_a_picture_repeats_and_its_shadows_lie_off_the_sky():
    first, again = draw_picture(3), draw_picture(3)
    assert (first.pixels == again.pixels).all() and (first.kept == again.kept).all() and first.camera == again.camera
    assert first.kept.shape == first.pixels.shape[:2] and first.kept.min() >= 0.0 and first.kept.max() < 1.02
    assert first.light in cases.LIGHTS and all(mask.any() for mask in first.masks)
    assert (draw_picture(4).pixels.shape != first.pixels.shape) or (draw_picture(4).pixels != first.pixels).any()


def test_no_picture_has_a_seed_of_the_rendered_sets():
    with pytest.raises(ValueError, match="begin at 0"):
        draw_picture(-1)
    assert all(first + count <= FIRST_SEED for count, first in cases.SETS.values())
