# SPDX-License-Identifier: MIT
"""A box that slides and turns before a still camera: the camera, its place and its turn from its outlines."""

import cv2
import numpy as np
import physgen
import pytest
from physgen.sim.composite.side_by_side import box_faces, box_pose, window_around, with_box
from physgen.sim.diagnose.track.box_pose import GroundCamera, corners, follow_box, repeats_after, unwrapped
from physgen.sim.diagnose.track.plain_bodies import follow_plain_body
from physgen.sim.diagnose.track.track_input import parse_body

CAMERA = GroundCamera(focal=620.0, middle=(320.0, 180.0), pitch=np.radians(42), roll=np.radians(1.5), height=0.24)
FPS, BRAKING = 120.0, 1.8


def slide(count=40, edge=0.06):
    """Return times, centres (T, 3) and turns (T,) of a box that slides to the left and turns."""
    t = np.arange(count) / FPS
    way = 0.85 * t - 0.5 * BRAKING * t**2
    centres = np.stack([0.1 - way, 0.27 - 0.08 * way, np.full(count, edge / 2)], axis=1)
    return t, centres, 0.3 + 9.0 * t - 8.0 * t**2


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def outlines(centres, turns, edges, rng):
    out = []
    for centre, angle in zip(centres, turns, strict=True):
        seen = CAMERA.pixels(centre + corners(edges) @ turned(angle).T)
        hull = cv2.convexHull(seen.astype(np.float32))[:, 0].astype(np.float64)
        middle = hull.mean(axis=0)
        grown = hull + 1.2 * (hull - middle) / np.linalg.norm(hull - middle, axis=1)[:, None]
        out.append(grown + rng.normal(0, 0.3, hull.shape))
    return out


@pytest.mark.parametrize("edges", [(0.06, 0.06, 0.06), (0.08, 0.05, 0.04)])
def test_outlines_of_a_box_tell_camera_path_and_turn(edges):
    edges = np.array(edges)
    _, centres, turns = slide(edge=edges[2])
    found = follow_box(outlines(centres, turns, edges, np.random.default_rng(0)), edges, (640, 360))
    assert found is not None
    assert np.degrees(found.camera.pitch - CAMERA.pitch) == pytest.approx(0, abs=2.5)
    assert found.camera.height == pytest.approx(CAMERA.height, rel=0.06)
    # The world's origin lies below the camera, whose place the picture shows only roughly: the path itself counts.
    way = found.centres[:, :2] - found.centres[0, :2]
    true = centres[:, :2] - centres[0, :2]
    assert np.linalg.norm(way - true, axis=1).max() < 0.03 * np.linalg.norm(true[-1])
    apart = found.turns - turns
    cycle = repeats_after(edges)
    assert np.degrees(np.ptp(apart)) < 2.5
    assert np.degrees(abs((apart.mean() + cycle / 2) % cycle - cycle / 2)) < 2.0


@pytest.mark.parametrize("edges", [(0.06, 0.06, 0.06), (0.08, 0.05, 0.04)])
def test_frames_in_which_something_joins_the_outline_are_named(edges):
    edges = np.array(edges)
    _, centres, turns = slide(edge=edges[2])
    seen = outlines(centres, turns, edges, np.random.default_rng(2))
    plain = follow_box(seen, edges, (640, 360))
    for k in (20, 21, 22):
        # A dark patch along a whole side, as of a contact shadow that counts as body for three frames.
        low = seen[k][seen[k][:, 1] > np.median(seen[k][:, 1])]
        hull = np.concatenate([seen[k], low + np.array([9.0, 9.0])]).astype(np.float32)
        seen[k] = cv2.convexHull(hull)[:, 0].astype(np.float64)
    found = follow_box(seen, edges, (640, 360))
    assert plain is not None and plain.sound.mean() > 0.9
    assert found is not None and not found.sound[20:23].any()
    assert found.sound.sum() >= plain.sound.sum() - 5


def test_a_shadow_beside_the_box_does_not_move_it():
    edges = np.full(3, 0.06)
    _, centres, turns = slide()
    rng = np.random.default_rng(1)
    spoiled = outlines(centres, turns, edges, rng)
    spoiled = [np.vstack([o, o[np.argmax(o[:, 1])] + rng.uniform((5, 0), (16, 8))]) for o in spoiled]
    found = follow_box(spoiled, edges, (640, 360))
    assert found is not None
    true = centres[:, :2] - centres[0, :2]
    off = np.linalg.norm(found.centres[:, :2] - found.centres[0, :2] - true, axis=1)
    assert off.max() < 0.05 * np.linalg.norm(true[-1])
    assert np.degrees(np.std(found.turns - turns)) < 2.0


