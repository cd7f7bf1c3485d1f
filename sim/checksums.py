# SPDX-License-Identifier: MIT
"""Checksums of files: written with a bake or a scene, and checked where they are read.

A cache has one for each range of samples, so that a frame is checked without reading the others. BLAKE2b of 8 bytes:
one damaged file in 10^19 would go unnoticed; it proves no origin.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from .errors import InputError
from .files import MOST_HASHED, open_file

SUM_BYTES = 8
MOST_RANGES = 256
"""Of a cache; a longer bake has more samples in each."""
_PIECE = 2**20

OK, DAMAGED, MISSING, UNKNOWN = "ok", "damaged", "missing", "no checksum"


@dataclass(frozen=True, kw_only=True)
class Checksum:
    """Of one file of a bake.

    file: relative to the bake; for splats the folder of their files. span: samples (or files) for each sum; 0: one sum
    for the whole file. samples: how many are covered. sums: hexadecimal digits, 16 for each sum.
    """

    file: str
    sums: str
    span: int = 0
    samples: int = 0

    def __post_init__(self) -> None:
        count = -(-self.samples // self.span) if self.span > 0 else 1
        good = self.span >= 0 and self.samples >= 0 and len(self.sums) == 2 * SUM_BYTES * count
        if not good or not set(self.sums) <= set("0123456789abcdef"):
            raise InputError(f"checksums of {self.file[:80]!r} are damaged; bake again")

    def of(self, index: int) -> str:
        """Return the sum ``index``, from 0."""
        return self.sums[2 * SUM_BYTES * index : 2 * SUM_BYTES * (index + 1)]

    def ranges(self, wanted: Iterable[int] | None) -> list[int]:
        """Return the indices of the sums that cover the samples ``wanted``; None: of all."""
        if wanted is None:
            return list(range(-(-self.samples // self.span)))
        return sorted({i // self.span for i in wanted if 0 <= i < self.samples})

    def samples_of(self, index: int) -> range:
        """Return the samples that the sum ``index`` covers."""
        return range(index * self.span, min((index + 1) * self.span, self.samples))


def span_for(samples: int) -> int:
    """Return how many samples one sum covers in a cache of ``samples``."""
    return max(1, -(-samples // MOST_RANGES))


class RunningSums:
    """Sums of what is written one sample after the other."""

    def __init__(self, span: int) -> None:
        self.span, self.samples = span, 0
        self._whole: list[str] = []
        self._part = hashlib.blake2b(digest_size=SUM_BYTES)

    def add(self, *contents: bytes) -> None:
        """Take in the next sample."""
        for content in contents:
            self._part.update(content)
        self.samples += 1
        if self.samples % self.span == 0:
            self._whole.append(self._part.hexdigest())
            self._part = hashlib.blake2b(digest_size=SUM_BYTES)

    def checksum(self, file: str, *, ended: bool) -> Checksum:
        """Return the checksum so far: of whole ranges, and where it has ``ended`` of the last one too."""
        part = [self._part.hexdigest()] if ended and self.samples % self.span else []
        samples = self.samples if ended else self.samples - self.samples % self.span
        return Checksum(file=file, span=self.span, samples=samples, sums="".join([*self._whole, *part]))


def file_sum(path: Path) -> str:
    """Return the sum of the whole file ``path``. Raises InputError and FileNotFoundError as ``open_file`` does."""
    with open_file(path, MOST_HASHED) as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=SUM_BYTES)).hexdigest()


def damaged_samples(
    path: Path, found: Checksum, sample_bytes: int, header: int, wanted: Iterable[int] | None = None
) -> list[int]:
    """Return the samples of the cache ``path`` that are not what was written, as far as its sums can tell.

    wanted: samples to check, None for all; whole ranges are read. Raises InputError and FileNotFoundError.
    """
    damaged: list[int] = []
    with open_file(path, MOST_HASHED) as file:
        for index in found.ranges(wanted):
            samples = found.samples_of(index)
            file.seek(header + samples.start * sample_bytes)
            if _sum_of(file, len(samples) * sample_bytes) != found.of(index):
                damaged += samples
    return damaged


def damaged_files(names: Callable[[int], Path], found: Checksum, wanted: Iterable[int] | None = None) -> list[int]:
    """Return the samples whose file ``names`` gives is not what was written, or gone."""
    damaged: list[int] = []
    for index in found.ranges(wanted):
        sums = RunningSums(len(found.samples_of(index)))
        try:
            for sample in found.samples_of(index):
                sums.add(file_sum(names(sample)).encode())
        except (InputError, FileNotFoundError):
            damaged += found.samples_of(index)
            continue
        if sums.checksum("", ended=True).sums != found.of(index):
            damaged += found.samples_of(index)
    return damaged


def _sum_of(file: io.BufferedReader, count: int) -> str:
    digest = hashlib.blake2b(digest_size=SUM_BYTES)
    while count > 0 and (piece := file.read(min(count, _PIECE))):
        digest.update(piece)
        count -= len(piece)
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class FileState:
    """Result of checking one file: ``state`` is ok, damaged, missing or no checksum; ``text`` explains it."""

    file: str
    state: str
    text: str = ""

    @property
    def good(self) -> bool:
        """Whether the file is there, and not known to be damaged."""
        return self.state in (OK, UNKNOWN)

    def line(self) -> str:
        """Return it as one line."""
        return f"{self.state:<12}{self.file}" + (f": {self.text}" if self.text else "")


def ranges_text(numbers: Iterable[int]) -> str:
    """Return ``numbers``, rising, as text: "3, 7 to 9"."""
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in _runs(numbers))


def _runs(numbers: Iterable[int]) -> Iterator[tuple[int, int]]:
    first = last = None
    for number in numbers:
        if last is not None and number == last + 1:
            last = number
            continue
        if first is not None and last is not None:
            yield first, last
        first = last = number
    if first is not None and last is not None:
        yield first, last


def sync(file: io.BufferedRandom) -> None:
    """Wait until what was written to ``file`` is on the disk."""
    file.flush()
    os.fsync(file.fileno())
