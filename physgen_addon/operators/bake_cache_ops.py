# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: free and relink bakes."""

import contextlib
from pathlib import Path

import bpy

from ...sim.cache.bake_folder import free_bake
from ...sim.errors import InputError, PhysGenError
from .. import bake_state, blend_trust, paths
from ..compat import OperatorMixin
from ..playback import bake_record, show_bake
from ..scene_io.motion_fingerprint import fingerprint
from ..text import count, popup, report_errors, storage


def used_elsewhere(scene: bpy.types.Scene, folder: Path) -> bool:
    """Return whether another scene or file plays the bake ``folder``, or it lies outside this scene's cache."""
    record = bake_record.read_record(folder)
    blend = Path(bpy.data.filepath) if bpy.data.filepath else None
    if record is not None and bake_record.other_files(record, blend):
        return True
    if any(bake_state.shows(other, folder) for other in bpy.data.scenes if other != scene):
        return True
    return not folder.is_relative_to(paths.scene_cache(scene))


def delete(folder: Path) -> int:
    """Delete the bake ``folder`` and its record; return freed bytes. Raises InputError if that fails."""
    freed = free_bake(folder)
    record = bake_record.record_file(folder)
    try:
        record.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{record}: cannot be deleted ({error.strerror or error}); delete it by hand") from error
    return freed


class _CacheOperator(OperatorMixin):
    """Disabled while the scene is being baked."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled unless the scene is being baked."""
        if bake_state.bake_job(context.scene) is not None:
            cls.poll_message_set("The scene is being baked; pause it first")
            return False
        return True


class PHYSGEN_OT_free_bake(_CacheOperator, bpy.types.Operator):
    """Remove the bake from the scene and delete its files; objects are restored"""

    bl_idname = "physgen.free_bake"
    bl_label = "Free Bake"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if a bake is shown."""
        if not context.scene.physgen.simulation.bake:
            cls.poll_message_set("No bake is shown")
            return False
        return super().poll(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Restore objects, then delete files."""
        scene = context.scene
        folder = paths.absolute(scene.physgen.simulation.bake)
        try:
            blend_trust.require(scene.physgen.simulation.bake)
            kept = used_elsewhere(scene, folder)
            show_bake.hide(scene)
            freed = 0 if kept or bake_record.manifest_of(folder) is None else delete(folder)
        except PhysGenError as error:
            with contextlib.suppress(PhysGenError):
                show_bake.show(scene, bake_state.record_of(scene, folder))
            bake_state.observe(scene)
            self.report({"ERROR"}, popup(str(error)))
            return {"CANCELLED"}
        bake_state.set_trouble(scene, "")
        bake_state.observe(scene)
        words = f"its files are kept for another scene or file: {folder}" if kept else f"{storage(freed)} freed"
        self.report({"INFO"}, f"Bake removed; {words}")
        return {"FINISHED"}


class PHYSGEN_OT_free_old_bakes(_CacheOperator, bpy.types.Operator):
    """Delete all bakes of this scene except the one it shows. Undo cannot restore them"""

    bl_idname = "physgen.free_old_bakes"
    bl_label = "Free Old Bakes"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete each; name those that cannot be deleted."""
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
        self.report({"INFO"}, f"{count(deleted, 'bake')} deleted; {storage(freed)} freed")
        return {"FINISHED"}


class PHYSGEN_OT_free_one_bake(_CacheOperator, bpy.types.Operator):
    """Delete this bake from the disk. Undo cannot restore it"""

    bl_idname = "physgen.free_one_bake"
    bl_label = "Free This Bake"

    folder: bpy.props.StringProperty(description="Folder of the bake", options={"HIDDEN", "SKIP_SAVE"})

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete it; the one that is shown leaves the scene first."""
        scene = context.scene
        known = [record for cache in bake_state.caches_of(scene) for record in bake_record.records(cache)]
        record = next((record for record in known if record.folder == self.folder), None)
        if record is None:
            raise InputError(f"{self.folder}: is no bake of this scene")
        if bake_state.shows(scene, record.path):
            return set(bpy.ops.physgen.free_bake())
        if used_elsewhere(scene, record.path):
            raise InputError(f"{record.path}: another scene or file plays it; free it there")
        freed = delete(record.path)
        bake_state.observe(scene)
        self.report({"INFO"}, f"Bake deleted; {storage(freed)} freed")
        return {"FINISHED"}


class PHYSGEN_OT_relink_caches(_CacheOperator, bpy.types.Operator):
    """Choose the folder of the moved bakes: the cache folder, one of its scenes, or the bake itself"""

    bl_idname = "physgen.relink_caches"
    bl_label = "Relink Caches"
    bl_options = {"UNDO"}  # noqa: RUF012

    directory: bpy.props.StringProperty(name="Folder", description="Where the bakes are now", subtype="DIR_PATH")
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Search the folder for the bake that was shown."""
        scene = context.scene
        relink(scene, paths.require_folder(self.directory, "Folder"))
        bake_state.set_trouble(scene, "")
        bake_state.observe(scene)
        self.report({"INFO"}, f"Bake found: {scene.physgen.simulation.bake}")
        return {"FINISHED"}


def relink(scene: bpy.types.Scene, chosen: Path) -> None:
    """Make ``scene`` play, from below ``chosen``, the bake that it showed; else the one that matches the scene now.

    Raises InputError if there is neither.
    """
    shown = paths.shown_bake(scene)
    name = shown.name if shown is not None else ""
    depths = ("", bake_record.BAKES, f"*/{bake_record.BAKES}", f"*/*/{bake_record.BAKES}")
    candidates = [chosen] if chosen.name == name else []
    if name:
        candidates += [path / name for depth in depths for path in (sorted(chosen.glob(depth)) if depth else [chosen])]
    for folder in candidates:
        if bake_record.manifest_of(folder) is not None:
            show_bake.show(scene, bake_state.record_of(scene, folder))
            return
    current = fingerprint(scene)
    for cache in (chosen, chosen.parent, *sorted(chosen.glob("*")), *sorted(chosen.glob("*/*"))):
        found = bake_record.matching(cache, current) if cache.is_dir() else None
        if found is not None:
            show_bake.show(scene, found)
            return
    what = f"the bake {name!r}" if name else "a bake of this scene"
    raise InputError(f"{chosen}: {what} is not in there; choose the folder with the caches, or bake again")
