# SPDX-License-Identifier: MIT
"""A body seen from around, with its texture: as many points as pixels need, the nearest one wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..given.sampled import spread

Pixels = NDArray[np.uint8]

SAMPLES = 260_000
LIGHT = np.array([-0.4, -0.55, 0.73])
"""Towards the light, beside and above whoever looks."""
PAPER = (233, 232, 228)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a surface: places (n, 3), normals (n, 3), colours (n, 3) 0 to 255."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    colours: NDArray[np.float64]


def surface_points(mesh: trimesh.Trimesh, count: int = SAMPLES) -> SurfacePoints:
    """``count`` points spread evenly over ``mesh``, in its own coordinates; without a texture they are grey."""
    points = spread(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    faces = np.asarray(mesh.faces)[points.faces]
    normals = np.einsum("nc,nci->ni", points.weights, np.asarray(mesh.vertex_normals)[faces])
    return SurfacePoints(points.places, normals, _colours(mesh, faces, points.weights))


def _colours(mesh: trimesh.Trimesh, faces: NDArray[np.int64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    uv = getattr(mesh.visual, "uv", None)
    image = getattr(getattr(mesh.visual, "material", None), "baseColorTexture", None)
    if uv is None or image is None:
        return np.full((len(faces), 3), 190.0)
    texture = np.asarray(image.convert("RGB"), dtype=np.float64)
    at = np.einsum("nc,nci->ni", corners, np.asarray(uv)[faces])
    columns = np.clip(at[:, 0] * texture.shape[1], 0, texture.shape[1] - 1).astype(int)
    rows = np.clip((1 - at[:, 1]) * texture.shape[0], 0, texture.shape[0] - 1).astype(int)
    return np.asarray(texture[rows, columns])


def view_from(points: SurfacePoints, turn: float, rise: float, side: int, radius: float) -> Pixels:
    """The points from far away, ``side`` pixels square; ``radius`` around their middle is seen.

    turn: radians to the right around the vertical from where y looks away; rise: above the horizontal.
    """
    middle = (points.places.min(axis=0) + points.places.max(axis=0)) / 2
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    ahead = np.array([-np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), -np.sin(rise)])
    up = np.cross(right, ahead)
    local = points.places - middle
    x = ((local @ right) / radius * 0.5 + 0.5) * side
    y = (0.5 - (local @ up) / radius * 0.5) * side
    light = LIGHT[0] * right + LIGHT[1] * ahead + LIGHT[2] * up
    lit = 0.5 + 0.5 * np.clip(points.normals @ (light / np.linalg.norm(light)), 0.0, None)
    colours = np.clip(points.colours * lit[:, None], 0, 255).astype(np.uint8)
    columns, rows = np.floor(x).astype(int), np.floor(y).astype(int)
    # Far ones first: where several points fall on one pixel, the last one written is the nearest.
    order = np.argsort(-(local @ ahead), kind="stable")
    inside = (columns >= 0) & (columns < side) & (rows >= 0) & (rows < side)
    order = order[inside[order]]
    picture = np.full((side, side, 3), PAPER, dtype=np.uint8)
    picture[rows[order], columns[order]] = colours[order]
    return picture


def turntable(mesh: trimesh.Trimesh, side: int = 220) -> Pixels:
    """From where the photo looks, from the right, from behind, and from above, side by side (side, 4 side, 3)."""
    points = surface_points(mesh)
    extent = np.ptp(points.places, axis=0)
    radius = 0.55 * float(np.linalg.norm(extent))
    views = ((0.0, 0.35), (np.pi / 2, 0.2), (np.pi, 0.35), (0.0, np.pi / 2 - 0.01))
    return np.concatenate([view_from(points, turn, rise, side, radius) for turn, rise in views], axis=1)
