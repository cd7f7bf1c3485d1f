# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks of the Movie Clip editor as captures, against markers whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.diagnose.capture_folder import load_capture, save_capture
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import Camera, SceneModel, SceneObject
from scipy.spatial.transform import Rotation

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.playback.movie_clips import ClipTrial, capture_from_clips

WIDTH, HEIGHT, FPS, FRAMES = 320, 240, 50.0, 12
LOOK_DOWN = ((1.0, 0.0, 0.0, 0.0), (0.0, -0.5, 0.75**0.5, -0.5), (0.0, -(0.75**0.5), -0.5, 0.35), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=350.0, fy=350.0, cx=160.0, cy=120.0, world_from_camera=LOOK_DOWN)
CENTRE = np.array([0.0, 0.0, 0.05])


def motion(t):
    return Rotation.from_rotvec([0.4 * t, 0, 3.0 * t]), CENTRE + np.array([0.3 * t, 0.0, t - 4.905 * t * t])


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "scene"
    (root / "meshes").mkdir(parents=True)
    for name in ("photo.png", "background.png"):
        cv2.imwrite(str(root / name), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    ball.apply_translation(CENTRE)
    ball.export(root / "meshes/ball.ply")
    item = SceneObject(name="ball", mesh="meshes/ball.ply", size_m=0.1, material=load_preset("wood"))
    return save_scene(root, SceneModel(camera=CAMERA, objects=(item,)))


@pytest.fixture
def clip(tmp_path):
    path = tmp_path / "take.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (WIDTH, HEIGHT))
    for _ in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    writer.release()
    clip = bpy.data.movieclips.load(str(path))
    clip.frame_start = 101
    return clip


def surface_points(count, seed=0):
    """Points (count, 3) of the ball, rest frame, on the side of the camera."""
    rng = np.random.default_rng(seed)
    rest = rng.normal(size=(40 * count, 3))
    rest *= 0.0499 / np.linalg.norm(rest, axis=1, keepdims=True)
    towards = CAMERA.position - CENTRE
    return rest[rest @ towards / np.linalg.norm(towards) > 0.035][:count]


def place(track, frame, pixel, mute=False):
    marker = track.markers.find_frame(frame) or track.markers.insert_frame(frame)
    marker.co = pixel[0] / WIDTH, 1 - pixel[1] / HEIGHT
    marker.mute = mute


def add_tracks(clip, rest, *, first=1, noise=0.0, prefix="p", lens=None):
    rng = np.random.default_rng(5)
    truth = []
    for frame in range(1, FRAMES + 1):
        turn, shift = motion((frame - 1) / FPS)
        pixels = CAMERA.project(turn.apply(rest) + shift)[:, :2]
        truth.append(pixels + rng.normal(0, noise, pixels.shape) if noise else pixels)
    for k in range(len(rest)):
        track = clip.tracking.tracks.new(name=f"{prefix}{k}", frame=first)
        for frame in range(first, FRAMES + 1):
            pixel = truth[frame - 1][k]
            place(track, frame, pixel if lens is None else lens(pixel))
    return np.array(truth)


def test_tracks_become_a_capture(folder, clip, tmp_path):
    rest = surface_points(12)
    truth = add_tracks(clip, rest, noise=0.2)
    capture = capture_from_clips([ClipTrial(clip=clip, name="take")], folder)
    save_capture(capture, tmp_path / "capture")
    loaded = load_capture(tmp_path / "capture")
    trial = loaded.trials[0]
    assert loaded.warnings == () and capture.warnings == ()
    np.testing.assert_allclose(trial.times, np.arange(FRAMES) / FPS, atol=1e-6)
    np.testing.assert_allclose(trial.pixels, truth, atol=1e-3)
    # The first frame's noise of 0.2 px is 0.3 mm on the ball, more where it curves away.
    assert np.median(np.linalg.norm(trial.rest_points - rest, axis=1)) < 5e-4
    np.testing.assert_allclose(np.linalg.norm(trial.rest_points, axis=1), 0.05, atol=2e-4)
    assert 0.1 < loaded.noise_sigma < 0.4
    assert loaded.camera.width == WIDTH and loaded.objects[0].belief.rigid


def test_muted_and_missing_markers_are_not_seen(folder, clip):
    truth = add_tracks(clip, surface_points(8))
    track = clip.tracking.tracks[2]
    place(track, 4, truth[3][2], mute=True)
    track.markers.delete_frame(7)
    seen = capture_from_clips([ClipTrial(clip=clip)], folder).trials[0].seen
    assert not seen[3, 2] and not seen[6, 2]
    assert seen.sum() == 8 * FRAMES - 2


def test_tracks_that_begin_later_are_put_where_the_object_is_by_then(folder, clip):
    early, late = surface_points(10), surface_points(6, seed=3)
    add_tracks(clip, early)
    add_tracks(clip, late, first=6, prefix="late")
    trial = capture_from_clips([ClipTrial(clip=clip)], folder).trials[0]
    assert trial.rest_points.shape == (16, 3)
    np.testing.assert_allclose(trial.rest_points[10:], late, atol=5e-4)
    assert not trial.seen[:5, 10:].any() and trial.seen[5:, 10:].all()


def test_a_track_beside_the_objects_is_left_out(folder, clip):
    add_tracks(clip, surface_points(8))
    stray = clip.tracking.tracks.new(name="floor", frame=1)
    for frame in range(1, FRAMES + 1):
        place(stray, frame, (20.0, 200.0))
    capture = capture_from_clips([ClipTrial(clip=clip)], folder)
    assert capture.trials[0].rest_points.shape == (8, 3)
    assert any("1 tracks lie on no object" in w and "floor" in w for w in capture.warnings)


def test_lens_distortion_of_the_polynomial_model_is_taken_out(folder, clip):
    lens = clip.tracking.camera
    lens.focal_length_pixels, lens.k1, lens.k2 = 340.0, -0.12, 0.03
    rest = surface_points(10)

    def bend(pixel):
        x, y = (pixel - [160, 120]) / 340.0
        r = x * x + y * y
        return np.array([160, 120]) + 340.0 * np.array([x, y]) * (1 - 0.12 * r + 0.03 * r * r)

    truth = add_tracks(clip, rest, lens=bend)
    trial = capture_from_clips([ClipTrial(clip=clip)], folder).trials[0]
    np.testing.assert_allclose(trial.pixels, truth, atol=5e-3)


def test_distortion_of_another_model_is_said(folder, clip):
    clip.tracking.camera.distortion_model = "DIVISION"
    clip.tracking.camera.division_k1 = 0.1
    add_tracks(clip, surface_points(8))
    assert any("DIVISION is not taken out" in w for w in capture_from_clips([ClipTrial(clip=clip)], folder).warnings)


def test_frame_rates(folder, clip, tmp_path):
    add_tracks(clip, surface_points(8))
    assert capture_from_clips([ClipTrial(clip=clip, fps=200.0)], folder).trials[0].times[1] == pytest.approx(0.005)
    for i in range(1, FRAMES + 1):
        cv2.imwrite(str(tmp_path / f"still_{i:03d}.png"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    sequence = bpy.data.movieclips.load(str(tmp_path / "still_001.png"))
    add_tracks(sequence, surface_points(8))
    scene = bpy.context.scene or bpy.data.scenes.new("scene")
    scene.render.fps, scene.render.fps_base = 30, 1.0
    if bpy.context.scene is None:
        bpy.context.window.scene = scene
    assert capture_from_clips([ClipTrial(clip=sequence)], folder).trials[0].times[1] == pytest.approx(1 / 30)


def test_a_predict_trial(folder, clip):
    add_tracks(clip, surface_points(8))
    takes = [ClipTrial(clip=clip, name="whole"), ClipTrial(clip=clip, name="part", predict_from=0.1)]
    capture = capture_from_clips(takes, folder)
    assert [t.role for t in capture.trials] == ["fit", "predict"]
    assert capture.trials[1].times[-1] < 0.1 <= capture.trials[1].predict_times[0]


def test_clips_without_use(folder, clip, tmp_path):
    with pytest.raises(InputError, match="track points in the Movie Clip editor first"):
        capture_from_clips([ClipTrial(clip=clip)], folder)
    stray = clip.tracking.tracks.new(name="floor", frame=1)
    for frame in range(1, FRAMES + 1):
        place(stray, frame, (20.0, 200.0))
    with pytest.raises(InputError, match="none of its 1 tracks lies on an object"):
        capture_from_clips([ClipTrial(clip=clip)], folder)
    path = tmp_path / "wide.png"
    cv2.imwrite(str(path), np.zeros((90, 200, 3), np.uint8))
    wide = bpy.data.movieclips.load(str(path))
    with pytest.raises(InputError, match="200x90"):
        capture_from_clips([ClipTrial(clip=wide)], folder)
    with pytest.raises(InputError, match="no clip"):
        capture_from_clips([], folder)
