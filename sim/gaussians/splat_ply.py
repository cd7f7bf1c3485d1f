# SPDX-License-Identifier: MIT
"""3DGS PLY files: splats read from any common dialect, and written as Inria's program writes them; docs/splats.md.

Kerbl et al. 2023 store logits of opacities, logarithms of scales, and colours as coefficients of the constant spherical
harmonic, c = 0.5 + Y₀₀ f_dc. SuperSplat's compressed PLY has 16 bytes a splat, quantised within the bounds of chunks of
256 splats, as PlayCanvas' engine reads it: positions and log scales of 11, 10 and 11 bits, the three smaller entries of
a quaternion of 10 bits each, colours and opacity of 8."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..errors import InputError
from ..files import open_file
from .ply_format import Columns, Element, Header, Property, read_columns, read_header
from .splats import MAX_SCALE, MIN_SCALE, Splats

SH_C0 = 0.28209479177387814
"""Y₀₀ = 1 / (2 √π), the constant spherical harmonic."""

MAX_DROPPED = 0.01
"""Fraction of a file's splats that may be invalid and dropped; more means a damaged file."""

CENTRE, SCALE, ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
COLOURS = (
    ("f_dc_0", "f_dc_1", "f_dc_2"),
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
OPACITIES = ("opacity", "alpha", "a")
PROPERTIES_READ = frozenset((*CENTRE, *SCALE, *ROTATION, *OPACITIES, *(name for names in COLOURS for name in names)))

_INTEGER_MAX = {"u1": 255.0, "u2": 65535.0}
"""Integer types → the value that represents 1."""


def require_splats(element: Element, is_mesh: bool, path: Path) -> None:
    """Raise InputError, saying what the file is instead, unless ``element`` has the properties of a splat."""
    have = set(element.types)
    if missing := [name for name in CENTRE if name not in have]:
        raise InputError(f"{path}: its {element.name} element lacks {', '.join(missing)}: choose a PLY file of splats")
    if not have & {*SCALE, *ROTATION}:
        kind, remedy = ("a mesh", "sample splats on it") if is_mesh else ("a plain point cloud", "fit splats to it")
        raise InputError(
            f"{path}: holds {kind}, without the scale_0…2 and rot_0…3 of splats: {remedy}, or choose a PLY of splats"
        )
    if missing := [name for name in (*SCALE, *ROTATION) if name not in have]:
        raise InputError(
            f"{path}: its splats lack {', '.join(missing)}: export them from the program that made them as a 3DGS PLY "
            "with scale_0…2 and rot_0…3"
        )
    if not any(have.issuperset(names) for names in COLOURS):
        raise InputError(f"{path}: its splats have no colours: export them with f_dc_0…2, or with red, green and blue")


def splats_from_columns(columns: Columns, element: Element, path: Path) -> tuple[Splats, tuple[str, ...]]:
    """Return the splats of ``columns``, each (N,), and notes for the user; ``require_splats`` must have passed.

    Raises InputError on colours or opacities out of range, and when over ``MAX_DROPPED`` of the splats are invalid.
    """
    notes: list[str] = []
    with np.errstate(over="ignore"):
        scales = np.exp(_stacked(columns, SCALE))
    centres, rotations = _stacked(columns, CENTRE), _stacked(columns, ROTATION)
    colours, opacities = _colours(columns, element, path, notes), _opacities(columns, element, path, notes)
    thin = (scales < MIN_SCALE) & ~np.isnan(scales)
    if thin.any():
        notes.append(f"{int(thin.any(axis=1).sum())} splats thinner than {MIN_SCALE:g} m were thickened to that")
        scales[thin] = MIN_SCALE
    return _valid_splats(centres, scales, rotations, opacities, colours, path, notes), tuple(notes)


def _stacked(columns: Columns, names: tuple[str, ...]) -> NDArray[np.float64]:
    return np.stack([columns[name] for name in names], axis=1)


def _colours(columns: Columns, element: Element, path: Path, notes: list[str]) -> NDArray[np.float64]:
    names = next(names for names in COLOURS if all(name in columns for name in names))
    values = _stacked(columns, names)
    if names == COLOURS[0]:
        return 0.5 + SH_C0 * values
    notes.append(f"colours were taken from {', '.join(names)}")
    return np.stack(
        [_normalised(values[:, i], element.types[name], name, path) for i, name in enumerate(names)], axis=1
    )


def _opacities(columns: Columns, element: Element, path: Path, notes: list[str]) -> NDArray[np.float64]:
    name = next((name for name in OPACITIES if name in columns), None)
    if name is None:
        notes.append("the file has no opacities: every splat is treated as opaque")
        return np.ones(len(columns["x"]))
    if name == "opacity" and element.types[name] not in _INTEGER_MAX:
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-columns[name])))
    notes.append(f"opacities were taken from {name}")
    return _normalised(columns[name], element.types[name], name, path)


