# SPDX-License-Identifier: MIT
"""Mesh files of a scene in world metres, in the vertex order that caches and skinning rely on; vertex tracks."""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import PICTURE_FORMATS, read_bytes
from ..npz import array_body, array_header, open_npz
from .folder import Scene, inside
from .model import SceneObject

if TYPE_CHECKING:
    import trimesh


MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
MAX_MESH_BYTES = 512 * 2**20
MAX_UNPACKED_BYTES = 4 * MAX_MESH_BYTES
"""Of a glTF's views, numbers and instances together: parts of a small file may overlap, and be used again and again."""
MAX_NODES, MAX_COMMAS = 10_000, 5_000_000
"""Places in a glTF's scene, and commas in its description, which says how much memory that takes."""


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
    mesh = read_mesh(folder.file(item.mesh), textures=False)
    matrix = np.asarray(item.world_from_mesh)
    in_file = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = in_file @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1].copy()
    return ObjectMesh(vertices=vertices, faces=faces, in_file=in_file)


def read_mesh(path: Path, *, textures: bool = True) -> trimesh.Trimesh:
    """Return one mesh file as it is: no vertex is merged, moved or reordered.

    textures: False leaves pictures unread, and decodes none: 4096 x 4096 pixels take up to 290 MiB. Vertices and faces
    are the same; ``visual`` is then of no use.

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
        content = read_bytes(path, MAX_MESH_BYTES, what="mesh")
        kind, beside = path.suffix.lower().removeprefix("."), _files_beside(path.parent, pictures=textures)
        options: dict[str, Any] = {}
        if kind in ("glb", "gltf"):
            _require_bounded(content, path)
            # Of an OBJ, trimesh calls the parts by their materials: there, only the pictures are missing.
            options = {"skip_materials": not textures}
        with _without_postscript():
            mesh = trimesh.load(
                io.BytesIO(content), file_type=kind, resolver=beside, process=False, force="mesh", **options
            )
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such mesh; restore it or reconstruct the scene again") from None
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory, or its header is damaged; export it again") from None
    # Third-party parsers raise anything on malformed input (struct.error, KeyError, …).
    except Exception as error:
        raise InputError(f"{path}: not a readable mesh ({type(error).__name__}: {error}); export it again") from error
    return _checked_mesh(mesh, path)


_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_NUMBER_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2}
_GLB = struct.Struct("<4sIII4s")


def _require_bounded(content: bytes, path: Path) -> None:
    """Raise InputError for a glTF that unpacks to more than ``MAX_UNPACKED_BYTES``, before trimesh does it.

    What is no glTF is left to trimesh, which says so. Its description is the first part of a GLB, as trimesh takes it,
    and not the first of the right type, as ``glb.glb_chunks`` does.
    """
    if content[:4] == b"glTF" and len(content) >= _GLB.size:
        content = content[_GLB.size : _GLB.size + _GLB.unpack_from(content)[3]]
    if content.count(b",") > MAX_COMMAS:
        raise InputError(f"{path}: its description has too many parts to be one mesh; export it again")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return
    nodes = _listed(document, "nodes")
    if len(nodes) > MAX_NODES:
        raise InputError(f"{path}: has {len(nodes)} nodes, more than {MAX_NODES}; join its meshes and export it again")
    views = sum(_count(view.get("byteLength")) for view in _listed(document, "bufferViews"))
    stored = [
        _count(item.get("count"))
        * _NUMBERS.get(str(item.get("type")), 1)
        * _NUMBER_BYTES.get(_count(item.get("componentType")), 4)
        for item in _listed(document, "accessors")
    ]

    def bytes_of(index: Any) -> int:
        return stored[index] if isinstance(index, int) and 0 <= index < len(stored) else 0

    meshes = []
    for mesh in _listed(document, "meshes"):
        parts = _listed(mesh, "primitives")
        named = [[*_values(part.get("attributes")), part.get("indices")] for part in parts]
        meshes.append(sum(bytes_of(index) for indices in named for index in indices))
    places = (node.get("mesh") for node in nodes)
    placed = sum(meshes[index] for index in places if isinstance(index, int) and 0 <= index < len(meshes))
    if (total := views + sum(stored) + sum(meshes) + placed) > MAX_UNPACKED_BYTES:
        raise InputError(
            f"{path}: unpacks to {total / 2**30:.3g} GiB, more than {MAX_UNPACKED_BYTES >> 30} GiB; reduce the mesh "
            "and export it again"
        )


def _listed(value: Any, kind: str) -> list[dict[str, Any]]:
    """Return the entries of the list ``kind`` of a damaged document, no objects as empty ones, so that places stay."""
    found = value.get(kind) if isinstance(value, dict) else None
    return [item if isinstance(item, dict) else {} for item in found] if isinstance(found, list) else []


def _values(value: Any) -> list[Any]:
    return list(value.values()) if isinstance(value, dict) else []


def _count(value: Any) -> int:
    return value if isinstance(value, int) and value > 0 else 0


_pillow = threading.RLock()


@contextlib.contextmanager
def _without_postscript() -> Iterator[None]:
    """Keep Pillow, which trimesh hands a mesh's textures whatever they are, from starting Ghostscript."""
    try:
        from PIL import EpsImagePlugin
    except ModuleNotFoundError:
        # Then textures are not decoded at all.
        yield
        return
    with _pillow:
        former = EpsImagePlugin.gs_binary
        EpsImagePlugin.gs_binary = False
        try:
            yield
        finally:
            EpsImagePlugin.gs_binary = former


