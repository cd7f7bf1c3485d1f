# SPDX-License-Identifier: MIT
"""The header of a PLY file: which elements it declares, in which order, with which properties.

Turk 1994, The PLY Polygon File Format; with the type names that programs have added since.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ...errors import InputError

MAX_HEADER_BYTES = 256 * 2**10
MAX_PROPERTIES = 1024
"""Of one element; spherical harmonics of degree 3 make a splat have 62."""

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
"""Names of types → numpy's, without byte order."""

_COUNT = re.compile(r"[0-9]{1,18}", re.ASCII)


@dataclass(frozen=True)
class Property:
    """A column. type: numpy's name without byte order; of a list, that of its entries."""

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
        """Whether its rows differ in length."""
        return any(prop.is_list for prop in self.properties)

    @property
    def types(self) -> dict[str, str]:
        """Names of its plain properties → their types, in the file's order."""
        return {prop.name: prop.type for prop in self.properties if not prop.is_list}


@dataclass(frozen=True)
class Header:
    """format: "ascii", "binary_little_endian" or "binary_big_endian"; body: bytes before the first row."""

    format: str
    elements: tuple[Element, ...]
    body: int

    def element(self, name: str) -> Element | None:
        """The element of that name."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(stream: IO[bytes], path: Path) -> Header:
    """The header of the PLY file ``path``, open as ``stream``. Raises InputError when it is none, or is damaged."""
    if stream.readline(16).strip() != b"ply":
        raise InputError(f'{path}: does not begin with "ply": give a PLY file of splats')
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
