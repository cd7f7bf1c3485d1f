# SPDX-License-Identifier: MIT
"""Bakes that travel: a bake folder packed to a fraction of its size, and unpacked to point caches that play.

Point caches are packed: quantised positions, predicted from the two samples before, folded, deflated. Little-endian:
char[12] "PHYSGENPACK1", int32 vertices, int32 samples, float32 start, float64[3] origin, float64 step; then for every
sample uint8 kind, uint32 length, and so many bytes of zlib. Sample 0 is float32 and exact; of the others the whole
numbers round((x - origin) / step) less their prediction, low bytes of all before high bytes. Folded numbers 0, -1, 1,
-2, 2 ... are written as 0, 1, 2, 3, 4 ...: a high byte that says the sign again would cost a bit a number.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import naming, replacing_tree, write_json
from ..cache.bake_check import require_intact, unchanged_bake
from ..cache.bake_folder import METRICS_FILE, Bake, BakeManifest, load_bake, save_manifest
from ..cache.checksums import Checksum, file_sum, span_for
from ..cache.folder_lock import lock_beside
from ..cache.pc2 import MAX_CACHE_BYTES, MAX_VERTICES, Pc2Reader, Pc2Writer
from ..errors import Cancelled, InputError
from ..events import IsCancelled, never
from ..files import is_file, open_file
from ..scene.folder import inside
from ..validation import parse, read_json, to_json

_HEADER = struct.Struct("<12siif3dd")
_PART = struct.Struct("<BI")
_MAGIC = b"PHYSGENPACK1"
MOST_SAMPLES = 100_000
ERROR = 0.9e-3
"""Largest distance of a point from where it was, over the largest extent of the object at rest."""
LEVEL = 6
_EXACT, _PLAIN, _ALONG = 0, 2, 4
"""Kinds of samples; the width in bytes, 2 or 4, less 2, is added to the last two: 2, 4; along the vertices 6, 8."""
_AFFINE = 16
"""Added where the prediction is the affine map of the sample before, whose 12 float64 precede the numbers."""
_FOLDED = 32
"""Added where the numbers are folded, as all that are written are; files of earlier versions have others."""
_TWO = 64
"""Added where the prediction is the affine map of both samples before, whose 21 float64 precede the numbers: it takes
of the speed what outlasts the rounding of the places."""
_MAP_ROWS = {0: 0, _AFFINE: 4, _TWO: 7}


def pack_cache(source: Pc2Reader, target: Path, samples: int) -> None:
    """Write the first ``samples`` of ``source`` packed to ``target``. Raises InputError for a damaged cache, or points
    that move too far for their size; OSError."""
    first = source.sample(0)
    extent = float(np.ptp(first, axis=0).max())
    step = max(extent * ERROR * 2.0 / math.sqrt(3.0), 1e-12)
    origin = first.min(axis=0).astype(np.float64)
    with naming(target), target.open("wb") as file:
        start = _HEADER.pack(_MAGIC, len(first), samples, source.start_frame, *origin, step)
        file.write(start)
        before = last = _whole(first, origin, step, source.path)
        data = zlib.compress(np.ascontiguousarray(first, "<f4").tobytes(), LEVEL)
        file.write(_PART.pack(_EXACT, len(data)) + data)
        for index in range(1, samples):
            now = _whole(source.sample(index), origin, step, source.path)
            both = np.column_stack([last, before])
            found = []
            for use, places in ((0, None), (_AFFINE, last), (_TWO, both)):
                if places is None:
                    head, expected = b"", 2 * last - before
                else:
                    affine = _fit(places, now)
                    head, expected = affine.astype("<f8").tobytes(), _mapped(places, affine)
                for kind, rest in _residuals(now - expected):
                    found.append((kind + use + _FOLDED, zlib.compress(head + _bytes(rest), LEVEL)))
            kind, data = min(found, key=lambda each: len(each[1]))
            file.write(_PART.pack(kind, len(data)) + data)
            before, last = last, now


def _residuals(rest: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.unsignedinteger]]]:
    along = np.diff(rest, axis=0, prepend=0)
    for kind, values in ((_PLAIN, rest), (_ALONG + 2, along)):
        folded = (values << 1) ^ (values >> 63)
        width = 2 if folded.max(initial=0) < 2**16 else 4
        yield kind + width - 2, folded.astype(f"<u{width}")


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


def _bytes(values: NDArray[np.unsignedinteger]) -> bytes:
    return values.T.copy().view(np.uint8).reshape(-1, values.dtype.itemsize).T.tobytes()


def _whole(sample: NDArray[np.float32], origin: NDArray[np.float64], step: float, path: Path) -> NDArray[np.int64]:
    found = np.rint((sample.astype(np.float64) - origin) / step)
    if not np.abs(found).max(initial=0.0) < 2**28:
        raise InputError(f"{path}: moves too far for its size to be packed; keep the bake as it is")
    return found.astype(np.int64)


class PackedCache:
    """A packed cache on disk; its samples come in order. Raises InputError when it is missing or not one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_file(path, MAX_CACHE_BYTES, what="packed cache") as file:
                head = file.read(_HEADER.size)
        except FileNotFoundError:
            raise InputError(f"{path}: there is no such packed cache; copy the whole folder") from None
        if len(head) < _HEADER.size or head[:12] != _MAGIC:
            raise InputError(f"{path}: is no packed cache; copy the folder again")
        _, self.vertex_count, self.sample_count, self.start_frame, *origin, self._step = _HEADER.unpack(head)
        self._origin = np.array(origin)
        good = 0 < self.vertex_count <= MAX_VERTICES and 0 < self.sample_count <= MOST_SAMPLES
        if not (good and np.isfinite(self._origin).all() and 0 < self._step < math.inf and abs(self.start_frame) < 1e7):
            raise InputError(f"{path}: {self.vertex_count} vertices, {self.sample_count} samples: is damaged")

    def samples(self) -> Iterator[NDArray[np.float32]]:
        """Yield the positions (V, 3) of every sample. Raises InputError where the file is damaged."""
        before = last = np.zeros((0, 3), np.int64)
        with open_file(self.path, MAX_CACHE_BYTES, what="packed cache") as file:
            file.seek(_HEADER.size)
            for index in range(self.sample_count):
                head = file.read(_PART.size)
                kind, length = _PART.unpack(head) if len(head) == _PART.size else (-1, 0)
                use, folded = max(kind, 0) & (_AFFINE | _TWO), kind > 0 and kind & _FOLDED != 0
                kind -= use + (_FOLDED if folded else 0)
                width = 4 if kind in (_EXACT, 4, 8) else 2
                rows = _MAP_ROWS.get(use, -1)
                count = 3 * self.vertex_count * width + 24 * max(rows, 0)
                if (
                    (kind == _EXACT) != (index == 0)
                    or kind not in (0, 2, 4, 6, 8)
                    or rows < 0
                    or (index == 0 and (use or folded))
                    or length > count + 2**16
                ):
                    raise InputError(f"{self.path}: sample {index} is damaged; copy the folder again")
                unpack = zlib.decompressobj()
                try:
                    data = unpack.decompress(file.read(length), count + 1)
                except zlib.error as error:
                    raise InputError(f"{self.path}: sample {index} is damaged ({error})") from None
                if len(data) != count:
                    raise InputError(f"{self.path}: sample {index} is damaged; copy the folder again")
                if index == 0:
                    first = np.frombuffer(data, "<f4").reshape(-1, 3)
                    if not np.isfinite(first).all() or np.abs(first).max() > 1e30:
                        raise InputError(f"{self.path}: sample 0 is damaged")
                    before = last = np.rint((first - self._origin) / self._step).clip(-(2**28), 2**28).astype(np.int64)
                    yield first
                    continue
                expected = 2 * last - before
                if use:
                    matrix = np.frombuffer(data[: 24 * rows], "<f8").reshape(rows, 3)
                    if not (np.isfinite(matrix).all() and np.abs(matrix).max() < 1e15):
                        raise InputError(f"{self.path}: sample {index} is damaged; copy the folder again")
                    places = last if use == _AFFINE else np.column_stack([last, before])
                    expected, data = _mapped(places, matrix), data[24 * rows :]
                planes = np.frombuffer(data, np.uint8).reshape(width, -1)
                sort = "u" if folded else "i"
                rest = np.ascontiguousarray(planes.T).view(f"<{sort}{width}").reshape(3, -1).T.astype(np.int64)
                if folded:
                    rest = (rest >> 1) ^ -(rest & 1)
                now = expected + (np.cumsum(rest, axis=0) if kind >= _ALONG + 2 else rest)
                if np.abs(now).max() > 2**29:
                    raise InputError(f"{self.path}: sample {index} is damaged; copy the folder again")
                before, last = last, now
                yield (self._origin + now * self._step).astype(np.float32)


