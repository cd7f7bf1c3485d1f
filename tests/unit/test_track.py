# SPDX-License-Identifier: MIT
"""Videos become captures: accuracy, occlusion, blur, times and files, against videos whose truth is known."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.capture_folder import load_capture
from physgen.sim.diagnose.track.track_command import add_arguments, parse_trials, run_command, track
from physgen.sim.diagnose.track.track_input import TrackOptions, VideoTrial, belief_warnings
from physgen.sim.diagnose.track.track_videos import track_video, track_videos, withhold
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import SceneObject
from scipy.spatial.transform import Rotation

from .track_scenes import (
    CAMERA,
    FPS,
    REST_PLACE,
    REST_TURN,
    SIDE,
    Stage,
    errors,
    film,
    make_scene,
    resting,
    squashed,
    toss,
    truth,
    write_video,
)


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    stage = Stage()
    return stage, make_scene(tmp_path_factory.mktemp("cube") / "scene", stage)


@pytest.fixture(scope="module")
def tossed(cube, tmp_path_factory):
    """The tossed cube, filmed and tracked once."""
    stage, folder = cube
    path = write_video(tmp_path_factory.mktemp("video") / "toss.avi", film(stage, toss, 30))
    return path, track_video(VideoTrial(path=path), folder)


def test_points_are_followed_to_a_tenth_of_a_pixel(tossed):
    # Lucas-Kanade on patches of 19 x 19 pixels with gradients of 20 levels per pixel and noise of 2 levels scatters by
    # 2 / (20 · 19) < 0.01 px; MJPEG, interpolation and lifting from fitted poses add to it. Ten times that is allowed.
    found = errors(tossed[1].trial, toss)
    assert len(found) > 20 * 25
    assert np.median(found) < 0.2
    assert np.percentile(found, 95) < 0.8
    assert found.max() < 3.0


def test_the_noise_is_that_of_moving_frames(tossed):
    """It was 0.4 times that: a median over frames at rest and points that are found well."""
    trial = tossed[1].trial
    away = (trial.pixels - truth(trial, toss))[5:]
    error = float(np.sqrt(np.nanmean(away**2)))
    # The error that all points of a frame share moves the fitted pose and is not seen.
    common = float(np.sqrt(np.nanmean(np.nanmean(away, axis=1) ** 2)))
    assert 0.8 * np.sqrt(error**2 - common**2) < tossed[1].noise_sigma < 1.1 * error
    assert common < 0.6 * error


def test_tracking_writes_a_capture_of_the_scene(cube, tossed, tmp_path):
    stage, folder = cube
    path, tracked = tossed
    capture = track(folder, [VideoTrial(path=path)], out=tmp_path / "capture")
    loaded = load_capture(tmp_path / "capture")
    assert loaded.warnings == ()
    assert [t.name for t in loaded.trials] == ["toss"]
    trial = loaded.trials[0]
    np.testing.assert_array_equal(trial.pixels, tracked.trial.pixels)
    np.testing.assert_allclose(np.diff(trial.times), 1 / FPS, atol=1e-6)
    item = loaded.objects[0]
    assert np.allclose(np.ptp(item.vertices @ REST_TURN.as_matrix(), axis=0), SIDE, atol=1e-5)
    assert item.belief.rigid and item.belief.density_kg_m3 == load_preset("wood").density
    on_surface = np.abs(REST_TURN.inv().apply(trial.rest_points)).max(axis=1)
    np.testing.assert_allclose(on_surface, SIDE / 2, atol=1e-6)
    # The camera of the capture shows the first frame's points where they were seen.
    first = trial.seen[0]
    shown = stage.camera.project(trial.rest_points[first] + REST_PLACE)[:, :2]
    np.testing.assert_allclose(shown, trial.pixels[0, first], atol=0.01)
    assert 0.03 < capture.noise_sigma < 0.5


def test_faces_that_turn_into_view_get_points_on_the_right_places(tossed):
    trial = tossed[1].trial
    born = np.array([np.flatnonzero(trial.seen[:, k])[0] for k in range(len(trial.rest_points))])
    assert (born > 5).sum() >= 8
    off = np.linalg.norm(trial.pixels - truth(trial, toss), axis=2)[:, born > 5]
    assert np.nanmedian(off) < 0.5


def test_the_pose_is_found(tossed):
    trial, poses = tossed[1].trial, tossed[1].poses
    for i in (0, 10, 20, 25):
        turn, place = toss(trial.times[i])
        assert np.linalg.norm(poses[i, 0, :3, 3] - place) < 0.003
        wrong = Rotation.from_matrix(poses[i, 0, :3, :3]).inv() * (turn * REST_TURN.inv())
        assert np.degrees(wrong.magnitude()) < 1.0


def test_hidden_points_are_nan(cube, tmp_path):
    """A textured bar sweeps over the resting cube; while it covers a point, the point is not seen, and later it is."""
    stage, folder = cube

    def bar(t):
        return 130 + 500 * t, 170 + 500 * t

    path = write_video(tmp_path / "bar.avi", film(stage, resting, 24, bar=bar))
    trial = track_video(VideoTrial(path=path), folder).trial
    true = truth(trial, resting)
    off = np.linalg.norm(trial.pixels - true, axis=2)
    assert np.nanmax(off) < 1.0
    low, high = (np.array([bar(t)[side] for t in trial.times])[:, None] for side in (0, 1))
    # A point a few pixels behind the bar's edge is still told by the greater part of its patch, and exactly.
    covered = (true[..., 0] > low + 4) & (true[..., 0] < high - 4)
    assert covered.sum() > 100
    assert not (trial.seen & covered).any()
    # Those the bar has passed are back: the same points, not new ones.
    passed = (true[..., 0] < low - 12) & (np.cumsum(covered, axis=0) > 0)
    assert passed.sum() > 100
    assert trial.seen[passed].mean() > 0.9


def test_an_occluder_never_carries_points_away(cube, tmp_path):
    stage, folder = cube
    path = write_video(tmp_path / "bar.mp4", film(stage, toss, 30, bar=lambda t: (900 * t - 80, 900 * t)), code="mp4v")
    found = errors(track_video(VideoTrial(path=path), folder).trial, toss)
    assert len(found) > 300
    assert np.median(found) < 0.5
    assert np.percentile(found, 99) < 3.0


@pytest.mark.parametrize(
    ("exposure", "median", "most"), [(0.25, 0.15, 0.8), pytest.param(0.75, 0.5, 3.0, marks=pytest.mark.slow)]
)
def test_motion_blur(cube, tmp_path, exposure, median, most):
    """Exposed for a share of the frame's time, over which the cube moves by up to 6 and 17 pixels."""
    stage, folder = cube
    path = write_video(tmp_path / "blur.avi", film(stage, toss, 26, exposure=exposure))
    tracked = track_video(VideoTrial(path=path), folder)
    found = errors(tracked.trial, toss)
    assert tracked.trial.seen.any(axis=1).all()
    assert np.median(found) < median
    assert np.percentile(found, 95) < most


