# SPDX-License-Identifier: MIT
"""Point caches packed to a fraction of their size, every point within 0.1 % of the object's size of where it was.

Positions are whole steps; of each sample, a map of earlier ones is taken away, then what the points around say, and the
rest is deflated. Little-endian: char[12] "PHYSGENPACK2", int32 vertices, int32 samples, float32 start, float64[3]
origin, float64 step; then for every sample uint8 kind, uint32 length, and so many bytes of zlib. Sample 0 is float32
and exact, its bytes in planes. A later sample's kind says the map (``_MAPS``) and, by ``_AROUND``, whether its points
are predicted from those around (point_prediction.py). It has the map's float64, then its numbers, x of all points
before y and z: folded, 0, -1, 1, -2, 2 ... to 0, 1, 2, 3, 4 ...; a byte each, 255 for those that follow as uint32.

"PHYSGENPACK1" is still read: without points around, two or four bytes a number, low bytes of all before high bytes.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..atomic import naming
from ..errors import InputError
from ..files import open_file
from .pc2 import MAX_CACHE_BYTES, MAX_VERTICES, Pc2Reader
from .point_prediction import point_prediction

_HEADER = struct.Struct("<12siif3dd")
_PART = struct.Struct("<BI")
_MAGIC, _FIRST_MAGIC = b"PHYSGENPACK2", b"PHYSGENPACK1"
MOST_SAMPLES = 100_000
MOST_VERTICES = 5_000_000
"""Of a packed cache, for each of which packing and unpacking take some 300 bytes of memory."""
ERROR = 0.9e-3
"""Largest distance of a point from where it was, over the largest extent of the object at rest."""
LEVEL = 9
_MAPS = {1: 0, 2: 4, 3: 4, 4: 10}
"""Rows of the affine map that predicts a sample: none, of the speed; from sample 0, which is exact; from the sample
before; from both samples before and sample 0. Rounded places blur a speed, so that sample 0 often says more."""
_AROUND = 16
_FINE = 16
"""Steps of ``point_prediction`` in one step of the positions."""


def pack_cache(source: Pc2Reader, target: Path, samples: int) -> None:
    """Write the first ``samples`` of ``source`` packed to ``target``. Raises InputError for a damaged cache, or points
    that move too far for their size; OSError."""
    if source.vertex_count > MOST_VERTICES:
        raise InputError(
            f"{source.path}: {source.vertex_count} vertices are more than {MOST_VERTICES}, the most that are packed; "
            "keep the bake as it is"
        )
    first = source.sample(0)
    extent = float(np.ptp(first, axis=0).max())
    step = max(extent * ERROR * 2.0 / math.sqrt(3.0), 1e-12)
    origin = first.min(axis=0).astype(np.float64)
    rest = _fine(first, origin, step)
    around = point_prediction(rest)
    with naming(target), target.open("wb") as file:
        file.write(_HEADER.pack(_MAGIC, len(first), samples, source.start_frame, *origin, step))
        data = _deflated(_planes(np.ascontiguousarray(first, "<f4")), zlib.Z_DEFAULT_STRATEGY)
        file.write(_PART.pack(0, len(data)) + data)
        before = last = _whole(first, origin, step, source.path)
        for index in range(1, samples):
            now = _whole(source.sample(index), origin, step, source.path)
            found = []
            for kind in _MAPS:
                places = _places(kind, rest, last, before)
                affine = None if places is None else _fit(places, now)
                head = b"" if affine is None else affine.astype("<f8").tobytes()
                numbers = now - (2 * last - before if places is None or affine is None else _mapped(places, affine))
                for use, values in ((0, numbers), (_AROUND, around.surprises(numbers))):
                    content = head + _folded(values)
                    tries = [_deflated(content, strategy) for strategy in (zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)]
                    found.append((min(map(len, tries)), kind + use, content, min(tries, key=len)))
            # Such numbers hardly repeat, so that looking for repetitions costs bits; where most are 0, they do.
            _, kind, content, data = min(found, key=lambda each: each[0])
            data = min(data, _deflated(content, zlib.Z_DEFAULT_STRATEGY), key=len)
            file.write(_PART.pack(kind, len(data)) + data)
            before, last = last, now


class PackedCache:
    """A packed cache on disk; its samples come in order. Raises InputError when it is missing or not one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_file(path, MAX_CACHE_BYTES, what="packed cache") as file:
                head = file.read(_HEADER.size)
        except FileNotFoundError:
            raise InputError(f"{path}: there is no such packed cache; copy the whole folder") from None
        if len(head) < _HEADER.size or head[:12] not in (_MAGIC, _FIRST_MAGIC):
            raise InputError(f"{path}: is no packed cache; copy the folder again")
        self._magic, self.vertex_count, self.sample_count, self.start_frame, *origin, self._step = _HEADER.unpack(head)
        self._origin = np.array(origin)
        most = MOST_VERTICES if self._magic == _MAGIC else MAX_VERTICES
        good = 0 < self.vertex_count <= most and 0 < self.sample_count <= MOST_SAMPLES
        if not (good and np.isfinite(self._origin).all() and 0 < self._step < math.inf and abs(self.start_frame) < 1e7):
            raise InputError(f"{path}: {self.vertex_count} vertices, {self.sample_count} samples: is damaged")

    def samples(self) -> Iterator[NDArray[np.float32]]:
        """Yield the positions (V, 3) of every sample. Raises InputError where the file is damaged."""
        with open_file(self.path, MAX_CACHE_BYTES, what="packed cache") as file:
            file.seek(_HEADER.size)
            first = self._first(file)
            yield first
            rest = _fine(first, self._origin, self._step)
            around = point_prediction(rest) if self._magic == _MAGIC and self.sample_count > 1 else None
            before = last = np.rint((first - self._origin) / self._step).clip(-(2**28), 2**28).astype(np.int64)
            for index in range(1, self.sample_count):
                kind, length = self._part(file, index)
                if around is None:
                    now = self._later_of_first_version(file, index, kind, length, last, before)
                else:
                    numbers, affine = self._numbers(file, index, kind, length)
                    if kind & _AROUND:
                        numbers = around.values(numbers)
                    places = _places(kind & ~_AROUND, rest, last, before)
                    now = numbers + (2 * last - before if places is None else _mapped(places, affine))
                if np.abs(now).max() > 2**29:
                    raise self._damaged(index)
                before, last = last, now
                yield (self._origin + now * self._step).astype(np.float32)

    def _first(self, file: BinaryIO) -> NDArray[np.float32]:
        kind, length = self._part(file, 0)
        data = self._unpacked(file, 0, length, 12 * self.vertex_count)
        if kind != 0 or len(data) != 12 * self.vertex_count:
            raise self._damaged(0)
        if self._magic == _MAGIC:
            data = np.frombuffer(data, np.uint8).reshape(4, -1).T.tobytes()
        first = np.frombuffer(data, "<f4").reshape(-1, 3)
        if not np.isfinite(first).all() or np.abs(first).max() > 1e30:
            raise self._damaged(0)
        return first

    def _numbers(
        self, file: BinaryIO, index: int, kind: int, length: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The numbers (V, 3) of a sample, and its map (K, 3)."""
        rows = _MAPS.get(kind & ~_AROUND, -1)
        if rows < 0:
            raise self._damaged(index)
        count = 3 * self.vertex_count
        data = self._unpacked(file, index, length, 24 * rows + 5 * count)
        low = np.frombuffer(data[24 * rows : 24 * rows + count], np.uint8)
        large = np.flatnonzero(low == 255)
        if len(data) != 24 * rows + count + 4 * len(large):
            raise self._damaged(index)
        folded = low.astype(np.int64)
        folded[large] = np.frombuffer(data[24 * rows + count :], "<u4")
        return _unfolded(folded).reshape(3, -1).T, self._map(index, data, rows)

    def _later_of_first_version(
        self, file: BinaryIO, index: int, kind: int, length: int, last: NDArray[np.int64], before: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Positions (V, 3) in steps, of a file of the first version: kinds 2, 4 and 6, 8, whose numbers have as many
        bytes, less 4 of the last two, which hold differences along the points; 16 and 64, a map; 32, folded."""
        use, folded = max(kind, 0) & (16 | 64), kind > 0 and kind & 32 != 0
        kind -= use + (32 if folded else 0)
        rows = {0: 0, 16: 4, 64: 7}.get(use, -1)
        if kind not in (2, 4, 6, 8) or rows < 0:
            raise self._damaged(index)
        width = 4 if kind in (4, 8) else 2
        count = 3 * self.vertex_count * width + 24 * rows
        data = self._unpacked(file, index, length, count)
        if len(data) != count:
            raise self._damaged(index)
        planes = np.frombuffer(data[24 * rows :], np.uint8).reshape(width, -1)
        rest = (
            np.ascontiguousarray(planes.T).view(f"<{'u' if folded else 'i'}{width}").reshape(3, -1).T.astype(np.int64)
        )
        rest = _unfolded(rest) if folded else rest
        rest = np.cumsum(rest, axis=0) if kind >= 6 else rest
        if not use:
            return np.asarray(2 * last - before + rest)
        return _mapped(last if use == 16 else np.column_stack([last, before]), self._map(index, data, rows)) + rest

    def _map(self, index: int, data: bytes, rows: int) -> NDArray[np.float64]:
        affine = np.frombuffer(data[: 24 * rows], "<f8").reshape(rows, 3)
        if rows and not (np.isfinite(affine).all() and np.abs(affine).max() < 1e15):
            raise self._damaged(index)
        return affine

    def _part(self, file: BinaryIO, index: int) -> tuple[int, int]:
        head = file.read(_PART.size)
        if len(head) != _PART.size:
            raise self._damaged(index)
        kind, length = _PART.unpack(head)
        return kind, length

    def _unpacked(self, file: BinaryIO, index: int, length: int, most: int) -> bytes:
        """At most ``most`` bytes and one."""
        if length > most + 2**16:
            raise self._damaged(index)
        try:
            return zlib.decompressobj().decompress(file.read(length), most + 1)
        except zlib.error as error:
            raise InputError(f"{self.path}: sample {index} is damaged ({error}); copy the folder again") from None

    def _damaged(self, index: int) -> InputError:
        return InputError(f"{self.path}: sample {index} is damaged; copy the folder again")


def _places(
    kind: int, rest: NDArray[np.int64], last: NDArray[np.int64], before: NDArray[np.int64]
) -> NDArray[np.int64] | None:
    """What the map of a ``kind`` of sample is of (V, K); None for the speed alone."""
    if kind == 4:
        return np.column_stack([last, before, rest])
    return {2: rest, 3: last}.get(kind)


def _fit(places: NDArray[np.int64], now: NDArray[np.int64]) -> NDArray[np.float64]:
    """(K + 1, 3) affine map from ``places`` (V, K) to ``now`` (V, 3) in least squares."""
    rows = np.column_stack([places, np.ones(len(places))])
    return np.asarray(np.linalg.lstsq(rows, now.astype(np.float64), rcond=None)[0])


def _mapped(places: NDArray[np.int64], affine: NDArray[np.float64]) -> NDArray[np.int64]:
    """The map of ``places`` (V, K), number by number, so that every machine rounds alike."""
    columns = places.T.astype(np.float64)
    rows = []
    for *factors, shift in affine.T:
        total = columns[0] * factors[0]
        for column, factor in zip(columns[1:], factors[1:], strict=True):
            total = total + column * factor
        rows.append(np.rint(total + shift))
    return np.stack(rows, axis=1).clip(-(2.0**40), 2.0**40).astype(np.int64)


def _folded(values: NDArray[np.int64]) -> bytes:
    """``values`` (V, 3), folded: a byte each, and uint32 of those that are no byte."""
    folded = ((values << 1) ^ (values >> 63)).T.ravel()
    return folded.clip(max=255).astype(np.uint8).tobytes() + folded[folded >= 255].astype("<u4").tobytes()


def _deflated(content: bytes, strategy: int) -> bytes:
    packer = zlib.compressobj(LEVEL, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, strategy)
    return packer.compress(content) + packer.flush()


def _unfolded(folded: NDArray[np.int64]) -> NDArray[np.int64]:
    return (folded >> 1) ^ -(folded & 1)


def _planes(first: NDArray[np.float32]) -> bytes:
    return first.view(np.uint8).reshape(-1, 4).T.tobytes()


def _fine(first: NDArray[np.float32], origin: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    """The exact sample 0 (V, 3) in ``_FINE`` parts of a step from ``origin``, below 2²⁰."""
    return np.rint((first.astype(np.float64) - origin) / step * _FINE).clip(0, 2**20 - 1).astype(np.int64)


def _whole(sample: NDArray[np.float32], origin: NDArray[np.float64], step: float, path: Path) -> NDArray[np.int64]:
    found = np.rint((sample.astype(np.float64) - origin) / step)
    if not np.abs(found).max(initial=0.0) < 2**28:
        raise InputError(f"{path}: moves too far for its size to be packed; keep the bake as it is")
    return found.astype(np.int64)
