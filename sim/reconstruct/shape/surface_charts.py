# SPDX-License-Identifier: MIT
"""Charts of a part of a surface: flat pieces that are projected along six directions and packed into a rectangle.

Each face belongs to the direction that its normal is nearest to, so lengths shrink to no less than 1/√3. What overlaps
in a projection, as an arm in front of a body does, becomes a chart of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..mesh_raster import rasterise

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

GUTTER = 3
"""Texels around each chart, for filtering."""
YAW_STEPS = 30
"""Yaws tried for the frame, over a quarter turn."""
SMOOTHING = 0.25
"""Weight of the neighbours' directions against the face's own normal, so that charts have smooth outlines."""
ROUNDS = 4
LEAST_FACES = 24
"""Smaller charts are given to a neighbour where that shrinks lengths to no less than ``LEAST_COSINE``."""
LEAST_COSINE = 0.35
COARSE = 256.0
"""Cells along a chart for finding what overlaps."""
APART = 3.0
"""Texels of height between two faces above which one hides the other in a projection."""


@dataclass(frozen=True, eq=False)
class Charts:
    """source: (N,) index of the surface's vertex; faces: (T, 3) into these; texels: (N, 2) x, y in a rectangle of
    ``size`` (width, height)."""

    source: NDArray[np.int64]
    faces: Faces
    texels: Points
    size: tuple[int, int]


def surface_frame(normals: Points, areas: NDArray[np.float64]) -> Points:
    """Return the rows x, y, z of the frame (3, 3), z up, whose axes the ``normals`` (T, 3), weighted by ``areas`` (T,),
    follow most closely."""
    yaws = np.arange(YAW_STEPS) * (np.pi / 2.0 / YAW_STEPS)
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    flat = areas * np.hypot(normals[:, 0], normals[:, 1])
    # cos⁴ + sin⁴ of the angle to an axis is 3/4 + cos(4 angle)/4.
    score = [float(flat @ np.cos(4.0 * (angle - yaw))) for yaw in yaws]
    best = int(np.argmax(score))
    # A round body has no axes of its own: it keeps the camera's.
    yaw = yaws[best] if score[best] > 0.2 * flat.sum() else 0.0
    return np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])


def unwrap(vertices: Points, faces: Faces, frame: Points, texels: float, width: int) -> Charts:
    """Return charts of ``faces`` (T, 3) with about ``texels`` a unit of length, packed into about ``width`` texels.

    vertices: (V, 3), shared by neighbouring faces. frame: (3, 3) rows are the axes of projection.
    """
    local = vertices @ frame.T
    a, b, c = (local[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    towards = np.concatenate([normals, -normals], axis=1)
    links = _neighbours(faces)
    label = _labels(towards, links)
    chart = _connected(label, links)
    label, chart = _merged(towards, label, chart, links)
    flat = np.empty((len(faces), 3, 3))
    for direction in range(6):
        rows = label == direction
        flat[rows] = _projected(local, direction)[faces[rows]]
    flat *= texels
    chart = _separated(flat, chart, links)
    return _packed(faces, flat[..., :2], chart, width)


def _neighbours(faces: Faces) -> sparse.csr_matrix:
    """Faces (T, T) with a common edge."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    owner = np.repeat(np.arange(len(faces)), 3)
    table = sparse.csr_matrix((np.ones(len(owner)), (owner, edge.reshape(-1))))
    links = (table @ table.T).tocsr()
    links.setdiag(0)
    links.eliminate_zeros()
    links.data[:] = 1.0
    return links


def _labels(towards: Points, links: sparse.csr_matrix) -> NDArray[np.int64]:
    """Direction (T,), 0 to 5, of each face."""
    label = np.argmax(towards, axis=1)
    for _ in range(ROUNDS):
        around = links @ np.eye(6)[label]
        label = np.argmax(np.where(towards > LEAST_COSINE, towards + SMOOTHING * around, towards - 10.0), axis=1)
    return np.asarray(label)


