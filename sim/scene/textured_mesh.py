# SPDX-License-Identifier: MIT
"""Textured meshes without an image library: read a GLB, and rewrite a mesh file with moved vertices.

A GLB with one primitive, as reconstruction writes it, is read with numpy alone and keeps its image bytes. Any other
mesh goes through ``read_mesh`` and loses its texture. Vertex order is that of ``read_mesh`` (glTF 2.0,
registry.khronos.org/glTF). Rewriting keeps vertex count and order, faces and texture.
"""

from __future__ import annotations

import io
import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing, write_bytes
from ..errors import InputError
from ..files import read_bytes
from .meshes import MAX_MESH_BYTES, MAX_NODES, read_mesh

MAX_JSON_BYTES = 16 * 2**20
PICTURES = ("image/png", "image/jpeg")
_MAGIC, _JSON, _BINARY, _TRIANGLES = b"glTF", b"JSON", b"BIN\0", 4
_COMPONENTS: dict[int, np.dtype[Any]] = {
    5121: np.dtype("u1"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_GARBAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, struct.error, RecursionError)
"""Errors from following references in a damaged file."""


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
    except _GARBAGE as error:
        raise InputError(f"{path}: not a readable mesh ({type(error).__name__}: {error}); export it again") from None


def _parse(content: bytes) -> TexturedMesh | None:
    document, binary = glb_chunks(content)
    found = _only_primitive(document)
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


def _only_primitive(document: dict[str, Any]) -> tuple[dict[str, Any], NDArray[np.float64]] | None:
    """Return the triangles of the file's one mesh, and their transform (4, 4); None for another number of parts."""
    if document.get("extensionsRequired"):
        return None
    instances = mesh_instances(document)
    if len(instances) != 1:
        return None
    index, matrix = instances[0]
    primitives = listed_item(document, "meshes", index)["primitives"]
    if len(primitives) != 1 or primitives[0].get("mode", _TRIANGLES) != _TRIANGLES:
        return None
    return primitives[0], matrix


def glb_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return a GLB file's JSON and binary data. Raises ValueError, struct.error or KeyError if it is none."""
    magic, version, _ = struct.unpack_from("<4sII", content, 0)
    if magic != _MAGIC or version != 2:
        raise ValueError("it is no binary glTF 2.0")
    found: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= len(content):
        length, kind = struct.unpack_from("<I4s", content, offset)
        if offset + 8 + length > len(content):
            raise ValueError("it is cut off")
        found.setdefault(kind, content[offset + 8 : offset + 8 + length])
        offset += 8 + length
    if len(found[_JSON]) > MAX_JSON_BYTES:
        raise ValueError("its description is too large")
    document = json.loads(found[_JSON])
    if not isinstance(document, dict):
        raise ValueError("its description is no object")
    return document, found.get(_BINARY, b"")


def listed_item(document: dict[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """Return an entry of a list of the file; negative indices are refused."""
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        raise ValueError(f"{kind}[{index!r}]")
    found = document[kind][index]
    if not isinstance(found, dict):
        raise ValueError(f"{kind}[{index}] is no object")
    return found


def mesh_instances(document: dict[str, Any]) -> list[tuple[int, NDArray[np.float64]]]:
    """Return each mesh index of the file's scene with its transform (4, 4)."""
    scene = listed_item(document, "scenes", document.get("scene", 0))
    waiting = [(index, np.eye(4)) for index in scene.get("nodes", [])]
    found: list[tuple[int, NDArray[np.float64]]] = []
    visits = 0
    while waiting:
        index, above = waiting.pop()
        visits += 1
        if visits > MAX_NODES:
            raise ValueError("its nodes go in circles, or are too many")
        node = listed_item(document, "nodes", index)
        matrix = above @ _local(node)
        if "mesh" in node:
            found.append((node["mesh"], matrix))
        waiting += [(child, matrix) for child in node.get("children", [])]
    return found


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        x, y, z, w = _numbers(node.get("rotation", (0, 0, 0, 1)), 4)
        matrix[:3, :3] = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        ) * _numbers(node.get("scale", (1, 1, 1)), 3)
        matrix[:3, 3] = _numbers(node.get("translation", (0, 0, 0)), 3)
    if not np.isfinite(matrix).all():
        raise ValueError("a node's place is not finite")
    return matrix


def _numbers(values: Any, count: int) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    if array.shape != (count,):
        raise ValueError(f"{count} numbers expected")
    return array


def _view(document: dict[str, Any], binary: bytes, index: Any) -> tuple[bytes, int]:
    """Return the bytes of a buffer view, and its stride (0: packed)."""
    view = listed_item(document, "bufferViews", index)
    start, length, stride = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 0)
    buffer = listed_item(document, "buffers", view["buffer"])
    if "uri" in buffer or view["buffer"] != 0:
        raise ValueError("it keeps its data in another file")
    if min(start, length, stride) < 0 or start + length > len(binary):
        raise ValueError("it names data beyond its end")
    return binary[start : start + length], stride


def accessor_values(document: dict[str, Any], binary: bytes, index: Any, width: int) -> NDArray[Any]:
    """Return the values (count, width) of an accessor."""
    accessor = listed_item(document, "accessors", index)
    if "sparse" in accessor or _WIDTHS[accessor["type"]] != width:
        raise ValueError(f"an accessor of {accessor['type']}")
    dtype, count = _COMPONENTS[accessor["componentType"]], accessor["count"]
    data, stride = _view(document, binary, accessor["bufferView"])
    start, row = accessor.get("byteOffset", 0), width * dtype.itemsize
    stride = stride or row
    if start < 0 or count < 1 or stride < row or start + (count - 1) * stride + row > len(data):
        raise ValueError("an accessor that reaches beyond its data")
    values = np.ndarray((count, width), dtype, data, offset=start, strides=(stride, dtype.itemsize))
    if accessor.get("normalized") and dtype.kind == "u":
        return np.asarray(values / float(2 ** (8 * dtype.itemsize) - 1))
    return values


def _colours(
    document: dict[str, Any], binary: bytes, attributes: dict[str, Any], count: int
) -> NDArray[np.float64] | None:
    if "COLOR_0" not in attributes:
        return None
    width = _WIDTHS[listed_item(document, "accessors", attributes["COLOR_0"])["type"]]
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
    return np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), _view(document, binary, image["bufferView"])[0]


def transformed(points: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``points`` (N, 3) under the affine ``matrix`` (4, 4), equal points to equal bits.

    A matrix product may round its last rows differently, and a mesh whose seams no longer coincide is open.
    """
    columns = np.ascontiguousarray(matrix[:3, :3].T)
    return np.asarray(
        points[:, :1] * columns[0] + points[:, 1:2] * columns[1] + points[:, 2:3] * columns[2] + matrix[:3, 3]
    )


Array = NDArray[np.float64]

_FLOAT = 5126
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
        found = _only_primitive(document)
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
    head = struct.pack("<4sII", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(data))
    return head + struct.pack("<I4s", len(text), _JSON) + text + struct.pack("<I4s", len(data), _BINARY) + data


def _overwrite(document: dict[str, Any], buffer: bytearray, index: Any, values: Array) -> bool:
    """Overwrite an accessor's values with ``values`` (V, 3) in place; return whether its layout allowed it."""
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
