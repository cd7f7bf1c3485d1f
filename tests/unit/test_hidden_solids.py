# SPDX-License-Identifier: MIT
"""Boxes and round bodies, projected by a pinhole camera, whose lower part something in front hides."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.amodal_completion import complete_outline
from physgen.sim.reconstruct.segmentation.hidden_solids import box

from .segmentation_scenes import HEIGHT, WIDTH, disc, overlap, polygon


def projected(points, pitch, *, distance=5.0, focal=330.0):
    """Pixels (n, 2) of ``points`` (n, 3), z up, seen from ``distance`` by a camera that looks down by ``pitch``."""
    down = np.radians(pitch)
    x, y, z = np.asarray(points, dtype=np.float64).T
    far = distance + y * np.cos(down) - z * np.sin(down)
    up = y * np.sin(down) + z * np.cos(down)
    return np.stack([WIDTH / 2 + focal * x / far, 105.0 - focal * up / far], axis=1)


def hull(points):
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.round(points).astype(np.int32)), 1)
    return drawn > 0


def carton(pitch, yaw, size):
    a, b, c = size
    corners = np.array([[x, y, z] for x in (-a, a) for y in (-b, b) for z in (-c, c)])
    turn = np.radians(yaw)
    corners[:, :2] = corners[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return hull(projected(corners, pitch))


def mug(pitch):
    around = np.linspace(0.0, 2.0 * np.pi, 60)
    rings = [
        np.stack([r * np.cos(around), r * np.sin(around), np.full(60, z)], 1) for r, z in ((0.62, -0.8), (0.8, 0.8))
    ]
    body = hull(projected(np.concatenate(rings), pitch))
    handle = projected(np.stack([0.72 + 0.42 * np.cos(around), 0.0 * around, 0.5 * np.sin(around)], 1), pitch)
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.polylines(drawn, [np.round(handle).astype(np.int32)], True, 1, 9)
    return body | (drawn > 0)


def foot(mask):
    """Row and mean column of the lowest pixels of ``mask``."""
    row = int(np.flatnonzero(mask.any(axis=1))[-1])
    return row, float(np.flatnonzero(mask[row]).mean())


@pytest.mark.parametrize("pitch", [10.0, 25.0, 40.0])
@pytest.mark.parametrize(("yaw", "size"), [(30.0, (0.9, 0.5, 0.7)), (60.0, (0.5, 0.7, 0.9)), (40.0, (0.8, 0.8, 0.4))])
def test_a_box_behind_a_ball_has_its_corner_where_its_edges_say(pitch, yaw, size):
    full = carton(pitch, yaw, size)
    row, column = foot(full)
    front = disc(column - 12, row + 10, 38)
    completed = complete_outline(full & ~front, front)
    assert overlap(completed & front, full & front) > 0.8


@pytest.mark.parametrize("pitch", [15.0, 30.0])
def test_the_foot_of_a_mug_is_round_whatever_its_handle_does(pitch):
    full = mug(pitch)
    row, column = foot(full)
    front = polygon((column - 2, row - 45), (column - 60, row + 70), (column + 70, row + 70))
    completed = complete_outline(full & ~front, front)
    assert overlap(completed & front, full & front) > 0.8


def test_a_length_that_is_not_seen_makes_a_box_less_likely():
    full = carton(20.0, 35.0, (0.9, 0.5, 0.6))
    row, column = foot(full)
    near = disc(column, row, 30)
    half = np.zeros_like(full)
    half[:, WIDTH // 2 :] = True
    whole, cut = (box(full & ~front, front) for front in (near, half))
    assert whole is not None and whole.misfit < 0.02
    assert cut is None or cut.misfit > whole.misfit + 0.02


def test_what_is_no_box_has_none():
    front = disc(200, 190, 40)
    assert box(disc(160, 120, 70) & ~front, front) is None
    assert box(mug(30.0) & ~front, front) is None
    assert box(disc(160, 120, 3), front) is None
