# SPDX-License-Identifier: MIT
"""Mesh files of a scene, in world metres, with the vertex order that caches and skinning rely on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .folder import SceneFolder
from .model import SceneObject

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
MAX_MESH_BYTES = 512 * 2**20


@dataclass(frozen=True, eq=False)
class ObjectMesh:
    """A triangle mesh.

    vertices: (V, 3) world metres.
    faces: (T, 3) vertex indices, counter-clockwise from outside in the world, also where it is mirrored there.
    in_file: (V, 3) the vertices as the mesh file has them.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    in_file: NDArray[np.float64]


def load_object_mesh(folder: SceneFolder, item: SceneObject) -> ObjectMesh:
    """The mesh of ``item`` in world metres. Raises InputError as ``read_mesh`` does."""
    mesh = read_mesh(folder.file(item.mesh))
    matrix = np.asarray(item.world_from_mesh)
    in_file = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = in_file @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1].copy()
    return ObjectMesh(vertices=vertices, faces=faces, in_file=in_file)


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read one mesh file as it is: no vertex is merged, moved or reordered.

    Raises InputError when the file is missing, too large, of an unknown kind, not readable, holds no triangle or
    coordinates that are not finite; and where trimesh, which reads them, is missing.
    """
    # Late: Blender draws its panels without ever reading a mesh, and this takes a tenth of a second.
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise InputError(
            f"{path}: cannot be read without the Python package {error.name}; install it, or give a GLB with one mesh"
        ) from None
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: mesh files are {', '.join(MESH_SUFFIXES)}, not {path.suffix or 'without suffix'!r}")
    try:
        size = path.stat().st_size
        if size > MAX_MESH_BYTES:
            raise InputError(f"{path}: {size >> 20} MiB is more than the {MAX_MESH_BYTES >> 20} MiB a mesh may have")
        mesh = trimesh.load(path, process=False, force="mesh")
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such mesh; restore it or reconstruct the scene again") from None
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory, or its counts are garbage; export it again") from None
    # Parsers of foreign formats fail in whatever way the garbage leads them to (struct.error, KeyError, …).
    except Exception as error:
        raise InputError(f"{path}: not a readable mesh ({type(error).__name__}: {error}); export it again") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: holds no triangles; export it again as a triangle mesh")
    if np.ndim(mesh.vertices) != 2 or np.shape(mesh.vertices)[1] != 3:
        raise InputError(f"{path}: has vertices without three coordinates; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: has vertices that are not finite; export it again")
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise InputError(f"{path}: has faces that name vertices it does not hold; export it again")
    return mesh
