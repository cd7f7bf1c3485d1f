# SPDX-License-Identifier: MIT
"""What the texture of a body depends on from place to place: normals, flatness, and pixels of the photo."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ...mpm.geometry.triangles import area_normals
from ...smoothstep import smoothstep
from .inflated_mesh import BodyMesh

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

BENT = (1.0, 0.4)
"""Curvature times the body's extent (2 on a ball) from which ``CLEAR`` holds not at all, and up to which fully: the
pixels along the outline of a round side are mixed with the background, and other cameras would see them as a line."""
SMOOTHINGS = 6
"""Rounds of averaging of the distance behind the rim."""
FLAT_RINGS = 2
"""Faces by which a flat side has to reach on all sides: patches that are smaller count as round."""


class SurfaceValues(NamedTuple):
    """What the colour of a place on the body depends on, each (P, k), interpolated over its faces."""

    place: Points
    """(P, 3)."""

    normal: Points
    """(P, 3), not of unit length between vertices."""

    counterpart: Points
    """(P, 2) px of the photo where the visible side is like it."""

    pixel: Points
    """(P, 2) px of the photo where it is itself."""

    hidden: Points
    """(P, 1) share of its faces that others hide."""

    flatness: Points
    """(P, 1) 0 where curved as a ball, 1 on a plane."""

    unlit: Points
    """(P, 1) share of the counterpart's light that is taken out."""

    blended: Points
    """(P, 3) sRGB, 0 to 255, across seams between counterparts."""

    seam: Points
    """(P, 1) share of ``blended``."""

    @classmethod
    def from_columns(cls, columns: Points) -> SurfaceValues:
        """Return the values of ``columns`` (P, 17), as ``np.column_stack`` makes them."""
        return cls(*np.split(columns, np.cumsum(WIDTHS)[:-1], axis=1))


WIDTHS = (3, 3, 2, 2, 1, 1, 1, 3, 1)
"""Columns of each of the ``SurfaceValues``."""


def vertex_normals(body: BodyMesh) -> Points:
    """Return unit normals (V, 3), means of those of the faces around."""
    summed = area_normals(body.vertices, body.faces)
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-300)


def vertex_share(body: BodyMesh, faces: Mask) -> NDArray[np.float64]:
    """Return the share (V,) of a vertex' faces that are among ``faces`` (T,)."""
    count, total = np.zeros(len(body.vertices)), np.zeros(len(body.vertices))
    for corner in range(3):
        np.add.at(total, body.faces[:, corner], 1.0)
        np.add.at(count, body.faces[:, corner], faces)
    return count / np.maximum(total, 1.0)


def smoothed(body: BodyMesh, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``values`` (V,) averaged with those of neighbours: what begins at a row of faces would begin in teeth."""
    count = np.bincount(body.faces.ravel(), minlength=len(values))
    for _ in range(SMOOTHINGS):
        total = np.zeros(len(values))
        for corner in range(3):
            np.add.at(total, body.faces[:, corner], values[body.faces].mean(axis=1))
        values = total / np.maximum(count, 1)
    return values


def flat_sides(body: BodyMesh, normals: Points) -> NDArray[np.float64]:
    """Return the flatness (V,) of the flattest side at each vertex, 0 where curved as a ball and 1 on a plane."""
    ends = np.sort(np.stack([body.faces, np.roll(body.faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    pairs = np.flatnonzero((ends[order][1:] == ends[order][:-1]).all(axis=1))
    first, second = order[pairs] // 3, order[pairs + 1] // 3
    middle = body.vertices[body.faces].mean(axis=1)
    bend = np.linalg.norm(normals[first] - normals[second], axis=1)
    bend /= np.maximum(np.linalg.norm(middle[first] - middle[second], axis=1), 1e-300)
    around = np.zeros((len(body.faces), 3))
    for one, edge in ((first, order[pairs]), (second, order[pairs + 1])):
        around[one, edge % 3] = bend
    extent = float(np.ptp(body.vertices, axis=0).max())
    flat = 1.0 - smoothstep(np.median(around, axis=1) * extent, *BENT[::-1])
    # A few even faces of a round side are no flat side: they would get other light than what is around them.
    for spread in (np.minimum, np.maximum):
        for _ in range(FLAT_RINGS):
            before = flat.copy()
            spread.at(flat, first, before[second])
            spread.at(flat, second, before[first])
    result = np.zeros(len(body.vertices))
    for corner in range(3):
        np.maximum.at(result, body.faces[:, corner], flat)
    return result


def sampled(picture: NDArray[np.float32], at: Points) -> NDArray[np.float64]:
    """Return ``picture`` (h, w, C) at ``at`` (n, 2), x and y from the centre of the first pixel, bilinear, (n, C)."""
    # OpenCV takes at most 32767 places in a row.
    count, columns = len(at), 1024
    padded = -(-max(count, 1) // columns) * columns
    x, y = (np.pad(at[:, i].astype(np.float32), (0, padded - count)).reshape(-1, columns) for i in (0, 1))
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(padded, -1)[:count], dtype=np.float64)
