# SPDX-License-Identifier: MIT
"""What is put in the place of a file of a loader: no files at all, and files that are programs for some reader.

Every loader gets all of them, whatever it reads: a name says nothing about what a stranger put under it.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

OUTSIDE = "/etc/passwd"
_PICKLE_RUNS = b"cos\nsystem\n(S'touch physgen-was-run'\ntR."


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _circle(path: Path) -> None:
    path.symlink_to(path.name)


def _outside(path: Path) -> None:
    path.symlink_to(OUTSIDE)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**42)


def _concat(path: Path) -> None:
    """FFmpeg opens what it names, here a pipe beside it, and waits."""
    os.mkfifo(path.with_name("waits"))
    path.write_bytes(b"ffconcat version 1.0\nfile 'waits'\n")


def _playlist(path: Path) -> None:
    os.mkfifo(path.with_name("waits"))
    path.write_bytes(
        b"#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:1\n#EXTINF:1.0,\n"
        + f"file://{path.with_name('waits').resolve()}\n#EXT-X-ENDLIST\n".encode()
    )


def _big_picture() -> bytes:
    """A PNG of 900 million pixels in a few kilobytes."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(2**20), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _objects() -> bytes:
    """An array of Python objects, whose pickle runs a program."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": (1,)})
    return head.getvalue() + _PICKLE_RUNS


ENTITIES = b"".join(
    [
        b'<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY e0 "xxxxxxxxxx"><!ENTITY out SYSTEM "file:///etc/passwd">',
        *(b'<!ENTITY e%d "%s">' % (n, b"&e%d;" % (n - 1) * 10) for n in range(1, 11)),
        b"]>\n<mujoco>&out;&e10;</mujoco>",
    ]
)
ALIASES = b"a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + b"".join(
    b"a%d: &a%d [%s]\n" % (n, n, b", ".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 12)
)
CONTENTS = {
    # For it, Pillow starts Ghostscript, whatever the file is called.
    "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n",
    "entities": ENTITIES,
    "aliases": ALIASES,
    "tag of Python": b"!!python/object/apply:os.system ['touch physgen-was-run']\n",
    "pickle": _PICKLE_RUNS,
    "pickle of protocol 4": pickle.dumps([1]),
    "array of objects": _objects(),
    "big picture": _big_picture(),
    "drawing": b'<svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd"/></svg>',
    "nested arrays": b"[" * 100_000,
    "open string": b'{"a": "' + b"\\u0000" * 10_000,
}
"""Files by what is bad about them."""

NO_FILES: tuple[Callable[[Path], object], ...] = (
    _pipe,
    _endless,
    _circle,
    _outside,
    _concat,
    _playlist,
    Path.mkdir,
    Path.touch,
    _sparse,
    lambda path: None,
)
"""The last one is nothing."""


def _written(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


INSTEAD = (*NO_FILES, *(_written(content) for content in CONTENTS.values()))
"""The first inputs of every loader."""
