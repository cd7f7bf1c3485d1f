# SPDX-License-Identifier: MIT
"""The PLY format: the header, and the wanted columns of one element in bounded memory.

Turk 1994, The PLY Polygon File Format; with the type names that programs have added since."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

MAX_HEADER_BYTES = 256 * 2**10
MAX_PROPERTIES = 1024
"""Of one element; a splat with spherical harmonics of degree 3 has 62."""

ASCII, LITTLE, BIG = "ascii", "binary_little_endian", "binary_big_endian"
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""PLY type names → NumPy type codes, without byte order."""

_COUNT = re.compile(r"[0-9]{1,18}", re.ASCII)


@dataclass(frozen=True)
class Property:
    """A column. type: NumPy type code without byte order; of a list, that of its entries."""

    name: str
    type: str
    is_list: bool = False


@dataclass(frozen=True)
class Element:
    """``count`` rows of ``properties``."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(prop.is_list for prop in self.properties)

    @property
    def types(self) -> dict[str, str]:
        """Names of scalar properties → their types, in file order."""
        return {prop.name: prop.type for prop in self.properties if not prop.is_list}


@dataclass(frozen=True)
class Header:
    """format: "ascii", "binary_little_endian" or "binary_big_endian"; body: bytes before the first row."""

    format: str
    elements: tuple[Element, ...]
    body: int

    def element(self, name: str) -> Element | None:
        """Return the element called ``name``, or None."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(stream: IO[bytes], path: Path) -> Header:
    """Return the header of the PLY file ``path``, open as ``stream``.

    Raises InputError when the file is not PLY or the header is damaged or longer than ``MAX_HEADER_BYTES``.
    """
    if stream.readline(16).strip() != b"ply":
        raise InputError(f'{path}: does not begin with "ply": choose a PLY file of splats')
    kind = ""
    elements: list[tuple[str, int, list[Property]]] = []
    while True:
        words = _words(stream, path)
        if words == ["end_header"]:
            break
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in (ASCII, LITTLE, BIG):
            kind = words[1]
        elif words[0] == "element" and len(words) == 3 and _COUNT.fullmatch(words[2]):
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements:
            _add_property(words, elements[-1][2], path)
        else:
            raise _damaged(path, f"its header has the line {' '.join(words)[:60]!r}")
    if not kind:
        raise _damaged(path, "its header names no format")
    names = [name for name, _, _ in elements]
    if len(set(names)) < len(names):
        raise _damaged(path, f"its header declares an element twice ({', '.join(names)[:60]})")
    return Header(kind, tuple(Element(name, count, tuple(found)) for name, count, found in elements), stream.tell())


def _words(stream: IO[bytes], path: Path) -> list[str]:
    line = stream.readline(MAX_HEADER_BYTES)
    if not line.endswith(b"\n"):
        raise _damaged(path, "its header has no end")
    if stream.tell() > MAX_HEADER_BYTES:
        raise _damaged(path, f"its header is longer than {MAX_HEADER_BYTES >> 10} KiB")
    return line.decode("latin-1").split()


def _add_property(words: list[str], found: list[Property], path: Path) -> None:
    if len(words) == 3 and words[1] in TYPES:
        added = Property(words[2], TYPES[words[1]])
    elif len(words) == 5 and words[1] == "list" and words[2] in TYPES and words[3] in TYPES:
        added = Property(words[4], TYPES[words[3]], is_list=True)
    else:
        raise _damaged(path, f"its header has the line {' '.join(words)[:60]!r}")
    if any(prop.name == added.name for prop in found):
        raise _damaged(path, f"its header declares the property {added.name[:40]!r} twice")
    found.append(added)
    if len(found) > MAX_PROPERTIES:
        raise _damaged(path, f"an element has more than {MAX_PROPERTIES} properties")


def _damaged(path: Path, what: str) -> InputError:
    return InputError(f"{path}: {what}: write the file again")


Columns = dict[str, NDArray[np.float64]]

BLOCK_BYTES = 8 * 2**20
MAX_LINE_BYTES = 64 * 2**10
"""Longest row of a text file."""


