# SPDX-License-Identifier: MIT
"""Patches are aligned and poses found: shifts, noise, contrast and outliers, against known truths."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.capture import Camera as CaptureCamera
from physgen.sim.diagnose.track.feature_tracking import align, contrast, extract_patches, image_noise, smoothed, warp
from physgen.sim.diagnose.track.pose_estimation import (
    Pose,
    Surface,
    cast,
    continued,
    facing,
    jitter,
    locate,
    pose_scatter,
    project,
    rigid_noise,
    silhouette,
    while_moving,
)
from scipy.spatial.transform import Rotation

from .track_scenes import HEIGHT, LOOK_DOWN, WIDTH, texture


def capture_camera() -> CaptureCamera:
    return CaptureCamera(
        width=WIDTH, height=HEIGHT, fx=520.0, fy=500.0, cx=230.0, cy=190.0, world_from_camera=LOOK_DOWN
    )


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_casting_inverts_projecting(seed):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    surface = Surface(vertices=np.asarray(ball.vertices), faces=np.asarray(ball.faces))
    pose = Pose(
        rotation=Rotation.random(random_state=seed).as_matrix(),
        translation=rng.uniform([-0.05, -0.05, 0.45], [0.05, 0.05, 0.55]),
    )
    camera = capture_camera()
    pixels = project(camera, pose.translation[None]) + rng.uniform(-80, 80, (60, 2))
    hits = cast(surface, pose, camera, pixels)
    hit = hits.face >= 0
    assert hit.any()
    np.testing.assert_allclose(project(camera, pose.apply(hits.rest[hit])), pixels[hit], atol=1e-6)
    radius = np.linalg.norm(hits.rest[hit], axis=1)
    assert (radius <= 0.05 + 1e-9).all() and (radius > 0.047).all()
    # The near side of a convex body is the one that is turned towards the camera.
    assert (facing(hits.rest[hit], surface.normals[hits.face[hit]], pose) > 0).all()
    inside = silhouette(surface, pose, camera)
    row, column = np.floor(pixels[hit]).astype(int)[:, ::-1].T
    fits = (row >= 0) & (row < HEIGHT) & (column >= 0) & (column < WIDTH)
    assert inside[row[fits], column[fits]].mean() > 0.97 if fits.any() else True


@given(st.integers(0, 10_000), st.integers(0, 6))
@settings(max_examples=30, deadline=None)
def test_a_pose_is_found_in_spite_of_outliers(seed, outliers):
    rng = np.random.default_rng(seed)
    rest = rng.uniform(-0.05, 0.05, (24, 3))
    true = Pose(rotation=Rotation.random(random_state=seed).as_matrix(), translation=np.array([0.02, -0.03, 0.6]))
    camera = capture_camera()
    pixels = project(camera, true.apply(rest)) + rng.normal(0, 0.1, (24, 2))
    pixels[:outliers] += rng.choice([-1, 1], (outliers, 2)) * rng.uniform(10, 40, (outliers, 2))
    guess = Pose(
        rotation=Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix() @ true.rotation,
        translation=true.translation + rng.normal(0, 0.005, 3),
    )
    found = locate(camera, rest, pixels, guess, tolerance=2.0, largest=5.0)
    assert found is not None
    assert not found.inliers[:outliers].any() and found.inliers[outliers:].all()
    assert np.linalg.norm(found.pose.translation - true.translation) < 0.003


def test_four_points_are_no_pose():
    rest = np.eye(4, 3) * 0.05
    pose = Pose(rotation=np.eye(3), translation=np.array([0, 0, 0.5]))
    camera = capture_camera()
    assert locate(camera, rest, project(camera, pose.apply(rest)), pose, tolerance=2.0, largest=5.0) is None


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(0.6, 1.2), st.floats(-30, 20))
@settings(max_examples=30, deadline=None)
def test_aligning_finds_shifts_whatever_the_light(dx, dy, gain, offset):
    image = cv2.GaussianBlur(texture(3, 200, 70, 180), (0, 0), 1.0)
    move = np.array([[1, 0, dx], [0, 1, dy]])
    moved = cv2.warpAffine(image, move, (200, 200), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    lit = np.clip(moved * gain + offset, 0, 255).astype(np.uint8)
    places = np.array([[80.5, 90.5], [120.5, 60.5], [100.5, 130.5]])
    crops = extract_patches(smoothed(image.astype(np.uint8)), places, 8)
    patches = warp(crops, np.broadcast_to(np.eye(2, 5), (3, 2, 5)), 8)
    found, score = align(smoothed(lit), patches, places, 8)
    np.testing.assert_allclose(found - places, np.broadcast_to([dx, dy], (3, 2)), atol=0.1)
    assert (score > 0.95).all()


@given(st.floats(1.0, 10.0))
@settings(max_examples=10, deadline=None)
def test_noise_is_measured_and_is_no_texture(sigma):
    rng = np.random.default_rng(1)
    grey = np.clip(128 + rng.normal(0, sigma, (200, 200)), 0, 255).astype(np.uint8)
    assert image_noise(grey) == pytest.approx(np.hypot(sigma, 0.29), rel=0.1, abs=0.15)
    assert np.median(contrast(grey, 8)) < 2 * 0.43 * max(sigma, 0.3)


def test_contrast_is_in_levels_per_pixel():
    x, y = np.meshgrid(np.arange(100), np.arange(100))
    ramps = (128 + 40 * np.sin(0.2 * x) * np.sin(0.2 * y)).astype(np.uint8)
    gradient = np.hypot(*np.gradient(ramps.astype(float))) / np.sqrt(2)
    assert contrast(ramps, 15)[50, 50] == pytest.approx(np.sqrt((gradient[35:66, 35:66] ** 2).mean()), rel=0.15)


@given(st.floats(0.05, 3.0), st.integers(0, 100))
@settings(max_examples=15, deadline=None)
def test_scatter_is_estimated(sigma, seed):
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, sigma, (80, 30, 2))
    noise[rng.random((80, 30)) < 0.2] = np.nan
    drift = np.linspace(0, 5, 80)[:, None, None] ** 2
    assert jitter(noise + drift) == pytest.approx(sigma, rel=0.15)
    # pose_scatter corrects for poses that were fitted: 6 of about 48 numbers a frame.
    assert pose_scatter(noise) == pytest.approx(sigma / np.sqrt(1 - 6 / 48), rel=0.1)


@given(st.floats(0.06, 1.0), st.floats(0.0, 0.05), st.integers(0, 100))
@settings(max_examples=15, deadline=None)
def test_the_noise_of_a_body_that_mostly_rests_is_that_of_its_motion(moving, still, seed):
    """A cup that hops for 6 of 48 frames scattered by 0.05 px in all, and by six times that in the air."""
    rng = np.random.default_rng(seed)
    hop = np.where((np.arange(48) >= 2) & (np.arange(48) < 8), moving, still)
    noise = rng.normal(size=(48, 30, 2)) * hop[:, None, None]
    way = np.cumsum(np.where((np.arange(48) >= 2) & (np.arange(48) < 9), 5.0, 0.0))
    places = noise + way[:, None, None]
    found = rigid_noise(noise, places)
    # Frames 1 and 8 move as well, towards the next and from the last one: 6 of 8 carry the noise.
    assert found == pytest.approx(np.sqrt((6 * moving**2 + 2 * still**2) / 8 / (1 - 6 / 60)), rel=0.15)
    assert np.isfinite(while_moving(noise, places)).all(axis=(1, 2)).nonzero()[0].tolist() == list(range(1, 9))
    # A single wild frame does not decide.
    noise[4] *= 50
    assert rigid_noise(noise, places) < 2 * found
    assert rigid_noise(noise, np.zeros_like(noise)) == pose_scatter(noise)
    assert rigid_noise(noise[:, :4], places[:, :4]) is None


def test_a_pose_that_is_continued_for_long_stays_a_rotation():
    """What rounding leaves of a rotation grew 2.4 times a frame: a cup at rest was lost after 40 frames."""
    turn = Rotation.from_rotvec([0.01, -0.02, 0.03])
    before = Pose(rotation=np.eye(3), translation=np.zeros(3))
    now = Pose(rotation=turn.as_matrix(), translation=np.array([0.0, 0.01, 0.0]))
    for _ in range(99):
        before, now = now, continued(before, now)
    assert now.rotation @ now.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert now.rotation == pytest.approx(Rotation.from_rotvec(100 * turn.as_rotvec()).as_matrix(), abs=1e-9)
    assert now.translation == pytest.approx([0.0, 1.0, 0.0])
