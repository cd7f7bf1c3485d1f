# SPDX-License-Identifier: MIT
"""One writer per folder. The kernel holds the lock, so that it ends with its process, whatever that ends by.

The lock file's text, process, start, machine, is for people and for whoever looks without taking it (``is_locked``).
The file is locked by ``flock``, or by ``msvcrt.locking`` on Windows; where a file system has no locks (some network
disks), its text decides. Locks of another machine are respected by the kernel where the disk passes them on, and
otherwise by the text that a run leaves there until its end.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import InputError
from .processes import UNKNOWN_START, Mark, own_mark, parse_mark

LOCK_FILE = ".lock"
MOST_BYTES = 4096
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EINVAL, getattr(errno, "ENOTSUP", errno.ENOSYS), errno.EOPNOTSUPP)
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
_UNWRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)


@dataclass
class _Held:
    """A lock of this process: its open file, the thread that holds it, and how many times."""

    file: int
    thread: int
    times: int = 1


_held: dict[str, _Held] = {}
_guard = threading.Lock()


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold ``folder`` for this thread, by a file in it. Where it is not there, it is made, and goes again if it stays
    empty.

    Raises InputError when another process or thread holds it.
    """
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        with _locked(folder / LOCK_FILE, folder):
            yield
    finally:
        if made:
            # Unless there is something in it.
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextmanager
def lock_beside(folder: Path) -> Iterator[None]:
    """Hold ``folder``, which may be replaced meanwhile, by a file beside it; the thread that holds it may do so again.

    A folder that cannot be written at all needs no lock. Raises InputError when another process or thread holds it.
    """
    folder = folder.resolve()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    with _locked(folder.with_name(f".{folder.name}{LOCK_FILE}"), folder, may_lack=True):
        yield


def _unwritable(folder: Path, error: OSError) -> InputError:
    remedy = "free space or choose another folder" if error.errno in _FULL else "choose another folder"
    return InputError(f"{folder}: cannot be written ({error.strerror or error}); {remedy}")


@contextmanager
def _locked(path: Path, folder: Path, *, may_lack: bool = False) -> Iterator[None]:
    key = os.path.realpath(path)
    with _guard:
        held = _held.get(key)
        if held is not None and held.thread == threading.get_ident():
            held.times += 1
        elif held is not None:
            raise InputError(f"{folder}: in use by another job of this process ({os.getpid()}); wait for it")
        else:
            try:
                _held[key] = _Held(_acquired(path, folder), threading.get_ident())
            except OSError as error:
                if not (may_lack and error.errno in _UNWRITABLE):
                    raise _unwritable(folder, error) from error
                key = ""
    try:
        yield
    finally:
        if key:
            with _guard:
                held = _held[key]
                held.times -= 1
                if held.times == 0:
                    _release(path, _held.pop(key).file)


def _acquired(path: Path, folder: Path) -> int:
    """Return the open and locked file at ``path``. Raises InputError where it is held, OSError."""
    for _ in range(100):
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        good = False
        try:
            about = os.fstat(file)
            if not stat.S_ISREG(about.st_mode) or about.st_nlink > 1:
                # It would be written over: under its other name it may be anything of the user's.
                raise InputError(f"{path}: is no lock file, but a pipe, or another name of another file; remove it")
            by_kernel = _take(file)
            owner = _owner(path)
            if by_kernel is False:
                raise InputError(_in_use(folder, path, owner))
            # Whoever had it may have removed it meanwhile: then this is no longer the file of that name.
            if not _is_at(file, path):
                continue
            if owner is not None and not owner.is_here:
                raise InputError(_in_use(folder, path, owner))
            if by_kernel is None and owner is not None and owner != own_mark() and not owner.is_dead:
                raise InputError(_in_use(folder, path, owner))
            try:
                _write_owner(file)
            except OSError:
                # The disk is full: no empty file stays there.
                if by_kernel:
                    with contextlib.suppress(OSError):
                        path.unlink()
                raise
            good = True
            return file
        finally:
            if not good:
                os.close(file)
    raise InputError(f"{folder}: another run took this folder just now; wait for it or choose another folder")


def _take(file: int) -> bool | None:
    """Lock the open ``file``; False if it is taken, None where the file system has no locks."""
    try:
        if os.name == "nt":
            import msvcrt

            windows: Any = msvcrt
            # Far behind the text, which others may then still read.
            os.lseek(file, 2**30, os.SEEK_SET)
            windows.locking(file, windows.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        if os.name == "nt" and error.errno in (errno.EACCES, errno.EDEADLK):
            return False
        raise
    return True


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.lstat())
    except FileNotFoundError:
        return False


def _write_owner(file: int) -> None:
    mark = own_mark()
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    text = json.dumps({"pid": mark.pid, "host": socket.gethostname(), "since": since, "mark": str(mark)})
    os.lseek(file, 0, os.SEEK_SET)
    os.ftruncate(file, 0)
    os.write(file, text.encode())


def _release(path: Path, file: int) -> None:
    """Remove the lock file while holding it, so that it cannot be another process's, then release it."""
    with contextlib.suppress(OSError):
        if os.name != "nt" and _is_at(file, path):
            path.unlink()
    os.close(file)
    if os.name == "nt":
        # An open file cannot be removed there; where somebody else has opened it meanwhile, this fails.
        with contextlib.suppress(OSError):
            path.unlink()


def release_all() -> None:
    """Release what this process holds, for when it must end without leaving its ``with`` statements."""
    for path, held in list(_held.items()):
        with contextlib.suppress(OSError):
            _release(Path(path), held.file)
    _held.clear()


def remove_dead_lock(path: Path) -> bool:
    """Remove the lock file at ``path`` if the process that it names is dead, or died before it named itself, and nobody
    holds it; return whether it did."""
    owner = _owner(path)
    try:
        if not (owner.is_dead if owner else path.is_file() and path.stat().st_size == 0):
            return False
        file = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return False
    if _take(file) is False or not _is_at(file, path):
        os.close(file)
        return False
    _release(path, file)
    return True


def is_locked(folder: Path) -> bool:
    """Return whether another living process of this machine holds ``folder``; judged by the text, taking nothing."""
    owner = _owner(folder / LOCK_FILE)
    return owner is not None and owner.pid != os.getpid() and owner.is_here and not owner.is_dead


def is_held(folder: Path) -> bool:
    """The same, also for a run on another machine, of which it is not known whether it lives."""
    owner = _owner(folder / LOCK_FILE)
    return is_locked(folder) or (owner is not None and not owner.is_here)


def _text(path: Path) -> Any:
    """Return what the lock file says; of a longer file, which is none of ours, its beginning."""
    with path.open("rb") as file:
        return json.loads(file.read(MOST_BYTES))


def _owner(path: Path) -> Mark | None:
    """Return who the text at ``path`` names; None for none, or no such text."""
    try:
        if not path.is_file():
            return None
        data = _text(path)
        mark = parse_mark(str(data.get("mark", "")))
        if mark is not None:
            return mark
        if str(data["host"]) != socket.gethostname():
            return Mark(int(data["pid"]), UNKNOWN_START, "another!")
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, AttributeError):
        pass
    return None


def _in_use(folder: Path, path: Path, owner: Mark | None) -> str:
    if owner is None:
        return f"{folder}: in use by another process; wait for it, stop it, or choose another folder"
    if owner.is_here:
        return f"{folder}: in use by process {owner.pid}; wait for it, stop it, or choose another folder"
    try:
        host = str(_text(path)["host"])[:100]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        host = "another machine"
    return f"{folder}: in use by process {owner.pid} on {host}; if that run is gone, delete {path}"
