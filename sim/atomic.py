# SPDX-License-Identifier: MIT
"""Atomic writes: files and folders are written under a temporary name and take their place in one step at the end.

A temporary name holds the mark of its process (``sim/processes.py``): ``.NAME.partial-MARK.SUFFIX`` of what is
being written, ``.NAME.old-MARK`` of a folder that is being replaced where it cannot be exchanged. ``recover`` puts back
or removes what dead processes left, and nothing else.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError
from .files import shown, to_disk
from .processes import MARK, Mark, own_mark, parse_mark

WINDOWS_PAUSES = (0.01, 0.05, 0.2, 0.5)
"""Seconds between attempts: Windows refuses to replace a file that another process is reading, or a folder with one."""
_PATIENT = os.name == "nt"

_TEMPORARY = re.compile(rf"\.(?P<name>.+)\.(?P<role>partial|old)-(?P<mark>{MARK})(?P<suffix>(?:\.[^/]*)?)", re.DOTALL)
_LOCK_OF_TEMPORARY = re.compile(rf"\.(?P<of>\..+\.(?:partial|old)-{MARK})\.lock", re.DOTALL)
_LIBRARYS = re.compile(r"\.[A-Za-z0-9]{6}")
"""Suffix in place of ours of the file in which usd-core first writes what it is to write under a temporary name."""
_SCRATCH = re.compile(rf"physgen-(?:[a-z]+-)?(?P<mark>{MARK})-.+")

LONGEST_NAME = 255
"""Bytes of the longest name on usual file systems."""
MOST_DEPTH, MOST_ENTRIES = 3, 100_000
"""Depth, and number of names, to which ``recover`` looks in a folder: ours are not deeper."""

_unfinished: set[Path] = set()
"""Files that this process is writing, to be removed by an exit that skips ``finally`` blocks."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it replaces ``path``, on failure it is removed.

    The suffix stays, because image writers choose the format by it. Raises InputError when the disk is full or the
    folder cannot be written.
    """
    partial = path.with_name(f".{path.stem}.partial-{own_mark()}{path.suffix}")
    _require_short(path, partial)
    _unfinished.add(partial)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        # The content first: a name that points to blocks never written is what a power cut leaves otherwise.
        _sync_tree(partial) if partial.is_dir() else to_disk(partial)
        _replace(partial, path)
    except OSError as error:
        raise InputError(
            f"{final_path(path)}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
    finally:
        _remove(partial)
        _unfinished.discard(partial)


def _require_short(path: Path, *temporary: Path) -> None:
    """Raise InputError if a ``temporary`` name of ``path`` is longer than file systems allow."""
    longest = max(len(os.fsencode(name.name)) for name in temporary)
    if longest > LONGEST_NAME:
        most = LONGEST_NAME - longest + len(os.fsencode(path.name))
        raise InputError(
            f"{shown(final_path(path))}: the name is too long to be written; choose one of at most {most} bytes"
        )


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an OSError that names no file, as those of writing and flushing, name ``path``."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def final_path(path: Path) -> Path:
    """Return ``path`` with every temporary name replaced by the one that it becomes, for messages."""
    found = [_TEMPORARY.fullmatch(part) for part in path.parts]
    return Path(
        *(match["name"] + match["suffix"] if match else part for part, match in zip(path.parts, found, strict=True))
    )


@contextmanager
def replacing_tree(out: Path) -> Iterator[Path]:
    """Yield a fresh folder beside the folder ``out``; on success it becomes ``out``, on failure it is removed.

    ``out`` is at every moment the whole earlier folder or the whole new one, whatever kills the process: the two are
    exchanged in one call, where the system has one. Elsewhere the earlier one is moved aside first, and a process that
    dies between the two calls leaves it as ``.NAME.old-MARK``, from where ``recover`` puts it back. The caller holds a
    lock of ``out``. Raises OSError, and InputError for a name that is too long.
    """
    partial, old = (out.with_name(f".{out.name}.{role}-{own_mark()}") for role in ("partial", "old"))
    _require_short(out, partial)
    _unfinished.add(partial)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _remove(partial)
        partial.mkdir()
        yield partial
        _sync_tree(partial)
        if out.exists() and not _exchange(partial, out):
            _move_aside(partial, out, old)
        elif not out.exists():
            _replace(partial, out)
        _sync_names(out.parent)
    finally:
        # After an exchange this is the earlier folder.
        _remove(partial)
        if out.exists():
            _remove(old)
        _unfinished.discard(partial)


def _move_aside(partial: Path, out: Path, old: Path) -> None:
    _replace(out, old)
    _sync_names(out.parent)
    try:
        _replace(partial, out)
    except OSError:
        _replace(old, out)
        raise


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two folders of one file system in one step; False where the system cannot, with nothing changed."""
    names = os.fsencode(first), os.fsencode(second)
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "linux":
            # AT_FDCWD is -100, RENAME_EXCHANGE is 2.
            code = library.renameat2(-100, names[0], -100, names[1], ctypes.c_uint(2))
        elif sys.platform == "darwin":
            # RENAME_SWAP is 2.
            code = library.renamex_np(*names, ctypes.c_uint(2))
        else:
            return False
    except (OSError, AttributeError, TypeError):
        return False
    if code == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EPERM):
        return False
    raise OSError(number, os.strerror(number), str(second))