def test_a_bounce(cube, tmp_path):
    """The velocity turns round between two frames, by 40 pixels a frame."""
    stage, folder = cube

    def bounce(t):
        t = max(0.0, t - 4.5 / FPS) % 0.25
        spin = Rotation.from_rotvec([0, 0, 1.0 * t])
        return spin * REST_TURN, REST_PLACE + np.array([0, 0, 4.905 * t * (0.25 - t)])

    path = write_video(tmp_path / "bounce.avi", film(stage, bounce, 25))
    tracked = track_video(VideoTrial(path=path), folder)
    assert tracked.trial.seen.any(axis=1).all()
    assert np.median(errors(tracked.trial, bounce)) < 0.15
    assert np.percentile(errors(tracked.trial, bounce), 99) < 1.0


def test_a_ball_that_deforms(tmp_path):
    stage = Stage(kind="ball")
    folder = make_scene(tmp_path / "scene", stage, preset="soft")
    path = write_video(tmp_path / "squash.avi", film(stage, squashed, 28))
    trial = track_video(VideoTrial(path=path), folder).trial
    assert ["deforms" in line and "rigid material" in line for line in belief_warnings(folder.model, [0])] == [True]
    found = errors(trial, squashed)
    assert trial.seen.any(axis=1).all()
    assert len(found) > 28 * 10
    assert np.median(found) < 0.5
    assert np.percentile(found, 95) < 2.0


