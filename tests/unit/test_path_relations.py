# SPDX-License-Identifier: MIT
"""A body's shadow, its pieces and its blurred frames, in drawn videos and paths."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from physgen.sim.diagnose.track.moving_regions import Region, find_moving_regions
from physgen.sim.diagnose.track.path_relations import bodies, shown_share
from physgen.sim.diagnose.track.region_track import RegionPath, link_regions

SIZE = (320, 240)


def write(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
    for frame in frames:
        writer.write(np.clip(frame, 0, 255).astype(np.uint8))
    writer.release()
    return find_moving_regions(path)


def test_a_ball_s_shadow_on_the_wall_is_no_second_body(tmp_path):
    """A grey ball flies before a pale wall on which it throws a small, soft shadow."""
    rng, frames = np.random.default_rng(2), []
    for k in range(45):
        t = k / 44
        ball = np.array([30 + 250 * t, 150 - 400 * t + 420 * t**2])
        frame = np.full((SIZE[1], SIZE[0], 3), 190.0)
        dark = np.zeros(frame.shape[:2], np.float32)
        cv2.circle(dark, tuple(int(v) for v in np.round((ball * 1.04 + (12, 30)) * 16)), 5 * 16, 1.0, -1, cv2.LINE_8, 4)
        frame *= 1 - 0.3 * cv2.GaussianBlur(dark, (0, 0), 1.0)[..., None]
        cv2.circle(frame, tuple(int(v) for v in np.round(ball * 16)), 6 * 16, (100, 100, 100), -1, cv2.LINE_8, 4)
        frames.append(frame + rng.normal(0, 1.5, frame.shape))
    found = write(tmp_path / "shadow.avi", frames)
    linked = [p for p in link_regions(found) if p.freedom() > 0]
    left = [p for p in bodies(linked, found.faint) if p.freedom() > 0]
    assert len(linked) == 2 and len(left) == 1
    assert len(left[0].regions) >= 43 and left[0].size == pytest.approx(6 * np.pi**0.5, rel=0.15)


def test_two_balls_that_part_are_two_bodies():
    a = [region(k, (20 + 5 * k, 100), shade=1.0, contrast=60.0) for k in range(30)]
    b = [region(k, (20 + 5 * k, 140 + 0.15 * k**2), shade=1.0, contrast=50.0) for k in range(30)]
    follows = [region(k, (40 + 5 * k, 140 + 0.1 * (k % 2)), shade=1.0, contrast=30.0) for k in range(30)]
    none = [[]] * 30
    assert len(bodies([RegionPath(a), RegionPath(b)], none)) == 2
    assert len(bodies([RegionPath(a), RegionPath(follows)], none)) == 1
    # What is no darker shade, or is as dark as the body, is no shadow of it.
    coloured = [region(k, r.middle, shade=0.1, contrast=30.0) for k, r in enumerate(follows)]
    assert len(bodies([RegionPath(a), RegionPath(coloured)], none)) == 2


def region(frame, middle, area=300.0, **other):
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.sqrt(area / np.pi) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    wide = np.sqrt(area / np.pi) / 2
    return Region(
        frame=frame, middle=np.asarray(middle, float), area=area, axes=np.array([wide, wide]), angle=0.0,
        outline=ring + middle, colour=np.zeros(3), cut=False, solid=1.0, **other,
    )  # fmt: skip


def test_pieces_that_move_along_are_no_bodies():
    body = RegionPath([region(k, (100 + 5 * k, 100), area=6000.0) for k in range(30)])
    piece = RegionPath([region(k, (110 + 5 * k, 60 + 0.2 * (k % 3)), area=60.0) for k in range(4, 28)])
    other = RegionPath([region(k, (90 + 2 * k, 160), area=60.0) for k in range(30)])
    left = bodies([piece, body, other], [[]] * 30)
    assert any(p is body for p in left) and any(p is other for p in left) and all(p is not piece for p in left)


def test_a_body_in_pieces_shows_the_share_of_its_largest_one():
    """A label of 40 x 40 px on a can whose rim above it is all else that is seen of it."""
    label = RegionPath([square(k, 100 + 5 * k, 120, 40) for k in range(30)])
    rim = RegionPath([square(k, 100 + 5 * k, 70, 16) for k in range(30)])
    inside = RegionPath([square(k, 100 + 5 * k, 110, 16) for k in range(30)])
    # The label, and a trapezoid of 38 px up to the top of the rim.
    assert shown_share(label, [label, rim]) == pytest.approx(1600 / (1600 + 38 * 28), rel=0.01)
    assert shown_share(label, [label, inside]) == shown_share(label, [label]) == 1.0


def square(frame, x, y, side):
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * side / 2 + (x, y)
    return replace(region(frame, (x, y), area=float(side**2)), outline=corners)


def test_a_ball_that_blur_makes_faint_is_followed_and_its_shadow_is_not():
    def height(k):
        return 200 - 24 * k + 1.1 * k**2

    body = [region(k, (100, height(k)), contrast=60.0) for k in range(6, 17)]
    faint = [[] for _ in range(24)]
    for k in [*range(3, 6), *range(17, 20)]:
        faint[k] = [region(k, (101, height(k)), area=420.0, shade=1.0)]
    path = bodies([RegionPath(list(body))], faint)[0]
    assert path.frames.tolist() == list(range(3, 20))
    # A shadow that is seen beside the body all the time does not go on in its place.
    beside = [[region(k, (118, height(k)), area=420.0, shade=1.0)] for k in range(24)]
    assert bodies([RegionPath(list(body))], beside)[0].frames.tolist() == list(range(6, 17))


def test_a_fast_ball_keeps_the_rim_that_blur_makes_like_a_shadow(tmp_path):
    """A green ball, dark on one side, is tossed before a pale wall, exposed for 0.9 of a frame: where it is fast,
    most of its streak is a darker wall, and only the core of its dark side is surely something else."""
    rng, frames, radius = np.random.default_rng(5), [], 8.0

    def place(k):
        return np.array([130.0 - 0.8 * k, 35 + 0.9 * (k - 12.3) ** 2])

    def disc(at, size):
        blank = np.zeros((SIZE[1], SIZE[0]), np.float32)
        centre = [int(v) for v in np.round((at - 0.5) * 16)]
        return cv2.circle(blank, centre, round(size * 16), 1.0, -1, cv2.LINE_AA, 4)[..., None]

    wall = np.full((SIZE[1], SIZE[0], 3), 170.0)
    for k in range(25):
        frame = np.zeros_like(wall)
        for part in np.linspace(-0.45, 0.45, 15):
            seen = wall + disc(place(k + part), radius) * (np.array([85.0, 115.0, 98.0]) - wall)
            frame += (
                seen + disc(place(k + part) + np.array([4.0, 1.0]), 4) * (np.array([20.0, 70.0, 40.0]) - seen)
            ) / 15
        frames.append(frame + rng.normal(0, 1.5, frame.shape))
    found = write(tmp_path / "blur.avi", frames)
    path = bodies([p for p in link_regions(found) if p.freedom() > 0], found.faint)[0]
    inside = [r for r in path.regions if not r.cut]
    off = np.array([r.middle - place(r.frame) for r in inside])
    widths = np.array([4 * r.axes[1] for r in inside])
    assert len(inside) >= 20
    assert np.linalg.norm(off, axis=1).max() < 1.0
    assert widths == pytest.approx(2 * radius, rel=0.12)