def _connected(label: NDArray[np.int64], links: sparse.csr_matrix) -> NDArray[np.int64]:
    """Number (T,) of the connected part of one ``label`` (T,) that each face belongs to."""
    pairs = links.tocoo()
    same = label[pairs.row] == label[pairs.col]
    graph = sparse.coo_matrix((np.ones(int(same.sum())), (pairs.row[same], pairs.col[same])), links.shape)
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def _merged(
    towards: Points, label: NDArray[np.int64], chart: NDArray[np.int64], links: sparse.csr_matrix
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """``label`` and ``chart`` (T,) without charts of a few faces."""
    for _ in range(ROUNDS):
        small = np.bincount(chart)[chart] < LEAST_FACES
        if not small.any():
            break
        around = np.asarray(links @ (np.eye(6)[label] * ~small[:, None]))
        around = np.where(towards > LEAST_COSINE, around, 0.0)
        best = np.argmax(around, axis=1)
        moved = small & (around.max(axis=1) > 0.0)
        if not moved.any():
            break
        label = np.where(moved, best, label)
        chart = _connected(label, links)
    return label, chart


def _projected(local: Points, direction: int) -> Points:
    """``local`` (V, 3) seen from outside along a direction, 0 to 5 as +x, +y, +z, −x, −y, −z: right, down, away."""
    x, y, z = local.T
    seen = (
        (y, -z, -x),
        (-x, -z, -y),
        (x, -y, -z),
        (-y, -z, x),
        (x, -z, y),
        (x, y, z),
    )[direction]
    return np.column_stack(seen)


def _separated(flat: Points, chart: NDArray[np.int64], links: sparse.csr_matrix) -> NDArray[np.int64]:
    """``chart`` (T,), where what is hidden by other faces of its chart ``flat`` (T, 3, 3) is a chart of its own."""
    for _ in range(ROUNDS):
        hidden = np.zeros(len(flat), dtype=bool)
        for number in range(int(chart.max()) + 1):
            rows = np.flatnonzero(chart == number)
            corner = flat[rows]
            low = corner.reshape(-1, 3).min(axis=0)
            corner = corner - low
            coarse = max(1.0, float(corner[..., :2].max()) / COARSE)
            corner[..., :2] /= coarse
            size = (int(corner[..., 0].max()) + 1, int(corner[..., 1].max()) + 1)
            # So far away that the perspective of the rasteriser is none.
            points = corner.reshape(-1, 3) + np.array([0.0, 0.0, 1e7])
            shown = rasterise(points, np.arange(len(points)).reshape(-1, 3), size, np.ones(len(rows), dtype=bool))
            depth = np.full(size[::-1], np.inf)
            depth[shown.rows, shown.columns] = shown.interpolated(
                np.arange(len(points)).reshape(-1, 3), corner.reshape(-1, 3)[:, 2:]
            )[:, 0]
            middle = corner.mean(axis=1)
            column, row = (np.minimum(middle[:, i].astype(int), size[i] - 1) for i in (0, 1))
            slack = APART + 2.0 * coarse + np.ptp(corner[..., 2], axis=1)
            hidden[rows] = middle[:, 2] > depth[row, column] + slack
        if not hidden.any():
            break
        chart = _connected(2 * chart + hidden, links)
    return chart


def _packed(faces: Faces, flat: Points, chart: NDArray[np.int64], width: int) -> Charts:
    """Charts at ``flat`` (T, 3, 2), each at its own place, tall ones first, row by row."""
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    extent = np.ceil(high - low).astype(int) + 1 + 2 * GUTTER
    width = max(width, int(extent[:, 0].max()))
    corner = np.zeros((count, 2))
    left = top = tall = 0
    for number in np.lexsort((np.arange(count), -extent[:, 1])):
        if left + extent[number, 0] > width:
            left, top, tall = 0, top + tall, 0
        corner[number] = left + GUTTER, top + GUTTER
        left += extent[number, 0]
        tall = max(tall, int(extent[number, 1]))
    place = (flat + (corner - low)[chart][:, None]).reshape(-1, 2)
    keys = np.column_stack([np.repeat(chart, 3), faces.ravel()])
    unique, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return Charts(unique[:, 1], which.reshape(-1, 3), place[first], (width, top + tall))