def _sync_names(folder: Path) -> None:
    """Have the system write the names in ``folder`` to the disk, as far as it can: what they name is in place."""
    with contextlib.suppress(OSError):
        to_disk(folder)


def _sync_tree(folder: Path) -> None:
    for root, _, names in os.walk(folder):
        for name in names:
            to_disk(Path(root) / name)
        to_disk(Path(root))


def _remove(path: Path) -> None:
    """Remove ``path``, a file, link or whole folder, if it is there and can be."""
    with contextlib.suppress(OSError):
        if stat.S_ISDIR(path.lstat().st_mode):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def remove_unfinished() -> None:
    """Remove all that this process has not finished writing, for an exit that skips ``finally`` blocks."""
    for path in list(_unfinished):
        _remove(path)
        for left in _entries(path.parent):
            if left.stem == path.stem and _LIBRARYS.fullmatch(left.suffix):
                _remove(left)


def _replace(partial: Path, path: Path) -> None:
    for pause in WINDOWS_PAUSES:
        try:
            partial.replace(path)
            return
        except PermissionError:
            if not _PATIENT:
                raise
            time.sleep(pause)
    partial.replace(path)


def recover(path: Path) -> list[str]:
    """Put back or remove what dead processes of this machine left of the file or folder ``path``; say what was done.

    Looks at temporary names of ``path`` beside it, and, where it is a folder, at all in it; never at others, through a
    link, or at what a living process or another machine's is writing. Each sentence is for the user.
    """
    notices: list[str] = []
    path = path.parent.resolve() / path.name
    for left in _dead_beside(path):
        notices.append(_put_back_or_removed(left))
    if path.is_dir() and not path.is_symlink():
        for left in _dead_within(path):
            notices.append(_put_back_or_removed(left))
    return notices


def _put_back_or_removed(left: Path) -> str:
    found = _TEMPORARY.fullmatch(left.name)
    is_lock = _LOCK_OF_TEMPORARY.fullmatch(left.name) is not None
    if found is not None and found["role"] == "old" and found["name"] not in (".", "..") and not is_lock:
        path = left.with_name(found["name"])
        if not path.exists():
            with contextlib.suppress(OSError):
                left.rename(path)
                return f"{path}: was put back, as a run that replaced it was killed in the middle"
    _remove(left)
    return f"{left}: removed, left by a run that was killed"