def test_a_ball_that_spins(tmp_path):
    """Its patches are curved: a flat warp would be off by a pixel by the end."""
    stage = Stage(kind="ball")
    folder = make_scene(tmp_path / "scene", stage)
    path = write_video(tmp_path / "spin.avi", film(stage, toss, 28))
    trial = track_video(VideoTrial(path=path), folder).trial
    assert np.median(errors(trial, toss)) < 0.25
    late = np.linalg.norm(trial.pixels - truth(trial, toss), axis=2)[20:]
    assert np.nanmedian(late) < 0.4


def test_another_resolution(cube, tmp_path):
    _, folder = cube
    camera = dataclasses.replace(CAMERA, width=720, height=540, fx=780.0, fy=780.0, cx=360.0, cy=270.0)
    path = write_video(tmp_path / "large.avi", film(Stage(camera=camera), toss, 14))
    tracked = track_video(VideoTrial(path=path), folder)
    assert (tracked.camera.width, tracked.camera.fx, tracked.camera.cy) == (720, 780.0, 270.0)
    off = np.linalg.norm(tracked.trial.pixels - truth(tracked.trial, toss, camera), axis=2)
    assert np.nanmedian(off) < 0.3


def test_an_object_that_is_elsewhere_is_recognised(cube, tmp_path):
    stage, folder = cube

    def thrown(t):
        place = REST_PLACE + np.array([-0.1 + 0.8 * t, 0.05, 0.05 + 0.5 * t - 4.905 * t**2])
        return Rotation.from_rotvec(np.array([0.5, 0.3, 1.0]) * (t + 0.2)) * REST_TURN, place

    path = write_video(tmp_path / "thrown.avi", film(stage, thrown, 12))
    tracked = track_video(VideoTrial(path=path), folder)
    assert any("at their scene poses" in w for w in tracked.warnings)
    assert np.median(errors(tracked.trial, thrown)) < 1.0


def test_an_object_that_is_not_there(cube, tmp_path):
    stage, folder = cube
    path = write_video(tmp_path / "gone.avi", film(stage, lambda t: (REST_TURN, np.array([5.0, 0, 0.05])), 5))
    with pytest.raises(InputError, match=r"body.*is not at its scene pose and not recognised elsewhere.*--start-frame"):
        track_video(VideoTrial(path=path), folder)


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_an_object_without_texture(tmp_path, noise):
    plain = Stage(textures=tuple(np.full((64, 64), 140, np.float32) for _ in range(6)))
    folder = make_scene(tmp_path / "scene", plain)
    photo = next(iter(film(plain, resting, 1, noise=noise)))
    cv2.imwrite(str(tmp_path / "scene/photo.png"), photo)
    path = write_video(tmp_path / "plain.avi", film(plain, toss, 8, noise=noise))
    with pytest.raises(InputError, match=r"'body'.*too little texture; add a pattern"):
        track_video(VideoTrial(path=path), folder)


def test_several_takes_and_one_to_predict(cube, tossed, tmp_path):
    _, folder = cube
    path, tracked = tossed
    second = tmp_path / "later.avi"
    second.write_bytes(path.read_bytes())
    trials = parse_trials([path, second], predict_from=["later=0.25"], end_frames=[24])
    capture = track(folder, trials, out=tmp_path / "capture", withheld=tmp_path / "withheld")
    loaded = load_capture(tmp_path / "capture")
    assert [(t.name, t.role) for t in loaded.trials] == [("toss", "fit"), ("later", "predict")]
    shown = loaded.predict_trials[0]
    assert shown.times[-1] < 0.25 <= shown.predict_times[0]
    assert len(shown.times) + len(shown.predict_times) == len(loaded.fit_trials[0].times) == 25
    assert shown.seen.any(axis=0).all()
    with np.load(tmp_path / "withheld/later.npz") as rest:
        np.testing.assert_allclose(rest["times"], shown.predict_times)
        np.testing.assert_array_equal(rest["rest_points"], shown.rest_points)
    assert not list((tmp_path / "capture").glob("**/*withheld*"))
    assert capture.noise_sigma == tracked.noise_sigma or capture.noise_sigma > 0


