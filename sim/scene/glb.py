# SPDX-License-Identifier: MIT
"""Binary glTF 2.0 (registry.khronos.org/glTF): chunks, nodes, and the numbers of accessors, read and overwritten.

Files may be damaged: every function raises one of ``DAMAGED`` where a reference leads nowhere.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .meshes import MAX_NODES

MAX_JSON_BYTES = 16 * 2**20
_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_TRIANGLES, _FLOAT = 4, 5126
_COMPONENTS: dict[int, np.dtype[Any]] = {
    5121: np.dtype("u1"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
DAMAGED = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, struct.error, RecursionError)
"""Errors from following references in a damaged file."""


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


def glb_content(document: dict[str, Any], binary: bytes) -> bytes:
    """Return the GLB file of a JSON ``document`` and its ``binary`` data."""
    text = json.dumps(document, ensure_ascii=False, allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    data = binary + bytes(-len(binary) % 4)
    head = struct.pack("<4sII", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(data))
    return head + struct.pack("<I4s", len(text), _JSON) + text + struct.pack("<I4s", len(data), _BINARY) + data


def listed_item(document: dict[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """Return an entry of a list of the file; negative indices are refused."""
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        raise ValueError(f"{kind}[{index!r}]")
    found = document[kind][index]
    if not isinstance(found, dict):
        raise ValueError(f"{kind}[{index}] is no object")
    return found


def only_primitive(document: dict[str, Any]) -> tuple[dict[str, Any], NDArray[np.float64]] | None:
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


def view_bytes(document: dict[str, Any], binary: bytes, index: Any) -> tuple[bytes, int]:
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
    if "sparse" in accessor or WIDTHS[accessor["type"]] != width:
        raise ValueError(f"an accessor of {accessor['type']}")
    dtype, count = _COMPONENTS[accessor["componentType"]], accessor["count"]
    data, stride = view_bytes(document, binary, accessor["bufferView"])
    start, row = accessor.get("byteOffset", 0), width * dtype.itemsize
    stride = stride or row
    if start < 0 or count < 1 or stride < row or start + (count - 1) * stride + row > len(data):
        raise ValueError("an accessor that reaches beyond its data")
    values = np.ndarray((count, width), dtype, data, offset=start, strides=(stride, dtype.itemsize))
    if accessor.get("normalized") and dtype.kind == "u":
        return np.asarray(values / float(2 ** (8 * dtype.itemsize) - 1))
    return values


def overwrite_accessor(document: dict[str, Any], buffer: bytearray, index: Any, values: NDArray[np.float64]) -> bool:
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
