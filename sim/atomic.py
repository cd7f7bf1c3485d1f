# SPDX-License-Identifier: MIT
"""Atomic writes: files and folders are written under a temporary name and renamed at the end."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError

WINDOWS_PAUSES = (0.01, 0.05, 0.2, 0.5)
"""Seconds between attempts: Windows refuses to replace a file that another process is reading."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it replaces ``path``, on failure it is removed.

    The suffix stays, because image writers choose the format by it. Raises InputError when the disk is full or the
    folder cannot be written.
    """
    partial = path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        _replace(partial, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
    finally:
        if partial.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
        else:
            # The parent may be a file, or gone.
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def remove_partials(folder: Path) -> None:
    """Remove this process's unfinished files in ``folder``, for an exit that skips ``finally`` blocks."""
    for partial in folder.glob(f".*.partial-{os.getpid()}*"):
        with contextlib.suppress(OSError):
            partial.unlink()


def _replace(partial: Path, path: Path) -> None:
    for pause in WINDOWS_PAUSES:
        try:
            partial.replace(path)
            return
        except PermissionError:
            if os.name != "nt":
                raise
            time.sleep(pause)
    partial.replace(path)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` atomically as indented UTF-8 JSON. Raises ValueError for NaN and infinity."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write ``content`` atomically."""
    with replacing(path) as partial:
        partial.write_bytes(content)
