# SPDX-License-Identifier: MIT
"""A file of splats of any usual dialect → splats; docs/splats.md, Files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from ...errors import InputError
from ..splats import Splats
from .compressed import PACKED, read_packed
from .dialects import CENTRE, COLOURS, ROTATION, SCALE, WANTED, from_columns, require_splats
from .header import Element, Header, Property, read_header
from .table import read_columns

MAX_SPLATS = 2_000_000
"""As many as a trained scene has at most; an object has thousands."""

_OTHER_FORMATS = {
    ".splat": "antimatter15's .splat",
    ".spz": "Niantic's .spz",
    ".ksplat": "mkkellogg's .ksplat",
    ".sog": "PlayCanvas' .sog",
}


@dataclass(frozen=True)
class SplatFile:
    """What a file holds. notes: sentences for people on all that was left out or taken otherwise than it stands."""

    splats: Splats
    notes: tuple[str, ...] = ()


def read_splats(path: Path, *, max_splats: int = MAX_SPLATS) -> Splats:
    """The splats of ``read_splat_file``, without its notes."""
    return read_splat_file(path, max_splats=max_splats).splats


def read_splat_file(path: Path, *, max_splats: int = MAX_SPLATS) -> SplatFile:
    """The splats of the PLY file ``path``, with its units taken as metres, and notes on what was not taken.

    Reads ascii and both byte orders, any order and type of properties, colours and opacities of several dialects, and
    SuperSplat's compressed files. View-dependent colour is left out, and up to 1 % of splats that are not finite.
    Memory is bounded by ``max_splats``, whatever the file says. Raises InputError on a file that is missing, another
    format, damaged, a mesh or a point cloud, has no splats or more than ``max_splats``.
    """
    if other := _OTHER_FORMATS.get(path.suffix.lower()):
        raise InputError(f"{path}: {other} files are not read: convert it to PLY, for example with SuperSplat")
    try:
        with path.open("rb") as stream:
            return _read(stream, path, max_splats)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error or 'memory ran out'}") from None


def _read(stream: IO[bytes], path: Path, max_splats: int) -> SplatFile:
    header = read_header(stream, path)
    element = header.element("vertex")
    if element is None:
        raise InputError(f"{path}: has no element vertex: give a PLY file of splats")
    if not element.count:
        raise InputError(f"{path}: holds no splats: write it again with some")
    if element.count > max_splats:
        raise InputError(f"{path}: declares {element.count} splats, more than {max_splats}: crop or thin it out first")
    if PACKED[0] in element.types:
        columns = read_packed(stream, header, element, path)
        # What it has been unpacked to, as if the file had said so.
        names = (*CENTRE, *COLOURS[0], "opacity", *SCALE, *ROTATION)
        element = replace(element, properties=tuple(Property(name, "f4") for name in names))
    else:
        require_splats(element, is_mesh=_has_faces(header), path=path)
        columns = read_columns(stream, header, element, WANTED, path)
    splats, notes = from_columns(columns, element, path)
    return SplatFile(splats, (*_left_out(header, element), *notes))


def _has_faces(header: Header) -> bool:
    return any(element.count and element.name in ("face", "tristrips") for element in header.elements)


def _left_out(header: Header, element: Element) -> tuple[str, ...]:
    harmonics = [name for other in header.elements for name in other.types if name.startswith("f_rest_")]
    if not harmonics and not any(other.name == "sh" for other in header.elements):
        return ()
    return ("colours that change with the direction of view (f_rest) were left out",)
