# SPDX-License-Identifier: MIT
"""One writer per folder: a lock file that names its process, so that a crash never blocks the next run."""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError

LOCK_FILE = ".lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold ``folder`` for this process.

    Raises InputError when a living process on this machine, or any process of another machine, holds it. The lock of a
    dead process is taken over.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / LOCK_FILE
        _acquire(path)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def release_lock(folder: Path) -> None:
    """Release ``folder`` if this process holds it, for when it must end without leaving ``folder_lock``."""
    path = folder / LOCK_FILE
    try:
        owner = json.loads(path.read_bytes())
        if (owner["pid"], owner["host"]) == (os.getpid(), socket.gethostname()):
            path.unlink()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return


def is_locked(folder: Path) -> bool:
    """Return whether another living process of this machine holds ``folder``."""
    try:
        owner = json.loads((folder / LOCK_FILE).read_bytes())
        pid, host = int(owner["pid"]), str(owner["host"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return False
    return host == socket.gethostname() and pid != os.getpid() and process_alive(pid)


def _acquire(path: Path) -> None:
    """Create the lock at ``path``: written beside it and linked, so that a partial one is never read."""
    mine = path.with_name(f"{LOCK_FILE}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    mine.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))
    try:
        for _ in range(3):
            try:
                _publish(mine, path)
            except FileExistsError:
                _drop_if_dead(path)
                continue
            return
    finally:
        mine.unlink(missing_ok=True)
    raise InputError(f"{path.parent}: another run took this folder just now; wait for it or choose another folder")


def _publish(mine: Path, path: Path) -> None:
    """Make ``path`` a lock with the content of ``mine``. Raises FileExistsError if there is one."""
    try:
        os.link(mine, path)
    except FileExistsError:
        raise
    except OSError:
        # exFAT and some network file systems have no hard links.
        with path.open("xb") as file:
            file.write(mine.read_bytes())


def _drop_if_dead(path: Path) -> None:
    """Remove the lock of a dead process. Raises InputError if it is alive or on another machine."""
    content = b""
    try:
        content = path.read_bytes()
        owner = json.loads(content)
        pid, host = int(owner["pid"]), str(owner["host"])
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        pid, host = 0, socket.gethostname()
    if host != socket.gethostname():
        raise InputError(f"{path.parent}: in use by process {pid} on {host}; if that run is gone, delete {path}")
    if pid != os.getpid() and process_alive(pid):
        raise InputError(f"{path.parent}: in use by process {pid}; wait for it, stop it, or choose another folder")
    # Renamed to a unique name: of two processes that find it dead, one gets it, and checks that it is unchanged.
    taken = path.with_name(f"{LOCK_FILE}-dead-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        path.rename(taken)
        if taken.read_bytes() != content:
            _publish(taken, path)
    except (FileNotFoundError, FileExistsError):
        return
    finally:
        taken.unlink(missing_ok=True)


def process_alive(pid: int) -> bool:
    """Return whether a process ``pid`` runs on this machine."""
    if pid <= 0:
        return False
    if os.name == "nt":
        import ctypes

        handle = ctypes.windll.kernel32.OpenProcess(0x1000, False, pid)  # type: ignore[attr-defined]
        if handle:
            ctypes.windll.kernel32.CloseHandle(handle)  # type: ignore[attr-defined]
        return bool(handle)
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        # OverflowError: no system has process numbers this large.
        return False
    except PermissionError:
        return True
    return True
