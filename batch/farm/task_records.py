# SPDX-License-Identifier: GPL-3.0-or-later
"""Logs and records of a farm's tasks, and whether a record is up to date."""

from __future__ import annotations

import os
import stat
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import TracebackType

from ...sim.atomic import write_json
from ...sim.cache.bake_folder import MANIFEST_FILE, load_manifest
from ...sim.errors import InputError
from ...sim.files import MOST_HASHED, open_file
from ...sim.scene.folder import file_hash, inside
from ...sim.validation import parse, read_json, to_json
from .planning.plan import Task

HEAD_BYTES = 256 * 1024
TAIL_BYTES = 256 * 1024
EARLIER_BYTES = 64 * 1024
"""Of earlier attempts, kept at the beginning."""
RECORD_FORMAT = "physgen-task/1"
SETTLED_S = 2.0
"""A more recently changed file may change again within the file system's clock tick: it is always hashed."""
_Hashes = dict[Path, tuple[tuple[int, int, int], str]]
_known: _Hashes = {}
"""Cached hashes with size, modification time and inode: chunks share scene and bake."""


class TaskLog:
    """The log of one attempt: its beginning is written at once, its end on close.

    Raises InputError when it cannot be created; later write errors are ignored, so that a full disk does not stop a
    task that needs no more space.
    """

    def __init__(self, path: Path, title: str) -> None:
        self.path = path
        self._left = HEAD_BYTES
        self._tail: deque[bytes] = deque()
        self._tail_bytes = self._dropped = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() and not path.is_file():
                raise InputError(f"{path}: is no regular file, so no log can be written there; move it away")
            earlier = _end_of(path, EARLIER_BYTES)[0]
            self._file = path.open("wb", buffering=0)
            self._file.write(earlier + f"==== {title}\n".encode())
        except OSError as error:
            raise InputError(
                f"{path}: cannot be written ({error.strerror or error}); free space or choose another folder"
            ) from error

    def write(self, line: bytes) -> None:
        """Add one line."""
        line = line.rstrip(b"\r\n") + b"\n"
        if len(line) <= self._left:
            self._left -= len(line)
            self._put(line)
            return
        self._left = 0
        self._tail.append(line)
        self._tail_bytes += len(line)
        while self._tail_bytes > TAIL_BYTES:
            self._tail_bytes -= len(self._tail.popleft())
            self._dropped += 1

    def close(self) -> None:
        """Write the end and close the file."""
        if self._dropped:
            self._put(f"… {self._dropped} lines omitted …\n".encode())
        self._put(b"".join(self._tail))
        self._file.close()

    def _put(self, content: bytes) -> None:
        try:
            self._file.write(content)
        except OSError:
            self._left = 0

    def __enter__(self) -> TaskLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def log_end(path: Path, most: int = 4096) -> str:
    """Return the last ``most`` bytes of a log, from the start of a line; empty if there is none."""
    content, size = _end_of(path, most)
    if size > most:
        content = content.partition(b"\n")[2]
    return content.decode("utf-8", "replace")


def _end_of(path: Path, most: int) -> tuple[bytes, int]:
    """Return the last ``most`` bytes of the regular file ``path``, and its size; nothing where there is none."""
    try:
        # A pipe would keep whoever opens it waiting, and a file that claims a terabyte takes all memory.
        with open_file(path, MOST_HASHED) as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - most))
            return file.read(most), size
    except (OSError, InputError):
        return b"", 0


@dataclass(frozen=True, kw_only=True)
class Record:
    """Record of a finished task.

    argv: as run. version: of the program. inputs, produced: (name relative to the root, SHA-256) of files.
    seconds, cpu_seconds, worker: as in ``Outcome``.
    """

    task: str
    version: str
    argv: tuple[str, ...]
    inputs: tuple[tuple[str, str], ...]
    produced: tuple[tuple[str, str], ...]
    seconds: float
    cpu_seconds: float
    worker: str


def record_path(task: Task, root: Path) -> Path:
    """Return the path of the record of ``task``. Raises InputError for an id that leads out of its folder."""
    return inside(root, f"{task.farm_folder}/records/{task.id}.json")


def log_path(task: Task, root: Path) -> Path:
    """Return the path of the log of ``task``. Raises InputError for an id that leads out of its folder."""
    return inside(root, f"{task.farm_folder}/logs/{task.id}.log")


def load_record(task: Task, root: Path) -> Record | None:
    """Return the record of ``task``; None if there is no readable one."""
    try:
        data = read_json(record_path(task, root))
        if not isinstance(data, dict) or data.pop("format", None) != RECORD_FORMAT:
            return None
        return parse(Record, data, "record")
    except InputError:
        return None


def save_record(task: Task, root: Path, record: Record) -> None:
    """Write the record of ``task``, atomically. Raises InputError when it cannot be written."""
    write_json(record_path(task, root), {"format": RECORD_FORMAT, **to_json(record)})


def input_hashes(task: Task, root: Path) -> tuple[tuple[str, str], ...]:
    """Return (name, SHA-256) of all input files of ``task``, including those in folders, sorted.

    Names that begin with a dot (locks, records, partial files) are skipped. Raises InputError for missing files.
    """
    found: dict[str, str] = {}
    for name in task.inputs:
        path = inside(root, name)
        if path.is_dir():
            for folder, folders, files in os.walk(path):
                folders[:] = [f for f in folders if not f.startswith(".")]
                for file in (Path(folder, f) for f in files if not f.startswith(".")):
                    found[file.relative_to(root).as_posix()] = content_hash(file)
        else:
            found[name] = content_hash(path)
    return tuple(sorted(found.items()))


def produced_hashes(task: Task, root: Path) -> tuple[tuple[str, str], ...]:
    """Return (name, SHA-256) of the output files of ``task``, sorted. Raises InputError for missing files.

    For a bake these include all caches in its manifest: which objects have particles is known only afterwards.
    """
    names = set(task.produces)
    for manifest in (PurePosixPath(name) for name in task.produces if task.stage == "bake"):
        if manifest.name == MANIFEST_FILE:
            caches = load_manifest(inside(root, str(manifest)).parent).files
            names |= {str(manifest.parent / cache) for cache in caches}
    return tuple((name, content_hash(inside(root, name))) for name in sorted(names))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file, cached by this process while the file is unchanged."""
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    if not stat.S_ISREG(state.st_mode):
        raise InputError(f"{path}: is not a regular file; move it away")
    seen = (state.st_size, state.st_mtime_ns, state.st_ino)
    known = _known.get(path)
    if known is not None and known[0] == seen:
        return known[1]
    result = file_hash(path)
    if time.time() - state.st_mtime > SETTLED_S:
        _known[path] = (seen, result)
    return result


def up_to_date_record(task: Task, root: Path, version: str) -> Record | None:
    """Return the record of ``task`` if arguments, inputs and outputs are unchanged since; else None."""
    record = load_record(task, root)
    if record is None or (record.task, record.version, record.argv) != (task.id, version, task.argv):
        return None
    try:
        same = record.produced == produced_hashes(task, root) and record.inputs == input_hashes(task, root)
    except InputError:
        return None
    return record if same else None
