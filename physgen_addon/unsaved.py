# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes and the place of the .blend: before its first save they wait elsewhere, then they come to lie beside it.

A scene's paths are its own affair, because Blender keeps only those of modifiers right when a file is saved elsewhere.
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import bpy

from ..sim.errors import InputError
from . import bake_record, bake_state, paths
from .bridge import playback

_moved: dict[int, tuple[Path, Path]] = {}
"""While saving, by the scene's session_uid: where its bakes were and where they are now."""
_shown: dict[int, Path] = {}
"""While saving: the bake that a scene shows, absolute."""


def forget() -> None:
    """Another file is open."""
    _moved.clear()
    _shown.clear()


def before_save(path: str) -> None:
    """Bring what waits beside the file that is about to be written, and store paths as they will be right there."""
    blend = Path(path)
    for scene in bpy.data.scenes:
        shown = paths.shown_bake(scene)
        if shown is not None:
            _shown[scene.session_uid] = shown
        if paths.is_unsaved_cache(scene) and bake_state.bake_job(scene) is None:
            old, new = paths.scene_cache(scene), paths.scene_cache_beside(scene, blend)
            if old.is_dir() and _copy(scene, old, new):
                playback.repoint(scene, old, new, blend)
                _moved[scene.session_uid] = (old, new)
                continue
        if shown is not None:
            scene.physgen.simulation.bake = paths.stored(shown, blend)


def after_save(path: str) -> None:
    """Drop what was copied; where the file was not saved, or a copy of it was, everything is as before."""
    saved_here = bool(bpy.data.filepath) and Path(bpy.data.filepath) == Path(path) and Path(path).is_file()
    for scene in bpy.data.scenes:
        shown = _shown.pop(scene.session_uid, None)
        moved = _moved.pop(scene.session_uid, None)
        if moved is None:
            if shown is not None:
                scene.physgen.simulation.bake = paths.stored(shown)
            continue
        old, new = moved
        if saved_here:
            playback.repoint(scene, new, new)
            scene.physgen.simulation.unsaved = ""
            shutil.rmtree(old, ignore_errors=True)
        else:
            playback.repoint(scene, new, old)
            if shown is not None:
                scene.physgen.simulation.bake = paths.stored(shown)
    _note_file(Path(path))


def _note_file(blend: Path) -> None:
    """Let the bakes know that the saved file ``blend`` shows them, so that no other file beside it deletes them."""
    if not blend.is_file():
        return
    for scene in bpy.data.scenes:
        for cache in bake_state.caches_of(scene):
            for record in bake_record.records(cache):
                shown = any(bake_state.shows(other, record.path) for other in bpy.data.scenes)
                # A cache that cannot be written cannot be deleted either.
                with contextlib.suppress(InputError):
                    bake_record.note_file(record, blend, shown)


def settle(scene: bpy.types.Scene) -> None:
    """Bring beside the saved file what waited while a bake ran. The file has to be saved once more then."""
    old = paths.unsaved_cache(scene, scene.physgen.simulation.unsaved)
    if old is None or not bpy.data.filepath:
        return
    new = paths.scene_cache(scene)
    if old.is_dir() and _copy(scene, old, new):
        playback.repoint(scene, old, new)
        scene.physgen.simulation.unsaved = ""
        shutil.rmtree(old, ignore_errors=True)


def _copy(scene: bpy.types.Scene, old: Path, new: Path) -> bool:
    """Copy bakes. What cannot be copied stays where it is, and is played there."""
    try:
        shutil.copytree(old, new, dirs_exist_ok=True)
    except OSError as error:
        reason = getattr(error, "strerror", None) or str(error)
        bake_state.set_trouble(scene, f"Its bakes could not be brought to {new} ({reason}) and stay in {old}")
        return False
    return True
