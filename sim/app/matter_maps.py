# SPDX-License-Identifier: MIT
"""Factors on stiffness and density of each particle, from weights painted on a mesh or in a picture laid on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide_to_size
from trimesh.triangles import closest_point, points_to_barycentric

from ..errors import InputError
from ..importers.image_masks import read_grey_image
from ..npz import read_npz
from ..scene.folder import Scene
from ..scene.meshes import MAX_MESH_BYTES, ObjectMesh, read_mesh
from ..scene.model import FactorMap, SceneObject

Array = NDArray[np.float64]

PICTURES = (".png", ".jpg", ".jpeg")

ROUNDED = 1e-3
"""Distance outside the range 0 to 1 that weights may have, as programs store them; they are cut off."""


def nearest_on_surface(mesh: ObjectMesh, places: Array, spacing: float) -> tuple[NDArray[np.int64], Array]:
    """Return the triangle (N,) of ``mesh`` nearest to each of ``places`` (N, 3), and the nearest point (N, 3) on it.

    Pieces of the surface ``spacing`` across tell which triangle is nearest, so that it may be one about as near.
    """
    points, faces, owners = subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=max(spacing, 1e-9), max_iter=24, return_index=True
    )
    nearest = owners[cKDTree(points[faces].mean(axis=1)).query(places)[1]]
    return nearest, closest_point(mesh.vertices[mesh.faces[nearest]], places)


def factors_of(
    folder: Scene, item: SceneObject, mesh: ObjectMesh, factors: FactorMap, places: Array, spacing: float
) -> Array:
    """Return the factor (N,) of matter of ``item`` at ``places`` (N, 3), world metres.

    spacing: of the particles, m. Raises InputError, with object and file, where weights or texture coordinates are
    missing or do not fit the mesh.
    """
    triangles, points = nearest_on_surface(mesh, places, spacing)
    shares = points_to_barycentric(mesh.vertices[mesh.faces[triangles]], points)
    # A triangle without area has no such coordinates: its first corner counts.
    shares = np.where(np.isfinite(shares).all(axis=1)[:, None], np.clip(shares, 0.0, 1.0), (1.0, 0.0, 0.0))
    corners = mesh.faces[triangles]
    if factors.file is not None and factors.file.lower().endswith(PICTURES):
        weights = _in_picture(folder, item, factors.file, np.einsum("nc,ncd->nd", shares, _uv(folder, item)[corners]))
    else:
        weights = (shares * _at_vertices(folder, item, factors, len(mesh.vertices))[corners]).sum(axis=1)
    weights = np.clip(weights, 0.0, 1.0)
    return np.asarray(factors.at_zero ** (1.0 - weights) * factors.at_one**weights)


def _at_vertices(folder: Scene, item: SceneObject, factors: FactorMap, count: int) -> Array:
    """Weights (V,) of the vertices."""
    if factors.file is not None:
        where = str(folder.file(factors.file))
        if not where.lower().endswith(".npz"):
            raise InputError(f"{where}: weights are read from {', '.join((*PICTURES, '.npz'))}: save it as one of them")
        found = read_npz(folder.file(factors.file), MAX_MESH_BYTES)
        if "weights" not in found:
            raise InputError(f"{where}: holds {', '.join(sorted(found)) or 'nothing'}: name the array weights")
        values = found["weights"]
    else:
        path = folder.file(item.mesh)
        where = f"{path}: attribute {factors.attribute!r}"
        mesh = read_mesh(path)
        attributes: dict[str, Any] = dict(mesh.vertex_attributes)
        raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
        if raw is not None and getattr(raw, "dtype", None) is not None and raw.dtype.names:
            attributes |= {name: raw[name] for name in raw.dtype.names if name not in ("x", "y", "z")}
        if factors.attribute not in attributes:
            known = ", ".join(sorted(attributes)) or "none"
            raise InputError(f"object {item.name}: {where} is missing; the vertices have {known}: name one of them")
        values = attributes[factors.attribute]
    values = np.asarray(values, dtype=np.float64)
    values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    if values.shape != (count,):
        raise InputError(f"object {item.name}: {where} has shape {values.shape}: give {count} weights, one a vertex")
    if not (np.isfinite(values).all() and values.min() >= -ROUNDED and values.max() <= 1.0 + ROUNDED):
        raise InputError(
            f"object {item.name}: {where} goes from {values.min():g} to {values.max():g}: give weights from 0 to 1; "
            "at_zero and at_one say which factors they mean"
        )
    return values


def _uv(folder: Scene, item: SceneObject) -> Array:
    """Texture coordinates (V, 2) of the vertices, the origin at the bottom left."""
    path = folder.file(item.mesh)
    uv = getattr(read_mesh(path).visual, "uv", None)
    if uv is None:
        raise InputError(
            f"object {item.name}: {path}: has no texture coordinates for a picture of weights: unwrap the mesh and "
            "export it with them as GLB or OBJ, or give weights of its vertices"
        )
    return np.asarray(uv, dtype=np.float64)


def _in_picture(folder: Scene, item: SceneObject, name: str, uv: Array) -> Array:
    """Values (N,) from 0 to 1 of the picture at ``uv`` (N, 2), linear between pixels, repeated beyond its edges."""
    picture = read_grey_image(folder.file(name))
    high = 1.0 if picture.dtype == bool else float(np.iinfo(picture.dtype).max)
    if not np.isfinite(uv).all():
        raise InputError(f"object {item.name}: its texture coordinates are not finite: unwrap the mesh again")
    uv = np.where((uv >= 0.0) & (uv <= 1.0), uv, uv % 1.0)
    rows, columns = (1.0 - uv[:, 1]) * picture.shape[0] - 0.5, uv[:, 0] * picture.shape[1] - 0.5
    return np.asarray(map_coordinates(picture / high, [rows, columns], order=1, mode="nearest"))