FORMAT = "physgen-packed-bake/1"
PACKED_FILE = "packed.json"
SUFFIX = ".packed"


@contextmanager
def _new(out: Path) -> Iterator[Path]:
    """Yield the folder that becomes ``out``, which is held meanwhile. Raises InputError where something is there."""
    with lock_beside(out):
        # Not before: another run may have written it meanwhile.
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: is there already; name a new folder")
        with replacing_tree(out) as partial:
            yield partial


def pack_bake(bake: Bake, *, out: Path, cancelled: IsCancelled = never) -> int:
    """Write the complete ``bake`` packed into the new folder ``out``; return its bytes.

    Every point is within 0.1 % of its object's size of where it was, and those of frame 1 are exact. Raises InputError
    for a bake that is not complete, damaged, or has splats, Cancelled; nothing is left then.
    """
    manifest = bake.manifest
    if manifest.state != "complete":
        raise InputError(f"{bake.root}: is {manifest.state}, and only a complete bake is packed; bake on")
    if any(item.splats for item in manifest.objects):
        raise InputError(f"{bake.root}: has splats, which are not packed; copy the folder as it is")
    require_intact(bake)
    with _new(out) as partial, unchanged_bake(bake):
        sums: dict[str, str] = {}
        for name in manifest.files:
            if cancelled():
                raise Cancelled("packing cancelled; nothing was written")
            pack_cache(Pc2Reader(bake.root / name), partial / f"{name}{SUFFIX}", manifest.frames)
            sums[f"{name}{SUFFIX}"] = file_sum(partial / f"{name}{SUFFIX}")
        for name in _others(bake.root, manifest):
            shutil.copyfile(bake.root / name, partial / name)
            sums[name] = file_sum(partial / name)
        content: dict[str, Any] = to_json(dataclasses.replace(manifest, checksums=()))
        write_json(partial / PACKED_FILE, {"format": FORMAT, "manifest": content, "sums": sums})
        return sum(path.stat().st_size for path in partial.iterdir())


