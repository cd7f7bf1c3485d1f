# SPDX-License-Identifier: GPL-3.0-or-later
"""Folder paths as entered in Blender, and pictures opened from files."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import uuid
from pathlib import Path

import bpy

from ..sim.cache.bake_folder import load_manifest
from ..sim.errors import InputError
from ..sim.files import shown
from ..sim.picture_header import require_picture
from ..sim.validation import DEVICES
from . import blend_trust

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
"""Options of a property whose path may begin with ``//``."""


ADDON = __package__.removesuffix(".physgen_addon")
"""Name of the extension's root package: ``physgen``, or ``bl_ext.<repository>.physgen`` when installed."""


def user_folder(name: str, *, create: bool = False) -> Path:
    """Return the folder ``name`` among the user's files of this extension. Raises InputError if it cannot be made."""
    try:
        if ADDON.startswith("bl_ext."):
            return Path(bpy.utils.extension_path_user(ADDON, path=name, create=create))
        # Registered by a script: Blender has no folder for this extension.
        folder = bpy.utils.user_resource("CONFIG", path=str(Path("physgen") / name), create=create)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be made ({error.strerror}); check the permissions") from error
    if not folder:
        raise InputError("Blender has no folder for the user's files; set BLENDER_USER_RESOURCES to one")
    return Path(folder)


LONGEST_FOR_BLENDER = 1023
"""Bytes of the longest path that Blender opens (FILE_MAX)."""


def for_blender(path: Path) -> str:
    """Return ``path`` for Blender's own readers. Raises InputError for one in which they see another: Blender takes
    backslashes for slashes, also where they are not, and cuts what is long."""
    text = str(path)
    if (os.sep != "\\" and "\\" in text) or len(os.fsencode(text)) > LONGEST_FOR_BLENDER:
        limit = f"backslashes or more than {LONGEST_FOR_BLENDER} bytes"
        raise InputError(f"{shown(text)}: Blender opens no path with {limit}; rename or move its folder")
    return text


def require_folder(path: str, what: str) -> Path:
    """Return ``path`` as an absolute path (``//`` is the .blend's folder).

    InputError if empty, or if it came with somebody else's file and the user has not agreed to it.
    """
    if not path.strip():
        raise InputError(f"{what} is empty: choose a folder")
    blend_trust.require(path)
    return Path(bpy.path.abspath(path.strip())).resolve()


def require_file(path: str, what: str) -> Path:
    """Return ``path`` as an absolute path (``//`` is the .blend's folder); InputError if it is no file."""
    if not path.strip():
        raise InputError(f"{what} is empty: choose a file")
    blend_trust.require(path)
    file = absolute(path.strip())
    if not file.is_file():
        raise InputError(f"{what}: {file} is no file; choose another")
    return file


def folder_beside(path: Path, suffix: str) -> Path:
    """Return ``NAME_suffix`` beside ``path``. Raises InputError if the place is not writable."""
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path.parent}: cannot be written; choose another folder for the results")
    return path.with_name(f"{path.name}_{suffix}")


def free_folder(path: Path) -> Path:
    """Return ``path``, numbered if something has that name."""
    candidate, number = path, 2
    while candidate.exists():
        candidate, number = path.with_name(f"{path.name}_{number}"), number + 1
    return candidate


def bake_folder(path: Path) -> Path:
    """Return ``path``, numbered if a complete bake or something else has that name.

    An incomplete bake keeps its name, so that it is resumed.
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
    """Return ``name`` as a valid file name on all systems; different names stay different."""
    plain = re.sub(r"[^\w .-]", "_", name).strip(" .") or "_"
    if plain == name and name.lower() not in DEVICES:
        return name
    return f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:6]}"


def is_unsaved_cache(scene: bpy.types.Scene) -> bool:
    """Return whether the scene's bakes are in a temporary folder, because ``//`` is undefined before the first save."""
    return not bpy.data.filepath and scene.physgen.simulation.cache.strip().startswith("//")


