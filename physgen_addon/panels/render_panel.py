# SPDX-License-Identifier: GPL-3.0-or-later
"""Render panel: into the photo or as any Blender scene, and export to other programs."""

from __future__ import annotations

import bpy
import gpu

from .. import blend_trust, compat, text
from ..background_jobs import running
from ..operators.export_ops import PHYSGEN_OT_export_alembic, PHYSGEN_OT_export_usd, PHYSGEN_OT_make_independent
from ..operators.farm_ops import PHYSGEN_OT_copy_farm_command, PHYSGEN_OT_farm, command, written
from ..operators.render_ops import PHYSGEN_OT_look_nodes, PHYSGEN_OT_render_still, PHYSGEN_OT_render_video
from .sidebar import RENDER, Sidebar, draw_job, draw_result, optional

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader", "basic render")
"""Parts of the names of renderers that draw without a graphics card."""


def draws_in_software(renderer: str) -> bool:
    """Return whether ``renderer``, as OpenGL or Vulkan calls it, has no graphics card."""
    return any(name in renderer.lower() for name in SOFTWARE)


def _graphics() -> str:
    # There is none without a window.
    return "" if bpy.app.background else gpu.platform.renderer_get()


class PHYSGEN_PT_render(Sidebar, bpy.types.Panel):
    """Render images and video"""

    bl_idname = "PHYSGEN_PT_render"
    bl_label = "Render"
    bl_order = RENDER
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw settings and buttons, of the photo's renderer or Blender's own."""
        column = self.layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        if context.scene.physgen.folder:
            _draw_photo_render(column, context)
        else:
            _draw_own_render(column, context)


def _draw_photo_render(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    state = context.scene.physgen
    rendering = state.rendering
    under_way = running()
    choices = layout.column()
    choices.enabled = under_way is None
    choices.prop(rendering, "engine")
    if rendering.engine == "cycles":
        choices.prop(rendering, "device")
    elif draws_in_software(_graphics()):
        text.sentences(choices, context, "There is no graphics card: EEVEE is slow, Cycles is faster.", icon="ERROR")
    optional(choices, rendering, "own_samples", "samples", "Samples", otherwise="Automatic")
    choices.prop(rendering, "size", slider=True)
    choices.prop(rendering, "format")
    choices.prop(rendering, "video")
    choices.prop(rendering, "output")
    if rendering.output.startswith("//") and not bpy.data.filepath:
        words = "Until this file is saved, frames go to a temporary folder."
        text.sentences(layout, context, words, icon="INFO")
    if not draw_job(layout, context, "Render") and not state.simulation.bake:
        text.sentences(layout, context, "Bake first (see Scene).", icon="INFO")
    row = layout.row(align=True)
    row.scale_y = 1.4
    row.operator(PHYSGEN_OT_render_still.bl_idname, icon="RENDER_STILL")
    row.operator(PHYSGEN_OT_render_video.bl_idname, icon="RENDER_ANIMATION")
    draw_result(layout, rendering)
    if context.scene.render.engine == compat.eevee():
        words = (
            "F12 and the viewport, by Blender's EEVEE, have no shadows on the ground. These buttons have, and Cycles."
        )
        text.sentences(layout, context, words, icon="INFO")


def _draw_own_render(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    scene = context.scene
    text.sentences(layout, context, "No photo: rendered as an ordinary Blender scene.")
    layout.prop(scene.render, "engine")
    layout.prop(scene.render, "resolution_percentage", text="Size")
    layout.prop(scene.render, "filepath", text="Output")
    layout.prop(scene.render, "use_motion_blur")
    if scene.camera is None:
        text.sentences(layout, context, "The scene has no camera: add one (Shift A).", icon="ERROR")
    row = layout.row(align=True)
    row.scale_y = 1.4
    row.enabled = scene.camera is not None
    row.operator("render.render", text="Render Still", icon="RENDER_STILL").use_viewport = True
    video = row.operator("render.render", text="Render Video", icon="RENDER_ANIMATION")
    video.animation, video.use_viewport = True, True


class _OfPhoto(Sidebar):
    """Mixin of parts of the panel that a photo's scene has."""

    bl_parent_id = "PHYSGEN_PT_render"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown with a photo."""
        return bool(context.scene.physgen.folder)


class PHYSGEN_PT_look(_OfPhoto, bpy.types.Panel):
    """Match the photo's camera"""

    bl_label = "Look"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw a line for each effect."""
        rendering = context.scene.physgen.rendering
        column = self.layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.enabled = running() is None
        column.prop(rendering, "motion_blur", slider=True)
        matched = column.column(heading="From the Photo", align=True)
        matched.prop(rendering, "grain")
        matched.prop(rendering, "match_sharpness")
        column.column(heading="Floor").prop(rendering, "reflections")
        optional(column, rendering, "blurs_depth", "f_number", "F-Number")
        if rendering.blurs_depth:
            optional(column, rendering, "own_focus", "focus_distance", "Focus", otherwise="On the objects")
        text.sentences(column, context, "Frame 1 always equals the photo.")
        if rendering.format == "exr_layers":
            column.operator(PHYSGEN_OT_look_nodes.bl_idname, icon="NODE_COMPOSITING")
        else:
            text.sentences(column, context, "To grade layers by hand: format EXR Layers.")


class PHYSGEN_PT_farm(_OfPhoto, bpy.types.Panel):
    """The whole clip as a job for this machine or a farm"""

    bl_label = "Farm"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw where it runs, the button, and the command that does the same."""
        rendering = context.scene.physgen.rendering
        layout = self.layout
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.enabled = running() is None
        column.prop(rendering, "farm")
        column.prop(rendering, "farm_folder", text="Folder")
        column.prop(rendering, "farm_chunk")
        draw_job(layout, context, PHYSGEN_OT_farm.job_title)
        here = rendering.farm == "local"
        layout.operator(
            PHYSGEN_OT_farm.bl_idname,
            text="Bake and Render Here" if here else "Write the Job",
            icon="RENDER_ANIMATION" if here else "EXPORT",
        )
        found = written(context.scene)
        if found is not None:
            folder, step = found
            row = layout.row(align=True)
            text.sentences(row, context, f"Written to {folder.name}. {step}", icon="CHECKMARK")
            if blend_trust.may_open(folder):
                row.operator("wm.path_open", text="", icon="FILE_FOLDER").filepath = str(folder)
        box = layout.box()
        row = box.row(align=True)
        row.label(text="In a terminal, once it is written:", icon="CONSOLE")
        row.operator(PHYSGEN_OT_copy_farm_command.bl_idname, text="", icon="COPYDOWN")
        text.sentences(box, context, command(context.scene))


class PHYSGEN_PT_out(Sidebar, bpy.types.Panel):
    """Export the motion for other programs, and for Blender without PhysGen"""

    bl_parent_id = "PHYSGEN_PT_render"
    bl_label = "Export"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw one button each."""
        layout = self.layout
        if not context.scene.physgen.simulation.bake:
            text.sentences(layout, context, "Bake first (see Scene) to export the motion.", icon="INFO")
        row = layout.row(align=True)
        row.operator(PHYSGEN_OT_export_alembic.bl_idname, text="Alembic", icon="EXPORT")
        row.operator(PHYSGEN_OT_export_usd.bl_idname, text="USD", icon="EXPORT")
        layout.operator(PHYSGEN_OT_make_independent.bl_idname, text="Make Independent", icon="UNLINKED")
        text.sentences(layout, context, "Independent: the file plays and renders without PhysGen.")