@contextmanager
def own_scratch() -> Iterator[Path | None]:
    """Yield one folder for all temporary files of this process and its children, removed at the end.

    Whatever ends them, ``recover_scratch`` then finds all they left, that of other programs too. None where there can
    be no such folder.
    """
    names = ("TMPDIR", "TEMP", "TMP")
    former, earlier = tempfile.tempdir, {name: os.environ.get(name) for name in names}
    try:
        folder = Path(tempfile.mkdtemp(prefix=scratch_prefix()))
    except OSError:
        yield None
        return
    _unfinished.add(folder)
    tempfile.tempdir = str(folder)
    os.environ.update(dict.fromkeys(names, str(folder)))
    try:
        yield folder
    finally:
        tempfile.tempdir = former
        for name, value in earlier.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        _remove(folder)
        _unfinished.discard(folder)


def recover_scratch(folder: Path | None = None) -> list[str]:
    """Remove the folders that this user's dead processes left among the system's temporary files; say so.

    folder: in place of the system's, for tests.
    """
    place, notices = folder or Path(tempfile.gettempdir()), []
    for left in _entries(place):
        # A child of the dead process may still be about to end.
        if _is_dead_scratch(left) and all(_is_dead_scratch(inner) is not False for inner in _entries(left)):
            _remove(left)
            notices.append(f"{left}: removed, left by a run that was killed")
    return notices


def _is_dead_scratch(path: Path) -> bool | None:
    """Return whether the temporary folder ``path`` of ours is a dead process's; None if it is none of ours."""
    found = _SCRATCH.fullmatch(path.name)
    mark = parse_mark(found["mark"]) if found else None
    return None if mark is None or not _is_ours(path) else mark.is_dead


def scratch_prefix(what: str = "") -> str:
    """Return the start of the name of a temporary folder of this process, by which ``recover_scratch`` knows it."""
    return f"physgen-{what + '-' if what else ''}{own_mark()}-"


def _entries(folder: Path) -> Iterable[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return ()


def _is_ours(path: Path) -> bool:
    try:
        return os.name == "nt" or path.lstat().st_uid == os.getuid()
    except OSError:
        return False


def _dead_mark(name: str) -> Mark | None:
    """Return whose ``name`` is, if it is a temporary name of a dead process; the innermost of several counts."""
    found = _TEMPORARY.fullmatch(name)
    mark = parse_mark(found["mark"]) if found else None
    return mark if mark is not None and mark.is_dead else None


def _dead_beside(path: Path) -> Iterator[Path]:
    for left in _entries(path.parent):
        if _dead_mark(left.name) and _is_ours(left) and (path.name in _names(left.name) or _is_librarys(left, path)):
            yield left


def _is_librarys(left: Path, path: Path) -> bool:
    """Return whether ``left`` is what a library wrote in place of the temporary file of ``path``."""
    found = _TEMPORARY.fullmatch(left.name)
    if found is None or found["role"] != "partial" or found["name"] != path.stem:
        return False
    return _LIBRARYS.fullmatch(found["suffix"]) is not None and not left.is_dir()


def _names(name: str) -> Iterator[str]:
    """Yield what a temporary ``name`` is of: a temporary name may be of another one, and a lock beside one."""
    if lock := _LOCK_OF_TEMPORARY.fullmatch(name):
        yield from _names(lock["of"])
    while found := _TEMPORARY.fullmatch(name):
        yield found["name"]
        yield found["name"] + found["suffix"]
        name = found["name"]


def _dead_within(folder: Path) -> Iterator[Path]:
    seen = 0
    for root, folders, names in os.walk(folder):
        seen += len(folders) + len(names)
        if seen > MOST_ENTRIES:
            return
        for name in sorted([*folders, *names]):
            path = Path(root) / name
            if _dead_mark(name) and _is_ours(path):
                yield path
        deep = len(Path(root).relative_to(folder).parts) >= MOST_DEPTH - 1
        folders[:] = [] if deep else [name for name in folders if not _TEMPORARY.fullmatch(name)]


def write_json(path: Path, value: Any, *, mode: int | None = None) -> None:
    """Write ``value`` atomically as indented UTF-8 JSON; ``mode``: permissions. Raises ValueError for NaN, infinity."""
    with replacing(path) as partial:
        if mode is not None:
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
        partial.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write ``content`` atomically."""
    with replacing(path) as partial:
        partial.write_bytes(content)
