# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's application handlers: what happens on load, save, undo and change; nothing during playback."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from . import background_jobs, bake_state, blend_trust, paths, unsaved_bakes
from .context import TAB, redraw
from .playback import point_caches
from .playback.bake_record import BAKES
from .props.body_props import bodies

SHOWN = "_shown"
"""End of the names of properties that show the number of another one."""
IGNORED = {
    "rna_type",
    "name",
    "bake",
    "cache",
    "unsaved",
    "estimate",
    "estimate_of",
    "body_index",
    "effect_index",
    "likeness",
}
"""Properties that do not affect the motion; changes of the bake itself are detected elsewhere."""


def settings_snapshot(scene: bpy.types.Scene) -> int:
    """Return a hash of the settings of ``scene`` and its bodies; takes about 0.1 ms a body."""
    world, simulation = _values(scene.physgen.world), _values(scene.physgen.simulation)
    return hash((world, simulation, *((item.name, _values(item.physgen)) for item in bodies(scene))))


def _values(group: bpy.types.PropertyGroup) -> tuple[Any, ...]:
    return tuple(_value(getattr(group, name), kind) for name, kind in _properties(group.__class__))


def _value(value: Any, kind: str) -> Any:
    if kind == "COLLECTION":
        return tuple(_values(item) for item in value)
    if kind == "ARRAY":
        return tuple(value)
    if kind == "POINTER":
        return _values(value) if isinstance(value, bpy.types.PropertyGroup) else getattr(value, "name", None)
    return value


@functools.cache
def _properties(group: Any) -> list[tuple[str, str]]:
    return [
        (prop.identifier, "ARRAY" if getattr(prop, "is_array", False) else prop.type)
        for prop in group.bl_rna.properties
        if prop.identifier not in IGNORED and not prop.identifier.endswith(SHOWN)
    ]


FIELDS = {
    "physgen": ("folder",),
    "physgen_diagnose": ("capture", "report", "scene_folder", "before", "after"),
}
"""Folder properties that keep their target when the file moves; caches and output move with the file instead."""

_before: list[tuple[bpy.types.PropertyGroup, str, str]] = []
"""During saving: changed properties and their previous values."""


def remember_folders(path: str) -> None:
    """Store folders beside the current file relative to ``path``, the file that is about to be written."""
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


def restore_folders(path: str) -> None:
    """Restore the properties if only a copy was saved, or nothing."""
    if Path(bpy.data.filepath) != Path(path):
        for group, name, value in _before:
            setattr(group, name, value)
    _before.clear()


TICK_S = 0.5
REST_S = 0.3
_settings: dict[int, int] = {}
"""Settings hash by session_uid, as last observed."""
_was_playing = [False]
"""Whether an animation was playing at the last tick: every frame counts as a change then, none of them relevant."""
longest_tick_s = [0.0]
"""Longest time the timer has blocked the main thread; read by benchmarks."""


def look() -> float:
    """Timer callback; return seconds until the next call."""
    began = time.perf_counter()
    playing = _is_playing()
    if _was_playing[0] and not playing:
        # Changes during playback were not tracked.
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
    # Scenes that are expensive to evaluate are evaluated less often.
    return max(TICK_S, 20 * took)


def _look_at(scene: bpy.types.Scene) -> None:
    _note_settings(scene)
    if not bake_state.is_dirty(scene):
        return
    before, now = bake_state.last_seen(scene), bake_state.refresh(scene)
    if now != before:
        redraw("VIEW_3D", "UI")
        # The bar of cached frames.
        redraw("DOPESHEET_EDITOR", "WINDOW")
    if now.status == "baking" or bake_state.is_stopping(scene):
        bake_state.mark_progress(scene)


def _note_settings(scene: bpy.types.Scene) -> None:
    mark = settings_snapshot(scene)
    if _settings.get(scene.session_uid, mark) != mark:
        bake_state.mark_dirty(scene)
    _settings[scene.session_uid] = mark


