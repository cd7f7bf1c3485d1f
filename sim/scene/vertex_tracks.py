# SPDX-License-Identifier: MIT
"""Meshes that deform, from an ``.npz`` of a scene folder. What a header says is checked before anything is read."""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

MAX_BYTES = 2**30
"""Largest array that is read, as float64; a header that claims more is refused unread."""


def load_vertex_track(path: Path, vertex_count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``times`` (K,) in s and ``vertices`` (K, V, 3) in metres of the file at ``path``; V must be ``vertex_count``.

    Raises InputError when the file is missing, damaged, of another shape or larger than ``MAX_BYTES``, holds anything
    but numbers, or its times do not rise. Nothing is ever unpickled.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            times = _read(archive, "times", path)
            vertices = _read(archive, "vertices", path)
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


def _read(archive: zipfile.ZipFile, name: str, path: Path) -> NDArray[np.float64]:
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
    if any(n < 0 for n in shape) or math.prod(shape) * max(8, dtype.itemsize) > MAX_BYTES:
        raise InputError(f"{path}: {name} has shape {shape}, more than {MAX_BYTES >> 20} MiB; give fewer keyframes")
    return tuple(shape)