def _normalised(values: NDArray[np.float64], kind: str, name: str, path: Path) -> NDArray[np.float64]:
    """Return ``values`` (N,) on a scale of 0 to 1. Raises InputError on types or values that do not fit it."""
    if kind in _INTEGER_MAX:
        return values / _INTEGER_MAX[kind]
    if kind[0] != "f":
        raise InputError(f"{path}: {name} has type {kind}: write it as uchar from 0 to 255, or as float from 0 to 1")
    finite = values[np.isfinite(values)]
    if finite.size and (finite.min() < 0 or finite.max() > 1):
        raise InputError(
            f"{path}: {name} ranges from {finite.min():g} to {finite.max():g}: write it as uchar from 0 to 255, or as "
            "float from 0 to 1"
        )
    return values


def _valid_splats(
    centres: NDArray[np.float64],
    scales: NDArray[np.float64],
    rotations: NDArray[np.float64],
    opacities: NDArray[np.float64],
    colours: NDArray[np.float64],
    path: Path,
    notes: list[str],
) -> Splats:
    """Return the valid splats; what was dropped is added to ``notes``. Raises InputError over ``MAX_DROPPED``."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(rotations, axis=1)
        reasons = {
            "a centre that is not finite": ~np.isfinite(centres).all(axis=1),
            f"a scale that is not a number or above {MAX_SCALE:g} m": ~(scales <= MAX_SCALE).all(axis=1),
            "a rotation that is zero or not finite": ~((lengths > 1e-12) & np.isfinite(lengths)),
            "an opacity that is not a number": np.isnan(opacities),
            "a colour that is not finite": ~np.isfinite(colours).all(axis=1),
        }
    bad = np.any(list(reasons.values()), axis=0)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        what = next(what for what, rows in reasons.items() if rows[first])
        if bad.sum() > MAX_DROPPED * len(bad):
            raise InputError(
                f"{path}: {int(bad.sum())} of {len(bad)} splats are invalid, the first of them splat {first} with "
                f"{what}: export the file again, or delete such splats"
            )
        notes.append(f"{int(bad.sum())} of {len(bad)} splats were left out, such as splat {first} with {what}")
    good = ~bad
    return Splats(
        centres=centres[good],
        scales=scales[good],
        rotations=rotations[good],
        opacities=opacities[good],
        colours=colours[good],
    )


PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
CHUNK_SPLATS = 256
_RGB = ("r", "g", "b")


def read_packed(stream: IO[bytes], header: Header, element: Element, path: Path) -> Columns:
    """Return the standard 3DGS columns that the packed ones of ``element`` encode. Raises InputError on damage."""
    chunks = header.element("chunk")
    bounds = [f"{end}_{prefix}{axis}" for end in ("min", "max") for prefix in ("", "scale_") for axis in "xyz"]
    if chunks is None or not set(bounds) <= set(chunks.types):
        raise InputError(f"{path}: its splats are packed without the bounds of their chunks: export the file again")
    if chunks.count != -(-element.count // CHUNK_SPLATS):
        raise InputError(
            f"{path}: has {chunks.count} chunks of {CHUNK_SPLATS} for {element.count} splats: export it again"
        )
    if missing := [name for name in PACKED if element.types.get(name) != "u4"]:
        raise InputError(f"{path}: its packed splats lack {', '.join(missing)} as uint: export the file again")
    limits = read_columns(stream, header, chunks, chunks.types, path)
    read = read_columns(stream, header, element, PACKED, path)
    packed = {name: values.astype(np.uint32) for name, values in read.items()}
    chunk = np.arange(element.count) // CHUNK_SPLATS

    def between(name: str, share: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = limits[f"min_{name}"][chunk], limits[f"max_{name}"][chunk]
        return np.asarray(low * (1 - share) + high * share)

    found: Columns = {}
    for i, (axis, shift, bits) in enumerate((("x", 21, 11), ("y", 11, 10), ("z", 0, 11))):
        found[axis] = between(axis, _unpacked_fraction(packed["packed_position"], shift, bits))
        found[f"scale_{i}"] = between(f"scale_{axis}", _unpacked_fraction(packed["packed_scale"], shift, bits))
    for i, entry in enumerate(_quaternions(packed["packed_rotation"]).T):
        found[f"rot_{i}"] = entry
    for i, channel in enumerate(_RGB):
        colour = _unpacked_fraction(packed["packed_color"], 24 - 8 * i, 8)
        # Older files keep colours within 0 to 1, without bounds.
        colour = between(channel, colour) if f"min_{channel}" in limits and f"max_{channel}" in limits else colour
        found[f"f_dc_{i}"] = (colour - 0.5) / SH_C0
    opacity = _unpacked_fraction(packed["packed_color"], 0, 8)
    with np.errstate(divide="ignore"):
        found["opacity"] = np.log(opacity) - np.log1p(-opacity)
    return found


def _unpacked_fraction(packed: NDArray[np.uint32], shift: int, bits: int) -> NDArray[np.float64]:
    most = (1 << bits) - 1
    return np.asarray(((packed >> np.uint32(shift)) & np.uint32(most)) / most)


def _quaternions(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return (N, 4) w, x, y, z: the first two bits are the index of the largest entry, which is omitted."""
    lesser = np.stack([(_unpacked_fraction(packed, shift, 10) - 0.5) * np.sqrt(2.0) for shift in (20, 10, 0)], axis=1)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (lesser**2).sum(axis=1)))
    which = (packed >> np.uint32(30)).astype(np.int64)
    rows = np.arange(len(packed))
    found = np.empty((len(packed), 4))
    for entry in range(4):
        found[:, entry] = lesser[rows, np.clip(np.where(entry > which, entry - 1, entry), 0, 2)]
    found[rows, which] = largest
    return found