_KEY = re.compile("[0-9a-f]{12}")
_unsaved_key = [uuid.uuid4().hex[:12]]
"""Key of the open file; also kept here, because undo reverts the scene's copy."""


def unsaved_key() -> str:
    """Return the key that separates the bakes of this unsaved file from those of others."""
    return _unsaved_key[0]


def new_unsaved_key() -> None:
    """Start a new key: another file was opened."""
    _unsaved_key[0] = uuid.uuid4().hex[:12]


def unsaved_root() -> Path:
    """Return the folder for bakes of unsaved files, beside Blender's temporary folder, which is deleted on exit.

    The place is world-writable, so the folder belongs to the user alone: ``make_unsaved_root``.
    """
    user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""
    return Path(bpy.app.tempdir).resolve().parent / f"physgen_unsaved{user}"


def make_unsaved_root() -> None:
    """Create ``unsaved_root`` for this user only. Raises InputError if another user owns that path."""
    root = unsaved_root()
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = root.lstat()
        if not stat.S_ISDIR(found.st_mode) or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
            raise InputError(f"{root}: belongs to another user, so no bake is stored there; save the file first")
        root.chmod(0o700)
    except OSError as error:
        raise InputError(f"{root}: cannot be made ({error.strerror or error}); save the file first") from error


def unsaved_cache(scene: bpy.types.Scene, key: str) -> Path | None:
    """Return the temporary cache folder of ``scene`` for ``key``; None for a key this extension did not create.

    The key is read from the .blend, which may come from anyone, and the folder is deleted after copying.
    """
    return unsaved_root() / key / file_name(scene.name) if _KEY.fullmatch(key) else None


def scene_cache(scene: bpy.types.Scene) -> Path:
    """Return the absolute folder of all bakes of ``scene``; it may not exist. InputError without a cache folder."""
    simulation = scene.physgen.simulation
    if is_unsaved_cache(scene):
        kept = unsaved_cache(scene, simulation.unsaved)
        return kept or unsaved_root() / _unsaved_key[0] / file_name(scene.name)
    return require_folder(simulation.cache, "Cache") / file_name(scene.name)


def scene_cache_beside(scene: bpy.types.Scene, blend: Path) -> Path:
    """Return ``scene_cache`` as it will be once the file is saved as ``blend``."""
    cache = scene.physgen.simulation.cache.strip()
    root = blend.parent / cache[2:].replace("\\", "/") if cache.startswith("//") else require_folder(cache, "Cache")
    return Path(os.path.normpath(root)) / file_name(scene.name)


def require_writable(folder: Path) -> None:
    """Create ``folder``. Raises InputError if it is not writable."""
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
    """Return ``path`` as stored in the file: ``//`` with forward slashes, absolute before the first save.

    blend: target file of a save in progress, if not the current one.
    """
    folder = blend.parent if blend else Path(bpy.data.filepath).parent if bpy.data.filepath else None
    if folder is None:
        return str(path)
    try:
        return "//" + os.path.relpath(path, folder).replace("\\", "/")
    except ValueError:
        # Another drive on Windows.
        return str(path)


def absolute(path: str) -> Path:
    """Return the absolute path of a ``stored`` one."""
    return Path(os.path.normpath(bpy.path.abspath(path)))


def shown_bake(scene: bpy.types.Scene) -> Path | None:
    """Return the folder of the bake that ``scene`` shows, existing or not; None without one, and for one that waits for
    the user's word."""
    path = scene.physgen.simulation.bake
    return absolute(path) if path and not blend_trust.is_pending(path) else None


def load_image(path: Path, *, check_existing: bool = False) -> bpy.types.Image:
    """Return the image at ``path``, once its header claims no more pixels than such a file may have: Blender decodes
    whatever it says.

    check_existing: as of ``bpy.data.images.load``. Raises InputError where it cannot be read or claims too much.
    """
    require_picture(path)
    try:
        return bpy.data.images.load(str(path), check_existing=check_existing)
    except RuntimeError:
        raise InputError(f"{path}: cannot be read; check that it is there and may be read") from None
