# SPDX-License-Identifier: MIT
"""Files of torn skins in a bake: triangles, walls, and what each vertex and corner takes from the object's mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..errors import InputError
from ..npz import read_npz
from .pc2 import MAX_VERTICES

MOST_BYTES = 2**32
FIELDS = ("faces", "inside", "source", "corners", "parents", "weights", "first")


@dataclass(frozen=True, eq=False)
class TornSkin:
    """Topology of a torn skin; its first V vertices are those of the object's mesh, T triangles are of the skin itself.

    faces: (T + W, 3) vertices, walls last. inside: (T + W,) whether a triangle is a wall. source: (T + W,) triangle of
    the object's mesh that each was cut from, or for walls is nearest to; corners: (T + W, 3, 3) barycentric coordinates
    in it of each corner, for what the mesh has by corner, such as texture coordinates. parents, weights: (V', 3) three
    vertices of the mesh, and shares, that each vertex gets what belongs to vertices from. first: sample in which the
    first crack opens.
    """

    faces: NDArray[np.int32]
    inside: NDArray[np.bool_]
    source: NDArray[np.int32]
    corners: NDArray[np.float32]
    parents: NDArray[np.int32]
    weights: NDArray[np.float32]
    first: int


def write_torn_skin(path: Path, skin: TornSkin) -> None:
    """Write ``skin``, whole or not at all. Raises InputError when it cannot be written."""
    with replacing(path) as partial:
        arrays: dict[str, Any] = {name: np.asarray(getattr(skin, name)) for name in FIELDS}
        np.savez(partial, **arrays)


def read_torn_skin(path: Path, vertices: int, triangles: int) -> TornSkin:
    """Return the torn skin of a mesh with so many ``vertices`` and ``triangles``.

    Raises InputError when the file is missing, damaged, or of another mesh.
    """
    data = read_npz(path, MOST_BYTES)
    missing = [name for name in FIELDS if name not in data]
    if missing:
        raise InputError(f"{path}: holds no array {missing[0]!r}; bake again")
    faces, inside, source = (np.asarray(data[name]) for name in FIELDS[:3])
    corners, parents, weights = (np.asarray(data[name]) for name in FIELDS[3:6])
    first = np.asarray(data["first"])
    count, total = len(np.atleast_1d(faces)), len(np.atleast_1d(parents))
    shapes = ((faces, (count, 3)), (inside, (count,)), (source, (count,)), (corners, (count, 3, 3)))
    good = all(array.shape == shape for array, shape in (*shapes, (parents, (total, 3)), (weights, (total, 3))))
    good = good and first.shape == () and all(a.dtype.kind in "iu" for a in (faces, source, parents, first))
    good = good and inside.dtype.kind == "b" and corners.dtype.kind == weights.dtype.kind == "f"
    good = good and count > 0 and vertices <= total <= MAX_VERTICES
    bounds = ((faces, total), (source, triangles), (parents, vertices), (first, 2**31))
    good = good and all(int(array.min()) >= 0 and int(array.max()) < limit for array, limit in bounds)
    if not (good and np.isfinite(corners).all() and np.isfinite(weights).all()):
        raise InputError(f"{path}: is no torn skin of a mesh with {vertices} vertices; bake again")
    return TornSkin(
        faces=faces.astype(np.int32),
        inside=inside,
        source=source.astype(np.int32),
        corners=corners.astype(np.float32),
        parents=parents.astype(np.int32),
        weights=weights.astype(np.float32),
        first=int(first),
    )
