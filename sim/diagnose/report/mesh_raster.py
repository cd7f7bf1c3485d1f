# SPDX-License-Identifier: MIT
"""A small rasteriser of meshes for the report: parallel projection, silhouettes and creases."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_TRIANGLES = 12_000
"""Larger meshes are decimated first; the difference is not visible at this size."""

_CREASE = math.cos(math.radians(28))
_SMOOTH = math.cos(math.radians(35))


@dataclass(frozen=True, kw_only=True)
class View:
    """View direction in degrees: azimuth 0 looks along +y, 90 along -x; +z is up."""

    azimuth: float
    elevation: float

    @property
    def axes(self) -> Array:
        """Return (3, 3): right, up and towards the viewer as rows."""
        turn, lift = math.radians(self.azimuth), math.radians(self.elevation)
        right = np.array([math.cos(turn), math.sin(turn), 0.0])
        towards = np.array([math.cos(lift) * math.sin(turn), -math.cos(lift) * math.cos(turn), math.sin(lift)])
        return np.stack([right, np.cross(towards, right), towards])


@dataclass(frozen=True, kw_only=True)
class Raster:
    """G-buffer of H rows and W columns, the first row at the top.

    face: (H, W) triangle index, -1 for background. place: (H, W, 3) m in the mesh's frame, NaN for background.
    normal: (H, W, 3) unit, smoothed on smooth surfaces. depth: (H, W) m towards the viewer, -inf for background.
    edge: (H, W) silhouette or crease.
    """

    face: NDArray[np.int64]
    place: Array
    normal: Array
    depth: Array
    edge: NDArray[np.bool_]


def simplified(
    vertices: Array, faces: NDArray[np.int64], limit: int = MAX_TRIANGLES
) -> tuple[Array, NDArray[np.int64]]:
    """Return the mesh with at most ``limit`` triangles, by vertex clustering in ever larger cells."""
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    cells = 160.0
    while len(faces) > limit and cells > 2:
        keys = np.floor((vertices - vertices.min(axis=0)) / max(extent, 1e-12) * cells).astype(np.int64)
        _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], merged.reshape(-1)[faces]
        different = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[different]
        cells /= 1.4
    return vertices, faces


def rasterise(
    vertices: Array,
    faces: NDArray[np.int64],
    view: View,
    *,
    width: int,
    height: int,
    centre: Array,
    pixels_per_m: float,
) -> Raster:
    """Return the mesh (V, 3), (F, 3) rendered orthographically from ``view``, centred on ``centre`` (3,)."""
    axes = view.axes
    seen = (vertices - centre) @ axes.T
    places = seen[:, :2] * (pixels_per_m, -pixels_per_m) + (width / 2, height / 2)
    normals = _face_normals(vertices, faces)
    corners = _corner_normals(len(vertices), faces, normals)
    face = np.full((height, width), -1, dtype=np.int64)
    depth = np.full((height, width), -np.inf)
    place = np.full((height, width, 3), np.nan)
    normal = np.zeros((height, width, 3))
    for index, triangle in enumerate(faces):
        a, b, c = places[triangle]
        low = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c) - 0.5), 0).astype(int)
        high = np.minimum(np.floor(np.maximum(np.maximum(a, b), c) - 0.5), (width - 1, height - 1)).astype(int)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if (high < low).any() or abs(area) < 1e-12:
            continue
        x = np.arange(low[0], high[0] + 1)[None, :] + 0.5
        y = np.arange(low[1], high[1] + 1)[:, None] + 0.5
        second = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        third = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        weights = np.stack([1 - second - third, second, third], axis=-1)
        z = weights @ seen[triangle, 2]
        window = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
        nearer = (weights >= -1e-9).all(axis=-1) & (z > depth[window])
        if not nearer.any():
            continue
        depth[window][nearer] = z[nearer]
        face[window][nearer] = index
        place[window][nearer] = weights[nearer] @ vertices[triangle]
        normal[window][nearer] = weights[nearer] @ corners[index]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    # Inside-out and open meshes still look right when every normal faces the viewer.
    normal = np.where((normal @ axes[2] < 0)[..., None], -normal, normal)
    return Raster(face=face, place=place, normal=normal, depth=depth, edge=_edges(face, depth, normals, pixels_per_m))


def _face_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))


def _corner_normals(count: int, faces: NDArray[np.int64], normals: Array) -> Array:
    """Return (F, 3, 3): the mean normal around each corner, or the triangle's own at sharp edges."""
    around = np.zeros((count, 3))
    for corner in range(3):
        np.add.at(around, faces[:, corner], normals)
    length = np.linalg.norm(around, axis=1, keepdims=True)
    around /= np.where(length > 0, length, 1.0)
    corners = around[faces]
    smooth = (np.einsum("fcj,fj->fc", corners, normals) > _SMOOTH)[..., None]
    return np.where(smooth, corners, normals[:, None, :])


def _edges(face: NDArray[np.int64], depth: Array, normals: Array, pixels_per_m: float) -> NDArray[np.bool_]:
    covered = face >= 0
    edge = np.zeros(face.shape, dtype=bool)
    if not len(normals):
        return edge
    step = 6.0 / pixels_per_m
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        one, two = face[here], face[there]
        line = covered[here] != covered[there]
        # Only between two triangles.
        row, column = np.nonzero((one != two) & covered[here] & covered[there])
        bend = np.einsum("ij,ij->i", normals[one[row, column]], normals[two[row, column]])
        jump = np.abs(depth[here][row, column] - depth[there][row, column]) > step
        line[row, column] = (np.abs(bend) < _CREASE) | jump
        edge[here] |= line
        edge[there] |= line & covered[there]
    return edge & covered
