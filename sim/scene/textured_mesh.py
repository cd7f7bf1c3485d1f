# SPDX-License-Identifier: MIT
"""Textured meshes without an image library: read a GLB, and rewrite a mesh file with moved vertices.

A GLB with one primitive, as reconstruction writes it, is read with numpy alone and keeps its image bytes. Any other
mesh goes through ``read_mesh`` and loses its texture. Vertex order is that of ``read_mesh``. Rewriting keeps vertex
count and order, faces and texture.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing, write_bytes
from ..errors import InputError
from ..files import read_bytes
from .glb import (
    DAMAGED,
    WIDTHS,
    accessor_values,
    glb_chunks,
    glb_content,
    listed_item,
    only_primitive,
    overwrite_accessor,
    view_bytes,
)
from .meshes import MAX_MESH_BYTES, read_mesh

Array = NDArray[np.float64]
PICTURES = ("image/png", "image/jpeg")


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh in its file's own coordinates.

    vertices: (V, 3); faces: (T, 3) vertex indices; uv: (V, 2), the origin at the bottom left, or None.
    picture: bytes of a PNG or JPEG file, the base colour, or None.
    colours: (V, 3) linear, at the vertices, or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    picture: bytes | None = None
    colours: NDArray[np.float64] | None = None


def read_textured_mesh(path: Path) -> TexturedMesh:
    """Return the mesh at ``path``, with its texture if it is a GLB with one primitive.

    Raises InputError when the file is missing, too large, unreadable, holds no triangles or coordinates that are not
    finite, or needs a library that is not installed.
    """
    if path.suffix.lower() == ".glb":
        found = _read_glb(path)
        if found is not None:
            return found
    mesh = read_mesh(path)
    return TexturedMesh(vertices=np.asarray(mesh.vertices, dtype=np.float64), faces=np.asarray(mesh.faces))


def texture_pixels(path: Path) -> int:
    """Return how many pixels the texture of the mesh file ``path`` has; 0 without one, or where that is not known."""
    from PIL import Image

    try:
        mesh = _read_glb(path) if path.suffix.lower() == ".glb" else None
        if mesh is None or mesh.picture is None:
            return 0
        with Image.open(io.BytesIO(mesh.picture), formats=("PNG", "JPEG")) as image:
            return image.width * image.height
    except (InputError, OSError, ValueError, Image.DecompressionBombError):
        return 0


def _read_glb(path: Path) -> TexturedMesh | None:
    """Return the mesh, or None for a GLB with features that this reader does not support."""
    try:
        content = read_bytes(path, MAX_MESH_BYTES, what="mesh")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such mesh; restore it or reconstruct the scene again") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    try:
        return _parse(content)
    except DAMAGED as error:
        raise InputError(f"{path}: not a readable mesh ({type(error).__name__}: {error}); export it again") from None


def _parse(content: bytes) -> TexturedMesh | None:
    document, binary = glb_chunks(content)
    found = only_primitive(document)
    if found is None:
        return None
    primitive, matrix = found
    attributes = primitive["attributes"]
    vertices = accessor_values(document, binary, attributes["POSITION"], 3).astype(np.float64)
    vertices = transformed(vertices, matrix)
    if not len(vertices) or not np.isfinite(vertices).all():
        raise ValueError("vertices that are not finite, or none")
    if "indices" in primitive:
        index = accessor_values(document, binary, primitive["indices"], 1).astype(np.int64).ravel()
    else:
        index = np.arange(len(vertices))
    if not len(index) or len(index) % 3 or index.max() >= len(vertices):
        raise ValueError("faces with vertex indices out of range, or none")
    uv, picture = _texture(document, binary, primitive, len(vertices))
    faces = index.reshape(-1, 3)
    # As in trimesh: a mirrored node keeps its outside.
    faces = faces[:, ::-1].copy() if np.linalg.det(matrix[:3, :3]) < 0 else faces
    colours = _colours(document, binary, attributes, len(vertices))
    return TexturedMesh(vertices=vertices, faces=faces, uv=uv, picture=picture, colours=colours)


def _colours(
    document: dict[str, Any], binary: bytes, attributes: dict[str, Any], count: int
) -> NDArray[np.float64] | None:
    if "COLOR_0" not in attributes:
        return None
    width = WIDTHS[listed_item(document, "accessors", attributes["COLOR_0"])["type"]]
    colours = accessor_values(document, binary, attributes["COLOR_0"], width).astype(np.float64)
    if width < 3 or len(colours) != count or not np.isfinite(colours).all():
        raise ValueError("colours that do not fit its vertices")
    return colours[:, :3]


def _texture(
    document: dict[str, Any], binary: bytes, primitive: dict[str, Any], count: int
) -> tuple[NDArray[np.float64] | None, bytes | None]:
    """Return texture coordinates and image bytes, or (None, None) if either is missing or unsupported."""
    if "material" not in primitive or "TEXCOORD_0" not in primitive["attributes"]:
        return None, None
    material = listed_item(document, "materials", primitive["material"])
    slot = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if slot is None or slot.get("texCoord", 0) != 0:
        return None, None
    image = listed_item(document, "images", listed_item(document, "textures", slot["index"]).get("source"))
    if image.get("mimeType") not in PICTURES or "bufferView" not in image:
        return None, None
    uv = accessor_values(document, binary, primitive["attributes"]["TEXCOORD_0"], 2).astype(np.float64)
    if len(uv) != count or not np.isfinite(uv).all() or not math.isfinite(float(np.abs(uv).max())):
        raise ValueError("texture coordinates that do not fit its vertices")
    return np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), view_bytes(document, binary, image["bufferView"])[0]


def transformed(points: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``points`` (N, 3) under the affine ``matrix`` (4, 4), equal points to equal bits.

    A matrix product may round its last rows differently, and a mesh whose seams no longer coincide is open.
    """
    columns = np.ascontiguousarray(matrix[:3, :3].T)
    return np.asarray(
        points[:, :1] * columns[0] + points[:, 1:2] * columns[1] + points[:, 2:3] * columns[2] + matrix[:3, 3]
    )


