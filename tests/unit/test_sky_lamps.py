# SPDX-License-Identifier: MIT
"""An environment as lamps lights the ground as the map does, wherever its light comes from."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.physgen_addon.render.render_regions import shadow_region
from physgen.physgen_addon.render.sky_lamps import sky_lamps
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground
from physgen.sim.scene.equirectangular import irradiance
from physgen.sim.scene.model import SceneModel
from physgen.sim.scene.scene_object import SceneObject


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 40), st.sampled_from([0.0, 50.0, 1e4]), st.integers(3, 24))
def test_the_ground_is_lit_as_by_the_map(seed, count, sun, height):
    rng = np.random.default_rng(seed)
    radiance = rng.uniform(0, 1, (height, 2 * height, 3)).astype(np.float32)
    radiance[rng.integers(height), rng.integers(2 * height)] += sun
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    above, below = sky_lamps(radiance, normal, above=count, below=count)
    assert 0 < len(above) <= count and 0 < len(below) <= count
    got = sum(lamp.irradiance * max(lamp.direction @ normal, 0.0) for lamp in above)
    np.testing.assert_allclose(got, irradiance(radiance, normal), rtol=1e-6)
    for lamp in above + below:
        assert np.isfinite(lamp.irradiance).all() and (lamp.irradiance >= 0).all()
        assert abs(np.linalg.norm(lamp.direction) - 1) < 1e-9 and 0 < lamp.angle <= 2 * np.pi


def test_a_bright_spot_has_a_small_lamp_of_its_own():
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[8, 40] = 1000.0
    above, _ = sky_lamps(radiance, np.array([0.0, 0.0, 1.0]), above=16, below=8)
    brightest = max(above, key=lambda lamp: lamp.irradiance.sum())
    elevation, azimuth = np.pi * (0.5 - 8.5 / 32), 2 * np.pi * (0.5 - 40.5 / 64)
    across = np.cos(elevation)
    spot = [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)]
    assert brightest.direction @ spot > np.cos(np.radians(5))
    assert brightest.angle < 0.3


def test_a_black_half_has_no_lamps():
    radiance = np.zeros((8, 16, 3), np.float32)
    radiance[:4] = 1.0
    above, below = sky_lamps(radiance, np.array([0.0, 0.0, 1.0]), above=4, below=4)
    assert len(above) == 4 and not below


def test_the_fine_part_of_a_shadow_reaches_as_far_as_the_lamps_of_the_map_cast_it():
    camera = camera_above_ground(320, 240, 300.0, math.radians(40.0))
    scene = SceneModel(camera=camera, objects=(SceneObject(name="cube", mesh="cube.glb", size_m=0.17),))
    middle = on_ground(camera, np.array([160.0, 120.0]))
    cube = middle + 0.1 * (np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - (0.5, 0.5, -2.0))
    towards = np.array([-0.6, 0.0, 0.8])
    lamp = [(towards, 0.05)]
    shadows = camera.project(cube - cube[:, 2:] * towards / towards[2])[:, :2]
    alone, lit = (shadow_region(scene, [cube], (320, 240), sky_reach=0.15, lamps=lamps) for lamps in ((), lamp))
    assert not np.all(shadows[:, 0] < alone.box.x1)
    assert np.all(shadows[:, 0] < lit.box.x1) and np.all(shadows[:, 1] < lit.box.y1) and lit.box.x0 <= alone.box.x0
