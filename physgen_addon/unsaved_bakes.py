# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of files that are not saved yet: they move with the file when it is."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import bpy

from ..sim.errors import InputError
from . import paths
from .bake_state import bake_job, caches_of, set_trouble, shows
from .playback import bake_record, show_bake

_moved: dict[int, tuple[Path, Path]] = {}
"""During saving, by the scene's session_uid: old and new cache folder."""
_shown: dict[int, Path] = {}
"""During saving, by the scene's session_uid: absolute folder of the shown bake."""


def forget_unsaved() -> None:
    """Forget pending moves: another file was opened."""
    _moved.clear()
    _shown.clear()


def before_first_save(path: str) -> None:
    """Copy bakes beside the file that is about to be written, and store paths relative to its new location."""
    blend = Path(path)
    for scene in bpy.data.scenes:
        shown = paths.shown_bake(scene)
        if shown is not None:
            _shown[scene.session_uid] = shown
        if paths.is_unsaved_cache(scene) and bake_job(scene) is None:
            old, new = paths.scene_cache(scene), paths.scene_cache_beside(scene, blend)
            if old.is_dir() and _copy(scene, old, new):
                show_bake.repoint(scene, old, new, blend)
                _moved[scene.session_uid] = (old, new)
                continue
        if shown is not None:
            scene.physgen.simulation.bake = paths.stored(shown, blend)


def after_first_save(path: str) -> None:
    """Delete the originals of copied bakes; restore everything if the save failed or only wrote a copy."""
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
            show_bake.repoint(scene, new, new)
            scene.physgen.simulation.unsaved = ""
            shutil.rmtree(old, ignore_errors=True)
        else:
            show_bake.repoint(scene, new, old)
            if shown is not None:
                scene.physgen.simulation.bake = paths.stored(shown)
    _note_file(Path(path))


def _note_file(blend: Path) -> None:
    """Record in the bakes that the saved file ``blend`` shows them, so that no other file beside it deletes them."""
    if not blend.is_file():
        return
    for scene in bpy.data.scenes:
        for cache in caches_of(scene):
            for record in bake_record.records(cache):
                shown = any(shows(other, record.path) for other in bpy.data.scenes)
                # A cache that cannot be written to cannot be deleted either.
                with contextlib.suppress(InputError):
                    bake_record.note_file(record, blend, shown)


def settle(scene: bpy.types.Scene) -> None:
    """Move bakes that were held by a running bake beside the saved file, which must be saved again afterwards."""
    old = paths.unsaved_cache(scene, scene.physgen.simulation.unsaved)
    if old is None or not bpy.data.filepath:
        return
    new = paths.scene_cache(scene)
    if old.is_dir() and _copy(scene, old, new):
        show_bake.repoint(scene, old, new)
        scene.physgen.simulation.unsaved = ""
        shutil.rmtree(old, ignore_errors=True)


def _copy(scene: bpy.types.Scene, old: Path, new: Path) -> bool:
    """Copy bakes. A bake that cannot be copied stays in place and is played from there."""
    try:
        shutil.copytree(old, new, dirs_exist_ok=True)
    except OSError as error:
        reason = getattr(error, "strerror", None) or str(error)
        set_trouble(scene, f"Its bakes could not be brought to {new} ({reason}) and stay in {old}")
        return False
    return True
