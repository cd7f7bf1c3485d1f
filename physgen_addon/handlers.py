# SPDX-License-Identifier: GPL-3.0-or-later
"""What PhysGen does when Blender loads, saves, undoes or changes something: little, and never during playback.

Handlers only note that something changed; a timer looks at it a moment later. In the background, where timers never
fire, files and undo steps are looked at at once.
"""

from __future__ import annotations

import time
from typing import Any

import bpy
from bpy.app.handlers import persistent

from . import bake_state, changes, folders, paths, unsaved
from .bake_record import BAKES
from .bridge import caches
from .views import redraw

TICK_S = 0.5
REST_S = 0.3
CLASSES = ()
_settings: dict[int, int] = {}
"""Of every scene, by its session_uid, as they were when last looked at."""
_was_playing = [False]
"""Whether an animation was playing at the last look: every frame is a change then, and none that matters."""
longest_tick_s = [0.0]
"""How long the timer has held Blender's main thread at most; looked at by benchmarks."""


def look() -> float:
    """What the timer does; seconds until it wants to look again."""
    began = time.perf_counter()
    playing = _is_playing()
    if _was_playing[0] and not playing:
        # What changed meanwhile was not noted.
        bake_state.mark_dirty()
    _was_playing[0] = playing
    for scene in bpy.data.scenes:
        if playing:
            if bake_state.bake_job(scene) is not None:
                bake_state.observe(scene)
        elif bake_state.rest_s() > REST_S:
            _look_at(scene)
    took = time.perf_counter() - began
    longest_tick_s[0] = max(longest_tick_s[0], took)
    # Scenes that are costly to look at are looked at less often.
    return max(TICK_S, 20 * took)


def _look_at(scene: bpy.types.Scene) -> None:
    _note_settings(scene)
    if not bake_state.is_dirty(scene):
        return
    before, now = bake_state.last_seen(scene), bake_state.refresh(scene)
    if now != before:
        redraw("VIEW_3D", "UI")
    if now.status == "baking" or bake_state.is_stopping(scene):
        bake_state.mark_progress(scene)


def _note_settings(scene: bpy.types.Scene) -> None:
    mark = changes.settings(scene)
    if _settings.get(scene.session_uid, mark) != mark:
        bake_state.mark_dirty(scene)
    _settings[scene.session_uid] = mark


def _is_playing() -> bool:
    """Nothing is worth a dropped frame."""
    return any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)


@persistent
def _on_change(scene: bpy.types.Scene, graph: bpy.types.Depsgraph | None = None) -> None:
    if (graph is None or len(graph.updates)) and not _was_playing[0]:
        bake_state.mark_dirty(scene)


@persistent
def _on_history(*_: Any) -> None:
    bake_state.mark_dirty()
    if bpy.app.background:
        _refresh_all()


@persistent
def _on_load(*_: Any) -> None:
    bake_state.forget()
    _settings.clear()
    paths.new_unsaved_key()
    unsaved.forget()
    for scene in bpy.data.scenes:
        _find_by_modifiers(scene)
    bake_state.mark_dirty()
    if bpy.app.background:
        _refresh_all()


def _refresh_all() -> None:
    for scene in bpy.data.scenes:
        bake_state.refresh(scene)


def _find_by_modifiers(scene: bpy.types.Scene) -> None:
    """In a copy of the file elsewhere Blender has kept the modifiers' paths right, and not the scene's."""
    shown = paths.shown_bake(scene)
    if shown is None or shown.is_dir():
        return
    for item in scene.objects:
        modifier = item.modifiers.get(caches.MODIFIER)
        if modifier is not None:
            folder = paths.absolute(modifier.filepath).parent
            if folder.is_dir() and folder.parent.name == BAKES:
                scene.physgen.simulation.bake = paths.stored(folder)
                return


@persistent
def _before_save(path: str = "", *_: Any) -> None:
    # Empty for the start-up file.
    if path:
        unsaved.before_save(path)
        folders.before_save(path)


@persistent
def _after_save(path: str = "", *_: Any) -> None:
    if path:
        folders.after_save(path)
        unsaved.after_save(path)
        bake_state.mark_dirty()


HANDLERS = {
    "depsgraph_update_post": _on_change,
    "undo_post": _on_history,
    "redo_post": _on_history,
    "load_post": _on_load,
    "save_pre": _before_save,
    "save_post": _after_save,
    "save_post_fail": _after_save,
}


def register() -> None:
    """Begin to listen."""
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(look, first_interval=TICK_S, persistent=True)


def unregister() -> None:
    """Listen no more."""
    for name, handler in HANDLERS.items():
        listening = getattr(bpy.app.handlers, name)
        if handler in listening:
            listening.remove(handler)
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
    bake_state.forget()
