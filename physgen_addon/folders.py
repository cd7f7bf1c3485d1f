# SPDX-License-Identifier: GPL-3.0-or-later
"""The folders that a scene names, when its file is saved elsewhere: Blender keeps only its own paths right."""

from __future__ import annotations

from pathlib import Path

import bpy

from . import paths

FIELDS = {
    "physgen": ("folder",),
    "physgen_diagnose": ("capture", "report", "scene_folder", "before", "after"),
}
"""Folders that stay where they are. Caches and output come to lie beside the new file, so theirs are not among them."""

_before: list[tuple[bpy.types.PropertyGroup, str, str]] = []
"""While saving: what was changed for it, and its value until then."""


def before_save(path: str) -> None:
    """Let folders beside the present file be found from the one that is about to be written at ``path``."""
    _before.clear()
    blend = Path(path)
    if not bpy.data.filepath or blend.parent == Path(bpy.data.filepath).parent:
        return
    for scene in bpy.data.scenes:
        for owner, names in FIELDS.items():
            group = getattr(scene, owner)
            for name in names:
                value = getattr(group, name)
                if value.startswith("//"):
                    _before.append((group, name, value))
                    setattr(group, name, paths.stored(paths.absolute(value), blend))


def after_save(path: str) -> None:
    """Take it back where only a copy was saved, or nothing."""
    if Path(bpy.data.filepath) != Path(path):
        for group, name, value in _before:
            setattr(group, name, value)
    _before.clear()