def _check_textures(mesh: Any, path: Path) -> None:
    """Raise InputError for a texture of a format that none of ours is: Pillow decodes it only where it is used."""
    material = getattr(getattr(mesh, "visual", None), "material", None)
    for part in (material, *(getattr(material, "materials", None) or ())):
        for value in {**getattr(part, "_data", {}), **getattr(part, "__dict__", {})}.values():
            found = getattr(value, "format", None)
            if isinstance(found, str) and found not in (*PICTURE_FORMATS, "MPO"):
                raise InputError(f"{path}: has a texture as {found}; export it again with PNG or JPEG textures")


def _checked_mesh(mesh: Any, path: Path) -> trimesh.Trimesh:
    import trimesh

    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: holds no triangles; export it again as a triangle mesh")
    if np.ndim(mesh.vertices) != 2 or np.shape(mesh.vertices)[1] != 3:
        raise InputError(f"{path}: has vertices without three coordinates; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: has vertices that are not finite; export it again")
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise InputError(f"{path}: has faces with vertex indices out of range; export it again")
    _check_textures(mesh, path)
    return mesh


PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".ppm", ".tga")
"""Endings of textures beside a mesh; one that is called otherwise is read, needed or not."""


def _files_beside(folder: Path, *, pictures: bool = True) -> Any:
    """Return trimesh's way to the files that a mesh names (buffers, materials, textures): regular files in ``folder``
    or below, whatever the version of trimesh itself would open. pictures: False hides an OBJ's and a PLY's.
    """
    from trimesh.resolvers import Resolver

    class Beside(Resolver):  # type: ignore[misc]
        def __init__(self) -> None:
            self.folder = folder
            self.left = 2 * MAX_MESH_BYTES

        def get(self, name: str) -> bytes:
            wanted = unquote(str(name)).replace("\\", "/").removeprefix("./").strip()
            if not pictures and wanted.lower().endswith(PICTURE_SUFFIXES):
                raise FileNotFoundError(wanted)
            # As programs on other machines wrote it, with folders that are not here: the file of that name beside.
            for candidate in (wanted, wanted.rpartition("/")[2]):
                with contextlib.suppress(InputError, FileNotFoundError):
                    most = min(MAX_MESH_BYTES, self.left)
                    content = read_bytes(inside(folder, candidate), most, what="part of a mesh", folder=folder)
                    # One file may be named any number of times.
                    self.left -= len(content)
                    return content
            raise FileNotFoundError(wanted)

        def keys(self) -> tuple[str, ...]:
            return ()

        def write(self, name: str, data: bytes) -> None:
            raise InputError(f"{folder}/{name}: is not written while a mesh is read")

        def namespaced(self, namespace: str) -> Any:
            return _files_beside(inside(folder, namespace), pictures=pictures)

    return Beside()


MAX_TRACK_BYTES = 2**30
"""Largest array that is read, as float64; larger ones are refused unread."""


def load_vertex_track(path: Path, vertex_count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ``times`` (K,) in s and ``vertices`` (K, V, 3) in metres of the file ``path``; V must be ``vertex_count``.

    Raises InputError when the file is missing, damaged, of another shape or larger than ``MAX_BYTES``, holds anything
    but numbers, or its times do not rise. Nothing is unpickled.
    """
    with open_npz(path, 2 * MAX_TRACK_BYTES) as archive:
        times = _read_track_array(archive, "times", path)
        vertices = _read_track_array(archive, "vertices", path)
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
    where = f"{path}: {name}"
    try:
        with archive.open(f"{name}.npy") as file:
            header = array_header(file, where)
            if header.dtype.kind not in "fiu":
                raise InputError(f"{where} holds {header.dtype}; give numbers")
            if math.prod(header.shape) * max(8, header.dtype.itemsize) > MAX_TRACK_BYTES:
                raise InputError(
                    f"{where} has shape {header.shape}, more than {MAX_TRACK_BYTES >> 20} MiB; give fewer keyframes"
                )
            array = array_body(file, header, where)
    except KeyError:
        raise InputError(f"{path}: holds no array {name!r}; write times and vertices") from None
    return np.ascontiguousarray(array, dtype=np.float64)
