# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths outside its own folder that somebody else's .blend file names are left alone until the user agrees.

Properties that hold a path are found by their subtype, so that none is forgotten. Values that were set in this session
are the user's word, and so are files that they saved. Of a file that is opened, every path that leads out of its folder
waits for the answer, unless its content is in the user's list (``sim/trust``): all that read, write or delete by such a
path ask ``require`` first.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator
from pathlib import Path

import bpy

from ..sim.trust import READS, WRITES, Claim, NotTrusted, remember, trusted_keys

_came: set[Claim] = set()
"""Claims of the open file that the user has not agreed to; never saved."""


GROUPS = ("physgen", "physgen_photo", "physgen_diagnose", "physgen_compose")
"""Our properties of a scene."""

PATHS = ("FILE_PATH", "DIR_PATH")
WRITTEN = ("output", "farm_folder", "cache", "bake", "report", "scene_folder", "after")
"""Properties whose files or folders are written, or deleted; the others are read."""


def _paths(scene: bpy.types.Scene, *, only_set: bool = False) -> Iterator[tuple[str, str, str]]:
    """Yield kind, name and text of every property of ``scene`` that names a file or folder. only_set: no defaults."""
    for name in GROUPS:
        yield from _paths_in(getattr(scene, name), "", only_set)


def _paths_in(group: bpy.types.PropertyGroup, where: str, only_set: bool) -> Iterator[tuple[str, str, str]]:
    for prop in group.bl_rna.properties:
        if prop.identifier == "rna_type":
            continue
        if prop.type == "STRING" and prop.subtype in PATHS:
            if only_set and not group.is_property_set(prop.identifier):
                continue
            kind = WRITES if prop.identifier in WRITTEN else READS
            yield kind, f"{where}{prop.name}", getattr(group, prop.identifier)
        elif prop.type == "POINTER" and isinstance(getattr(group, prop.identifier), bpy.types.PropertyGroup):
            yield from _paths_in(getattr(group, prop.identifier), where, only_set)
        elif prop.type == "COLLECTION":
            for item in getattr(group, prop.identifier):
                if isinstance(item, bpy.types.PropertyGroup):
                    yield from _paths_in(item, f"{item.name}: " if item.name else where, only_set)


def _own_file() -> Path | None:
    return Path(bpy.data.filepath) if bpy.data.filepath else None


def _outside(text: str, file: Path | None) -> str | None:
    """Return where ``text`` in ``file`` leads, if that is not the folder of the file; None if it is.

    Nothing outside is touched to find out: on Windows a look at another computer's folder tells it who looks.
    """
    if file is None:
        return os.path.normpath(bpy.path.abspath(text.strip()))
    home = file.parent
    path = Path(os.path.normpath(bpy.path.abspath(text.strip(), start=str(home))))
    if path.is_relative_to(home) or path.is_relative_to(home.resolve()):
        # A link may lead out.
        found = path.resolve()
        return None if found.is_relative_to(home.resolve()) else str(found)
    return str(path)


def _claims(scene: bpy.types.Scene, file: Path | None = None) -> list[Claim]:
    """Return all that the settings of ``scene`` name outside the folder of ``file``; None: of the open one."""
    file = file or _own_file()
    named = ((kind, where, _outside(text, file)) for kind, where, text in _paths(scene) if text.strip())
    return [Claim(kind, where, path) for kind, where, path in named if path is not None]


def _key(claims: list[Claim]) -> str:
    return hashlib.sha256("\n".join(claim.line() for claim in sorted(claims)).encode()).hexdigest()


def note_loaded() -> None:
    """Remember what the file that was just opened asks for; called after every load, before anything else is."""
    _came.clear()
    if not bpy.data.filepath:
        return
    keys = trusted_keys()
    for scene in bpy.data.scenes:
        claims = _claims(scene)
        if claims and _key(claims) not in keys:
            _came.update(claims)


def note_imported(scene: bpy.types.Scene, file: Path | None) -> None:
    """Remember what ``scene``, appended or linked from ``file``, asks for beyond the folder of the open file, unless
    the user saved that one or agreed to it."""
    if file is not None and _key(_claims(scene, file)) in trusted_keys():
        return
    # What is at its default is ours, wherever it leads in a file that has no folder yet.
    chosen = {where for _, where, _ in _paths(scene, only_set=True)}
    _came.update(claim for claim in _claims(scene) if claim.where in chosen)


def note_saved() -> None:
    """Count the file that was just saved as the user's own, where nothing in it waits for an answer."""
    for scene in bpy.data.scenes:
        claims = _claims(scene)
        if claims and not _came.intersection(claims):
            remember(_key(claims), Path(bpy.data.filepath))


def pending(scene: bpy.types.Scene) -> list[Claim]:
    """Return what ``scene`` names that came with the file, and that the user has not agreed to."""
    return [claim for claim in _claims(scene) if claim in _came] if _came else []


def agree(scene: bpy.types.Scene) -> None:
    """Take the user's word for all that ``pending`` names, now and the next time."""
    claims = _claims(scene)
    _came.difference_update(claims)
    if bpy.data.filepath:
        remember(_key(claims), Path(bpy.data.filepath))


def is_pending(text: str) -> bool:
    """Return whether the path ``text`` of a property waits for the user's word."""
    return bool(_came) and bool(text.strip()) and _outside(text, _own_file()) in {claim.text for claim in _came}


PROGRAMS = (
    ".app", ".action", ".appex", ".bundle", ".kext", ".mpkg", ".pkg", ".plugin", ".prefpane", ".saver", ".service",
    ".workflow", ".xpc",
)  # fmt: skip
"""Suffixes of folders that macOS runs or installs when they are opened, whatever is in them."""


def may_open(path: Path, suffixes: Collection[str] = ()) -> bool:
    """Return whether ``path``, which a file from elsewhere may have set, can be handed to the operating system: a file
    with one of ``suffixes`` that is there, or, without any, a folder. A program would run."""
    try:
        if suffixes:
            return path.suffix in suffixes and path.is_file()
        # What is not there may be found with another ending, as on Windows.
        return path.is_dir() and path.resolve().suffix.lower() not in PROGRAMS and path.suffix.lower() not in PROGRAMS
    except (OSError, ValueError, RuntimeError):
        return False


def require(text: str) -> None:
    """Raise NotTrusted if the path ``text`` of a property waits for the user's word."""
    if is_pending(text):
        found = _outside(text, _own_file())
        _refuse([claim for claim in sorted(_came) if claim.text == found])


def require_agreed(scene: bpy.types.Scene) -> None:
    """Raise NotTrusted if anything is pending."""
    claims = pending(scene)
    if claims:
        _refuse(claims)


def _refuse(claims: list[Claim]) -> None:
    lines = "; ".join(claim.line() for claim in claims)
    raise NotTrusted(
        f"this file came with paths outside its folder, and you have not agreed to them: {lines}; press Look and Agree "
        "in the Scene panel, or choose the files anew",
        claims,
    )
