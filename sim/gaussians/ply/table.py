# SPDX-License-Identifier: MIT
"""The numbers of one element of a PLY file: only the wanted columns, a block of rows at a time."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .header import ASCII, BIG, Element, Header

Columns = dict[str, NDArray[np.float64]]

BLOCK_BYTES = 8 * 2**20
MAX_LINE_BYTES = 64 * 2**10
"""Of a row in a file of text."""


def read_columns(stream: IO[bytes], header: Header, element: Element, wanted: Collection[str], path: Path) -> Columns:
    """The ``wanted`` plain properties of ``element`` that it has, each (count,) as float64.

    That the file is as long as its header says is found before anything is read or held. Raises InputError when it is
    shorter, holds what is no number, or has lists that stand in the way.
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
    # Bytes that make a signalling NaN are told as what they are later, not warned of here.
    with np.errstate(invalid="ignore"):
        for block in blocks:
            for name, column in found.items():
                column[start : start + len(block)] = block[name]
            start += len(block)
    return found


def _bytes_of(before: tuple[Element, ...], order: str, element: Element, path: Path) -> int:
    """How many bytes the elements ``before`` take, which have no lists, or their lengths would have to be read."""
    for other in before:
        if other.has_lists and other.count:
            raise InputError(
                f"{path}: {other.name} with its lists stands before {element.name}: export the file with "
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
            f"{path}: its header declares rows of at least {needed} bytes, and {left} follow: copy or write it again"
        )