_PLY_START = b"ply\nformat binary_little_endian 1.0\n"
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_MOST_HEADER_BYTES = 65_536

AGREES = 1e-5
"""Tolerance of vertices after writing and reading, over the mesh's size: files store 32-bit coordinates."""


def moved_suffix(source: Path) -> str:
    """Return the suffix that ``write_moved_mesh`` gives its copy of ``source``: formats without textures become GLB."""
    suffix = source.suffix.lower()
    return suffix if suffix in (".glb", ".ply", ".stl") else ".glb"


def write_moved_mesh(source: Path, target: Path, vertices: Array, faces: NDArray[np.integer]) -> None:
    """Write the mesh file ``source`` as ``target`` with other ``vertices`` (V, 3), in the file's own coordinates.

    A GLB with one mesh, and a binary PLY without normals, are copied byte by byte except for positions (and a GLB's
    normals); others are exported anew from ``read_mesh``. faces: (T, 3), for the normals. target: with the suffix of
    ``moved_suffix``.

    Raises InputError when ``source`` cannot be read, has another vertex count, or when ``target`` does not read back
    with the given vertices.
    """
    kind = source.suffix.lower()
    moved = None
    if kind in (".glb", ".ply"):
        # Read first, for the usual errors about missing and oversized files.
        read_textured_mesh(source)
        content = read_bytes(source, MAX_MESH_BYTES, what="mesh")
        moved = _glb_moved(content, vertices, faces) if kind == ".glb" else _ply_moved(content, vertices)
    if moved is not None:
        write_bytes(target, moved)
    else:
        mesh = read_mesh(source)
        if len(mesh.vertices) != len(vertices):
            raise InputError(f"{source}: has {len(mesh.vertices)} vertices, but {len(vertices)} positions were given")
        mesh.vertices = vertices
        with replacing(target) as partial:
            mesh.export(partial)
    found = read_textured_mesh(target).vertices
    size = float(np.abs(vertices).max())
    if found.shape != vertices.shape or float(np.abs(found - vertices).max()) > AGREES * size:
        raise InputError(f"{source}: its vertices cannot be moved in a file of this kind; export it as GLB")


def _glb_moved(content: bytes, vertices: Array, faces: NDArray[np.integer]) -> bytes | None:
    """Return the file's bytes, or None for an unsupported layout: several meshes, positions shared or not 32-bit."""
    try:
        document, binary = glb_chunks(content)
        found = only_primitive(document)
        if found is None:
            return None
        primitive, matrix = found
        attributes = primitive["attributes"]
        buffer = bytearray(binary)
        if "TANGENT" in attributes or primitive.get("targets"):
            return None
        # Duplicate vertices along a texture seam stay coincident to the last bit.
        before = accessor_values(document, binary, attributes["POSITION"], 3)
        _, first, place = np.unique(before, axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        if len(place) != len(vertices):
            return None
        local = transformed(vertices[first][place], np.linalg.inv(matrix))
        if not overwrite_accessor(document, buffer, attributes["POSITION"], local):
            return None
        accessor = listed_item(document, "accessors", attributes["POSITION"])
        written = local.astype("<f4").astype(np.float64)
        accessor["min"], accessor["max"] = written.min(axis=0).tolist(), written.max(axis=0).tolist()
        if "NORMAL" in attributes:
            turned = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
            if not overwrite_accessor(document, buffer, attributes["NORMAL"], _normals(local, turned, place)):
                return None
    except DAMAGED:
        return None
    return glb_content(document, bytes(buffer))


def _ply_moved(content: bytes, vertices: Array) -> bytes | None:
    """Return the file's bytes, or None if it is text or its vertices have lists or normals, which would be stale."""
    end = content.find(b"end_header\n", 0, _MOST_HEADER_BYTES)
    if end < 0 or not content.startswith(_PLY_START):
        return None
    lines = [line.split() for line in content[:end].decode("ascii", "replace").splitlines()[2:]]
    words = [line for line in lines if line and line[0] in ("element", "property")]
    if not words or words[0][:2] != ["element", "vertex"] or words[0][2] != str(len(vertices)):
        return None
    fields = []
    for line in words[1:]:
        if line[0] == "element":
            break
        if len(line) != 3 or line[1] not in _PLY_TYPES or line[2] == "nx":
            return None
        fields.append((line[2], _PLY_TYPES[line[1]]))
    try:
        rows = np.frombuffer(content, np.dtype(fields), len(vertices), end + len(b"end_header\n")).copy()
        for axis, name in enumerate("xyz"):
            rows[name] = vertices[:, axis]
    except ValueError:
        return None
    start = end + len(b"end_header\n")
    return content[:start] + rows.tobytes() + content[start + rows.nbytes :]


def _normals(vertices: Array, faces: NDArray[np.integer], place: NDArray[np.integer]) -> Array:
    """Return area-weighted unit normals (V, 3), equal for vertices with the same index in ``place`` (V,)."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((int(place.max()) + 1, 3))
    np.add.at(total, place[faces].ravel(), np.repeat(across, 3, axis=0))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))
    return np.asarray(unit[place])
