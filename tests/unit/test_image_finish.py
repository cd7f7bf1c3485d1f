# SPDX-License-Identifier: GPL-3.0-or-later
"""Sharpness, depth of field, the mirror and the shutter on small arrays."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.physgen_addon.render import motion_blur
from physgen.sim.composite import blur, floor_reflection
from physgen.sim.composite import blur as defocus
from physgen.sim.composite import blur as sharpness
from physgen.sim.composite.compositing import ObjectLayer, compose
from physgen.sim.composite.pull_push import spread_values
from physgen.sim.scene.model import Camera, Ground

SIZE = 120
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, -0.5, 3**0.5 / 2, -0.4), (0.0, -(3**0.5) / 2, -0.5, 0.3), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=160, height=120, fx=190.0, fy=200.0, cx=74.0, cy=63.5, world_from_camera=EYE)


def disc_coverage(centre: float, radius: float = 30.0) -> np.ndarray:
    """Coverage of a disc, a mean over each pixel's area."""
    axis = (np.arange(SIZE * 8) + 0.5) / 8
    fine = (np.hypot(axis[None] - centre, axis[:, None] - SIZE / 2) < radius).astype(np.float32)
    return cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA)


def rise(profile: np.ndarray) -> float:
    """Pixels over which an edge goes from 10 to 90 %."""
    x = np.arange(len(profile))
    profile = (profile - profile.min()) / np.ptp(profile)
    return float(np.interp(0.9, profile, x) - np.interp(0.1, profile, x))


