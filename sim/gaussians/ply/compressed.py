# SPDX-License-Identifier: MIT
"""SuperSplat's compressed PLY: 16 bytes a splat, quantised within the bounds of chunks of 256 splats.

As PlayCanvas' engine reads it: positions and logarithms of scales of 11, 10 and 11 bits, the three lesser entries of a
quaternion of 10 bits each, colours and opacity of 8.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .dialects import SH_C0
from .header import Element, Header
from .table import Columns, read_columns

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
CHUNK = 256
_COLOURS = ("r", "g", "b")


def read_packed(stream: IO[bytes], header: Header, element: Element, path: Path) -> Columns:
    """The columns of usual 3DGS that the packed ones of ``element`` stand for. Raises InputError."""
    chunks = header.element("chunk")
    bounds = [f"{end}_{prefix}{axis}" for end in ("min", "max") for prefix in ("", "scale_") for axis in "xyz"]
    if chunks is None or not set(bounds) <= set(chunks.types):
        raise InputError(f"{path}: its splats are packed without the bounds of their chunks: export the file again")
    if chunks.count != -(-element.count // CHUNK):
        raise InputError(f"{path}: has {chunks.count} chunks of {CHUNK} for {element.count} splats: export it again")
    if missing := [name for name in PACKED if element.types.get(name) != "u4"]:
        raise InputError(f"{path}: its packed splats lack {', '.join(missing)} as uint: export the file again")
    limits = read_columns(stream, header, chunks, chunks.types, path)
    read = read_columns(stream, header, element, PACKED, path)
    packed = {name: values.astype(np.uint32) for name, values in read.items()}
    chunk = np.arange(element.count) // CHUNK

    def between(name: str, share: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = limits[f"min_{name}"][chunk], limits[f"max_{name}"][chunk]
        return np.asarray(low * (1 - share) + high * share)

    found: Columns = {}
    for i, (axis, shift, bits) in enumerate((("x", 21, 11), ("y", 11, 10), ("z", 0, 11))):
        found[axis] = between(axis, _share(packed["packed_position"], shift, bits))
        found[f"scale_{i}"] = between(f"scale_{axis}", _share(packed["packed_scale"], shift, bits))
    for i, entry in enumerate(_quaternions(packed["packed_rotation"]).T):
        found[f"rot_{i}"] = entry
    for i, channel in enumerate(_COLOURS):
        colour = _share(packed["packed_color"], 24 - 8 * i, 8)
        # Older files keep colours within 0 to 1, without bounds.
        colour = between(channel, colour) if f"min_{channel}" in limits and f"max_{channel}" in limits else colour
        found[f"f_dc_{i}"] = (colour - 0.5) / SH_C0
    opacity = _share(packed["packed_color"], 0, 8)
    with np.errstate(divide="ignore"):
        found["opacity"] = np.log(opacity) - np.log1p(-opacity)
    return found


def _share(packed: NDArray[np.uint32], shift: int, bits: int) -> NDArray[np.float64]:
    most = (1 << bits) - 1
    return np.asarray(((packed >> np.uint32(shift)) & np.uint32(most)) / most)


def _quaternions(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """(N, 4) w, x, y, z: the two first bits say which entry is the largest and left out."""
    lesser = np.stack([(_share(packed, shift, 10) - 0.5) * np.sqrt(2.0) for shift in (20, 10, 0)], axis=1)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (lesser**2).sum(axis=1)))
    which = (packed >> np.uint32(30)).astype(np.int64)
    rows = np.arange(len(packed))
    found = np.empty((len(packed), 4))
    for entry in range(4):
        found[:, entry] = lesser[rows, np.clip(np.where(entry > which, entry - 1, entry), 0, 2)]
    found[rows, which] = largest
    return found
