# SPDX-License-Identifier: GPL-3.0-or-later
"""Small holes of a mesh, closed for the simulation alone: faces are added, vertices stay, so its cache still fits."""

from __future__ import annotations

import bmesh
import numpy as np
from numpy.typing import NDArray

SMALL = 0.1
"""Area of all holes over that of the mesh up to which they are closed: the eyes of a head, not the mouth of a bowl."""


def caps(points: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangles (C, 3) that close the holes of the mesh (V, 3), (T, 3); none where the holes are not small.

    Vertices in the same place must be one in ``faces``; a face names none twice.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)[1:]
    single = (count[number.reshape(-1)] == 1).reshape(-1, 3)
    mesh = bmesh.new()
    try:
        # Faces along the holes are enough, and tell which way a cap has to look.
        rim = faces[single.any(axis=1)]
        places = np.unique(rim)
        vertices = {int(index): mesh.verts.new(points[index].tolist()) for index in places}
        index_of = {vertex: index for index, vertex in vertices.items()}
        for face in rim.tolist():
            corners = [vertices[index] for index in face]
            if mesh.faces.get(corners) is None:
                mesh.faces.new(corners)
        loops = {tuple(side) for side in sides.reshape(-1, 3, 2)[single].tolist()}
        edges = [edge for edge in mesh.edges if tuple(sorted(index_of[vertex] for vertex in edge.verts)) in loops]
        filled = bmesh.ops.holes_fill(mesh, edges=edges, sides=0)["faces"]
        cut = bmesh.ops.triangulate(mesh, faces=filled)["faces"]
        found = np.array([[index_of[v] for v in face.verts] for face in cut], dtype=np.int32).reshape(-1, 3)
    finally:
        mesh.free()
    return found if _area(points, found) <= SMALL * _area(points, faces) else found[:0]


def _area(points: NDArray[np.float32], faces: NDArray[np.int32]) -> float:
    a, b, c = np.moveaxis(points[faces].astype(np.float64), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
