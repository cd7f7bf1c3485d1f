# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender meshes as triangles in numpy and as PLY files, vertex for vertex; what no simulation could use is refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.errors import InputError
from .export_holes import caps

Points = NDArray[np.float32]
Indices = NDArray[np.int32]

FLAT = 1e-9
"""Volume over that of the bounding box below which a mesh is a sheet; the simulation's own limit."""

THICKEN = "give it thickness (Solidify modifier, applied if the object is simulated)"


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh of Blender. points: (V, 3) in its own space, in the order of its vertices; faces: (T, 3).

    edges: number of polygons at every edge that has any.
    """

    points: Points
    faces: Indices
    edges: NDArray[np.intp]


def read_points(mesh: bpy.types.Mesh) -> Points:
    """Coordinates (V, 3) of the vertices of ``mesh`` in their order."""
    points = np.empty((len(mesh.vertices), 3), dtype=np.float32)
    # Attributes are copied hundreds of times as fast, but in edit mode they are those of the unfinished mesh.
    if mesh.is_editmode:
        mesh.vertices.foreach_get("co", points.ravel())
    else:
        mesh.attributes["position"].data.foreach_get("vector", points.ravel())
    return points


def read_corners(mesh: bpy.types.Mesh) -> Indices:
    """The vertex of every corner of every polygon."""
    return _corners(mesh, ".corner_vert", "vertex_index")


def _corners(mesh: bpy.types.Mesh, attribute: str, field: str) -> Indices:
    corners = np.empty(len(mesh.loops), dtype=np.int32)
    if mesh.is_editmode:
        mesh.loops.foreach_get(field, corners)
    elif len(corners):
        mesh.attributes[attribute].data.foreach_get("value", corners)
    return corners


def read_triangles(mesh: bpy.types.Mesh) -> Triangles:
    """``mesh`` with its polygons cut into triangles, as Blender cuts them to show them."""
    mesh.calc_loop_triangles()
    faces = np.empty((len(mesh.loop_triangles), 3), dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces.ravel())
    edges = np.bincount(_corners(mesh, ".corner_edge", "edge_index"))
    return Triangles(points=read_points(mesh), faces=faces, edges=edges[edges > 0])


def require_sound(mesh: Triangles, name: str) -> None:
    """Raise InputError, with the name of the object and the way out, for what the simulation could not fill or hit.

    Loose vertices and edges, and faces without area, do no harm: they follow the rest.
    """
    points, faces = mesh.points, mesh.faces
    if len(faces) == 0:
        raise InputError(f"object {name!r}: has no faces: add some, or take it out of the simulation")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"object {name!r}: vertex {bad[0]} is at {points[bad[0]].tolist()}: delete it, or undo what put it there"
        )
    corners = points[faces].astype(np.float64)
    used = np.zeros(len(points), dtype=np.bool_)
    used[faces.ravel()] = True
    extent = np.ptp(points[used].astype(np.float64), axis=0)
    if not extent.min() > 1e-12 * extent.max():
        raise InputError(f"object {name!r}: is flat and has no inside: {THICKEN}")
    # Where every edge has an even number of faces, joining vertices in the same place leaves it at that.
    if (mesh.edges % 2 == 1).any():
        faces = _joined(points, faces)
        odd, total = _open_edges(faces)
        if odd:
            raise InputError(
                f"object {name!r}: its mesh is not closed, {odd} of {total} edges have an odd number of faces: fill "
                f"its holes (Mesh > Clean Up > Fill Holes), or {THICKEN}"
            )
    corners -= corners[0, 0]
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6
    if abs(volume) <= FLAT * float(extent.prod()) and _oriented(_joined(points, faces)):
        raise InputError(
            f"object {name!r}: has no volume: {THICKEN}, or if it has, turn its faces outward "
            "(Mesh > Normals > Recalculate Outside)"
        )


def closed(mesh: Triangles) -> Triangles:
    """``mesh`` with its small holes closed; itself where it has none, or larger ones."""
    if not (mesh.edges % 2 == 1).any() or not np.isfinite(mesh.points).all():
        return mesh
    faces = _joined(mesh.points, mesh.faces)
    if not _open_edges(faces)[0]:
        return mesh
    added = caps(mesh.points, faces)
    faces = np.concatenate([faces, added])
    # All or nothing: what is still open is refused as it came.
    return mesh if _open_edges(faces)[0] else Triangles(points=mesh.points, faces=faces, edges=np.array([2]))


def _joined(points: Points, faces: Indices) -> Indices:
    """``faces`` (T, 3) with vertices in the same place taken as one, without those that then name one twice."""
    bits = np.ascontiguousarray(points + np.float32(0.0)).view(np.dtype((np.void, 12))).ravel()
    _, first, number = np.unique(bits, return_index=True, return_inverse=True)
    joined = first[number.reshape(-1)][faces]
    distinct = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return np.asarray(joined[distinct], dtype=np.int32)


def _directed(faces: Indices) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """A number for the edge of every side (3 T,) of the triangles, and whether it runs upward."""
    start, end = faces.astype(np.int64).ravel(), np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    return np.minimum(start, end) << 32 | np.maximum(start, end), start < end


def _open_edges(faces: Indices) -> tuple[int, int]:
    """How many edges have an odd number of faces, and how many there are."""
    count = np.unique(_directed(faces)[0], return_counts=True)[1]
    return int((count % 2 == 1).sum()), len(count)


def _oriented(faces: Indices) -> bool:
    """Whether every edge is run through as often one way as the other."""
    edges, upward = _directed(faces)
    inverse = np.unique(edges, return_inverse=True)[1].reshape(-1)
    return not np.bincount(inverse, weights=np.where(upward, 1.0, -1.0)).any()


def write_mesh(path: Path, points: Points, faces: Indices) -> None:
    """Write a binary PLY file: 32-bit coordinates as Blender has them, in their order. InputError if it cannot be."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(points.astype("<f4", copy=False).tobytes())
        file.write(rows.tobytes())


def read_points_file(path: Path) -> NDArray[np.float64]:
    """Coordinates (V, 3) in a file that ``write_mesh`` wrote. Raises InputError for any other."""
    try:
        content = path.read_bytes()
        head, _, data = content.partition(b"end_header\n")
        count = int(head.split(b"element vertex ", 1)[1].split(b"\n", 1)[0])
        points = np.frombuffer(data, "<f4", 3 * count).reshape(count, 3).astype(np.float64)
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: cannot be read ({error}); fit again") from error
    if not np.isfinite(points).all():
        raise InputError(f"{path}: has places that are not finite; fit again")
    return points
