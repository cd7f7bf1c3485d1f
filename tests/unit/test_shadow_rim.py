# SPDX-License-Identifier: MIT
"""Dark ground that touches an object: the shadow of what stands close to the ground, or another surface."""

import math

import numpy as np
import pytest
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.lighting.ground_pixels import ground_pixels, proxy_body
from physgen.sim.reconstruct.lighting.shadow_masks import PENUMBRA_DILATION, cast_shadows, object_holes
from physgen.sim.reconstruct.lighting.shadow_model import LEVELS, dark_rim, darkening_sums
from physgen.sim.srgb import linear_to_bytes
from PIL import Image
from scipy import ndimage

WIDTH, HEIGHT = 240, 160
CAMERA = camera_above_ground(WIDTH, HEIGHT, 230.0, math.radians(35.0))
COLUMNS, ROWS = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)


def ellipse(x, y):
    return ((COLUMNS - x) / 62.0) ** 2 + ((ROWS - y) / 42.0) ** 2 < 1.0


def photo(dark, kept):
    """A red saucer on a wooden table whose pixels ``dark`` keep the share ``kept`` of their light; and its mask."""
    saucer = ellipse(125.0, 80.0)
    grain = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(HEIGHT, WIDTH)), (1.0, 5.0))
    light = np.array([0.45, 0.22, 0.1]) * np.exp(0.25 * grain / grain.std())[..., None]
    light[dark] *= kept
    light[saucer] = [0.5, 0.05, 0.02]
    return linear_to_bytes(ndimage.gaussian_filter(light, (0.6, 0.6, 0.0))), saucer


@pytest.mark.parametrize("kept", [0.06, 0.2])
def test_the_dark_crescent_under_a_saucer_is_its_shadow(kept):
    crescent = ellipse(118.0, 89.0) & ~ellipse(125.0, 80.0)
    pixels, saucer = photo(crescent, kept)
    (found,) = cast_shadows(pixels, [saucer], CAMERA)
    assert (found.shadow & crescent).sum() > 0.9 * crescent.sum()
    assert (found.shadow & ~crescent).sum() < 0.5 * crescent.sum()
    dilation = PENUMBRA_DILATION * WIDTH / 1024.0
    (hole,) = object_holes([saucer], [found.penumbra | found.expected], dilation)
    assert not (crescent & ~hole).any(), "a stain would stay where the saucer stood"


def test_a_dark_floor_that_goes_on_is_no_shadow():
    floor = ROWS > 100.0
    pixels, saucer = photo(floor, 0.1)
    (found,) = cast_shadows(pixels, [saucer], CAMERA)
    far = floor & (ROWS > 135.0)
    assert (found.shadow & far).sum() < 0.1 * far.sum()


def test_only_ground_whose_sky_the_object_hides_belongs_to_the_rim():
    crescent = ellipse(118.0, 89.0) & ~ellipse(125.0, 80.0)
    pixels, saucer = photo(crescent, 0.1)
    ground = ground_pixels(pixels, [saucer], CAMERA, [proxy_body(saucer, CAMERA)])
    prior = np.tile(np.eye(len(LEVELS))[0], (len(ground.rows), 1))
    near = np.zeros(len(ground.rows))
    assert dark_rim(ground, prior, near + 1.0, near).any()
    assert not dark_rim(ground, prior, near, near).any()
    assert not dark_rim(ground, prior, near + 1.0, near + 1.0).any()


@pytest.mark.parametrize(("kept", "least", "most"), [(0.3, 0.7, 1.3), (1.0, -0.3, 0.3), (2.0, -1.0, -0.3)])
def test_a_shadow_is_seen_to_be_darker_than_the_ground_beside_it(kept, least, most):
    """All bright leaves below a log were a backpack's shadow, and became as dark as the log."""
    near = ROWS > 120.0
    pixels, saucer = photo(near, kept)
    ground = ground_pixels(pixels, [saucer], CAMERA, [proxy_body(saucer, CAMERA)])
    small = np.asarray(Image.fromarray(near).resize(ground.known.shape[::-1]))[ground.rows, ground.columns]
    alone, claimed = np.ones(len(small)), np.where(small, 0.3, 1.0)
    seen, told = darkening_sums(ground, claimed, alone)
    assert least < seen / told < most
    seen, told = darkening_sums(ground, alone, alone)
    assert seen == told


def test_what_another_shadow_darkens_is_not_seen_of_this_one():
    near = ROWS > 120.0
    pixels, saucer = photo(near, 0.3)
    ground = ground_pixels(pixels, [saucer], CAMERA, [proxy_body(saucer, CAMERA)])
    small = np.asarray(Image.fromarray(near).resize(ground.known.shape[::-1]))[ground.rows, ground.columns]
    claimed = np.where(small, 0.3, 1.0)
    seen, told = darkening_sums(ground, claimed, claimed)
    assert abs(seen / told) < 0.3
