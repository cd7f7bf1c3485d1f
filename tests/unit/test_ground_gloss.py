# SPDX-License-Identifier: MIT
"""What a glossy ground tells of its gloss, and that matte ground with shadows, spots and grain tells of none."""

import dataclasses
import math
import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from physgen.sim.composite import floor_reflection
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.events import never
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground, on_ground
from physgen.sim.reconstruct.lighting.ground_gloss import _Comparison, _Kept, estimate_gloss
from physgen.sim.reconstruct.lighting.ground_roughness import fitted_roughness, mirror_image
from physgen.sim.reconstruct.mesh_raster import Paint, colours, visible_pixels
from physgen.sim.reconstruct.photo_layers import Layers, make_clean_plate
from physgen.sim.reconstruct.reconstruct_options import ReconstructOptions
from physgen.sim.reconstruct.shape.body_texture import TexturedSurface
from physgen.sim.reconstruct.stage_cache import StageCache, Steps
from physgen.sim.scene.model import Ground
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes

WIDTH, HEIGHT = 240, 180
VIEW = camera_above_ground(WIDTH, HEIGHT, 260.0, math.radians(20.0))
RED, DARK, WHITE = (200, 60, 40), (22, 22, 24), (235, 230, 220)


def book(*stripes):
    """An upright card with upright ``stripes`` on its front and a lid of plain colour; closed."""
    low, high = np.array([-0.35, 2.2, 0.0]), np.array([0.35, 2.4, 0.75])
    corner = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    quads = [(0, 1, 5, 4), (3, 2, 6, 7), (2, 0, 4, 6), (1, 3, 7, 5), (4, 5, 7, 6), (2, 3, 1, 0)]
    vertices = np.concatenate([(low + corner * (high - low))[list(quad)] for quad in quads])
    faces = np.concatenate([[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(6)])
    picture = np.repeat(np.repeat(np.array([stripes], np.uint8), 64, axis=0), 64 // len(stripes), axis=1)
    return TexturedSurface(
        vertices, faces, np.tile([[0.01, 0.01], [0.99, 0.01], [0.99, 0.99], [0.01, 0.99]], (6, 1)), picture
    )


def photo(surface, gloss, *, view=VIEW, shadow=0.0, seed=0, colour=(150, 95, 60), grain=0.04):
    """The body on grained ground of ``gloss``, with the share ``shadow`` of light lost at its foot and to the right;
    pixels, its mask, and the ground alone."""
    noise = np.random.default_rng(seed).normal(size=(view.height, view.width)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), sigmaX=5.0, sigmaY=1.2)
    texture = 1.0 + grain * noise / noise.std()
    bare = bytes_to_linear(np.array(colour, np.uint8)) * texture[..., None]
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    place = on_ground(view, np.stack([x, y], axis=-1))
    # A shadow towards the camera and to the right, soft: it darkens and nothing else.
    dark = ((place[..., 1] > 1.75) & (np.abs(place[..., 0] - 0.3 * (2.2 - place[..., 1])) < 0.36)).astype(np.float32)
    ground = bare * (1.0 - shadow * cv2.GaussianBlur(dark, (0, 0), 2.5))[..., None]
    image = mirror_image(view, surface, 1.0).blurred(gloss.reflection_roughness)
    share = (
        floor_reflection.fresnel(view, gloss, (view.width, view.height))[0]
        if gloss.reflectivity > 0
        else np.zeros(dark.shape)
    )
    light = ground * (1.0 - image[..., 3:] * share[..., None]) + image[..., :3] * share[..., None]
    seen = visible_pixels(view, surface.vertices, surface.faces)
    mask = seen.on_grid((view.width, view.height))
    shown = colours(seen, view.project(surface.vertices), surface.faces, Paint(texture=surface.picture, uv=surface.uv))
    light[seen.rows, seen.columns] = bytes_to_linear(np.rint(shown).astype(np.uint8))
    return linear_to_bytes(light), mask, linear_to_bytes(ground)


@pytest.mark.long
@settings(max_examples=5, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(
    reflectivity=st.floats(0.04, 0.3),
    roughness=st.sampled_from([0.0, 0.08, 0.2]),
    seed=st.integers(0, 9),
    shadow=st.floats(0.0, 0.5),
)
def test_a_glossy_ground_is_measured_whatever_its_shadow(reflectivity, roughness, seed, shadow):
    gloss = Ground(reflectivity=reflectivity, reflection_roughness=roughness)
    surface = book(WHITE, DARK, DARK, DARK, RED, DARK)
    pixels, mask, _ = photo(surface, gloss, seed=seed, shadow=shadow)
    found = estimate_gloss(pixels, mask, VIEW, [surface])
    assert found.reflectivity == pytest.approx(reflectivity, rel=0.3, abs=0.015)
    assert found.roughness == pytest.approx(roughness, abs=0.04)


def test_a_mirror_image_is_sharp_at_its_contact_and_blurs_with_height():
    """By the rays themselves: one turned by twice the slope's deviation, after the share h / (H + h) of its path."""
    surface = book(WHITE, DARK)
    image = mirror_image(VIEW, surface, 1.0)
    rows = np.flatnonzero((image.alpha > 0).any(axis=1))
    sigma = np.array([image.sigma[row][image.alpha[row] > 0].mean() for row in rows])
    eye = float(VIEW.position[2])
    top = math.sqrt(2.0) * VIEW.fy * 0.75 / (eye + 0.75)
    assert sigma[:5].mean() < 0.15 * top
    assert sigma.max() == pytest.approx(top, rel=0.05)
    assert (np.diff(sigma[:: len(sigma) // 5]) > 0).all()


@pytest.mark.parametrize(("roughness", "shadow"), [(0.05, 0.3), (0.1, 0.0), (0.2, 0.5)])
def test_roughness_is_told_within_a_quarter(roughness, shadow):
    view = camera_above_ground(2 * WIDTH, 2 * HEIGHT, 520.0, math.radians(20.0))
    surface = book(WHITE, DARK, DARK, DARK, RED, DARK)
    gloss = Ground(reflectivity=0.05, reflection_roughness=roughness)
    pixels, mask, _ = photo(surface, gloss, view=view, shadow=shadow, seed=1)
    found = fitted_roughness(pixels, mask, view, [surface], 0.08)
    assert found == pytest.approx(roughness, rel=0.25)


@pytest.mark.long
@settings(max_examples=8, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(
    stripes=st.sampled_from([(DARK, DARK), (DARK, RED), (WHITE, DARK, DARK, DARK, RED, DARK), (RED, RED)]),
    seed=st.integers(0, 50),
    shadow=st.floats(0.0, 0.8),
    grain=st.floats(0.0, 0.2),
)
def test_matte_ground_with_any_shadow_has_no_gloss(stripes, seed, shadow, grain):
    surface = book(*stripes)
    pixels, mask, _ = photo(surface, Ground(), seed=seed, shadow=shadow, grain=grain)
    found = estimate_gloss(pixels, mask, VIEW, [surface])
    assert found.reflectivity == 0.0
    assert not any(image.any() for image in found.images)
    assert np.array_equal(found.pixels, pixels)


def test_a_plain_thing_alone_cannot_be_told_from_its_colour_on_the_ground():
    """Turned left to right it is the same: the light that it throws on the ground is not excluded."""
    surface = book(RED, RED)
    pixels, mask, _ = photo(surface, Ground(reflectivity=0.2, reflection_roughness=0.08))
    found = estimate_gloss(pixels, mask, VIEW, [surface])
    assert found.reflectivity == 0.0
    assert found.by_chance > 0.5


def test_nothing_that_is_mirrored_in_view_means_no_gloss():
    surface = book(WHITE, DARK)
    pixels, mask, _ = photo(surface, Ground(reflectivity=0.3))
    assert estimate_gloss(pixels, np.ones_like(mask), VIEW, [surface]).reflectivity == 0.0


def test_the_background_keeps_no_mirror_image(tmp_path):
    surface = book(WHITE, DARK, DARK, DARK, RED, DARK)
    pixels, mask, ground = photo(surface, Ground(reflectivity=0.2, reflection_roughness=0.08))
    hole = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    nothing = np.zeros_like(mask)
    layers = Layers((mask,), (mask,), (nothing,), (hole,), (pixels,), pixels, (0,), {})
    said = []
    store = StageCache(tmp_path, tmp_path, said.append)

    def plate(picture):
        return make_clean_plate(
            layers,
            picture,
            [surface],
            VIEW,
            ReconstructOptions(),
            inpainter=lambda picture, where: np.where(where[..., None], ground, picture),
            store=store,
            steps=Steps(2, lambda event: said.append(event.get("message", "")), never),
        )

    made, gloss = plate(pixels)
    (image,) = gloss.images
    kept = image & ~hole
    assert kept.sum() > 1000
    assert psnr(made.background, ground, kept) > psnr(pixels, ground, kept) + 8.0
    assert np.array_equal(made.holes[0], hole | image)
    assert np.array_equal(made.background[~made.holes[0]], pixels[~made.holes[0]])
    assert any("reflectivity 0." in text for text in said)
    flat, _, _ = photo(surface, Ground())
    same, none = plate(flat)
    assert np.array_equal(same.holes[0], hole)
    assert np.array_equal(same.background[~hole], flat[~hole])
    assert none.reflectivity == 0.0


def test_where_a_mirror_image_is_strong_the_ground_is_filled(tmp_path):
    """A can's image in ice, whose blur was not quite right, left blue and orange spots on the plate."""
    surface = book(WHITE, DARK, DARK, DARK, RED, DARK)
    pixels, mask, ground = photo(surface, Ground(reflectivity=0.5, reflection_roughness=0.08), grain=0.02)
    hole = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    nothing = np.zeros_like(mask)
    layers = Layers((mask,), (mask,), (nothing,), (hole,), (pixels,), pixels, (0,), {})
    filled = []

    def inpainter(picture, where):
        filled.append(where)
        return np.where(where[..., None], ground, picture)

    store, steps = StageCache(tmp_path, tmp_path, lambda text: None), Steps(2, lambda event: None, never)
    made, gloss = make_clean_plate(
        layers, pixels, [surface], VIEW, ReconstructOptions(), inpainter=inpainter, store=store, steps=steps
    )
    (image,) = gloss.images
    apart = np.abs(np.log(pixels + 4.0) - np.log(ground + 4.0)).max(axis=-1)
    strong = cv2.erode((image & ~hole & (apart > 0.3)).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert strong.sum() > 300 and (filled[0] & strong).sum() > 0.95 * strong.sum()
    assert not (filled[0] & ~hole & ~image).any()
    assert psnr(made.background, ground, image) > psnr(gloss.pixels, ground, image) + 3.0


def test_each_of_many_things_takes_its_own_pixels_and_not_the_photos():
    """It was 132 bytes of each pixel of the photo for each thing: 4 GB of twenty small ones in 1440 x 1080."""
    view = camera_above_ground(160, 120, 180.0, math.radians(20.0))
    whole = book(WHITE, DARK)
    small = TexturedSurface(0.3 * whole.vertices + (0, 1.6, 0), whole.faces, whole.uv, whole.picture)
    pixels = np.random.default_rng(0).integers(90, 110, (120, 160, 3)).astype(np.uint8)
    image = mirror_image(view, small, 1.0)

    def peak(things):
        tracemalloc.start()
        try:
            kept = [_Kept.of(dataclasses.replace(image, sigma=image.sigma.copy())) for _ in range(things)]
            comparison = _Comparison(pixels, np.zeros((120, 160), bool), view, kept)
            for roughness in (0.0, 0.1, 0.25):
                comparison.fit(roughness)
            return tracemalloc.get_traced_memory()[1] / (160 * 120)
        finally:
            tracemalloc.stop()

    # What is kept of each that has the photo's size is its blur, in 4 bytes.
    assert (peak(7) - peak(2)) / 5 < 8
