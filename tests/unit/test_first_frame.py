# SPDX-License-Identifier: MIT
"""Bodies show the photo from where it was taken, up to their outlines: the first frame, without a renderer."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.composite.compositing import ObjectLayer, behind, compose, matted, soft_reach
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.events import ignore, never
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.mesh_raster import visible_pixels
from physgen.sim.reconstruct.photo_layers import Layers
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.object_bodies import make_bodies
from physgen.sim.reconstruct.shape.primitives import Box, Sphere, SurfaceOfRevolution, rasterize
from physgen.sim.reconstruct.stage_cache import StageCache, Steps
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes

WIDTH, HEIGHT = 480, 360
VIEW = camera_above_ground(WIDTH, HEIGHT, 520.0, math.radians(14.0))
BOOK = Box(0.05, 2.2, 0.07, 0.62, 0.2, 0.75)
"""Its fore-edge is seen at 86° from its normal, as a strip of pixels; so is its top."""
CAN = SurfaceOfRevolution(-0.1, 2.0, (0.0, 0.5), (0.2, 0.2))
BALL = Sphere(0.05, 2.2, 0.25)
FINER = 3
REQUIRED_DB = 35.0
INSIDE_DB = 40.0


def outline(primitive):
    return rasterize(primitive, VIEW, (HEIGHT, WIDTH), 0, 0)


def rounded(mask, radius):
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0


def figure():
    """A head on a body with arms: inflated."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.ellipse(mask, (240, 250), (60, 70), 0, 0, 360, 1, -1)
    cv2.circle(mask, (240, 150), 48, 1, -1)
    cv2.line(mask, (180, 240), (130, 190), 1, 22)
    cv2.line(mask, (300, 240), (350, 190), 1, 22)
    return mask > 0


MASKS = {
    "book": rounded(outline(BOOK), 9),
    "can": outline(CAN),
    "ball": outline(BALL),
    "figure": figure(),
}
SHAPES = {"book": "box", "can": "cylinder", "ball": "sphere", "figure": "inflated"}


FINEST = {"book": 3, "can": 8, "ball": 8, "figure": 8}
"""Size in pixels of what the photo shows on each; a book is printed up to its edges."""


def a_photo(mask, finest):
    """Blotches on the object before a plain ground, so that colours from elsewhere on the object count as well."""
    random = np.random.default_rng(5)
    blotches = cv2.resize(
        random.uniform(90, 250, (HEIGHT // finest, WIDTH // finest, 3)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC
    )
    ground = np.full((HEIGHT, WIDTH, 3), 90.0)
    return np.clip(np.where(mask[..., None], blotches, ground), 0, 255).astype(np.uint8), ground


def first_frame(surface, photo):
    """What is composited over the photo, averaged over FINER² places in each pixel; and how much the body covers."""
    seen = visible_pixels(VIEW, surface.vertices, surface.faces, FINER)
    uv = seen.interpolated(surface.faces, surface.uv)
    height, width = surface.picture.shape[:2]
    x, y = np.floor(uv[:, 0] * width).astype(int), np.floor((1.0 - uv[:, 1]) * height).astype(int)
    at = (y.clip(0, height - 1), x.clip(0, width - 1))
    fine = np.zeros((HEIGHT * FINER, WIDTH * FINER, 5), np.float32)
    fine[seen.rows, seen.columns, :3] = bytes_to_linear(surface.picture)[at]
    fine[seen.rows, seen.columns, 3] = 1.0
    fine[seen.rows, seen.columns, 4] = 1.0 - surface.alpha[at] / 255.0
    mean = fine.reshape(HEIGHT, FINER, WIDTH, FINER, 5).mean(axis=(1, 3))
    covered, lack = mean[..., 3], mean[..., 4]
    layer = ObjectLayer(texture=mean[..., :3], alpha=covered, light=np.ones_like(mean[..., :3]))
    layer = matted(layer, lack, soft_reach(covered, lack))
    return linear_to_bytes(compose(layer, behind(bytes_to_linear(photo), layer))), covered


@pytest.mark.parametrize("name", MASKS)
def test_a_body_shows_the_photo_up_to_its_outline(name, tmp_path):
    mask = MASKS[name]
    photo, ground = a_photo(mask, FINEST[name])
    layers = Layers(
        seen=(mask,),
        full=(mask,),
        shadows=(np.zeros_like(mask),),
        holes=(mask,),
        colours=(photo,),
        background=ground.astype(np.uint8),
        front_to_back=(0,),
        uncovered={},
    )
    store = StageCache(tmp_path, tmp_path, lambda _: None)
    wanted = ObjectRequest(name="thing", box=(0, 0, 9, 9), shape=SHAPES[name])
    options = ReconstructOptions(mesh_vertices=6000)
    (body,) = make_bodies(layers, VIEW, [wanted], options, store, Steps(1, ignore, never))
    assert body.shape == SHAPES[name]
    shown, covered = first_frame(body.surface, photo)
    assert psnr(shown, photo, mask) > REQUIRED_DB
    # Colours from elsewhere on the object are no less wrong than the ground behind it.
    assert psnr(shown, photo, mask & (covered == 1.0)) > INSIDE_DB