def read_columns(stream: IO[bytes], header: Header, element: Element, wanted: Collection[str], path: Path) -> Columns:
    """Return the ``wanted`` scalar properties that ``element`` has, each (count,) float64.

    The file's length is checked against the header before anything is read or allocated. Raises InputError when it is
    shorter, holds anything but numbers, or has lists in or before ``element``.
    """
    before = header.elements[: header.elements.index(element)]
    if element.has_lists:
        raise InputError(f"{path}: the rows of {element.name} hold lists: export the splats without them")
    stream.seek(0, os.SEEK_END)
    left = stream.tell() - header.body
    stream.seek(header.body)
    if header.format == ASCII:
        rows_before = sum(other.count for other in before)
        # Every number takes a digit and a space, and every row a line.
        _require_bytes(left, rows_before + element.count * 2 * len(element.properties) - 1, path)
        blocks = _text_blocks(stream, rows_before, element, path)
    else:
        order = ">" if header.format == BIG else "<"
        skipped = _bytes_of(before, order, element, path)
        row = _row(element, order)
        _require_bytes(left, skipped + element.count * row.itemsize, path)
        stream.seek(skipped, os.SEEK_CUR)
        blocks = _binary_blocks(stream, row, element, path)
    found = {name: np.empty(element.count) for name in element.types if name in wanted}
    start = 0
    # Signalling NaNs are reported by the caller; NumPy's warning would only repeat it.
    with np.errstate(invalid="ignore"):
        for block in blocks:
            for name, column in found.items():
                column[start : start + len(block)] = block[name]
            start += len(block)
    return found


def _bytes_of(before: tuple[Element, ...], order: str, element: Element, path: Path) -> int:
    """Return the bytes that the elements ``before`` take. Raises InputError where they have lists of unknown length."""
    for other in before:
        if other.has_lists and other.count:
            raise InputError(
                f"{path}: {other.name} with its lists comes before {element.name}: export the file with "
                f"{element.name} first, or without {other.name}"
            )
    return sum(other.count * _row(other, order).itemsize for other in before)


def _binary_blocks(
    stream: IO[bytes], row: np.dtype[np.void], element: Element, path: Path
) -> Iterator[NDArray[np.void]]:
    step = max(1, BLOCK_BYTES // max(1, row.itemsize))
    for start in range(0, element.count, step):
        rows = min(step, element.count - start)
        content = stream.read(rows * row.itemsize)
        if len(content) < rows * row.itemsize:
            raise InputError(f"{path}: ends early, after {start} rows of {element.name}: copy or write it again")
        yield np.frombuffer(content, row)


def _row(element: Element, order: str) -> np.dtype[np.void]:
    return np.dtype([(name, order + kind) for name, kind in element.types.items()])


def _text_blocks(stream: IO[bytes], skipped: int, element: Element, path: Path) -> Iterator[NDArray[np.void]]:
    for _ in range(skipped):
        _line(stream, path)
    row = np.dtype([(name, "f8") for name in element.types])
    width = len(element.properties)
    step = max(1, BLOCK_BYTES // (32 * max(1, width)))
    for start in range(0, element.count, step):
        rows = min(step, element.count - start)
        table = np.empty((rows, width))
        for index in range(rows):
            words = _line(stream, path).split()
            try:
                if len(words) != width:
                    raise ValueError
                table[index] = words
            except ValueError:
                raise InputError(
                    f"{path}: row {start + index} of {element.name} does not hold {width} numbers "
                    f"({b' '.join(words)[:40].decode('latin-1')!r}): write the file again"
                ) from None
        yield table.view(row).reshape(rows)


def _line(stream: IO[bytes], path: Path) -> bytes:
    line = stream.readline(MAX_LINE_BYTES)
    if not line:
        raise InputError(f"{path}: ends early: copy or write it again")
    if len(line) >= MAX_LINE_BYTES:
        raise InputError(f"{path}: has a line longer than {MAX_LINE_BYTES >> 10} KiB: write it again")
    return line


def _require_bytes(left: int, needed: int, path: Path) -> None:
    if left < needed:
        raise InputError(
            f"{path}: its header declares rows of at least {needed} bytes, but {left} follow: copy or write it again"
        )
