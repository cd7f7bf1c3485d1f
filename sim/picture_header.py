# SPDX-License-Identifier: MIT
"""How many pixels a picture file claims, from its header alone: for decoders that take memory unchecked.

Blender decodes whatever a file is, by its content and however large. Pillow is not among the packages of its Python, so
the headers are read here.
"""

from __future__ import annotations

import os
import re
import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from .errors import InputError
from .files import MAX_PICTURE_BYTES, open_file, shown

MAX_PIXELS = 200_000_000
MAX_FLOAT_PIXELS = 64_000_000
"""Of EXR and HDR, of which every pixel becomes four numbers of four bytes."""
SMALL, MOST_A_BYTE = 2**24, 2000
"""Pixels that are decoded whatever the file says, and beyond them pixels a byte of the file: JPEG and PNG have at most
some 1,000, photos less than 100. Others keep a decoder busy for long with nothing."""
FORMATS = "PNG, JPEG, TIFF, WebP, BMP, EXR or HDR"
_MOST_PARTS = 200
"""Segments, entries, attributes or layers that are looked through."""
_MOST_BETWEEN = 512
"""Bytes between two segments of a JPEG."""


def require_picture(path: Path, *, folder: Path | None = None) -> tuple[int, int]:
    """Return width and height in pixels of the picture file ``path``, of one of ``FORMATS``, whatever its name.

    folder: where it must lie. Raises InputError where there is none, for another format, and for more pixels than are
    decoded.
    """
    try:
        with open_file(path, MAX_PICTURE_BYTES, what="picture", folder=folder) as stream:
            return _required(stream, os.fstat(stream.fileno()).st_size, shown(path))
    except FileNotFoundError:
        raise InputError(f"{shown(path)}: cannot be read; check that it is there and may be read") from None


def require_picture_bytes(content: bytes, what: str) -> tuple[int, int]:
    """The same of a picture in memory. what: its name, for the message."""
    return _required(BytesIO(content), len(content), what)


def _required(stream: BinaryIO, length: int, name: str) -> tuple[int, int]:
    try:
        found = _size(stream)
    except (struct.error, ValueError, IndexError, OverflowError):
        found = None
    if found is None or min(found[:2]) <= 0:
        raise InputError(f"{name}: is not a readable picture; give {FORMATS}")
    width, height, is_float = found
    most = min(MAX_FLOAT_PIXELS if is_float else MAX_PIXELS, max(SMALL, MOST_A_BYTE * length))
    if width * height > most:
        raise InputError(f"{name}: claims {width}x{height} pixels, more than such a file may have; scale it down")
    return width, height


def _size(stream: BinaryIO) -> tuple[int, int, bool] | None:
    """Return width, height, and whether pixels are floating-point numbers; None for other formats."""
    head = stream.read(32)
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        # The first chunk is this one in every PNG.
        return (*struct.unpack(">II", head[16:24]), False) if head[12:16] == b"IHDR" else None
    if head[:2] == b"\xff\xd8":
        return _jpeg(stream)
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return _webp(head)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return _tiff(stream, "<" if head[:1] == b"I" else ">")
    if head[:2] == b"BM":
        width, height = struct.unpack("<ii", head[18:26])
        return width, abs(height), False
    if head[:4] == b"\x76\x2f\x31\x01":
        return _exr(stream)
    if head[:2] == b"#?":
        return _hdr(stream)
    return None


def _jpeg(stream: BinaryIO) -> tuple[int, int, bool] | None:
    stream.seek(2)
    for _ in range(_MOST_PARTS):
        # Between segments there may be a few other bytes, and any number of FF before a marker.
        between = stream.read(_MOST_BETWEEN)
        found = re.search(rb"\xff+([^\xff\0])", between)
        if found is None or found[1] in (b"\xd9", b"\xda"):
            return None
        kind = found[1][0]
        stream.seek(found.end() - len(between), os.SEEK_CUR)
        if kind == 0x01 or 0xD0 <= kind <= 0xD8:
            continue
        (length,) = struct.unpack(">H", stream.read(2))
        # Frames of all codings; C4, C8 and CC are tables.
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            _, height, width = struct.unpack(">BHH", stream.read(5))
            return width, height, False
        stream.seek(max(0, length - 2), os.SEEK_CUR)
    return None


def _webp(head: bytes) -> tuple[int, int, bool] | None:
    kind = head[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(head[24:27], "little"), 1 + int.from_bytes(head[27:30], "little"), False
    if kind == b"VP8L":
        bits = int.from_bytes(head[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), False
    if kind == b"VP8 ":
        width, height = struct.unpack("<HH", head[26:30])
        return width & 0x3FFF, height & 0x3FFF, False
    return None


def _tiff(stream: BinaryIO, order: str) -> tuple[int, int, bool] | None:
    stream.seek(4)
    (at,) = struct.unpack(f"{order}I", stream.read(4))
    stream.seek(at)
    (count,) = struct.unpack(f"{order}H", stream.read(2))
    found: dict[int, int] = {}
    for _ in range(min(count, _MOST_PARTS)):
        entry = stream.read(12)
        tag, kind = struct.unpack(f"{order}HH", entry[:4])
        if tag in (256, 257):
            # SHORT or LONG.
            (found[tag],) = struct.unpack(f"{order}{'H' if kind == 3 else 'I'}", entry[8 : 10 if kind == 3 else 12])
    return (found[256], found[257], False) if len(found) == 2 else None


def _exr(stream: BinaryIO) -> tuple[int, int, bool] | None:
    """The largest of the parts, each of which has a header."""
    stream.seek(4)
    (version,) = struct.unpack("<I", stream.read(4))
    largest: tuple[int, int] | None = None
    for _ in range(_MOST_PARTS):
        name = b""
        for _ in range(_MOST_PARTS):
            name = _text(stream)
            if not name:
                break
            kind = _text(stream)
            (length,) = struct.unpack("<i", stream.read(4))
            if name == b"dataWindow" and kind == b"box2i":
                left, top, right, bottom = struct.unpack("<4i", stream.read(16))
                size = (right - left + 1, bottom - top + 1)
                if min(size) <= 0:
                    return None
                largest = size if largest is None or size[0] * size[1] > largest[0] * largest[1] else largest
            elif length < 0:
                return None
            else:
                stream.seek(length, os.SEEK_CUR)
        # Of several parts, an empty header ends the headers.
        if name or not version & 0x1000 or stream.read(1) == b"\0":
            return None if largest is None or name else (*largest, True)
        stream.seek(-1, os.SEEK_CUR)
    return None


def _text(stream: BinaryIO) -> bytes:
    """The text up to the next zero byte, of at most 255 bytes."""
    text = b""
    for _ in range(256):
        byte = stream.read(1)
        if byte == b"\0":
            return text
        if not byte:
            break
        text += byte
    raise ValueError("no such text")


def _hdr(stream: BinaryIO) -> tuple[int, int, bool] | None:
    stream.seek(0)
    for _ in range(_MOST_PARTS):
        line = stream.readline(4096)
        found = re.fullmatch(rb"[+-]([XY])\s+(\d{1,9})\s+[+-]([XY])\s+(\d{1,9})\s*", line)
        if found and found[1] != found[3]:
            return int(found[2 if found[1] == b"X" else 4]), int(found[4 if found[1] == b"X" else 2]), True
        if not line:
            break
    return None
