# SPDX-License-Identifier: MIT
"""Cameras found again in pictures that were drawn with known ones."""

import math

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.camera import ground_camera as cameras
from physgen.sim.reconstruct.camera.camera_estimate import estimate_camera
from physgen.sim.reconstruct.camera.depth_map import DepthMap
from physgen.sim.reconstruct.photo import Photo
from physgen.sim.reconstruct.reconstruct_options import ReconstructOptions

WIDTH, HEIGHT = 640, 480


def silent(_):
    pass


def camera_of(fov_deg, pitch_deg, roll_deg=0.0):
    focal = cameras.focal_of_fov(WIDTH, HEIGHT, fov_deg)
    return cameras.camera_above_ground(WIDTH, HEIGHT, focal, math.radians(pitch_deg), math.radians(roll_deg))


def photo_of(grey, focal=None, seed=0):
    noisy = grey + np.random.default_rng(seed).normal(0, 3, grey.shape)
    pixels = np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    full_frame = None if focal is None else focal / math.hypot(WIDTH, HEIGHT) * math.hypot(36, 24)
    return Photo(pixels=pixels, scale=1.0, original_size=(WIDTH, HEIGHT), focal_35mm=full_frame)


def tiles(camera, turn_deg=25.0, side=0.3):
    """A tiled floor: joints a twentieth of a tile wide, drawn at twice the size."""
    rows, columns = (np.mgrid[: 2 * HEIGHT, : 2 * WIDTH] + 0.5) / 2
    points = cameras.on_ground(camera, np.stack([columns, rows], axis=-1))
    turn = math.radians(turn_deg)
    with np.errstate(invalid="ignore"):
        a = points[..., 0] * math.cos(turn) + points[..., 1] * math.sin(turn)
        b = points[..., 1] * math.cos(turn) - points[..., 0] * math.sin(turn)
        joint = (a % side < side / 20) | (b % side < side / 20)
        grey = np.where(joint, 70.0, 140.0)
        grey[~(np.hypot(points[..., 0], points[..., 1]) < 12)] = 190.0
    return cv2.resize(cv2.GaussianBlur(grey, (0, 0), 1.0), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def boxes(camera):
    """Three boxes on a plain floor, each turned another way, and the masks of them."""
    grey, masks = np.full((HEIGHT, WIDTH), 150.0), []
    for place, size, turn_deg in (((-0.6, 2.3), 0.5, 20), ((0.5, 2.1), 0.45, 65), ((0.0, 1.5), 0.35, 40)):
        turn = math.radians(turn_deg)
        corner = size * np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
        x, y = corner[:, 0].copy(), corner[:, 1].copy()
        corner[:, 0] = x * math.cos(turn) - y * math.sin(turn) + place[0]
        corner[:, 1] = x * math.sin(turn) + y * math.cos(turn) + place[1]
        seen = camera.project(corner)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4)]
        for number, face in enumerate(sorted(faces, key=lambda f: -seen[list(f), 2].mean())):
            polygon = np.round((seen[list(face), :2] - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(grey, [polygon], 30.0 + 33 * number, cv2.LINE_AA, 4)
            cv2.fillPoly(mask, [polygon], 1, cv2.LINE_8, 4)
        masks.append(mask > 0)
    return cv2.GaussianBlur(grey, (0, 0), 0.7), masks


def mask_at(x=320, y=380, radius=30):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(mask, (x, y), radius, 1, -1)
    return mask > 0


def normal_error(estimate, truth):
    cosine = cameras.up_in_camera(estimate.camera) @ cameras.up_in_camera(truth)
    return math.degrees(math.acos(min(1.0, float(cosine))))


def fov_error(estimate, truth):
    return abs(estimate.fov_deg / cameras.fov_of_focal(WIDTH, HEIGHT, truth.fx) - 1.0)


@pytest.mark.parametrize(
    ("fov_deg", "pitch_deg", "roll_deg"), [(60, 25, 0), (45, 35, -4), (70, 18, 3), (50, 50, 2), (40, 28, 6)]
)
def test_focal_length_and_ground_from_tiles(fov_deg, pitch_deg, roll_deg):
    truth = camera_of(fov_deg, pitch_deg, roll_deg)
    found = estimate_camera(photo_of(tiles(truth)), [mask_at()], ReconstructOptions(), None, silent)
    assert fov_error(found, truth) < 0.10
    assert normal_error(found, truth) < 3.0
    assert found.focal_source == found.normal_source == "straight lines"
    assert found.normal_sigma_deg < 3.0


@pytest.mark.parametrize(("fov_deg", "pitch_deg", "roll_deg"), [(60, 25, 2), (45, 32, -3), (52, 20, 0)])
def test_ground_from_the_edges_of_boxes(fov_deg, pitch_deg, roll_deg):
    truth = camera_of(fov_deg, pitch_deg, roll_deg)
    grey, masks = boxes(truth)
    found = estimate_camera(photo_of(grey, truth.fx), masks, ReconstructOptions(), None, silent)
    assert normal_error(found, truth) < 3.0
    assert found.focal_source.startswith("EXIF")
    assert fov_error(found, truth) < 0.05


def test_without_lines_the_uncertainty_is_that_of_habit():
    plain = np.full((HEIGHT, WIDTH), 130.0)
    strokes = plain.copy()
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(0, [WIDTH, HEIGHT], (900, 2)):
        turn, length = 0.7 + rng.normal(0, 0.1), rng.uniform(15, 50)
        end = (int(x + length * math.cos(turn)), int(y + length * math.sin(turn)))
        cv2.line(strokes, (int(x), int(y)), end, rng.uniform(30, 220), 2, cv2.LINE_AA)
    for grey in (plain, strokes):
        said = []
        found = estimate_camera(photo_of(grey), [mask_at()], ReconstructOptions(), None, said.append)
        assert found.normal_sigma_deg > 8.0
        assert found.fov_sigma_deg > 8.0
        assert found.normal_source == "a typical pose"
        assert 10 < math.degrees(cameras.pitch_and_roll(cameras.up_in_camera(found.camera))[0]) < 35
        told = " ".join(said)
        for word in ("fov_deg", "pitch_deg", "horizon_y", "roll_deg", "hardly constrains"):
            assert word in told


def test_things_high_up_in_the_photo_are_below_the_horizon():
    found = estimate_camera(
        photo_of(np.full((HEIGHT, WIDTH), 130.0)),
        [mask_at(y=40, radius=20)],
        ReconstructOptions(),
        None,
        silent,
    )
    assert max(found.horizon) < 40


def test_options_always_win():
    truth = camera_of(60, 25, 0)
    photo = photo_of(tiles(truth), focal=500.0)
    options = ReconstructOptions(fov_deg=33.0, pitch_deg=41.0, roll_deg=-7.0)
    said = []
    found = estimate_camera(photo, [mask_at()], options, None, said.append)
    assert found.fov_deg == pytest.approx(33.0)
    pitch, roll = cameras.pitch_and_roll(cameras.up_in_camera(found.camera))
    assert (math.degrees(pitch), math.degrees(roll)) == pytest.approx((41.0, -7.0))
    assert found.fov_sigma_deg == found.normal_sigma_deg == 0.0
    assert not said
    options = ReconstructOptions(horizon_y=-0.25, fov_deg=60.0)
    found = estimate_camera(photo, [mask_at()], options, None, silent)
    assert sum(found.horizon) / 2 == pytest.approx(-0.25 * HEIGHT, abs=0.5)
    assert found.normal_source.startswith("horizon_y")


def test_given_pitch_leaves_the_focal_length_to_the_lines():
    truth = camera_of(60, 25, 0)
    found = estimate_camera(photo_of(tiles(truth)), [mask_at()], ReconstructOptions(pitch_deg=25.0), None, silent)
    assert fov_error(found, truth) < 0.05


def test_what_hangs_above_the_given_horizon_leaves_the_camera_to_the_rest():
    """A kite above the horizon has no say: the camera is that of the floor and what stands on it, alone or not."""
    truth = camera_of(60, 15, 0)
    photo, options = photo_of(tiles(truth)), ReconstructOptions(horizon_y=cameras.horizon_at_edges(truth)[0] / HEIGHT)
    alone = estimate_camera(photo, [mask_at()], options, None, silent)
    both = estimate_camera(photo, [mask_at(), mask_at(y=50, radius=20)], options, None, silent)
    assert both.horizon == pytest.approx([options.horizon_y * HEIGHT] * 2, abs=1.0)
    assert both.camera.fx == pytest.approx(alone.camera.fx, rel=0.02)
    kite = estimate_camera(photo, [mask_at(y=50, radius=20)], options, None, silent)
    assert kite.horizon == pytest.approx([options.horizon_y * HEIGHT] * 2, abs=1.0)


def test_a_depth_map_in_metres_gives_ground_and_scale():
    truth = camera_of(55, 32, 4)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    depth = cameras.ground_depth(truth, truth.rays(np.stack([columns, rows], axis=-1))) * 0.7
    values = np.minimum(depth, 4.0).astype(np.float32)
    said = []
    found = estimate_camera(
        photo_of(np.full((HEIGHT, WIDTH), 130.0)),
        [mask_at()],
        ReconstructOptions(),
        DepthMap(values=values, disparity=False, metric=True, focal=truth.fx),
        said.append,
    )
    assert normal_error(found, truth) < 1.5
    assert found.metres_per_unit == pytest.approx(0.7, rel=0.03)
    assert found.normal_source == "the depth map"
    assert found.focal_source == "the depth map"
    assert "ground found" in said[0]


def test_equal_photos_give_equal_cameras():
    photo = photo_of(tiles(camera_of(60, 25, 0)))
    first, second = (estimate_camera(photo, [mask_at()], ReconstructOptions(), None, silent) for _ in range(2))
    assert first == second