@pytest.mark.parametrize("sigma", [0.0, 0.8, 1.6, 2.5])
def test_outlines_of_what_moved_are_as_soft_as_the_photos(sigma):
    rest, moved = disc_coverage(45.0), disc_coverage(70.0)
    noise = np.random.default_rng(0).normal(0, 0.003, (SIZE, SIZE, 3))
    seen = cv2.GaussianBlur(rest, (0, 0), sigma) if sigma else rest
    photo = (0.15 + seen[..., None] * np.array([0.6, 0.4, 0.3]) + noise).astype(np.float32)
    found = sharpness.outline_sigma(photo, rest > 0.5)
    layer = ObjectLayer(
        texture=np.repeat(moved[..., None] * np.float32(0.7), 3, axis=-1),
        alpha=moved,
        light=np.ones((SIZE, SIZE, 3), np.float32),
    )
    everywhere = np.ones((SIZE, SIZE), np.float32)
    soft = sharpness.soften_outlines(layer, everywhere * found, everywhere)
    frame = compose(soft, np.full((SIZE, SIZE, 3), 0.15, np.float32))[..., 0]
    truth = photo[SIZE // 2 - 2 : SIZE // 2 + 2, 5:45, 0].mean(axis=0)
    assert rise(frame[SIZE // 2, 30:70]) == pytest.approx(rise(truth), rel=0.12)
    assert frame[SIZE // 2, 70] == pytest.approx(0.7, abs=1e-3)
    still = sharpness.soften_outlines(layer, everywhere * found, np.zeros_like(everywhere))
    assert np.array_equal(still.texture, layer.texture) and np.array_equal(still.alpha, layer.alpha)


def test_squares_of_a_nearer_texture_are_smoothed_and_others_stay():
    texture = np.random.default_rng(0).random((SIZE // 4, SIZE // 4, 3), dtype=np.float32)
    alpha = np.ones((SIZE, SIZE), np.float32)
    squares = ObjectLayer(
        texture=np.kron(texture, np.ones((4, 4, 1), np.float32)),
        alpha=alpha,
        light=np.ones((SIZE, SIZE, 3), np.float32),
    )

    def steepest(layer: ObjectLayer) -> float:
        return float(np.abs(np.diff(layer.texture, axis=1)).max())

    smooth = sharpness.soften_squares(squares, 4.0 * alpha)
    assert steepest(smooth) < 0.5 * steepest(squares)
    assert smooth.texture.mean() == pytest.approx(squares.texture.mean(), rel=0.01)
    assert np.array_equal(sharpness.soften_squares(squares, alpha).texture, squares.texture)


def test_smooth_masks_without_edges_tell_nothing():
    flat = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    assert sharpness.outline_sigma(flat, disc_coverage(60.0) > 0.5) is None
    assert sharpness.outline_sigma(flat, np.zeros((SIZE, SIZE), bool)) is None


def test_blur_differs_from_place_to_place():
    image = np.zeros((64, 128, 1), np.float32)
    image[:, 32], image[:, 96] = 1.0, 1.0
    strength = np.zeros((64, 128), np.float32)
    strength[:, 64:] = 3.0
    smeared = blur.varying_blur(image, strength, blur.gaussian_blur)
    assert np.array_equal(smeared[:, :60], image[:, :60])
    assert smeared[32, 96, 0] == pytest.approx(1 / (3.0 * np.sqrt(2 * np.pi)), rel=0.1)
    assert blur.disc_blur(image, 4.0).sum() == pytest.approx(image.sum(), rel=1e-4)


def test_circle_of_confusion_is_the_thin_lens():
    # A 50 mm lens at f/2 focused at 2 m: a point at 4 m is drawn 25 mm · 50 / 1950 · 2 / 4 = 0.3205 mm wide.
    camera = Camera(width=3600, height=2400, fx=5000.0, fy=5000.0, cx=1800.0, cy=1200.0, world_from_camera=EYE)
    radius = defocus.blur_radius(camera, np.array([2.0, 4.0]), 2.0, 2.0)
    assert radius == pytest.approx([0.0, 0.3205 / 36 * 3600 / 2], rel=1e-3)
    assert defocus.added_radius(np.array([5.0, 1.0]), np.array([3.0, 2.0])) == pytest.approx([4.0, 0.0])


heights = st.floats(0.0, 0.2)
ways = st.floats(-0.15, 0.15)


@settings(max_examples=40, deadline=None)
@given(x=ways, y=ways, z=heights, tilt=st.floats(-0.2, 0.2))
def test_the_mirrored_camera_sees_what_a_floor_shows(x, y, z, tilt):
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    ground = Ground(point=(0.0, 0.0, -0.05), normal=tuple(normal))
    point = np.array([x, y, z])
    image = point - 2 * float(ground.heights(point)) * ground.unit_normal
    wanted, seen = CAMERA.project(image), floor_reflection.mirrored_camera(CAMERA, ground).project(point)
    assert (CAMERA.width - seen[0], seen[1], seen[2]) == pytest.approx(tuple(wanted), abs=1e-6)


def test_a_floor_mirrors_more_at_a_slant_and_nothing_new_at_rest():
    share, _ = floor_reflection.fresnel(CAMERA, Ground(reflectivity=0.04), (160, 120))
    assert share[-1].min() >= 0.04 and share[0].mean() > 1.5 * share[-1].mean()
    rng = np.random.default_rng(0)
    ground, colour = rng.random((2, 120, 160, 3), dtype=np.float32)
    shown = floor_reflection.Mirrored(colour=colour * 0.1, alpha=share)
    same = floor_reflection.with_reflection(ground, shown, shown, np.ones((120, 160), np.float32))
    assert np.array_equal(same, ground)
    gone = floor_reflection.with_reflection(ground, shown, shown, np.zeros((120, 160), np.float32))
    assert gone == pytest.approx(ground * (1 - share[..., None]) + colour * 0.1, abs=1e-6)


def test_maps_show_the_nearest_points_and_go_on_between():
    pixels = np.array([[20.0, 20.0], [20.0, 20.0], [100.0, 60.0]])
    shown = spread_values(pixels, np.array([1.0, 2.0, 1.0]), np.array([1.0, 9.0, 3.0]), (128, 96))
    assert shown.shape == (96, 128)
    assert shown[20, 20] == pytest.approx(1.0, abs=0.2) and shown[60, 100] == pytest.approx(3.0, abs=0.2)
    assert shown.min() >= 0.99 and shown.max() <= 3.01
    assert not spread_values(pixels, -np.ones(3), np.ones(3), (128, 96)).any()


def test_a_stroke_has_both_its_ends_and_rest_has_none():
    skin = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.02]], np.float32)
    rest, now = (
        motion_blur.Pose(skins=[skin + np.float32([x, 0, 0])], particles=[None], flowing=(False,)) for x in (0.0, 0.04)
    )
    choice = {"still": 1e-5, "camera": CAMERA, "scale": 1.0}
    moving = motion_blur.moment(2, rest, now, shutter=0.5, **choice)
    assert np.allclose(moving.swept[0], np.concatenate([skin + np.float32([0.02, 0, 0]), now.skins[0]]))
    assert moving.shutter == 0.5 and 4 < moving.length < 20
    assert moving.samples(16, at_most=4) == round(16 * moving.length / motion_blur.SAMPLED_PX)
    for before, shutter in ((now, 0.5), (rest, 0.0)):
        sharp = motion_blur.moment(2, before, now, shutter=shutter, **choice)
        assert (
            sharp.shutter == 0 and np.array_equal(sharp.swept[0], now.skins[0]) and sharp.samples(16, at_most=4) == 16
        )