def test_the_command(cube, tossed, tmp_path):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    line = f"{tossed[0]} --scene {cube[1].root} --out {tmp_path / 'c'} --end-frame 8 --density 20 --objects body"
    events = []
    done = run_command(parser.parse_args(line.split()), events.append, lambda: False)
    assert done["event"] == "done" and done["capture"] == str(tmp_path / "c")
    assert "9 frames in 0.133 s" in done["summary"]
    trial = load_capture(tmp_path / "c").trials[0]
    assert trial.seen[0].sum() <= 20
    with pytest.raises(InputError, match="already exists"):
        run_command(parser.parse_args(line.split()), events.append, lambda: False)


def test_two_objects_one_behind_the_other(tmp_path):
    """A still collider in front hides the moving cube; what it hides is not seen though nobody tracks the collider."""
    stage = Stage()
    folder = make_scene(tmp_path / "scene", stage)
    wall = trimesh.creation.box((0.06, 0.01, 0.3))
    wall.apply_translation((0.12, -0.12, 0.1))
    wall.export(folder.root / "meshes/wall.ply")
    items = (*folder.model.objects, SceneObject(name="wall", mesh="meshes/wall.ply", size_m=0.3, role="collider"))
    folder = save_scene(folder.root, dataclasses.replace(folder.model, objects=items))

    def pushed(t):
        return REST_TURN, REST_PLACE + np.array([0.8 * max(0.0, t - 0.05), 0, 0])

    corners = CAMERA.project(np.asarray(wall.vertices))[:, :2]
    shape = cv2.convexHull(np.round(corners - 0.5).astype(np.int32))

    def frames():
        for frame in film(stage, pushed, 28):
            cv2.fillConvexPoly(frame, shape, 120)
            yield frame

    tracked = track_video(VideoTrial(path=write_video(tmp_path / "pushed.avi", frames())), folder)
    true = truth(tracked.trial, pushed)
    assert np.nanmax(np.linalg.norm(tracked.trial.pixels - true, axis=2)) < 1.5
    inside = np.array([[cv2.pointPolygonTest(shape, tuple(p), True) for p in row] for row in true - 0.5])
    assert (inside > 4).sum() > 50
    assert not tracked.trial.seen[inside > 4].any()


def test_trials_without_a_complete_frame_are_refused(cube, tossed):
    with pytest.raises(InputError, match="leave at least one complete"):
        track_videos([VideoTrial(path=tossed[0], predict_from=0.2)], cube[1])


@given(st.floats(0.01, 1.0))
@settings(max_examples=25, deadline=None)
def test_withholding_shows_nothing_of_later(tossed, seconds):
    trial = tossed[1].trial
    try:
        shown, rest = withhold(trial, seconds)
    except InputError:
        assert seconds < 4 / FPS or seconds > trial.times[-1]
        return
    assert shown.times[-1] < seconds <= rest.times[0]
    np.testing.assert_array_equal(shown.predict_times, rest.times)
    np.testing.assert_array_equal(np.concatenate([shown.times, rest.times]), trial.times)
    assert shown.seen.any(axis=0).all()


def stretch_times(path: Path, first: int, delta: int) -> None:
    """Let the frames of an MP4 file after the ``first`` ones last ``delta`` times as long (ISO 14496-12, box stts)."""
    data = bytearray(path.read_bytes())
    at = data.find(b"stts") - 4
    count, step = (int.from_bytes(data[at + i : at + i + 4], "big") for i in (16, 20))
    numbers = [2, first, step, count - first, step * delta]
    box = b"stts" + bytes(4) + b"".join(n.to_bytes(4, "big") for n in numbers)
    old = int.from_bytes(data[at : at + 4], "big")
    assert int.from_bytes(data[at + 12 : at + 16], "big") == 1 and data.find(b"moov") > data.find(b"mdat")
    for parent in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        place = data.find(parent) - 4
        size = int.from_bytes(data[place : place + 4], "big")
        data[place : place + 4] = (size + len(box) + 4 - old).to_bytes(4, "big")
    data[at : at + old] = (len(box) + 4).to_bytes(4, "big") + box
    # OpenCV's writer also notes how long the whole lasts, and players stop there.
    path.write_bytes(bytes(data).replace(b"edts", b"free"))


def test_times_are_the_containers(cube, tmp_path):
    stage, folder = cube
    path = write_video(tmp_path / "vfr.mp4", film(stage, resting, 12), fps=50.0, code="mp4v")
    stretch_times(path, 5, 3)
    times = track_video(VideoTrial(path=path), folder).trial.times
    np.testing.assert_allclose(np.diff(times), [0.02] * 5 + [0.06] * 6, atol=1e-4)
    times = track_video(VideoTrial(path=path, start_frame=6, end_frame=10), folder).trial.times
    np.testing.assert_allclose(times, np.arange(5) * 0.06, atol=1e-4)


