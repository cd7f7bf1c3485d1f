# SPDX-License-Identifier: GPL-3.0-or-later
"""The material presets that a user can choose: those that PhysGen brings and those of one's own."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.errors import InputError
from ...sim.scene.materials import PRESET_FOLDER, PresetFolder, read_presets
from ...sim.scene.matter import Material
from .preferences import ADDON

CUSTOM = "custom"
_SHIPPED = read_presets(PRESET_FOLDER)

_own = PresetFolder()
_read_at: list[tuple[str, int]] = []
_items: dict[tuple[str, str], tuple[str, str, str, str, int]] = {}
"""Blender does not keep the strings of a dynamic enum alive; this does."""


def own_folder(*, create: bool = False) -> Path:
    """Where presets of one's own are kept. Raises InputError where the user's folder cannot be made."""
    try:
        if ADDON.startswith("bl_ext."):
            return Path(bpy.utils.extension_path_user(ADDON, path="materials", create=create))
        # Registered by a script, so that Blender knows no folder of this extension.
        folder = bpy.utils.user_resource("CONFIG", path=str(Path("physgen") / "materials"), create=create)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be made ({error.strerror}); check the permissions") from error
    if not folder:
        raise InputError("Blender has no folder for the user's files; set BLENDER_USER_RESOURCES to one")
    return Path(folder)


def own_presets() -> PresetFolder:
    """Those of one's own; read again when a file came or went."""
    global _own
    try:
        folder = own_folder()
        stamp = [(str(folder), folder.stat().st_mtime_ns)]
    except (OSError, InputError):
        _own, _read_at[:] = PresetFolder(), []
        return _own
    if stamp != _read_at:
        _own, _read_at[:] = _without_shipped(read_presets(folder)), stamp
    return _own


def _without_shipped(found: PresetFolder) -> PresetFolder:
    for name in set(found.good) & set(_SHIPPED.good):
        del found.good[name]
        found.broken[name] = "PhysGen brings a preset of the same name; rename the file"
    return found


def forget() -> None:
    """Read the files again when they are asked for next."""
    _read_at.clear()


def find(name: str) -> Material | None:
    """The preset ``name``; None for "custom", a broken one and one that is not on this computer."""
    return _SHIPPED.good.get(name) or own_presets().good.get(name)


def items(chosen: str) -> list[tuple[str, str, str, str, int]]:
    """Entries of Blender's menu, numbered by their place; ``chosen`` is among them whether it exists or not."""
    own = own_presets()
    rows = [(name, name.capitalize(), _SHIPPED.descriptions[name], "NONE") for name in _SHIPPED.good]
    rows += [(name, name, own.descriptions[name] or "A preset of your own", "USER") for name in own.good]
    # The colon is in no good name, so that a broken file never stands in for a preset.
    rows += [(f"broken:{name}", f"{name} (broken)", f"Unusable: {why}", "ERROR") for name, why in own.broken.items()]
    rows.append((CUSTOM, "Custom", "Numbers of your own", "NONE"))
    if chosen not in (row[0] for row in rows):
        rows.append((chosen, f"{chosen} (missing)", "Not on this computer; the object keeps its numbers", "ERROR"))
    return [_items.setdefault((row[0], repr((row, index))), (*row, index)) for index, row in enumerate(rows)]


def title(name: str) -> str:
    """What people call the preset ``name``."""
    return name.capitalize() if name in _SHIPPED.good or name == CUSTOM else name
