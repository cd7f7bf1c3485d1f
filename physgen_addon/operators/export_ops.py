# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: baked motion for other programs and other files: Alembic, USD, objects that need no bake."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import bpy

from ...sim.errors import InputError, PhysGenError
from .. import bake_state, paths
from ..compat import OperatorMixin
from ..playback import bake_record, particles, show_bake
from ..props.body_props import bodies


class _ExportOperator(OperatorMixin):
    """Asks for a file, selects the baked objects, and runs Blender's exporter, which blocks Blender.

    Subclasses define ``filename_ext``, ``format_name``, ``other_format`` (offered if this one is missing) and
    ``write``.
    """

    filename_ext: ClassVar[str]
    format_name: ClassVar[str]
    other_format: ClassVar[str]
    if TYPE_CHECKING:
        filepath: str

    def write(self, path: str, first: int, last: int) -> None:
        """Write the frames ``first`` to ``last`` to ``path``."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if a bake is shown."""
        if not context.scene.physgen.simulation.bake:
            cls.poll_message_set("Nothing is baked yet")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        if not self.filepath:
            blend = Path(bpy.data.filepath or "untitled.blend")
            self.filepath = str(blend.with_suffix(self.filename_ext))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Export the baked frames."""
        scene = context.scene
        try:
            self._require_exporter()
            first, last = baked_range(scene)
            path = self._target()
            with _only_baked(context, scene, first, last):
                self.write(str(path), first, last)
        except (PhysGenError, RuntimeError) as error:
            self.report({"ERROR"}, str(error).strip())
            return {"CANCELLED"}
        if not path.is_file():
            self.report({"ERROR"}, f"{path}: Blender's exporter has written nothing; see its messages")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Frames {first} to {last} are in {path}")
        return {"FINISHED"}

    def _require_exporter(self) -> None:
        """Raise InputError if this Blender lacks the exporter."""
        if not getattr(bpy.app.build_options, self.format_name.lower()):
            raise InputError(
                f"this Blender was built without {self.format_name}; use an official build, or export "
                f"{self.other_format}"
            )

    def _target(self) -> Path:
        if not self.filepath.strip():
            raise InputError("File is empty: choose where to write")
        path = Path(bpy.path.abspath(self.filepath))
        path = path if path.suffix else path.with_suffix(self.filename_ext)
        paths.require_writable(path.parent)
        return path


class PHYSGEN_OT_export_alembic(_ExportOperator, bpy.types.Operator):
    """Export the baked animation as Alembic: bodies, surfaces, and grains as vertices. Blender waits for it"""

    bl_idname = "physgen.export_alembic"
    bl_label = "Export Alembic"
    filename_ext = ".abc"
    format_name, other_format = "Alembic", "USD"

    filepath: bpy.props.StringProperty(name="File", description="File to write", subtype="FILE_PATH")
    filter_glob: bpy.props.StringProperty(default="*.abc", options={"HIDDEN"})

    def write(self, path: str, first: int, last: int) -> None:
        """Run Blender's exporter."""
        bpy.ops.wm.alembic_export(filepath=path, start=first, end=last, selected=True, as_background_job=False)


class PHYSGEN_OT_export_usd(_ExportOperator, bpy.types.Operator):
    """Export the baked animation as USD: bodies, surfaces, and grains as vertices. Blender waits for it"""

    bl_idname = "physgen.export_usd"
    bl_label = "Export USD"
    filename_ext = ".usdc"
    format_name, other_format = "USD", "Alembic"

    filepath: bpy.props.StringProperty(name="File", description="File to write", subtype="FILE_PATH")
    filter_glob: bpy.props.StringProperty(default="*.usd;*.usdc;*.usda;*.usdz", options={"HIDDEN"})

    def write(self, path: str, first: int, last: int) -> None:
        """Run Blender's exporter; the frames are the scene's range."""
        bpy.ops.wm.usd_export(filepath=path, selected_objects_only=True, export_animation=True)


def baked_range(scene: bpy.types.Scene) -> tuple[int, int]:
    """Return first and last playable frame. Raises InputError if there is none."""
    record = bake_state.shown_record(scene)
    done = bake_record.playable(record.path) if record is not None else 0
    if record is None or done < 1:
        raise InputError("no frame of the bake can be played; bake again, or relink its files")
    return record.frame_start, record.frame_start + done - 1


@contextlib.contextmanager
def _only_baked(context: bpy.types.Context, scene: bpy.types.Scene, first: int, last: int) -> Iterator[None]:
    """Select bodies and particles and set the frame range within the context."""
    layer = context.view_layer
    chosen = [item for item in layer.objects if item.select_get()]
    frames, current = (scene.frame_start, scene.frame_end), scene.frame_current
    baked = {*bodies(scene), *(item for item in scene.objects if particles.POINTS_OF in item)}
    locked = [item for item in baked if item.hide_select]
    try:
        for item in locked:
            item.hide_select = False
        for item in baked:
            particles.set_bare(item, True)
        for item in layer.objects:
            item.select_set(item in baked)
        scene.frame_start, scene.frame_end = first, last
        yield
    finally:
        for item in locked:
            item.hide_select = True
        for item in baked:
            particles.set_bare(item, False)
        for item in layer.objects:
            item.select_set(item in chosen)
        scene.frame_start, scene.frame_end = frames
        scene.frame_set(current)


class PHYSGEN_OT_make_independent(bpy.types.Operator):
    """Make the file independent of PhysGen: the animation uses native data only. The point caches stay files
    beside it; images are packed. PhysGen can no longer find or free its bakes
    """

    bl_idname = "physgen.make_independent"
    bl_label = "Make Independent"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(
        name="Copy",
        description="Save a copy there and keep this file unchanged; empty: convert this file",
        subtype="FILE_PATH",
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Convert this file, or a copy of it."""
        try:
            if self.filepath.strip():
                needed = show_bake.save_independent_copy(Path(bpy.path.abspath(self.filepath)))
            else:
                needed = show_bake.strip_extension_data()
        except (PhysGenError, RuntimeError) as error:
            self.report({"ERROR"}, str(error).strip())
            return {"CANCELLED"}
        words = f"These must travel with it: {', '.join(needed)}" if needed else "It needs no other file"
        self.report({"INFO"}, f"The file no longer depends on PhysGen. {words}")
        return {"FINISHED"}