def test_slow_motion_files_are_told_their_rate(cube, tmp_path):
    stage, folder = cube
    path = write_video(tmp_path / "slow.avi", film(stage, resting, 6), fps=30.0)
    times = track_video(VideoTrial(path=path, fps_override=240.0), folder).trial.times
    np.testing.assert_allclose(times, np.arange(6) / 240.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no such video"), (b"", "is empty"), (b"not a video at all" * 100, "not a readable video")],
)
def test_files_that_are_no_videos(cube, tmp_path, content, message):
    path = tmp_path / "broken.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        track_video(VideoTrial(path=path), cube[1])


def test_a_damaged_video(cube, tossed, tmp_path):
    whole = tossed[0].read_bytes()
    path = tmp_path / "half.avi"
    path.write_bytes(whole[: len(whole) // 2])
    tracked = track_video(VideoTrial(path=path), cube[1])
    assert 5 < len(tracked.trial.times) < 30
    path.write_bytes(whole[: whole.find(b"00dc", whole.find(b"00dc", whole.find(b"00dc") + 4) + 4)])
    with pytest.raises(InputError, match="a motion needs 3"):
        track_video(VideoTrial(path=path), cube[1])


def test_ranges_beyond_the_video(cube, tossed):
    with pytest.raises(InputError, match="no frame could be read from frame 500 on"):
        track_video(VideoTrial(path=tossed[0], start_frame=500), cube[1])
    with pytest.raises(InputError, match="end_frame is 3"):
        VideoTrial(path=tossed[0], start_frame=3, end_frame=3)


def test_another_shape_of_picture(cube, tmp_path):
    path = write_video(tmp_path / "wide.avi", (np.full((180, 320), 90, np.uint8) for _ in range(4)))
    with pytest.raises(InputError, match=r"320x180.*480x360.*reconstruct the scene from a frame"):
        track_video(VideoTrial(path=path), cube[1])


def test_a_camera_that_moves_is_noticed(cube, tmp_path):
    stage, folder = cube

    def shaken():
        for i, frame in enumerate(film(stage, resting, 12)):
            yield np.roll(frame, i // 2, axis=1)

    tracked = track_video(VideoTrial(path=write_video(tmp_path / "shaken.avi", shaken())), folder)
    assert any("camera was not fixed" in w for w in tracked.warnings)


def test_cancelling_leaves_nothing(cube, tossed, tmp_path):
    with pytest.raises(Cancelled):
        track(cube[1], [VideoTrial(path=tossed[0])], out=tmp_path / "capture", cancelled=lambda: True)
    assert not (tmp_path / "capture").exists()


def test_progress_and_warnings_are_events(cube, tossed, tmp_path):
    events = []
    track(cube[1], [VideoTrial(path=tossed[0], end_frame=9)], out=tmp_path / "capture", on_event=events.append)
    progress = [e for e in events if e["event"] == "progress"]
    assert [e["done"] for e in progress] == list(range(1, 11))
    assert {e["total"] for e in progress} == {10}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"density": 3}, "density is 3"),
        ({"min_score": float("nan")}, "min_score is nan"),
        ({"min_contrast": 0.0}, "min_contrast"),
    ],
)
def test_options_out_of_range(changes, message):
    with pytest.raises(InputError, match=message):
        TrackOptions(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_frames": [1, 2, 3]}, "--start-frame: 3 given for 2 videos"),
        ({"predict_from": ["third=0.2"]}, "name one of the videos: a, b"),
        ({"predict_from": ["soon"]}, "give SECONDS"),
        ({"fps_overrides": [-3.0]}, "fps_override is -3.0"),
    ],
)
def test_wrong_arguments(changes, message):
    with pytest.raises(InputError, match=message):
        parse_trials([Path("a.mp4"), Path("b.mp4")], **changes)


def test_wrong_objects(cube, tossed):
    with pytest.raises(InputError, match="no object 'cup'; choose from body"):
        track_video(VideoTrial(path=tossed[0]), cube[1], objects=["cup"])
