# SPDX-License-Identifier: MIT
"""Triangle surfaces of scalar fields: marching cubes at a spacing that gives the wanted number of vertices, relaxed.

Also bodies as φ over the pixels of a crop and the depth along the camera's rays, before marching cubes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from skimage.measure import marching_cubes

from ...errors import InputError
from ...scene.model import Camera
from ..camera.ground_camera import ground_depth
from .inflate import Crop

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

WORTH_SAYING = 0.01
"""Share of the surface above which its removal gives a notice."""


def keep_main_part(points: Points, faces: Faces) -> tuple[Points, Faces, float]:
    """Return the connected part with the largest area, its vertices renumbered in order, and the removed share of the
    area.

    points: (V, 3); faces: (T, 3), not empty. Vertices without a face are removed as well.
    """
    count = len(points)
    ends = faces[:, [0, 1, 2, 1]].reshape(-1, 2)
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    parts, labels = sparse.csgraph.connected_components(links, directed=False)
    lost = 0.0
    if parts > 1:
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        areas = np.bincount(
            labels[faces[:, 0]], weights=np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=parts
        )
        keep = int(np.argmax(areas))
        lost = float(1.0 - areas[keep] / max(float(areas.sum()), 1e-300))
        faces = faces[labels[faces[:, 0]] == keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(faces.shape), lost


RELAXATION_ROUNDS = 6


class Field(Protocol):
    """A field φ(x, y, t) > 0 inside; x, y in crop pixels (centres at integers), t in pixels along the ray."""

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return body (n) and ground (n) at ``points`` (n, 3): φ is the smaller one."""

    def value(self, points: Points) -> Points:
        """Return φ (n,) at ``points`` (n, 3)."""

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid of about ``spacing`` pixels, negative on its border, its first corner (3,) and its steps
        (3,)."""


def surface_of_size(field: Field, area: float, target: int) -> tuple[Points, Faces, float]:
    """Return the surface on a grid with about ``target`` vertices, and the share that was disconnected and removed.

    area: of the mask in pixels². Raises InputError when the mask is too thin for a closed surface.
    """
    # A round body has 2.6 vertices a cell, front and back.
    spacing = max(0.5, float(np.sqrt(2.6 * area / target)))
    for _ in range(3):
        points, faces, lost = _surface(field, spacing)
        ratio = len(points) / target
        finer = max(0.5, spacing * np.sqrt(ratio))
        if 0.8 < ratio < 1.25 or abs(finer / spacing - 1.0) < 0.05:
            break
        spacing = finer
    return points, faces, lost


def _surface(field: Field, spacing: float) -> tuple[Points, Faces, float]:
    grid, first, steps = field.grid(spacing)
    if not (grid > 0).any():
        raise InputError("the outline is too thin for a body; draw the box around a larger object")
    vertices, faces, _, _ = marching_cubes(grid, level=0.0, method="lewiner", allow_degenerate=True)
    points = first + vertices.astype(np.float64) * steps
    return keep_main_part(points, faces.astype(np.int64))


def relax(field: Field, points: Points, faces: Faces, rounds: int = RELAXATION_ROUNDS) -> Points:
    """Return ``points`` relaxed along the surface: moved towards the neighbours' mean, then back onto φ = 0.

    Vertices at the edge between base and body, and their neighbours, stay, or the edge would be rounded.
    """
    count = len(points)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    links = ((links + links.T) > 0).astype(np.float64)
    mean = sparse.diags(1.0 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links
    film, ground = field.sample(points)
    on_base = (ground < film).astype(np.float64)
    share = mean @ on_base
    free = (np.abs(share - on_base) < 1e-9)[:, None]
    for _ in range(rounds):
        gradient = _gradient(field, points)
        normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        move = mean @ points - points
        move -= (move * normal).sum(axis=1, keepdims=True) * normal
        moved = points + 0.5 * np.where(free, move, 0.0)
        for _ in range(2):
            gradient = _gradient(field, moved)
            step = field.value(moved)[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 1e-9)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            moved = moved - np.where(free, step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-12)), 0.0)
        points = moved
    return points


def _gradient(field: Field, points: Points, step: float = 0.5) -> Points:
    result = np.empty_like(points)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        result[:, axis] = (field.value(points + offset) - field.value(points - offset)) / (2.0 * step)
    return result


class RayField(ABC):
    """φ in pixels, positive inside, at points (x, y, t): x and y are pixels of the crop, t pixels of depth behind the
    body's middle, each of ``unit`` metres."""

    _camera: Camera
    _crop: Crop
    _middle: float
    unit: float

    @abstractmethod
    def value(self, points: Points) -> Points:
        """Return φ (n) at ``points`` (n, 3)."""

    def world(self, places: Points, t: Points, shift: Points | None = None) -> Points:
        """Return ``places`` (n, 2), moved by ``shift`` (n, 2), at depths ``t`` (n) in the world (n, 3)."""
        pixels, depth = self._pixels(places), self._depth(t)
        if shift is not None:
            pixels = pixels + shift
        return np.asarray(self._camera.position + depth[:, None] * self._camera.rays(pixels))

    def _pixels(self, places: Points) -> Points:
        return np.asarray(places + np.array([self._crop.left + 0.5, self._crop.top + 0.5]))

    def _depth(self, t: Points) -> Points:
        return np.asarray(np.maximum(self._middle + t * self.unit, 0.02 * self._middle))

    def sampled(self, first: Points, steps: Points, counts: tuple[int, int, int]) -> NDArray[np.float32]:
        """Return φ on the grid of ``counts`` nodes from ``first`` (3,) in ``steps`` (3,), negative at its border.

        Away from the crop's outline φ is only known to be negative.
        """
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], indexing="ij"), axis=-1).reshape(-1, 2)
        outline = ndimage.map_coordinates(self._crop.distance, flat[:, ::-1].T, order=1, mode="nearest")
        near = outline > -2.0 * steps[0]
        points = np.column_stack([np.repeat(flat[near], counts[2], axis=0), np.tile(axes[2], int(near.sum()))])
        columns = np.repeat(np.minimum(outline, -1.0)[:, None], counts[2], axis=1)
        columns[near] = self.value(points).reshape(-1, counts[2])
        field = columns.reshape(counts)
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32)

    def depths(self, points: Points) -> tuple[Points, Points, Points]:
        """Return photo pixels (n, 2), depth (n) and depth of the ground (n) of ``points`` (n, 3)."""
        pixels = self._pixels(points[:, :2])
        return pixels, self._depth(points[:, 2]), ground_depth(self._camera, self._camera.rays(pixels))
