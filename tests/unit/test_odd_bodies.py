# SPDX-License-Identifier: MIT
"""Outlines that hardly are a body, wherever they stand: each becomes closed, textured bodies, or one clear line."""

import math

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.events import ignore, never
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.photo_layers import Layers
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.object_bodies import make_bodies
from physgen.sim.reconstruct.stage_cache import StageCache, Steps

pytestmark = pytest.mark.long
WIDTH, HEIGHT = 200, 150
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
OPTIONS = ReconstructOptions(mesh_vertices=600)


def bodies_of(masks, folder, *, pitch=20.0):
    """Bodies of ``masks`` in the order from front to back, and the notices."""
    view = camera_above_ground(WIDTH, HEIGHT, 220.0, math.radians(pitch))
    photo = np.random.default_rng(4).integers(60, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    none = np.zeros((HEIGHT, WIDTH), bool)
    masks = tuple(mask & ~np.logical_or.reduce([none, *masks[:i]]) for i, mask in enumerate(masks))
    layers = Layers(
        seen=masks,
        full=masks,
        shadows=(none,) * len(masks),
        holes=masks,
        colours=(photo,) * len(masks),
        background=photo,
        front_to_back=tuple(range(len(masks))),
        uncovered={},
    )
    steps = Steps(len(masks), ignore, never)
    wanted = [ObjectRequest(name=f"thing_{i}", box=(0, 0, 9, 9)) for i in range(len(masks))]
    store = StageCache(folder, folder, steps.notice)
    return make_bodies(layers, view, wanted, OPTIONS, store, steps), steps.notices


def checked(bodies):
    """Each is finite, closed, above the ground and has a texture."""
    for body in bodies:
        surface = body.surface
        assert np.isfinite(surface.vertices).all() and surface.vertices[:, 2].min() > -1e-6
        # Vertices along borders of charts occur once per chart.
        closed = trimesh.Trimesh(np.round(surface.vertices, 9), surface.faces)
        assert closed.is_watertight and closed.volume > 0.0
        assert surface.picture.shape[2] == 3 and surface.uv.min() >= 0.0 and surface.uv.max() <= 1.0


def disc(x, y, radius):
    return (COLUMNS - x) ** 2 + (ROWS - y) ** 2 < radius**2


def polygon(*corners):
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(image, [np.array(corners)], 1)
    return image > 0


def limbs(seed):
    image, random = np.zeros((HEIGHT, WIDTH), np.uint8), np.random.default_rng(seed)
    for angle in random.uniform(0, 2 * np.pi, 7):
        end = (100 + int(55 * math.cos(angle)), 85 + int(55 * math.sin(angle)))
        cv2.line(image, (100, 85), end, 1, int(random.integers(1, 7)))
    return image > 0


SINGLE = {
    "all limbs": limbs(1),
    "a ring": disc(100, 90, 40) & ~disc(100, 90, 34),
    "a ring that lies": (((COLUMNS - 100) / 60) ** 2 + ((ROWS - 110) / 20) ** 2 < 1)
    & (((COLUMNS - 100) / 52) ** 2 + ((ROWS - 110) / 14) ** 2 > 1),
}


@pytest.mark.parametrize("name", SINGLE)
def test_an_odd_outline_becomes_a_textured_body_or_one_clear_line(name, tmp_path):
    try:
        bodies, _ = bodies_of([SINGLE[name]], tmp_path)
    except InputError as error:
        assert "thing_0" in str(error) or "outline" in str(error) or "thin" in str(error)
        assert "\n" not in str(error) and len(str(error)) < 200
        return
    checked(bodies)


PLACED = {
    "in mid-air beside another": ([disc(150, 110, 25), disc(60, 45, 22)], 20.0),
    "above the horizon": ([disc(100, 30, 20)], 5.0),
    "from above the photo": ([polygon((90, 0), (110, 0), (112, 60), (88, 60))], 5.0),
    "leaning on each other": (
        [polygon((40, 120), (60, 120), (100, 30), (90, 30)), polygon((140, 120), (160, 120), (112, 30), (102, 30))],
        20.0,
    ),
    "lying across another": ([polygon((20, 80), (180, 60), (180, 72), (20, 92)), disc(100, 100, 30)], 25.0),
}


@pytest.mark.parametrize("name", PLACED)
def test_what_floats_hangs_or_leans_becomes_bodies(name, tmp_path):
    masks, pitch = PLACED[name]
    bodies, notices = bodies_of(masks, tmp_path, pitch=pitch)
    assert len(bodies) == len(masks)
    checked(bodies)
    if name in ("above the horizon", "from above the photo"):
        assert any("above the horizon" in text and "thing_0" in text for text in notices)
