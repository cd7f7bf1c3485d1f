# SPDX-License-Identifier: MIT
"""Bounded reading of .npy and .npz files from other programs: size limits, no pickled objects."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .files import open_file

MAX_MEMBERS = 1024
"""Most arrays of an archive; no vision model writes more."""
ARCHIVE_BYTES = 2**20
"""Bytes by which an archive may be longer than its arrays: headers and the list of members."""
_NUMBERS, _TEXT = "biuf", "biufU"
_PIECE = 2**20
_MOST_SIDE = 2**48
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class ArrayHeader(NamedTuple):
    """Header of a ``.npy`` file: shape, whether in Fortran's order, type."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_npy(path: Path, max_bytes: int) -> NDArray[Any]:
    """Return the array of the ``.npy`` file ``path``: booleans, integers or floats.

    The header is checked first: an array of more than ``max_bytes``, or a file of another size than the header implies,
    is refused unread. Raises InputError.
    """
    try:
        with open_file(path, max_bytes + ARCHIVE_BYTES, what="array") as stream:
            header = array_header(stream, str(path))
            return array_body(stream, require_numbers(header, str(path), max_bytes), str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None


def read_npz(path: Path, max_bytes: int, *, own: bool = False, remedy: str = "save less") -> dict[str, NDArray[Any]]:
    """Return the arrays of the ``.npz`` archive ``path`` by name, together at most ``max_bytes``.

    own: of an archive that PhysGen writes: strings are read too, and members of other types refused; in other archives
    they are left out. remedy: for one that is too large. Raises InputError.
    """
    found: dict[str, NDArray[Any]] = {}
    with open_npz(path, max_bytes, remedy) as archive:
        for info in archive.infolist():
            if not info.filename.endswith(".npy"):
                continue
            name = info.filename.removesuffix(".npy")
            where = f"{path}: {name[:80]}"
            with archive.open(info) as stream:
                header = array_header(stream, where)
                if header.dtype.kind not in (_TEXT if own else _NUMBERS):
                    if own:
                        raise InputError(f"{where}: holds {header.dtype}: not a readable archive of plain arrays")
                    continue
                require_size(header, where, max_bytes, remedy)
                found[name] = array_body(stream, header, where)
            max_bytes -= found[name].nbytes
    return found


@contextmanager
def open_npz(path: Path, max_bytes: int, remedy: str = "save less") -> Iterator[zipfile.ZipFile]:
    """Yield the archive ``path``, whose members together are at most ``max_bytes``, packed and unpacked.

    Whatever its damage raises inside the block becomes an InputError.
    """
    most = max_bytes + ARCHIVE_BYTES
    try:
        with open_file(path, most, what="archive of arrays") as stream, zipfile.ZipFile(stream) as archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS:
                raise InputError(f"{path}: holds {len(members)} arrays, more than the {MAX_MEMBERS} allowed")
            if (size := sum(info.file_size for info in members)) > most:
                raise InputError(
                    f"{path}: holds {size >> 20} MiB, more than the {max_bytes >> 20} MiB allowed; {remedy}"
                )
            yield archive
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    # zlib.error, struct.error, NotImplementedError, TokenError and others, depending on which byte is damaged.
    except Exception as error:
        why = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(f"{path}: not readable as .npz ({why}); save it again with numpy.savez") from None


def array_header(stream: IO[bytes], where: str) -> ArrayHeader:
    """Return the header of the ``.npy`` data in ``stream``, which is then at the array. Raises InputError."""
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"version {version} of NumPy's format")
        shape, fortran, dtype = _HEADERS[version](stream)
        good = all(type(side) is int and 0 <= side < _MOST_SIDE for side in shape) and len(shape) <= 32
    # The header is a Python literal, and its parser raises whatever it likes: TokenError, SyntaxError, MemoryError.
    except Exception as error:
        why = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(f"{where}: not readable as .npy ({why}); save it again with numpy.save") from None
    if not good:
        raise InputError(f"{where}: an array of {str(shape)[:80]} is none; save it again with numpy.save")
    return ArrayHeader(tuple(shape), bool(fortran), dtype)


def require_numbers(header: ArrayHeader, where: str, max_bytes: int) -> ArrayHeader:
    """Return ``header``. Raises InputError unless it is of booleans, integers or floats, at most ``max_bytes``."""
    if header.dtype.kind not in _NUMBERS:
        raise InputError(
            f"{where}: holds {header.dtype}, expected booleans, integers or floats; convert it and save again"
        )
    require_size(header, where, max_bytes)
    return header


def require_size(header: ArrayHeader, where: str, max_bytes: int, remedy: str = "save less") -> None:
    """Raise InputError when the array is of more than ``max_bytes``."""
    if header.size > max_bytes:
        allowed = f"{max_bytes >> 20} MiB" if max_bytes >= 2**20 else f"{max_bytes} bytes"
        raise InputError(f"{where}: an array of {header.shape} is more than the {allowed} allowed; {remedy}")


def array_body(stream: IO[bytes], header: ArrayHeader, where: str) -> NDArray[Any]:
    """Return the array after ``header``: what is left of ``stream``, to the byte. Raises InputError.

    The caller has checked type and size.
    """
    content = bytearray()
    while piece := stream.read(min(_PIECE, header.size + 1 - len(content))):
        content += piece
        if len(content) > header.size:
            break
    if len(content) != header.size:
        found = "more" if len(content) > header.size else str(len(content))
        raise InputError(f"{where}: has {found} bytes of data, but {header.shape} needs {header.size}; save it again")
    try:
        array = np.frombuffer(content, dtype=header.dtype)
        shaped = array.reshape(header.shape, order="F" if header.fortran else "C")
        return shaped.astype(header.dtype.newbyteorder("="), copy=False)
    except (ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{where}: {error}; save it again with numpy.save") from None
