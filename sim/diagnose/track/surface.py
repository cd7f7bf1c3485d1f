# SPDX-License-Identifier: MIT
"""What a camera sees of a mesh: which point of it a pixel shows, and its outline.

Rays are cast in the image: a triangle in front of the camera covers a pixel where its projection does, and inverse
depth is linear in the image, which is exact and needs no search tree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Camera
from .pose import Array, Mask, Pose, project

_PAIRS_AT_ONCE = 1_000_000
"""Pixels times triangles that are compared in one go, to bound the memory."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A mesh in its rest frame: vertices (V, 3) m, faces (F, 3)."""

    vertices: Array
    faces: NDArray[np.int64]

    @property
    def normals(self) -> Array:
        """Unit normals (F, 3) of the faces."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


@dataclass(frozen=True, kw_only=True)
class Hits:
    """Of each pixel: face (N,), -1 where the mesh is not hit; rest (N, 3) m and depth (N,) m, NaN and inf there."""

    face: NDArray[np.int64]
    rest: Array
    depth: Array


def cast(surface: Surface, pose: Pose, camera: Camera, pixels: Array) -> Hits:
    """The nearest points of ``surface`` at ``pose`` that ``pixels`` (N, 2) show."""
    local = pose.apply(surface.vertices)
    flat, depth = project(camera, local)[surface.faces], local[surface.faces, 2]
    usable = np.flatnonzero(_over_corners(np.minimum, depth) > 1e-6)
    flat, depth = flat[usable], depth[usable]
    low, high = _over_corners(np.minimum, flat), _over_corners(np.maximum, flat)
    count = len(pixels)
    face = np.full(count, -1, dtype=np.int64)
    rest = np.full((count, 3), np.nan)
    nearest = np.full(count, np.inf)
    # Pixels in the order of x: those beside a triangle are a stretch of them.
    by_x = np.argsort(pixels[:, 0], kind="stable")
    left = np.searchsorted(pixels[by_x, 0], low[:, 0], side="left")
    counts = np.searchsorted(pixels[by_x, 0], high[:, 0], side="right") - left
    for part in _parts(counts):
        triangle = np.repeat(part, counts[part])
        step = np.arange(len(triangle)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
        which = by_x[left[triangle] + step]
        beside = (pixels[which, 1] >= low[triangle, 1]) & (pixels[which, 1] <= high[triangle, 1])
        which, triangle = which[beside], triangle[beside]
        a, b, c = (flat[triangle, i] for i in range(3))
        p = pixels[which]
        area = _cross(b - a, c - a)
        area = np.where(np.abs(area) < 1e-12, np.nan, area)
        weights = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=1) / area[:, None]
        hit = (weights >= -1e-9).all(axis=1)
        which, triangle, weights = which[hit], triangle[hit], weights[hit]
        shares = weights / depth[triangle]
        z = 1.0 / shares.sum(axis=1)
        order = np.lexsort((z, which))
        first = order[np.unique(which[order], return_index=True)[1]]
        first = first[z[first] < nearest[which[first]]]
        rows = which[first]
        face[rows], nearest[rows] = usable[triangle[first]], z[first]
        corners = surface.vertices[surface.faces[face[rows]]]
        rest[rows] = (corners * (shares[first] * z[first][:, None])[:, :, None]).sum(axis=1)
    return Hits(face=face, rest=rest, depth=nearest)


def _over_corners(smaller: np.ufunc, values: Array) -> Array:
    """The least or largest of ``values`` (F, 3, …) over the corners; NumPy's own is slow along so short an axis."""
    return np.asarray(smaller(smaller(values[:, 0], values[:, 1]), values[:, 2]))


def _parts(counts: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Indices of triangles, in parts whose ``counts`` of pixels together stay bounded."""
    wanted = np.flatnonzero(counts > 0)
    bins = np.cumsum(counts[wanted]) // _PAIRS_AT_ONCE
    for number in np.unique(bins):
        yield wanted[bins == number]


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def silhouette(surface: Surface, pose: Pose, camera: Camera) -> Mask:
    """(H, W): pixels that show ``surface``, whatever is in front of it."""
    local = pose.apply(surface.vertices)
    flat = project(camera, local)[surface.faces]
    drawn = np.zeros((camera.height, camera.width), dtype=np.uint8)
    # OpenCV's drawing wraps around far outside of the picture.
    limit = 8 * max(camera.width, camera.height)
    with np.errstate(invalid="ignore"):
        near = (np.abs(flat) < limit).all(axis=(1, 2))
    bits = 4
    scaled = np.round((flat[near] - 0.5) * 2**bits).astype(np.int32)
    for triangle in scaled:
        cv2.fillConvexPoly(drawn, triangle, 1, lineType=cv2.LINE_8, shift=bits)
    return np.asarray(drawn > 0)


def facing(rest: Array, normals: Array, pose: Pose) -> Array:
    """(N,): cosine between the surface's normal and the way to the camera; 1 seen head-on, below 0 from behind."""
    local = pose.apply(rest)
    return np.asarray(-((normals @ pose.rotation.T) * local).sum(axis=1) / np.linalg.norm(local, axis=1))
