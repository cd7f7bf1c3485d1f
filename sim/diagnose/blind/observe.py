# SPDX-License-Identifier: MIT
"""What a tracker would have delivered of a motion: noise, lost points, one camera's view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..capture import Camera
from .rigid_world import Array


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What is wrong with a camera: radial distortion k1 of x (1 + k1 r²), 0 for a pinhole."""

    k1: float = 0.0


def lost(frames: int, points: int, share: float, rng: np.random.Generator) -> Array:
    """(T, K) bool: points lost in runs of 2 to 12 frames, together about ``share`` of all."""
    out = np.zeros((frames, points), dtype=bool)
    mean = 5.0
    for point in range(points):
        wanted = share * float(rng.exponential())
        frame = 0
        while True:
            frame += 1 + int(rng.exponential(mean * (1 - min(wanted, 0.8)) / max(min(wanted, 0.8), 1e-3)))
            if frame >= frames:
                break
            run = int(np.clip(rng.exponential(mean), 2, 12))
            out[frame : frame + run, point] = True
            frame += run
    # The state at the beginning must be estimable whatever the luck: never all points of a frame.
    crowded = out.mean(axis=1) > 0.6
    out[crowded] = False
    return out


def project(points: Array, camera: Camera, lens: Lens) -> Array:
    """(…, 2) pixels of world ``points`` (…, 3)."""
    world_from_camera = camera.matrix
    local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    flat = local[..., :2] / local[..., 2:]
    flat = flat * (1 + lens.k1 * np.sum(flat**2, axis=-1, keepdims=True))
    return np.asarray(flat * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def draw_camera(target: Array, distance: float, rng: np.random.Generator) -> Camera:
    """A camera that looks at ``target`` from ``distance`` m, somewhat above."""
    azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.45)
    back = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    eye = target + distance * back
    forward = -back
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return _camera(np.column_stack([right, np.cross(forward, right), forward]), eye, float(rng.uniform(840, 980)))


def moved_camera(camera: Camera, rotation: Array, shift: Array) -> Camera:
    """``camera`` turned by the matrix ``rotation`` about the world's origin and moved by ``shift`` m."""
    matrix = camera.matrix
    return _camera(rotation @ matrix[:3, :3], rotation @ matrix[:3, 3] + shift, camera.fx)


def _camera(turn: Array, eye: Array, focal: float) -> Camera:
    rows = [(*map(float, turn[i]), float(eye[i])) for i in range(3)] + [(0.0, 0.0, 0.0, 1.0)]
    return Camera(
        width=1280,
        height=720,
        fx=focal,
        fy=focal,
        cx=640.0,
        cy=360.0,
        world_from_camera=tuple((r[0], r[1], r[2], r[3]) for r in rows),
    )
