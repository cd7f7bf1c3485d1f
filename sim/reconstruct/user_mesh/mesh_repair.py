# SPDX-License-Identifier: MIT
"""Repair an external mesh for simulation: one closed body, with its colours.

Mesh generators leave floating specks, open borders and inverted faces. Each is repaired as little as necessary, with a
notice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ...errors import InputError

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

SPECK = 0.01
"""Share of the surface below which a separate part is removed anywhere."""
LOOSE = 0.2
"""Share of the surface below which a separate part is removed if it floats."""
GAP = 0.03
"""Distance over the largest extent beyond which a part floats."""
VOXELS = 110
"""Voxels along the largest extent of a mesh that is closed as a volume."""
SHARP = np.radians(40.0)
"""Angle between the normals of two faces from which the edge between them is sharp."""
MOST_FACES = 2_000_000
MOST_TILES = 16
"""Repetitions of a mesh's own picture across a single face above which vertex colours are used instead."""
MOST_TILED = 4096
"""Largest side in pixels of a picture with its repetitions."""


@dataclass(frozen=True)
class RepairedMesh:
    """A closed surface in the file's coordinates.

    vertices: (V, 3); faces: (T, 3); uv: (V, 2) or None, and its picture (h, w, 3) uint8 or None; colours: (V, 3) 0 to
    255 at the vertices, or None if the file has none.
    """

    vertices: Points
    faces: Faces
    uv: NDArray[np.float64] | None
    picture: NDArray[np.uint8] | None
    colours: NDArray[np.float64] | None


def repair_mesh(mesh: trimesh.Trimesh, name: str, notice: Callable[[str], None]) -> RepairedMesh:
    """Return ``mesh`` as one closed body. ``notice`` receives the repairs.

    Raises InputError when it has no extent, or is too large to simulate.
    """
    if len(mesh.faces) > MOST_FACES:
        raise InputError(
            f"{name}: the mesh has {len(mesh.faces)} faces; decimate it to {MOST_FACES} or less "
            "(in Blender: Decimate modifier)"
        )
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    size = float(np.ptp(vertices, axis=0).max())
    if not size > 1e-12:
        raise InputError(f"{name}: the mesh has no extent; export it again")
    uv, picture, colours = _appearance(mesh, name, notice)
    if uv is not None and picture is not None:
        tiled = _tiled(uv, picture, faces)
        if tiled is None:
            notice(f"{name}: its texture repeats many times within a face; the colours at its vertices are used")
            uv = picture = None
        else:
            uv, picture, faces, source = tiled
            vertices, colours = vertices[source], None if colours is None else colours[source]
    welded = _welded(vertices, faces)
    kept = _kept_faces(vertices, faces, welded, size, name, notice)
    used, renumbered = np.unique(faces[kept], return_inverse=True)
    vertices, faces, welded = vertices[used], renumbered.reshape(-1, 3), welded[used]
    uv = None if uv is None else uv[used]
    colours = None if colours is None else colours[used]
    if _is_closed(welded[faces]):
        faces = _outward(vertices, faces, welded, name, notice)
        if uv is None:
            vertices, faces, source = _joined(vertices, faces, welded)
            colours = None if colours is None else colours[source]
        return RepairedMesh(vertices, faces, uv, picture, colours)
    return _closed_volume(vertices, faces, colours, size, name, notice)


