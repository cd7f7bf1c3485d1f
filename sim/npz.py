# SPDX-License-Identifier: MIT
"""Bounded reading of .npy and .npz files from other programs: size limits, no pickled objects."""

from __future__ import annotations

import io
import tokenize
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

MAX_MEMBERS = 1024
"""Most arrays of an archive; no vision model writes more."""
_KINDS = "biuf"
_DAMAGED = (OSError, ValueError, EOFError, KeyError, SyntaxError, TypeError, tokenize.TokenError, MemoryError)
"""Errors that numpy's header readers and zipfile raise on malformed data."""


def read_npy(path: Path, max_bytes: int) -> NDArray[Any]:
    """Return the array of the ``.npy`` file ``path``: booleans, integers or floats.

    The header is checked first: an array of more than ``max_bytes``, or a file of another size than the header implies,
    is refused unread. Raises InputError.
    """
    try:
        with path.open("rb") as stream:
            return _array(stream, path.stat().st_size, max_bytes, str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def read_npz(path: Path, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of the ``.npz`` archive ``path`` by name, together at most ``max_bytes``.

    Members of other types, such as text, are left out. Raises InputError.
    """
    found: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            if len(members) > MAX_MEMBERS:
                raise InputError(f"{path}: holds {len(members)} arrays, more than the {MAX_MEMBERS} allowed")
            for info in members:
                name = info.filename.removesuffix(".npy")
                with archive.open(info) as stream:
                    array = _array(stream, info.file_size, max_bytes, f"{path}: {name}", objects=True)
                if array is not None:
                    max_bytes -= array.nbytes
                    found[name] = array
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError, *_DAMAGED) as error:
        raise InputError(f"{path}: not readable as .npz ({error}); save it again with numpy.savez") from None
    # zlib.error and others, depending on the compression.
    except Exception as error:
        raise InputError(f"{path}: damaged ({type(error).__name__}: {error}); save it again") from error
    return found


def _array(stream: IO[bytes], file_bytes: int, max_bytes: int, where: str, *, objects: bool = False) -> Any:
    """Return the array, or with ``objects`` None for one of an unsupported type."""
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except _DAMAGED as error:
        raise InputError(f"{where}: not readable as .npy ({error}); save it again with numpy.save") from None
    if dtype.kind not in _KINDS:
        if objects:
            return None
        raise InputError(f"{where}: holds {dtype}, expected booleans, integers or floats; convert it and save again")
    count = 1
    for side in shape:
        count *= int(side)
    size = count * dtype.itemsize
    if any(side < 0 for side in shape) or size > max_bytes:
        raise InputError(f"{where}: an array of {shape} is more than the {max_bytes >> 20} MiB allowed; save less")
    header = stream.tell() if stream.seekable() else None
    if header is not None and file_bytes - header != size:
        raise InputError(f"{where}: has {file_bytes - header} bytes of data, but {shape} needs {size}; save it again")
    content = stream.read(size)
    if len(content) != size:
        raise InputError(f"{where}: ends too early; save it again")
    array = np.frombuffer(io.BytesIO(content).getbuffer(), dtype=dtype)
    return np.array(array.reshape(shape, order="F" if fortran else "C"), dtype=dtype.newbyteorder("="))
