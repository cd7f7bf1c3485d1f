# SPDX-License-Identifier: MIT
"""Bake folders as things on a disk: what they take, and getting rid of one.

Only what a manifest lists is ever counted or deleted, so that nothing that somebody else put there is lost.
"""

from __future__ import annotations

import contextlib
import re
from pathlib import Path, PurePosixPath

from ..errors import InputError
from .lock import LOCK_FILE, folder_lock, process_alive
from .manifest import CHECKPOINT_FILE, MANIFEST_FILE, METRICS_FILE, BakeManifest, load_manifest

_PARTIAL = re.compile(r"\.(?:manifest|metrics|state)\.partial-\d+\.(?:json|npz)")
_PARTIAL_SPLATS = re.compile(r"\.\d{4,}\.partial-\d+\.ply")
_LOCK_LEFTOVER = re.compile(re.escape(LOCK_FILE) + r"-(?:dead-)?(\d+)-[0-9a-f]{8}")


def listed_files(manifest: BakeManifest) -> list[str]:
    """Names of all files of a bake, those that are not there yet or any more among them."""
    return [*manifest.files, *manifest.splat_frames(manifest.frames), CHECKPOINT_FILE, METRICS_FILE, MANIFEST_FILE]


def disk_use(folder: Path) -> int:
    """Bytes of the bake in ``folder``, as far as its manifest lists them. Raises InputError when there is none."""
    total = 0
    for name in listed_files(load_manifest(folder)):
        with contextlib.suppress(OSError):
            total += (folder / name).lstat().st_size
    return total


def free_bake(folder: Path) -> int:
    """Delete the bake in ``folder``, then the folder if nothing else is in it; the bytes that are free again.

    Deleted is what the manifest lists, and what a killed run of ours left half-written; nothing is deleted through a
    link. The manifest goes last, so that this can be done again when something could not be deleted.

    Raises InputError when there is no bake, ``folder`` is a link, a living process writes into it, or a file cannot be
    deleted.
    """
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link; free the folder that it leads to")
    load_manifest(folder)
    with folder_lock(folder):
        freed = disk_use(folder)
        try:
            remove_leftovers(folder)
            remove_listed(folder)
            for place in (*_splat_folders(folder), (folder / CHECKPOINT_FILE).parent):
                with contextlib.suppress(OSError):
                    place.rmdir()
            (folder / MANIFEST_FILE).unlink()
        except OSError as error:
            raise InputError(
                f"{error.filename or folder}: cannot be deleted ({error.strerror or error}); close what uses it, or "
                "change its permissions, and free the bake again"
            ) from error
    # Not empty: it holds what no manifest lists.
    with contextlib.suppress(OSError):
        folder.rmdir()
    return freed


def remove_listed(folder: Path) -> None:
    """Delete what the manifest in ``folder`` lists, but not itself; nothing where there is none. Caller holds the lock.

    Raises OSError when a file cannot be deleted.
    """
    try:
        manifest = load_manifest(folder)
    except InputError:
        return
    for name in listed_files(manifest):
        # Never through a link to another place.
        parents = list(PurePosixPath(name).parents)[:-1]
        if name != MANIFEST_FILE and not any((folder / parent).is_symlink() for parent in parents):
            (folder / name).unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Delete half-written files that killed runs left in the bake ``folder``, whose lock the caller holds."""
    for place in (folder, (folder / CHECKPOINT_FILE).parent):
        if place.is_symlink() or not place.is_dir():
            continue
        for path in place.iterdir():
            lock = _LOCK_LEFTOVER.fullmatch(path.name)
            if _PARTIAL.fullmatch(path.name) or (lock and not process_alive(int(lock[1]))):
                path.unlink(missing_ok=True)
    for place in _splat_folders(folder):
        for path in place.glob(".*.ply"):
            if _PARTIAL_SPLATS.fullmatch(path.name):
                path.unlink(missing_ok=True)


def _splat_folders(folder: Path) -> list[Path]:
    """Folders of splats' PLY files that are there and no links, as the manifest in ``folder`` lists them."""
    try:
        names = [item.splats_folder for item in load_manifest(folder).objects if item.splats_folder is not None]
    except InputError:
        return []
    found = [folder / name for name in names]
    return [place for place in found if place.is_dir() and not place.is_symlink()]
