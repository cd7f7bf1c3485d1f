# SPDX-License-Identifier: MIT
"""Members of a gzip-compressed tar archive from a stranger, read in order and within bounds.

Nothing is extracted by its path: the caller gets names and bytes. Python's ``tarfile`` reads extended headers of any
length into memory, and links and devices are of no use here, so only plain headers (ustar) are read.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

from ...errors import InputError
from ...files import MOST_HASHED, open_file

BLOCK = 512
PIECE = 2**20
"""Bytes that are held in memory at a time."""


class ArchiveReader:
    """Members of the archive ``path``, of which at most ``most_bytes`` are unpacked. Raises InputError."""

    def __init__(self, path: Path, most_bytes: int) -> None:
        self._path, self._left = path, most_bytes
        self._member = self._padding = 0
        try:
            self._packed = open_file(path, MOST_HASHED, what="archive")
        except (FileNotFoundError, InputError) as error:
            why = getattr(error, "strerror", None) or error
            raise InputError(f"{path}: cannot be opened ({why}); check its path") from None
        self._stream = gzip.open(self._packed, "rb")  # noqa: SIM115  closed by ``__exit__``

    def __enter__(self) -> ArchiveReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        self._packed.close()

    def members(self) -> Iterator[tuple[str, int]]:
        """Yield name and size in bytes of each regular file, which ``content`` may read until the next is asked for."""
        while True:
            self._skip()
            header = self._read(BLOCK)
            if not any(header):
                return
            if _checksum(header) != _octal(header[148:156]):
                raise InputError(f"{self._path}: is no tar archive, or is damaged; fetch it again")
            size = _octal(header[124:136])
            if size is None:
                raise InputError(f"{self._path}: holds a member of unreadable size; fetch it again")
            self._member, self._padding = size, -size % BLOCK
            # "0" and NUL are regular files; what else there is has content that is skipped like any other.
            if header[156:157] in (b"0", b"\0"):
                prefix = _text(header[345:500]) if header[257:262] == b"ustar" else ""
                name = _text(header[:100])
                yield (f"{prefix}/{name}" if prefix else name), size

    def content(self) -> Iterator[bytes]:
        """Yield the present member's bytes, in pieces of at most 1 MiB."""
        while self._member > 0:
            piece = self._read(min(PIECE, self._member))
            self._member -= len(piece)
            yield piece

    def _skip(self) -> None:
        for _ in self.content():
            pass
        self._read(self._padding)
        self._padding = 0

    def _read(self, count: int) -> bytes:
        if count > self._left:
            raise InputError(f"{self._path}: unpacks to more than such an archive has; fetch it again")
        self._left -= count
        try:
            data = self._stream.read(count)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{self._path}: is damaged or was broken off ({error}); fetch it again") from None
        if len(data) < count:
            raise InputError(f"{self._path}: ends too early; fetch it again")
        return data


def _octal(field: bytes) -> int | None:
    text = field.strip(b"\0 ")
    try:
        return int(text, 8) if text.isdigit() else None
    except ValueError:
        return None


def _checksum(header: bytes) -> int:
    return sum(header[:148]) + 8 * ord(" ") + sum(header[156:])


def _text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")
