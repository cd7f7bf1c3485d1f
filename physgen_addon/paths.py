# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders as people type them into Blender."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ..sim.cache.manifest import load_manifest
from ..sim.errors import InputError


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
