# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders as people type them into Blender."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import uuid
from pathlib import Path

import bpy

from ..sim.cache.manifest import load_manifest
from ..sim.errors import InputError
from ..sim.scene.names import DEVICES

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
"""Option of a property that may begin with ``//``."""


def require_folder(path: str, what: str) -> Path:
    """``path``, where ``//`` is beside the .blend, as an absolute path; InputError when it is empty."""
    if not path.strip():
        raise InputError(f"{what} is empty: choose a folder")
    return Path(bpy.path.abspath(path.strip())).resolve()


def folder_beside(path: Path, suffix: str) -> Path:
    """``NAME_suffix`` beside ``path``. Raises InputError where nothing can be written there."""
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path.parent}: cannot be written; choose another folder for the results")
    return path.with_name(f"{path.name}_{suffix}")


def bake_folder(path: Path) -> Path:
    """``path``, or with a number behind it where a complete bake or something else has that name already.

    A bake that was stopped keeps its name, so that it goes on.
    """
    candidate, number = path, 2
    while candidate.exists() and not _unfinished(candidate):
        candidate, number = path.with_name(f"{path.name}_{number}"), number + 1
    return candidate


def _unfinished(folder: Path) -> bool:
    try:
        return load_manifest(folder).state != "complete"
    except InputError:
        return False


def file_name(name: str) -> str:
    """``name`` as every file system takes it; two names that differ stay different."""
    plain = re.sub(r"[^\w .-]", "_", name).strip(" .") or "_"
    if plain == name and name.lower() not in DEVICES:
        return name
    return f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:6]}"


def is_unsaved_cache(scene: bpy.types.Scene) -> bool:
    """Whether the scene's bakes wait in a temporary folder, because ``//`` means nothing before the file is saved."""
    return not bpy.data.filepath and scene.physgen.simulation.cache.strip().startswith("//")


_KEY = re.compile("[0-9a-f]{12}")
_unsaved_key = [uuid.uuid4().hex[:12]]
"""Of the file that is open; also kept here, because undo takes back what a scene remembers."""


def unsaved_key() -> str:
    """What tells the bakes of this unsaved file from those of others."""
    return _unsaved_key[0]


def new_unsaved_key() -> None:
    """Another file is open."""
    _unsaved_key[0] = uuid.uuid4().hex[:12]


def unsaved_root() -> Path:
    """Where bakes of unsaved files wait. Beside Blender's temporary folder, which is deleted when Blender ends.

    Everybody may write there, so it is the user's own: ``make_unsaved_root``.
    """
    user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""
    return Path(bpy.app.tempdir).resolve().parent / f"physgen_unsaved{user}"


def make_unsaved_root() -> None:
    """Make ``unsaved_root`` for nobody but this user. Raises InputError where somebody else has put something there."""
    root = unsaved_root()
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = root.lstat()
        if not stat.S_ISDIR(found.st_mode) or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
            raise InputError(f"{root}: is somebody else's, so no bake is kept there; save the file first")
        root.chmod(0o700)
    except OSError as error:
        raise InputError(f"{root}: cannot be made ({error.strerror or error}); save the file first") from error


def unsaved_cache(scene: bpy.types.Scene, key: str) -> Path | None:
    """Where bakes of ``scene`` waited under ``key``; None for a key that this extension has not made.

    A .blend keeps the key, so it may come from anybody, and what is there is deleted once it is copied.
    """
    return unsaved_root() / key / file_name(scene.name) if _KEY.fullmatch(key) else None


def scene_cache(scene: bpy.types.Scene) -> Path:
    """Folder of all bakes of ``scene``, absolute; it need not exist. InputError when no cache folder is named."""
    simulation = scene.physgen.simulation
    if is_unsaved_cache(scene):
        kept = unsaved_cache(scene, simulation.unsaved)
        return kept or unsaved_root() / _unsaved_key[0] / file_name(scene.name)
    return require_folder(simulation.cache, "Cache") / file_name(scene.name)


def scene_cache_beside(scene: bpy.types.Scene, blend: Path) -> Path:
    """``scene_cache`` as it will be once the file is saved as ``blend``."""
    cache = scene.physgen.simulation.cache.strip()
    root = blend.parent / cache[2:].replace("\\", "/") if cache.startswith("//") else require_folder(cache, "Cache")
    return Path(os.path.normpath(root)) / file_name(scene.name)


def require_writable(folder: Path) -> None:
    """Make ``folder``. Raises InputError where nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made ({error.strerror or error}); choose another Cache folder, or save the file "
            "where you may write"
        ) from error
    if not os.access(folder, os.W_OK):
        raise InputError(f"{folder}: cannot be written; choose another Cache folder")


def stored(path: Path, blend: Path | None = None) -> str:
    """``path`` as the file remembers it: from ``//`` with forward slashes, absolute before the file is saved.

    blend: where the file is about to be saved, if not where it is now.
    """
    folder = blend.parent if blend else Path(bpy.data.filepath).parent if bpy.data.filepath else None
    if folder is None:
        return str(path)
    try:
        return "//" + os.path.relpath(path, folder).replace("\\", "/")
    except ValueError:
        # Another drive of Windows.
        return str(path)


def absolute(path: str) -> Path:
    """What ``stored`` gave, as an absolute path."""
    return Path(os.path.normpath(bpy.path.abspath(path)))


def shown_bake(scene: bpy.types.Scene) -> Path | None:
    """Folder of the bake that ``scene`` shows, whether it is still there or not; None: it shows none."""
    path = scene.physgen.simulation.bake
    return absolute(path) if path else None