def _appearance(
    mesh: trimesh.Trimesh, name: str, notice: Callable[[str], None]
) -> tuple[NDArray[np.float64] | None, NDArray[np.uint8] | None, NDArray[np.float64] | None]:
    """UV as in the file, picture and vertex colours, if the file has them."""
    uv = getattr(mesh.visual, "uv", None)
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None and len(uv) == len(mesh.vertices) and np.isfinite(uv).all():
        picture = np.asarray(image.convert("RGB"), dtype=np.uint8)
        coordinates = np.asarray(uv, dtype=np.float64)
        wrapped = coordinates - np.floor(coordinates)
        wrapped[coordinates == 1.0] = 1.0
        columns = np.minimum((wrapped[:, 0] * picture.shape[1]).astype(int), picture.shape[1] - 1)
        rows = np.minimum(((1 - wrapped[:, 1]) * picture.shape[0]).astype(int), picture.shape[0] - 1)
        return coordinates, picture, picture[rows, columns].astype(np.float64)
    if image is not None:
        notice(
            f"{name}: the mesh has a picture but no usable texture coordinates; the photo's colours are used instead"
        )
    if getattr(mesh.visual, "kind", None) == "vertex":
        return None, None, np.asarray(getattr(mesh.visual, "vertex_colors"), dtype=np.float64)[:, :3]  # noqa: B009
    return None, None, None


def _tiled(
    uv: NDArray[np.float64], picture: NDArray[np.uint8], faces: Faces
) -> tuple[NDArray[np.float64], NDArray[np.uint8], Faces, NDArray[np.int64]] | None:
    """UV (W, 2) from 0 to 1, picture, faces (T, 3) and the vertex that each of the W vertices was; None for too many
    repetitions.

    Coordinates beyond 0 to 1 repeat the picture. Wrapping each vertex by itself would draw the whole picture backwards
    across every face that crosses a border, so faces are wrapped as a whole, and the picture is repeated for those.
    """
    corners = uv[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    within = (low >= -1e-6) & (high <= 1.0 + 1e-6)
    tile = np.where(within, 0.0, np.floor(low + 1e-6))
    columns, rows = (max(1, int(np.ceil(n - 1e-6))) for n in (high - tile).max(axis=0))
    largest = max(columns * picture.shape[1], rows * picture.shape[0])
    if columns * rows > 1 and (columns * rows > MOST_TILES or largest > MOST_TILED):
        return None
    keys = np.concatenate([np.repeat(tile, 3, axis=0), faces.reshape(-1, 1)], axis=1)
    used, renumbered = np.unique(keys, axis=0, return_inverse=True)
    source = used[:, 2].astype(np.int64)
    wrapped = np.clip((uv[source] - used[:, :2]) / (columns, rows), 0.0, 1.0)
    return wrapped, np.tile(picture, (rows, columns, 1)), renumbered.reshape(-1, 3), source


def _welded(vertices: Points, faces: Faces) -> NDArray[np.int64]:
    """For each vertex the index of its position: exporters split vertices along texture seams."""
    return np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _kept_faces(
    vertices: Points, faces: Faces, welded: NDArray[np.int64], size: float, name: str, notice: Callable[[str], None]
) -> NDArray[np.bool_]:
    """Faces (bool) with area that belong to the body, without floating parts."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    corners = welded[faces]
    kept = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    if not kept.any() or not areas[kept].sum() > 1e-14 * size**2:
        raise InputError(f"{name}: the mesh has no area; export it again as a triangle mesh")
    count = int(welded.max()) + 1
    ends = corners[kept][:, [0, 1, 1, 2]].reshape(-1, 2)
    links = sparse.coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), (count, count))
    labels = sparse.csgraph.connected_components(links, directed=False)[1][corners[:, 0]]
    shares = np.bincount(labels[kept], weights=areas[kept]) / areas[kept].sum()
    main = int(np.argmax(shares))
    near = cKDTree((vertices[faces[kept & (labels == main)]]).reshape(-1, 3))
    dropped = 0
    for label in np.flatnonzero((shares > 0) & (shares < LOOSE)):
        if label == main:
            continue
        part = kept & (labels == label)
        gap = float(near.query(vertices[faces[part]].reshape(-1, 3))[0].min())
        if shares[label] < SPECK or gap > GAP * size:
            kept = kept & ~part
            dropped += 1
    if dropped:
        notice(
            f"{name}: {dropped} separate {'part' if dropped == 1 else 'parts'} of the mesh removed, floating or tiny"
        )
    return np.asarray(kept)


def _is_closed(corners: Faces) -> bool:
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    return bool((counts == 2).all())


def _outward(
    vertices: Points, faces: Faces, welded: NDArray[np.int64], name: str, notice: Callable[[str], None]
) -> Faces:
    """``faces`` all oriented outward."""
    places = np.zeros((int(welded.max()) + 1, 3))
    places[welded] = vertices
    body = trimesh.Trimesh(places, welded[faces], process=False)
    before = np.asarray(body.faces).copy()
    trimesh.repair.fix_normals(body, multibody=True)
    after = np.asarray(body.faces)
    # A face was flipped if its corners now run the other way round.
    first = np.argmax(after == before[:, :1], axis=1)
    turned = after[np.arange(len(after)), (first + 1) % 3] != before[:, 1]
    if turned.any():
        if not turned.all():
            notice(f"{name}: {int(turned.sum())} faces of the mesh faced inward; they are flipped")
        faces = faces.copy()
        faces[turned] = faces[turned][:, ::-1]
    return faces


def _joined(vertices: Points, faces: Faces, welded: NDArray[np.int64]) -> tuple[Points, Faces, NDArray[np.int64]]:
    """Vertices (W, 3), faces (T, 3) and the vertex that each of the W was: split at sharp edges alone.

    STL gives each face corners of its own; light and texture would begin and end with single faces.
    """
    places = np.zeros((int(welded.max()) + 1, 3))
    places[welded] = vertices
    body = trimesh.Trimesh(places, welded[faces], process=False)
    pairs = np.asarray(body.face_adjacency)[np.asarray(body.face_adjacency_angles) < SHARP]
    count = len(faces)
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
    side = sparse.csgraph.connected_components(links, directed=False)[1].astype(np.int64)
    keys = (welded[faces] * count + side[:, None]).reshape(-1)
    _, first, renumbered = np.unique(keys, return_index=True, return_inverse=True)
    source = faces.reshape(-1)[first]
    return vertices[source], renumbered.reshape(-1, 3).astype(np.int64), source


def _enclosed(surface: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (x, y, z) of the surface, and those enclosed by it in at least five of the six directions."""
    blocked = np.zeros(surface.shape, dtype=np.int8)
    for axis in range(3):
        blocked += np.logical_or.accumulate(surface, axis=axis)
        blocked += np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis=axis), axis)
    return np.asarray(surface | (blocked >= 5))


