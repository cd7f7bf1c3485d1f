# SPDX-License-Identifier: GPL-3.0-or-later
"""What a task was made from and what it made, by content: by this it is known that nothing is left to do."""

from __future__ import annotations

import os
import stat
import time
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ...sim.app.bake_inputs import file_hash
from ...sim.atomic import write_json
from ...sim.cache.manifest import MANIFEST_FILE, load_manifest
from ...sim.errors import InputError
from ...sim.scene.folder import inside
from ...sim.scene.json_fields import parse, read_json, to_json
from .task import Task

FORMAT = "physgen-task/1"
SETTLED_S = 2.0
"""A file that changed less long ago may change again within the tick of the file system's clock: it is always read."""

_Hashes = dict[Path, tuple[tuple[int, int, int], str]]
_known: _Hashes = {}
"""Hashes of files that this process has read, with size, time of change and inode: chunks share scene and bake."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """What is remembered of a task that was done.

    argv: as it was run. version: of the program. inputs, produced: (name relative to the root, SHA-256) of files.
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
    """Where the record of ``task`` is; InputError for an id that leads out of its folder."""
    return inside(root, f"{task.farm_folder}/records/{task.id}.json")


def log_path(task: Task, root: Path) -> Path:
    """Where the log of ``task`` is; InputError for an id that leads out of its folder."""
    return inside(root, f"{task.farm_folder}/logs/{task.id}.log")


def load_record(task: Task, root: Path) -> Record | None:
    """The record of ``task``; None when there is none that can be read."""
    try:
        data = read_json(record_path(task, root))
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            return None
        return parse(Record, data, "record")
    except InputError:
        return None


def save_record(task: Task, root: Path, record: Record) -> None:
    """Write the record of ``task``, atomically. Raises InputError when it cannot be written."""
    write_json(record_path(task, root), {"format": FORMAT, **to_json(record)})


def input_hashes(task: Task, root: Path) -> tuple[tuple[str, str], ...]:
    """(name, SHA-256) of all files that the result of ``task`` depends on, those in folders included, in order.

    Names that begin with a dot (locks, records, files half written) are none. Raises InputError for what is missing.
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
    """(name, SHA-256) of the files that ``task`` has to leave. Raises InputError for what is missing.

    Of a bake, all caches that its manifest lists are among them: which objects have particles is known only by then.
    """
    names = set(task.produces)
    for manifest in (PurePosixPath(name) for name in task.produces if task.stage == "bake"):
        if manifest.name == MANIFEST_FILE:
            caches = load_manifest(inside(root, str(manifest)).parent).files
            names |= {str(manifest.parent / cache) for cache in caches}
    return tuple((name, content_hash(inside(root, name))) for name in sorted(names))


def content_hash(path: Path) -> str:
    """SHA-256 of a file; one that this process has read and that has not changed since is not read again."""
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    if not stat.S_ISREG(state.st_mode):
        raise InputError(f"{path}: is no file; move it away")
    seen = (state.st_size, state.st_mtime_ns, state.st_ino)
    known = _known.get(path)
    if known is not None and known[0] == seen:
        return known[1]
    result = file_hash(path)
    if time.time() - state.st_mtime > SETTLED_S:
        _known[path] = (seen, result)
    return result


def kept_record(task: Task, root: Path, version: str) -> Record | None:
    """The record of ``task`` if the same arguments and inputs have already made exactly the files that are there."""
    record = load_record(task, root)
    if record is None or (record.task, record.version, record.argv) != (task.id, version, task.argv):
        return None
    try:
        same = record.produced == produced_hashes(task, root) and record.inputs == input_hashes(task, root)
    except InputError:
        return None
    return record if same else None
