# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender meshes as closed triangle meshes in numpy, as PLY files, and their bounds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bmesh
import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.errors import InputError
from ...sim.files import read_bytes
from ...sim.scene.meshes import MAX_MESH_BYTES

SMALL = 0.1
"""Largest total area of holes, as a share of the mesh's area, that is closed: eyes of a head, not the mouth of a bowl.
"""


def caps(points: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return triangles (C, 3) that close the holes of a mesh (V, 3), (T, 3); none if the holes are not small.

    Coincident vertices must share one index in ``faces``; no face repeats an index.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)[1:]
    single = (count[number.reshape(-1)] == 1).reshape(-1, 3)
    mesh = bmesh.new()
    try:
        # Faces along the holes suffice to orient the caps.
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


Points = NDArray[np.float32]
Indices = NDArray[np.int32]

FLAT = 1e-9
"""Volume as a share of the bounding box below which a mesh is a sheet; also the simulation's limit."""

THICKEN = "give it thickness (Solidify modifier, applied if the object is simulated)"


@dataclass(frozen=True, eq=False)
class Triangles:
    """A Blender mesh. points: (V, 3) in object space, in vertex order; faces: (T, 3).

    edges: number of polygons at each edge that has any.
    """

    points: Points
    faces: Indices
    edges: NDArray[np.intp]


def read_points(mesh: bpy.types.Mesh) -> Points:
    """Return coordinates (V, 3) of the vertices of ``mesh`` in order."""
    points = np.empty((len(mesh.vertices), 3), dtype=np.float32)
    # Attributes are copied hundreds of times as fast, but in edit mode they are not up to date.
    if mesh.is_editmode:
        mesh.vertices.foreach_get("co", points.ravel())
    else:
        mesh.attributes["position"].data.foreach_get("vector", points.ravel())
    return points


def read_corners(mesh: bpy.types.Mesh) -> Indices:
    """Return the vertex index of every polygon corner."""
    return _corners(mesh, ".corner_vert", "vertex_index")


def _corners(mesh: bpy.types.Mesh, attribute: str, field: str) -> Indices:
    corners = np.empty(len(mesh.loops), dtype=np.int32)
    if mesh.is_editmode:
        mesh.loops.foreach_get(field, corners)
    elif len(corners):
        mesh.attributes[attribute].data.foreach_get("value", corners)
    return corners


def read_triangles(mesh: bpy.types.Mesh) -> Triangles:
    """Return ``mesh`` triangulated as Blender displays it."""
    mesh.calc_loop_triangles()
    faces = np.empty((len(mesh.loop_triangles), 3), dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces.ravel())
    edges = np.bincount(_corners(mesh, ".corner_edge", "edge_index"))
    return Triangles(points=read_points(mesh), faces=faces, edges=edges[edges > 0])


def require_sound(mesh: Triangles, name: str) -> None:
    """Raise InputError, with the object's name and a remedy, for meshes that cannot be simulated or collided with.

    Loose vertices and edges, and faces without area, are harmless: they follow the rest.
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
    # If every edge has an even number of faces, merging coincident vertices does not change that.
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


def mesh_trouble(item: bpy.types.Object) -> str:
    """Return why the mesh of ``item`` cannot be simulated, with a remedy; empty if it can."""
    try:
        require_sound(closed(read_triangles(item.data)), item.name)
    except InputError as error:
        return str(error)
    return ""


def closed(mesh: Triangles) -> Triangles:
    """Return ``mesh`` with small holes closed; unchanged if it has none, or larger ones."""
    if not (mesh.edges % 2 == 1).any() or not np.isfinite(mesh.points).all():
        return mesh
    faces = _joined(mesh.points, mesh.faces)
    if not _open_edges(faces)[0]:
        return mesh
    added = caps(mesh.points, faces)
    faces = np.concatenate([faces, added])
    # All or nothing: a mesh that stays open is rejected as it is.
    return mesh if _open_edges(faces)[0] else Triangles(points=mesh.points, faces=faces, edges=np.array([2]))


def _joined(points: Points, faces: Indices) -> Indices:
    """Return ``faces`` (T, 3) with coincident vertices merged, without faces that then repeat a vertex."""
    bits = np.ascontiguousarray(points + np.float32(0.0)).view(np.dtype((np.void, 12))).ravel()
    _, first, number = np.unique(bits, return_index=True, return_inverse=True)
    joined = first[number.reshape(-1)][faces]
    distinct = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return np.asarray(joined[distinct], dtype=np.int32)


def _directed(faces: Indices) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return an edge number for every triangle side (3 T,), and whether the side runs upward."""
    start, end = faces.astype(np.int64).ravel(), np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    return np.minimum(start, end) << 32 | np.maximum(start, end), start < end


def _open_edges(faces: Indices) -> tuple[int, int]:
    """Return how many edges have an odd number of faces, and the number of edges."""
    count = np.unique(_directed(faces)[0], return_counts=True)[1]
    return int((count % 2 == 1).sum()), len(count)


def _oriented(faces: Indices) -> bool:
    """Return whether every edge is used equally often in both directions."""
    edges, upward = _directed(faces)
    inverse = np.unique(edges, return_inverse=True)[1].reshape(-1)
    return not np.bincount(inverse, weights=np.where(upward, 1.0, -1.0)).any()


def write_mesh(path: Path, points: Points, faces: Indices) -> None:
    """Write a binary PLY file: 32-bit coordinates as in Blender, in order. Raises InputError if that fails."""
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
    """Return coordinates (V, 3) from a file by ``write_mesh``. Raises InputError for any other file."""
    try:
        content = read_bytes(path, MAX_MESH_BYTES, what="file of points")
        head, _, data = content.partition(b"end_header\n")
        count = int(head.split(b"element vertex ", 1)[1].split(b"\n", 1)[0])
        points = np.frombuffer(data, "<f4", 3 * count).reshape(count, 3).astype(np.float64)
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: cannot be read ({error}); fit again") from error
    if not np.isfinite(points).all():
        raise InputError(f"{path}: has places that are not finite; fit again")
    return points


def box_corners(item: bpy.types.Object) -> NDArray[np.float64]:
    """Return the corners (8, 3) of the evaluated bounding box of ``item`` in world space."""
    return np.array([item.matrix_world @ Vector(corner) for corner in item.bound_box])


def rest_bounds(item: bpy.types.Object) -> tuple[Vector, Vector]:
    """Return lowest and highest corner of the meshes before modifiers, including a bake's."""
    points = read_points(item.data)
    matrix = np.asarray(item.matrix_world)
    world = (points if len(points) else np.zeros((1, 3))) @ matrix[:3, :3].T + matrix[:3, 3]
    return Vector(world.min(axis=0)), Vector(world.max(axis=0))