def _closed_volume(
    vertices: Points,
    faces: Faces,
    colours: NDArray[np.float64] | None,
    size: float,
    name: str,
    notice: Callable[[str], None],
) -> RepairedMesh:
    """The mesh as a volume with surface holes closed, smoothed; thin sheets get a thickness."""
    notice(
        f"{name}: the mesh is not closed; it was closed as a volume of {VOXELS} cells along its largest side. Finer "
        "detail is lost, and hollows that open to one side are filled: close it by hand if that matters (in Blender: "
        "Mesh > Clean Up > Fill Holes)"
    )
    grid = trimesh.Trimesh(vertices, faces, process=False).voxelized(size / VOXELS)
    volume = np.pad(_enclosed(np.asarray(grid.matrix)), 1)
    points, corners, _, _ = marching_cubes(volume.astype(np.float32), level=0.5)
    points = (points - 1) @ np.asarray(grid.transform)[:3, :3].T + np.asarray(grid.transform)[:3, 3]
    body = trimesh.Trimesh(points, corners, process=False)
    trimesh.smoothing.filter_taubin(body, iterations=8)
    parts = sorted(body.split(only_watertight=False), key=lambda part: -part.area)
    body = parts[0] if parts else body
    trimesh.repair.fix_normals(body)
    found = np.asarray(body.vertices, dtype=np.float64)
    taken = None if colours is None else colours[cKDTree(vertices).query(found)[1]]
    return RepairedMesh(found, np.asarray(body.faces, dtype=np.int64), None, None, taken)
