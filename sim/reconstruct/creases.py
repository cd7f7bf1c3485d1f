# SPDX-License-Identifier: MIT
"""Normals of a surface that is smooth except at creases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Points = NDArray[np.float64]

CREASE_COSINE = 0.77
"""Cosine of 40°: faces at a sharper edge do not share a normal."""


@dataclass(frozen=True, eq=False)
class CreasedSurface:
    """A surface with one vertex per normal.

    vertices, normals: (N, 3), normals of unit length; faces: (T, 3) into them, in the order of the surface's own;
    source: (N,) index of the surface's own vertex.
    """

    vertices: Points
    normals: Points
    faces: NDArray[np.int64]
    source: NDArray[np.int64]


def split_creases(vertices: Points, faces: NDArray[np.integer]) -> CreasedSurface:
    """Return the surface of ``vertices`` (V, 3), ``faces`` (T, 3), smooth except at creases; coincident vertices share
    normals."""
    faces = np.asarray(faces, dtype=np.int64)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-30)
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    _, place = np.unique(np.round((vertices - vertices.min(axis=0)) / size * 1e6), axis=0, return_inverse=True)
    place = place.reshape(-1)
    corner_place, corner_face = place[faces].ravel(), np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(len(corner_place))
    touching = sparse.csr_matrix((ones, (corner_place, corner_face)), shape=(int(place.max()) + 1, len(faces)))
    pairs = touching[corner_place].tocoo()
    smooth = (unit[corner_face[pairs.row]] * unit[pairs.col]).sum(axis=1) > CREASE_COSINE
    rows, columns = pairs.row[smooth], pairs.col[smooth]
    averaging = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(corner_place), len(faces)))
    summed = averaging @ weighted
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    normals = np.where(length > 1e-30, summed / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))
    keys = np.column_stack([faces.ravel(), np.round(normals * 1000)]).astype(np.int64)
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    source = np.asarray(faces.ravel()[first], dtype=np.int64)
    return CreasedSurface(vertices[source], normals[first], which.reshape(-1, 3), source)