def _others(root: Path, manifest: BakeManifest) -> list[str]:
    return [name for name in (METRICS_FILE, *manifest.torn_skin_file) if is_file(root / name)]


def unpack_bake(folder: Path, *, out: Path, cancelled: IsCancelled = never) -> Bake:
    """Return the bake packed in ``folder``, unpacked into the new folder ``out``, with checksums of its own.

    Raises InputError for a folder that is no packed bake, or damaged, Cancelled; nothing is left then.
    """
    path = folder / PACKED_FILE
    data = read_json(path, folder=folder)
    if not isinstance(data, dict) or data.get("format") != FORMAT or not isinstance(data.get("sums"), dict):
        raise InputError(f"{path}: is no packed bake ({FORMAT}); pack the bake again")
    manifest = parse(BakeManifest, data.get("manifest"), str(path))
    wanted = [*(f"{name}{SUFFIX}" for name in manifest.files), *manifest.torn_skin_file]
    others = [name for name in (METRICS_FILE, *manifest.torn_skin_file) if name in data["sums"]]
    for name in {*wanted, *others}:
        try:
            good = file_sum(inside(folder, name)) == data["sums"].get(name)
        except FileNotFoundError:
            good = False
        if not good:
            raise InputError(f"{folder / name}: is missing, or not what was packed; copy the folder again")
    with _new(out) as partial:
        checksums: list[Checksum] = []
        for name, count in manifest.files.items():
            packed = PackedCache(inside(folder, f"{name}{SUFFIX}"))
            if packed.vertex_count != count or packed.sample_count != manifest.frames:
                raise InputError(f"{packed.path}: has {packed.vertex_count} vertices, not {count}; pack the bake again")
            target = inside(partial, name)
            with Pc2Writer(
                target, vertex_count=count, start_frame=manifest.frame_start, span=span_for(manifest.frames)
            ) as writer:
                for sample in packed.samples():
                    if cancelled():
                        raise Cancelled("unpacking cancelled; nothing was written")
                    writer.append(sample)
                checksums.append(writer.checksum(name, ended=True))
        for name in others:
            shutil.copyfile(inside(folder, name), inside(partial, name))
            checksums.append(Checksum(file=name, sums=file_sum(partial / name)))
        save_manifest(partial, dataclasses.replace(manifest, checksums=tuple(checksums)))
    return load_bake(out)
