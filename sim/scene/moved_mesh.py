# SPDX-License-Identifier: MIT
"""A mesh file again with its vertices in other places: same number and order, same faces, same texture."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing, write_bytes
from ..errors import InputError
from .glb import accessor_values, glb_chunks, listed_item, mesh_instances, read_textured_mesh, transformed
from .meshes import read_mesh

Array = NDArray[np.float64]

_FLOAT, _TRIANGLES = 5126, 4
_GARBAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, struct.error)
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
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
"""Share of a mesh's size by which vertices may differ after writing and reading: coordinates of files have 32 bits."""


def moved_suffix(source: Path) -> str:
    """Suffix of the file that ``write_moved_mesh`` makes of ``source``: formats that lose textures become GLB."""
    suffix = source.suffix.lower()
    return suffix if suffix in (".glb", ".ply", ".stl") else ".glb"


def write_moved_mesh(source: Path, target: Path, vertices: Array, faces: NDArray[np.integer]) -> None:
    """Write the mesh file ``source`` as ``target`` with other ``vertices`` (V, 3), in the file's own coordinates.

    A GLB with one mesh, and a binary PLY without normals, are copied byte by byte but for places (and a GLB's
    normals); others are written anew from what ``read_mesh`` finds in them. faces: (T, 3), for the normals. target:
    with the suffix of ``moved_suffix``.

    Raises InputError when ``source`` cannot be read, has another number of vertices, or when what was written does not
    read back with its vertices where they were put.
    """
    kind = source.suffix.lower()
    moved = None
    if kind in (".glb", ".ply"):
        # Read before, so that what is missing or too large is said as everywhere.
        read_textured_mesh(source)
        content = source.read_bytes()
        moved = _glb_moved(content, vertices, faces) if kind == ".glb" else _ply_moved(content, vertices)
    if moved is not None:
        write_bytes(target, moved)
    else:
        mesh = read_mesh(source)
        if len(mesh.vertices) != len(vertices):
            raise InputError(f"{source}: has {len(mesh.vertices)} vertices: {len(vertices)} places were given")
        mesh.vertices = vertices
        with replacing(target) as partial:
            mesh.export(partial)
    found = read_textured_mesh(target).vertices
    size = float(np.abs(vertices).max())
    if found.shape != vertices.shape or float(np.abs(found - vertices).max()) > AGREES * size:
        raise InputError(f"{source}: its vertices cannot be moved in a file of this kind; export it as GLB")


def _glb_moved(content: bytes, vertices: Array, faces: NDArray[np.integer]) -> bytes | None:
    """None where the file is built otherwise than expected: several meshes, places shared or not of 32 bits."""
    try:
        document, binary = glb_chunks(content)
        instances = mesh_instances(document)
        if document.get("extensionsRequired") or len(instances) != 1:
            return None
        index, matrix = instances[0]
        primitives = listed_item(document, "meshes", index)["primitives"]
        if len(primitives) != 1 or primitives[0].get("mode", _TRIANGLES) != _TRIANGLES:
            return None
        attributes = primitives[0]["attributes"]
        buffer = bytearray(binary)
        if "TANGENT" in attributes or primitives[0].get("targets"):
            return None
        # Along a texture's seam there are two vertices in one place; they stay in one, to the last bit.
        before = accessor_values(document, binary, attributes["POSITION"], 3)
        _, first, place = np.unique(before, axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        if len(place) != len(vertices):
            return None
        local = transformed(vertices[first][place], np.linalg.inv(matrix))
        if not _overwrite(document, buffer, attributes["POSITION"], local):
            return None
        accessor = listed_item(document, "accessors", attributes["POSITION"])
        written = local.astype("<f4").astype(np.float64)
        accessor["min"], accessor["max"] = written.min(axis=0).tolist(), written.max(axis=0).tolist()
        if "NORMAL" in attributes:
            turned = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
            if not _overwrite(document, buffer, attributes["NORMAL"], _normals(local, turned, place)):
                return None
    except _GARBAGE:
        return None
    text = json.dumps(document, ensure_ascii=False, allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    data = bytes(buffer) + bytes(-len(buffer) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    return head + struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(data), _BINARY) + data


def _overwrite(document: dict[str, Any], buffer: bytearray, index: Any, values: Array) -> bool:
    """Put ``values`` (V, 3) where an accessor has its own; whether it could be done."""
    accessor = listed_item(document, "accessors", index)
    plain = accessor["componentType"] == _FLOAT and accessor["type"] == "VEC3" and "sparse" not in accessor
    if not plain or accessor["count"] != len(values):
        return False
    view = listed_item(document, "bufferViews", accessor["bufferView"])
    if view["buffer"] != 0 or "uri" in listed_item(document, "buffers", 0):
        return False
    stride = view.get("byteStride", 0) or 12
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if start < 0 or stride < 12 or start + (len(values) - 1) * stride + 12 > len(buffer):
        return False
    np.ndarray((len(values), 3), "<f4", buffer, offset=start, strides=(stride, 4))[:] = values
    return True


def _ply_moved(content: bytes, vertices: Array) -> bytes | None:
    """None where it is text, or its vertices have lists or normals, which would no longer be right."""
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
    """Unit normals (V, 3), weighted by area; the same for vertices of the same number in ``place`` (V,)."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((int(place.max()) + 1, 3))
    np.add.at(total, place[faces].ravel(), np.repeat(across, 3, axis=0))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))
    return np.asarray(unit[place])