def test_what_is_no_box_is_not_taken_for_one():
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    discs = [np.array([100 + 8 * k, 180.0]) + 40 * ring for k in range(20)]
    assert follow_box(discs, np.array([0.06, 0.06, 0.06]), (640, 360)) is None


def test_turns_are_continuous_past_the_angle_at_which_the_outline_repeats():
    turns = 0.1 * np.arange(60) + 0.002 * np.arange(60) ** 2
    assert np.allclose(unwrapped(turns % (np.pi / 2), np.pi / 2), turns)


def test_points_on_the_ground_are_those_that_the_camera_sees():
    points = np.array([[0.1, 0.3, 0.02], [-0.05, 0.5, 0.02]])
    assert np.allclose(CAMERA.ground(CAMERA.pixels(points), 0.02), points)


def drawn_slide(path):
    """Write a video of a cube with coloured faces that slides and turns; return its centres and turns."""
    rng = np.random.default_rng(5)
    colours = np.array([(40, 90, 200), (190, 70, 40), (60, 160, 60), (40, 40, 190), (20, 20, 20), (60, 210, 220)])
    faces = np.repeat(np.repeat(colours[:, None, None], 96, axis=1), 96, axis=2).astype(np.uint8)
    table = cv2.GaussianBlur(rng.normal(150, 12, (360, 640, 3)), (0, 0), 1.5)
    edges = np.full(3, 0.06)
    _, centres, turns = slide()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (640, 360))
    for centre, angle in zip(centres, turns, strict=True):
        pose = box_pose(centre, turned(angle), edges, CAMERA.pixels, CAMERA.place)
        frame = with_box(table.clip(0, 255).astype(np.uint8), faces, pose)
        writer.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    writer.release()
    return centres, turns


def test_a_drawn_cube_is_followed_with_its_turn_and_shown_with_its_faces(tmp_path):
    video = tmp_path / "cube.avi"
    centres, turns = drawn_slide(video)
    found = follow_plain_body(physgen.VideoTrial(path=video, fps_override=FPS), parse_body("box:x=0.06,y=0.06,z=0.06"))
    assert found.view.kind == "surface" and found.box is not None and found.view.camera is not None
    assert np.degrees(found.view.camera.pitch - CAMERA.pitch) == pytest.approx(0, abs=4)
    trial = found.capture.trials[0]
    assert trial.observed.shape[1] == 5, "a cube is no ball: its turn counts"
    way = np.linalg.norm(trial.observed[:, 0] - trial.observed[0, 0], axis=1)
    true = np.linalg.norm(centres[found.frames] - centres[found.frames[0]], axis=1)
    assert np.abs(way - true).max() < 0.04 * true.max()
    arm = trial.observed[:, 1] - trial.observed[:, 0]
    angle = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0]))
    assert np.degrees(np.abs((angle - angle[0]) - (turns[found.frames] - turns[found.frames[0]])).max()) < 4
    # The centre is drawn where it is, and the side towards the camera has its own colour.
    pixels = found.view.pixels(trial.observed[:, 0])
    assert np.linalg.norm(pixels - CAMERA.pixels(centres[found.frames]), axis=1).max() < 4
    assert any("turns by" in note for note in found.view.notes)


def test_faces_come_from_the_frames_and_are_drawn_where_they_belong():
    colours = np.array([(40, 90, 200), (190, 70, 40), (60, 160, 60), (40, 40, 190), (20, 20, 20), (60, 210, 220)])
    faces = np.repeat(np.repeat(colours[:, None, None], 96, axis=1), 96, axis=2).astype(np.uint8)
    grey, edges = np.full((360, 640, 3), 128, np.uint8), np.full(3, 0.06)
    _, centres, turns = slide()
    poses = [box_pose(c, turned(a), edges, CAMERA.pixels, CAMERA.place) for c, a in zip(centres, turns, strict=True)]
    read = box_faces((with_box(grey, faces, pose), pose) for pose in poses)
    seen = [k for k in range(6) if max(p.facing[k] for p in poses) > 0.4]
    assert 5 in seen and 4 not in seen and len(seen) >= 3
    for k in seen:
        assert np.abs(read[k, 20:76, 20:76].astype(int) - colours[k]).max() < 12
    # A face that was never seen is darker than the others, and drawn all the same.
    assert read[4].mean() < np.mean([read[k].mean() for k in seen])


def test_the_shown_part_holds_the_motion_and_stays_in_the_picture():
    left, top, right, bottom = window_around(np.array([[600.0, 20], [500, 60], [np.nan, 0]]), 30, (640, 360))
    assert (right, top) == (640, 0) and right - left >= 320 and bottom - top >= 180
    assert left <= 470 and bottom >= 90
    assert window_around(np.array([[-50.0, 10], [900, 700]]), 10, (640, 360)) == (0, 0, 640, 360)
