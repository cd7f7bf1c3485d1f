# SPDX-License-Identifier: MIT
"""Mesh files of a scene in world metres, in the vertex order that caches and skinning rely on; vertex tracks."""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .folder import Scene
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
    in_file: (V, 3) the vertices in the mesh file's coordinates.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    in_file: NDArray[np.float64]


def load_object_mesh(folder: Scene, item: SceneObject) -> ObjectMesh:
    """Return the mesh of ``item`` in world metres. Raises InputError as ``read_mesh`` does."""
    mesh = read_mesh(folder.file(item.mesh))
    matrix = np.asarray(item.world_from_mesh)
    in_file = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = in_file @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1].copy()
    return ObjectMesh(vertices=vertices, faces=faces, in_file=in_file)


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Return one mesh file as it is: no vertex is merged, moved or reordered.

    Raises InputError when the file is missing, too large, of an unknown format, unreadable, holds no triangles or
    coordinates that are not finite, or when trimesh is not installed.
    """
    # Imported late: it takes a tenth of a second, and Blender draws its panels without reading a mesh.
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
        raise InputError(f"{path}: does not fit in memory, or its header is damaged; export it again") from None
    # Third-party parsers raise anything on malformed input (struct.error, KeyError, …).
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
        raise InputError(f"{path}: has faces with vertex indices out of range; export it again")
    return mesh


MAX_TRACK_BYTES = 2**30
"""Largest array that is read, as float64; larger ones are refused unread."""


def load_vertex_track(path: Path, vertex_count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ``times`` (K,) in s and ``vertices`` (K, V, 3) in metres of the file ``path``; V must be ``vertex_count``.

    Raises InputError when the file is missing, damaged, of another shape or larger than ``MAX_BYTES``, holds anything
    but numbers, or its times do not rise. Nothing is unpickled.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            times = _read_track_array(archive, "times", path)
            vertices = _read_track_array(archive, "vertices", path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; restore it or remove vertices_file") from None
    except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, struct.error) as error:
        raise InputError(f"{path}: not readable as .npz ({error}); write it again with numpy.savez") from None
    if times.ndim != 1 or len(times) == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise InputError(f"{path}: times has shape {times.shape}: give (K,) finite seconds in rising order, each once")
    if vertices.shape != (len(times), vertex_count, 3):
        raise InputError(
            f"{path}: vertices has shape {vertices.shape}: give {(len(times), vertex_count, 3)}, a row a time and the "
            "vertices of the object's mesh file in their order"
        )
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: vertices are not finite: remove NaN and infinite numbers")
    return times, vertices


def _read_track_array(archive: zipfile.ZipFile, name: str, path: Path) -> NDArray[np.float64]:
    try:
        with archive.open(f"{name}.npy") as file:
            shape = _checked_shape(file, name, path)
        with archive.open(f"{name}.npy") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    except KeyError:
        raise InputError(f"{path}: holds no array {name!r}; write times and vertices") from None
    if array.shape != shape:
        raise InputError(f"{path}: {name} has shape {array.shape}, its header says {shape}; write it again")
    return np.ascontiguousarray(array, dtype=np.float64)


def _checked_shape(file: IO[bytes], name: str, path: Path) -> tuple[int, ...]:
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise InputError(f"{path}: {name} is of .npy version {version}; write it again with numpy.savez")
    if dtype.kind not in "fiu":
        raise InputError(f"{path}: {name} holds {dtype}; give numbers")
    if any(n < 0 for n in shape) or math.prod(shape) * max(8, dtype.itemsize) > MAX_TRACK_BYTES:
        raise InputError(
            f"{path}: {name} has shape {shape}, more than {MAX_TRACK_BYTES >> 20} MiB; give fewer keyframes"
        )
    return tuple(shape)