def why_still(scene: bpy.types.Scene) -> str:
    """Return why the objects of ``scene`` stand still when it is played, and what to do; empty if they move."""
    found = bake_state.state(scene)
    if found.status != "none" or not any(item.physgen.role == "dynamic" for item in bodies(scene)):
        return ""
    return f"{bake_state.unbaked(scene)} (sidebar: N, tab {TAB})"


_told = [False]
"""Whether the status bar tells why nothing moves."""


@persistent
def _on_play(scene: bpy.types.Scene, *_: Any) -> None:
    why = "" if bpy.app.background else why_still(scene)
    if why:
        _told[0] = True
        _set_status(why)


@persistent
def _on_stop(*_: Any) -> None:
    if _told[0]:
        _told[0] = False
        _set_status(None)


def _set_status(words: str | None) -> None:
    for window in bpy.context.window_manager.windows:
        window.workspace.status_text_set(words)


def _is_playing() -> bool:
    """Return whether an animation is playing: no check is worth a dropped frame."""
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
def _on_undo(*_: Any) -> None:
    background_jobs.note_undo()
    _on_history()


@persistent
def _on_load(*_: Any) -> None:
    # First, so that nothing is looked at before it is known what the file may ask for.
    blend_trust.note_loaded()
    bake_state.forget()
    _settings.clear()
    paths.new_unsaved_key()
    unsaved_bakes.forget_unsaved()
    for scene in bpy.data.scenes:
        _find_by_modifiers(scene)
    bake_state.mark_dirty()
    if bpy.app.background:
        _refresh_all()


@persistent
def _on_import(found: bpy.types.BlendImportContext, *_: Any) -> None:
    # A scene that is appended brings its settings, as a file that is opened does.
    for item in found.import_items:
        if isinstance(item.id, bpy.types.Scene):
            library = item.source_library
            blend_trust.note_imported(item.id, None if library is None else paths.absolute(library.filepath))
    bake_state.mark_dirty()


def _refresh_all() -> None:
    for scene in bpy.data.scenes:
        bake_state.refresh(scene)


def _find_by_modifiers(scene: bpy.types.Scene) -> None:
    """Find bakes by modifier paths: in a copy of the file elsewhere Blender keeps those right, unlike the scene's."""
    shown = paths.shown_bake(scene)
    if shown is None or shown.is_dir():
        return
    for item in scene.objects:
        modifier = item.modifiers.get(point_caches.MODIFIER)
        if modifier is not None:
            folder = paths.absolute(modifier.filepath).parent
            if folder.is_dir() and folder.parent.name == BAKES:
                scene.physgen.simulation.bake = paths.stored(folder)
                return


@persistent
def _before_save(path: str = "", *_: Any) -> None:
    # Empty for the start-up file.
    if path:
        unsaved_bakes.before_first_save(path)
        remember_folders(path)


@persistent
def _after_save(path: str = "", *_: Any) -> None:
    if path:
        restore_folders(path)
        unsaved_bakes.after_first_save(path)
        blend_trust.note_saved()
        bake_state.mark_dirty()


HANDLERS = {
    "depsgraph_update_post": _on_change,
    "animation_playback_pre": _on_play,
    "animation_playback_post": _on_stop,
    "undo_post": _on_undo,
    "redo_post": _on_history,
    "load_post": _on_load,
    "blend_import_post": _on_import,
    "save_pre": _before_save,
    "save_post": _after_save,
    "save_post_fail": _after_save,
}


def register_handlers() -> None:
    """Register handlers and the timer."""
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(look, first_interval=TICK_S, persistent=True)


def unregister_handlers() -> None:
    """Remove handlers and the timer."""
    for name, handler in HANDLERS.items():
        listening = getattr(bpy.app.handlers, name)
        if handler in listening:
            listening.remove(handler)
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
    bake_state.forget()