MAX_SPLATS = 2_000_000
"""The largest trained scenes have as many; an object has thousands."""

_OTHER_FORMATS = {
    ".splat": "antimatter15's .splat",
    ".spz": "Niantic's .spz",
    ".ksplat": "mkkellogg's .ksplat",
    ".sog": "PlayCanvas' .sog",
}


@dataclass(frozen=True)
class SplatFile:
    """Content of a splat file. notes: sentences for the user on what was dropped or interpreted."""

    splats: Splats
    notes: tuple[str, ...] = ()


MAX_FILE_BYTES = 2**36
"""Rows are read one block at a time, and only as many as the header declares."""


def read_splats(path: Path, *, max_splats: int = MAX_SPLATS) -> Splats:
    """Return the splats of ``read_splat_file``, without its notes."""
    return read_splat_file(path, max_splats=max_splats).splats


def read_splat_file(path: Path, *, max_splats: int = MAX_SPLATS) -> SplatFile:
    """Return the splats of the PLY file ``path``, its units read as metres, and notes on what was dropped.

    Reads ASCII and both byte orders, any order and type of properties, colours and opacities of several dialects, and
    SuperSplat's compressed files. View-dependent colour is dropped, and up to 1 % of splats that are invalid. Memory is
    bounded by ``max_splats``, whatever the header declares. Raises InputError on a file that is missing, of another
    format, damaged, a mesh or a point cloud, without splats or with more than ``max_splats``.
    """
    if other := _OTHER_FORMATS.get(path.suffix.lower()):
        raise InputError(f"{path}: {other} files are not supported: convert it to PLY, for example with SuperSplat")
    try:
        with open_file(path, MAX_FILE_BYTES, what="file of splats") as stream:
            return _read(stream, path, max_splats)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error or 'out of memory'}") from None


def _read(stream: IO[bytes], path: Path, max_splats: int) -> SplatFile:
    header = read_header(stream, path)
    element = header.element("vertex")
    if element is None:
        raise InputError(f"{path}: has no element vertex: choose a PLY file of splats")
    if not element.count:
        raise InputError(f"{path}: holds no splats: write it again with some")
    if element.count > max_splats:
        raise InputError(f"{path}: declares {element.count} splats, more than {max_splats}: crop or thin it out first")
    if PACKED[0] in element.types:
        columns = read_packed(stream, header, element, path)
        # As if the file had declared the unpacked columns.
        names = (*CENTRE, *COLOURS[0], "opacity", *SCALE, *ROTATION)
        element = replace(element, properties=tuple(Property(name, "f4") for name in names))
    else:
        require_splats(element, is_mesh=_has_faces(header), path=path)
        columns = read_columns(stream, header, element, PROPERTIES_READ, path)
    splats, notes = splats_from_columns(columns, element, path)
    return SplatFile(splats, (*_left_out(header, element), *notes))


def _has_faces(header: Header) -> bool:
    return any(element.count and element.name in ("face", "tristrips") for element in header.elements)


def _left_out(header: Header, element: Element) -> tuple[str, ...]:
    harmonics = [name for other in header.elements for name in other.types if name.startswith("f_rest_")]
    if not harmonics and not any(other.name == "sh" for other in header.elements):
        return ()
    return ("view-dependent colours (f_rest) were dropped",)


MIN_OPACITY = 1e-6
"""Distance that opacities keep from 0 and 1, whose logits are infinite."""

PROPERTIES = ("x", "y", "z", "nx", "ny", "nz", *COLOURS[0], "opacity", *SCALE, *ROTATION)
"""In Inria's order, all float32, binary little endian; normals are zero, but readers expect them."""


def write_splats(path: Path, splats: Splats) -> None:
    """Write ``splats`` to ``path`` atomically.

    Read again they are equal to float32 precision, opacities within 1e-6. Raises InputError when there are none, when a
    coordinate does not fit float32, or when the file cannot be written.
    """
    if not len(splats):
        raise InputError(f"{path}: no splats to write: give at least one")
    opacities = np.clip(splats.opacities, MIN_OPACITY, 1.0 - MIN_OPACITY)
    table = np.column_stack(
        [
            splats.centres,
            np.zeros((len(splats), 3)),
            (splats.colours - 0.5) / SH_C0,
            np.log(opacities) - np.log1p(-opacities),
            np.log(splats.scales),
            splats.rotations,
        ]
    )
    if np.abs(table).max() > np.finfo(np.float32).max:
        raise InputError(f"{path}: coordinates or colours beyond 3e38 do not fit float32: scale the splats")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in PROPERTIES]
    with replacing(path) as partial, partial.open("wb") as stream:
        stream.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        stream.write(table.astype("<f4").tobytes())
