# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes as files: free them, find them again after the .blend was moved."""

from __future__ import annotations

import contextlib
from pathlib import Path

import bpy

from ...sim.cache.folder import free_bake
from ...sim.errors import InputError, PhysGenError
from .. import bake_record, bake_state, paths
from ..bridge import playback
from ..bridge.fingerprint import fingerprint
from ..reports import reports_errors
from ..text import count, storage


def used_elsewhere(scene: bpy.types.Scene, folder: Path) -> bool:
    """Whether another scene or file plays the bake ``folder``, or it lies outside this scene's own cache."""
    record = bake_record.read_record(folder)
    blend = Path(bpy.data.filepath) if bpy.data.filepath else None
    if record is not None and bake_record.other_files(record, blend):
        return True
    if any(bake_state.shows(other, folder) for other in bpy.data.scenes if other != scene):
        return True
    return not folder.is_relative_to(paths.scene_cache(scene))


def delete(folder: Path) -> int:
    """Delete the bake ``folder`` and its record; bytes freed. Raises InputError where that cannot be done."""
    freed = free_bake(folder)
    record = bake_record.record_file(folder)
    try:
        record.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{record}: cannot be deleted ({error.strerror or error}); delete it by hand") from error
    return freed


class _CacheOperator:
    """Refused while the scene is being baked."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The scene is not being baked."""
        if bake_state.bake_job(context.scene) is not None:
            cls.poll_message_set("The scene is being baked; pause it first")
            return False
        return True


class PHYSGEN_OT_free_bake(_CacheOperator, bpy.types.Operator):
    """Take the bake out of the scene and delete its files; objects are as they were before"""

    bl_idname = "physgen.free_bake"
    bl_label = "Free Bake"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A bake is shown."""
        if not context.scene.physgen.simulation.bake:
            cls.poll_message_set("No bake is shown")
            return False
        return super().poll(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Objects first, then files."""
        scene = context.scene
        folder = paths.absolute(scene.physgen.simulation.bake)
        try:
            kept = used_elsewhere(scene, folder)
            playback.hide(scene)
            freed = 0 if kept or bake_record.manifest_of(folder) is None else delete(folder)
        except PhysGenError as error:
            with contextlib.suppress(PhysGenError):
                playback.show(scene, bake_state.record_of(scene, folder))
            bake_state.observe(scene)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        bake_state.set_trouble(scene, "")
        bake_state.observe(scene)
        words = f"its files stay, because they are not this scene's alone: {folder}" if kept else storage(freed)
        self.report({"INFO"}, f"The bake is out of the scene; {words}")
        return {"FINISHED"}


class PHYSGEN_OT_free_old_bakes(_CacheOperator, bpy.types.Operator):
    """Delete all bakes of this scene except the one it shows. Undoing a change will not bring them back then"""

    bl_idname = "physgen.free_old_bakes"
    bl_label = "Free Old Bakes"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """One after the other; what cannot be deleted is named, the rest is deleted all the same."""
        scene, freed, deleted, troubles = context.scene, 0, 0, []
        for cache in bake_state.caches_of(scene):
            for record in bake_record.records(cache):
                if bake_state.shows(scene, record.path) or used_elsewhere(scene, record.path):
                    continue
                try:
                    freed += delete(record.path)
                    deleted += 1
                except InputError as error:
                    troubles.append(str(error))
        bake_state.observe(scene)
        for trouble in troubles:
            self.report({"WARNING"}, trouble)
        self.report({"INFO"}, f"{count(deleted, 'bake')} deleted; {storage(freed)}")
        return {"FINISHED"}


class PHYSGEN_OT_relink_caches(_CacheOperator, bpy.types.Operator):
    """Choose the folder in which the bakes are now: the cache folder, one of its scenes, or the bake itself"""

    bl_idname = "physgen.relink_caches"
    bl_label = "Relink Caches"
    bl_options = {"UNDO"}  # noqa: RUF012

    directory: bpy.props.StringProperty(name="Folder", description="Where the bakes are now", subtype="DIR_PATH")
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Look for the bake that was shown below the folder."""
        scene = context.scene
        relink(scene, paths.require_folder(self.directory, "Folder"))
        bake_state.set_trouble(scene, "")
        bake_state.observe(scene)
        self.report({"INFO"}, f"The bake is {scene.physgen.simulation.bake}")
        return {"FINISHED"}


def relink(scene: bpy.types.Scene, chosen: Path) -> None:
    """Let ``scene`` play, from below ``chosen``, the bake that it showed; else the one of the scene as it is now.

    Raises InputError when none of both is there.
    """
    shown = paths.shown_bake(scene)
    name = shown.name if shown is not None else ""
    depths = ("", bake_record.BAKES, f"*/{bake_record.BAKES}", f"*/*/{bake_record.BAKES}")
    candidates = [chosen] if chosen.name == name else []
    if name:
        candidates += [path / name for depth in depths for path in (sorted(chosen.glob(depth)) if depth else [chosen])]
    for folder in candidates:
        if bake_record.manifest_of(folder) is not None:
            playback.show(scene, bake_state.record_of(scene, folder))
            return
    current = fingerprint(scene)
    for cache in (chosen, chosen.parent, *sorted(chosen.glob("*")), *sorted(chosen.glob("*/*"))):
        found = bake_record.matching(cache, current) if cache.is_dir() else None
        if found is not None:
            playback.show(scene, found)
            return
    what = f"the bake {name!r}" if name else "a bake of this scene"
    raise InputError(f"{chosen}: {what} is not in there; choose the folder with the caches, or bake again")


CLASSES = (PHYSGEN_OT_free_bake, PHYSGEN_OT_free_old_bakes, PHYSGEN_OT_relink_caches)
