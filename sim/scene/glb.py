# SPDX-License-Identifier: MIT
"""A scene's meshes with their texture, for programs without an image library: the picture stays as the file has it.

Reads what reconstruction writes, a GLB with one primitive, with numpy alone; anything else goes through ``read_mesh``
and comes back without its texture. Vertex order is that of ``read_mesh`` (glTF 2.0, registry.khronos.org/glTF).
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .meshes import MAX_MESH_BYTES, read_mesh

MAX_JSON_BYTES = 16 * 2**20
MAX_NODES = 10_000
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
"""What following the references of a damaged file leads to."""


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh in its file's own coordinates.

    vertices: (V, 3); faces: (T, 3) vertex indices; uv: (V, 2), the origin at the bottom left, or None.
    picture: bytes of a PNG or JPEG file, the colour of the surface, or None.
    colours: (V, 3) linear, at the vertices, or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    picture: bytes | None = None
    colours: NDArray[np.float64] | None = None


def read_textured_mesh(path: Path) -> TexturedMesh:
    """The mesh at ``path``, with its texture where it is a GLB with one primitive.

    Raises InputError when the file is missing, too large, not readable, holds no triangle or coordinates that are not
    finite, or is of a kind that needs a library which is not installed.
    """
    if path.suffix.lower() == ".glb":
        found = _read_glb(path)
        if found is not None:
            return found
    mesh = read_mesh(path)
    return TexturedMesh(vertices=np.asarray(mesh.vertices, dtype=np.float64), faces=np.asarray(mesh.faces))


def _read_glb(path: Path) -> TexturedMesh | None:
    """None where it is a GLB that this reader does not cover."""
    try:
        size = path.stat().st_size
        if size > MAX_MESH_BYTES:
            raise InputError(f"{path}: {size >> 20} MiB is more than the {MAX_MESH_BYTES >> 20} MiB a mesh may have")
        content = path.read_bytes()
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
    if document.get("extensionsRequired"):
        return None
    instances = mesh_instances(document)
    if len(instances) != 1:
        return None
    (mesh_index, matrix) = instances[0]
    primitives = listed_item(document, "meshes", mesh_index)["primitives"]
    if len(primitives) != 1 or primitives[0].get("mode", _TRIANGLES) != _TRIANGLES:
        return None
    primitive = primitives[0]
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
        raise ValueError("faces that name vertices it does not hold, or none")
    uv, picture = _texture(document, binary, primitive, len(vertices))
    faces = index.reshape(-1, 3)
    # As trimesh has it: a mirrored node keeps its outside.
    faces = faces[:, ::-1].copy() if np.linalg.det(matrix[:3, :3]) < 0 else faces
    colours = _colours(document, binary, attributes, len(vertices))
    return TexturedMesh(vertices=vertices, faces=faces, uv=uv, picture=picture, colours=colours)


def glb_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Description and binary data of a GLB file. Raises ValueError, struct.error or KeyError for what is none."""
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
    """An entry of a list of the file; a negative index would count from the end."""
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        raise ValueError(f"{kind}[{index!r}]")
    found = document[kind][index]
    if not isinstance(found, dict):
        raise ValueError(f"{kind}[{index}] is no object")
    return found


def mesh_instances(document: dict[str, Any]) -> list[tuple[int, NDArray[np.float64]]]:
    """Each mesh of the file's scene with its place (4, 4)."""
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
    """The bytes of a buffer view, and its stride (0: packed)."""
    view = listed_item(document, "bufferViews", index)
    start, length, stride = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 0)
    buffer = listed_item(document, "buffers", view["buffer"])
    if "uri" in buffer or view["buffer"] != 0:
        raise ValueError("it keeps its data in another file")
    if min(start, length, stride) < 0 or start + length > len(binary):
        raise ValueError("it names data beyond its end")
    return binary[start : start + length], stride


def accessor_values(document: dict[str, Any], binary: bytes, index: Any, width: int) -> NDArray[Any]:
    """The values (count, width) of an accessor."""
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
    """Texture coordinates and the picture; both None where either is missing or of a kind that is not covered."""
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
    """``points`` (N, 3) under the affine ``matrix`` (4, 4), equal ones to the same bits.

    A matrix product may round the last rows otherwise than the others, and a mesh whose seams no longer meet is open.
    """
    columns = np.ascontiguousarray(matrix[:3, :3].T)
    return np.asarray(
        points[:, :1] * columns[0] + points[:, 1:2] * columns[1] + points[:, 2:3] * columns[2] + matrix[:3, 3]
    )
