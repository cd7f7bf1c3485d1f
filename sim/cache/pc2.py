# SPDX-License-Identifier: MIT
"""PC2 point caches: one sample of all vertices per frame, float32.

The format of Blender's Mesh Cache modifier: a little-endian header of 32 bytes

    char[12] "POINTCACHE2\\0" · int32 version 1 · int32 vertices · float32 start · float32 rate · int32 samples

followed by samples × vertices × 3 float32.
"""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from ..atomic import naming
from ..checksums import Checksum, RunningSums, sync
from ..errors import InputError
from ..files import open_file

_HEADER = struct.Struct("<12siiffi")
_SIGNATURE = b"POINTCACHE2\0"
MAX_VERTICES = 50_000_000
"""A header that claims more is refused; a sample of that size is 600 MB."""
MAX_CACHE_BYTES = 2**44


HEADER_BYTES = _HEADER.size


def header(vertex_count: int, start_frame: int, samples: int) -> bytes:
    """Return the header of a cache."""
    return _HEADER.pack(_SIGNATURE, 1, vertex_count, float(start_frame), 1.0, samples)


class Pc2Reader:
    """A cache on disk: opening reads the header, samples are read on request.

    Not memory-mapped, because a bake may truncate the file, which would crash a process that has mapped it.

    Raises InputError when the file is missing, not PC2, or shorter than its header says.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_file(path, MAX_CACHE_BYTES, what="point cache") as file:
                size = os.fstat(file.fileno()).st_size
                head = file.read(_HEADER.size)
        except FileNotFoundError:
            raise InputError(f"{path}: there is no such point cache; bake the scene again") from None
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from None
        if len(head) < _HEADER.size or head[:12] != _SIGNATURE:
            raise InputError(f"{path}: not a PC2 point cache; bake the scene again")
        _, version, vertices, start, rate, samples = _HEADER.unpack(head)
        if version != 1 or not 0 < vertices <= MAX_VERTICES or samples < 0 or not 0 < rate < math.inf:
            raise InputError(
                f"{path}: PC2 header of version {version}, {vertices} vertices, {samples} samples is invalid; rebake"
            )
        if size < _HEADER.size + samples * vertices * 12:
            raise InputError(
                f"{path}: cut off: {samples} samples of {vertices} vertices do not fit in {size} bytes; bake again"
            )
        self.vertex_count: int = vertices
        self.sample_count: int = samples
        self.start_frame: float = start
        self.sample_rate: float = rate

    def sample(self, index: int) -> NDArray[np.float32]:
        """Return the vertex positions (V, 3) of sample ``index`` from 0. Raises InputError out of range."""
        if not 0 <= index < self.sample_count:
            raise InputError(
                f"{self.path}: has {self.sample_count} samples, so there is no sample {index}; bake more frames"
            )
        count = 3 * self.vertex_count
        try:
            with open_file(self.path, MAX_CACHE_BYTES, what="point cache") as file:
                numbers = np.fromfile(file, dtype="<f4", count=count, offset=_HEADER.size + 4 * index * count)
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror or error}; bake again") from None
        if len(numbers) < count:
            raise InputError(f"{self.path}: was cut off at sample {index} meanwhile; wait for the bake, or bake again")
        sample: NDArray[np.float32] = numbers.reshape(-1, 3).astype(np.float32, copy=False)
        if not np.isfinite(sample).all():
            raise InputError(f"{self.path}: sample {index} has positions that are not finite; bake again")
        return sample


class Pc2Writer:
    """Appends samples; the header is updated after each, so that a killed run leaves a readable file.

    Opened on an existing cache, it keeps the first ``keep`` samples and drops the rest; with ``over`` it writes over
    the existing samples and keeps those behind. span: samples that one checksum covers (``checksum``).
    """

    def __init__(
        self, path: Path, *, vertex_count: int, start_frame: int = 1, keep: int = 0, over: int = 0, span: int = 1
    ) -> None:
        if not 0 < vertex_count <= MAX_VERTICES:
            raise InputError(f"{path}: a cache of {vertex_count} vertices cannot be written")
        self.path = path
        self.vertex_count = vertex_count
        self.sample_count = keep
        self._start_frame = float(start_frame)
        if keep:
            existing = Pc2Reader(path)
            if existing.vertex_count != vertex_count or existing.sample_count < keep:
                raise InputError(f"{path}: does not have the {keep} samples of {vertex_count} vertices to resume from")
        self._sums = RunningSums(span)
        self._over = over
        self._file = path.open("r+b" if keep or (over and path.exists()) else "w+b")
        try:
            # The header first: readers, and a resume after a kill between the two, always find the samples it promises.
            self._write_header()
            with naming(path):
                self._file.truncate(_HEADER.size + max(keep, over) * vertex_count * 12)
            self._file.seek(_HEADER.size)
            for _ in range(keep):
                self._sums.add(self._file.read(vertex_count * 12))
        except BaseException:
            with naming(path):
                self._file.close()
            raise

    def append(self, positions: NDArray[np.floating]) -> None:
        """Append one sample of finite positions (V, 3)."""
        sample = np.ascontiguousarray(positions, dtype="<f4")
        if sample.shape != (self.vertex_count, 3):
            raise InputError(f"{self.path}: a sample of shape {sample.shape} does not fit {self.vertex_count} vertices")
        if not np.isfinite(sample).all():
            raise InputError(f"{self.path}: sample {self.sample_count} has positions that are not finite")
        content = sample.tobytes()
        with naming(self.path):
            self._file.seek(_HEADER.size + self.sample_count * len(content))
            self._file.write(content)
        self._sums.add(content)
        self.sample_count += 1
        self._write_header()

    def _write_header(self) -> None:
        with naming(self.path):
            self._file.seek(0)
            self._file.write(header(self.vertex_count, int(self._start_frame), max(self.sample_count, self._over)))
            self._file.flush()

    def checksum(self, file: str, *, ended: bool) -> Checksum:
        """Return the checksum, for the manifest, of the samples so far; of whole ranges alone unless ``ended``."""
        return self._sums.checksum(file, ended=ended)

    def to_disk(self) -> None:
        """Wait until the samples so far are on the disk, also after an error has closed the file."""
        if not self._file.closed:
            sync(self._file)
            return
        with self.path.open("r+b") as file:
            os.fsync(file.fileno())

    def close(self) -> None:
        """Flush to disk and close."""
        if not self._file.closed:
            with naming(self.path):
                try:
                    self._file.flush()
                    os.fsync(self._file.fileno())
                finally:
                    # What could not be written is tried again, and fails again.
                    self._file.close()

    def __enter__(self) -> Pc2Writer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
