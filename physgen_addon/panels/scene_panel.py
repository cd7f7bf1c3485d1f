# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene panel: starting points, the source of this scene, and corrections of its reconstruction."""

from __future__ import annotations

from pathlib import Path

import bpy

from .. import bake_state, blend_trust, text
from ..background_jobs import PHYSGEN_OT_cancel_job, running
from ..operators.asset_ops import PHYSGEN_OT_open_sample
from ..operators.bake_ops import PHYSGEN_OT_pause_bake
from ..operators.body_ops import PHYSGEN_OT_add_bodies
from ..operators.import_ops import PHYSGEN_OT_choose_splats, PHYSGEN_OT_import_scene
from ..operators.photo_object_ops import PHYSGEN_OT_show_cutouts
from ..operators.photo_ops import PHYSGEN_OT_open_photo, PHYSGEN_OT_use_image, image_here
from ..operators.render_ops import PHYSGEN_OT_render_still, PHYSGEN_OT_render_video
from ..props.body_props import bodies
from . import photo_panel
from .photo_panel import draw_photo
from .sidebar import (
    COMMAND,
    SCENE,
    Sidebar,
    draw_bake_button,
    draw_missing_python,
    draw_progress,
    draw_result,
    draw_trouble,
    draw_trust,
)


class PHYSGEN_PT_scene(Sidebar, bpy.types.Panel):
    """Source of the scene"""

    bl_idname = "PHYSGEN_PT_scene"
    bl_label = "Scene"
    bl_order = SCENE

    def draw(self, context: bpy.types.Context) -> None:
        """Draw starting points; later the scene's folder."""
        layout, state = self.layout, context.scene.physgen
        _draw_in_sight(layout, context)
        draw_trust(layout, context)
        if state.folder:
            _draw_folder(layout, context, state)
            return
        if context.scene.physgen_photo.image is not None:
            photo_panel.draw_photo(layout, context)
            return
        found = bodies(context.scene)
        if not found:
            _draw_beginning(layout, context)
            return
        row = layout.row(align=True)
        row.operator(PHYSGEN_OT_open_photo.bl_idname, text="Open Photo", icon="IMAGE_DATA")
        row.operator(PHYSGEN_OT_import_scene.bl_idname, text="Import", icon="IMPORT")


def _draw_in_sight(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw what must be seen however long the panels below are: progress, that no Python simulates, Bake, or Play."""
    job, scene = running(), context.scene
    if job is None:
        found = bake_state.state(scene)
        if COMMAND in found.trouble:
            draw_trouble(layout.box(), context, found.trouble, icon="ERROR")
        elif draw_missing_python(layout, context) or found.status == "baking":
            pass
        elif found.status == "baked" and not found.trouble:
            text.sentences(layout, context, f"Baked: {text.count(found.frames_done, 'frame')}", icon="CHECKMARK")
            _draw_baked(layout, context)
        elif any(item.physgen.role == "dynamic" for item in bodies(scene)):
            draw_bake_button(layout, found.status)
            if found.status == "stale":
                text.sentences(layout, context, found.advice, icon="ERROR")
            elif found.status == "none":
                text.sentences(layout, context, bake_state.unbaked(scene), icon="INFO")
        return
    shows_photo = not context.scene.physgen.folder and context.scene.physgen_photo.image is not None
    if shows_photo and job.title in photo_panel.JOBS:
        # Drawn beside the button that has started it.
        return
    row = draw_progress(layout, context, job)
    if bake_state.bake_job(context.scene) is not None:
        row.operator(PHYSGEN_OT_pause_bake.bl_idname, text="", icon="PAUSE")
    else:
        row.operator(PHYSGEN_OT_cancel_job.bl_idname, text="", icon="X")


def _draw_baked(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw what comes after a bake: to play it, and to render it into the photo."""
    row = layout.row(align=True)
    row.scale_y = 1.4
    plays = context.screen is not None and context.screen.is_animation_playing
    row.operator("screen.animation_play", text="Stop" if plays else "Play", icon="PAUSE" if plays else "PLAY")
    if context.scene.physgen.folder:
        row.operator(PHYSGEN_OT_render_video.bl_idname, icon="RENDER_ANIMATION")
        row.operator(PHYSGEN_OT_render_still.bl_idname, text="", icon="RENDER_STILL")
        draw_result(layout, context.scene.physgen.rendering)


def _draw_beginning(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    image = image_here(context)
    if image is not None:
        row = layout.row()
        row.scale_y = 1.4
        row.operator(PHYSGEN_OT_use_image.bl_idname, text=f"Start from {image.name}", icon="IMAGE_DATA")
    text.sentences(layout, context, "Objects that fall, bounce, deform and flow. Start with one of these:")
    for title, operator, label, icon in (
        ("Meshes: select some in the viewport", PHYSGEN_OT_add_bodies, "Simulate Selected", "PHYSICS"),
        ("A photo: draw a box around each object", PHYSGEN_OT_open_photo, "Open Photo", "IMAGE_DATA"),
        ("An existing scene folder", PHYSGEN_OT_import_scene, "Import Scene Folder", "IMPORT"),
        ("Gaussian splats of an object (PLY)", PHYSGEN_OT_choose_splats, "Import Splats", "POINTCLOUD_DATA"),
    ):
        box = layout.box()
        text.sentences(box, context, title)
        row = box.row()
        row.scale_y = 1.3
        row.operator(operator.bl_idname, text=label, icon=icon)
    box = layout.box()
    text.sentences(box, context, "No scene at hand? Try a sample")
    row = box.row(align=True)
    row.scale_y = 1.3
    row.operator(PHYSGEN_OT_open_sample.bl_idname, text="Sample Meshes", icon="SHADERFX").sample = "MESHES"
    row.operator(PHYSGEN_OT_open_sample.bl_idname, text="Sample Photo", icon="IMAGE_REFERENCE").sample = "PHOTO"
    text.sentences(layout, context, "Then choose materials and velocities, and press Bake.")


def _draw_folder(layout: bpy.types.UILayout, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> None:
    folder = Path(bpy.path.abspath(state.folder))
    row = layout.row(align=True)
    row.prop(state, "folder", text="")
    row.operator(PHYSGEN_OT_import_scene.bl_idname, text="", icon="IMPORT")
    there = not blend_trust.is_pending(state.folder) and folder.is_dir()
    if there and blend_trust.may_open(folder):
        row.operator("wm.path_open", text="", icon="WINDOW").filepath = str(folder)
    if not there:
        row.alert = True
        text.sentences(
            layout, context, "This folder is not there: choose where it is now, or import it again.", icon="ERROR"
        )
    row = layout.row(align=True)
    row.operator("view3d.view_camera", text="Camera", icon="VIEW_CAMERA")
    row.operator(PHYSGEN_OT_show_cutouts.bl_idname, text="Cut-outs", icon="MOD_MASK")
    if state.photo_root is not None:
        row.prop(state.photo_root, "hide_viewport", text="")


class PHYSGEN_PT_correct(Sidebar, bpy.types.Panel):
    """The photo of a reconstructed scene, to correct its estimates"""

    bl_idname = "PHYSGEN_PT_correct"
    bl_label = "Correct"
    bl_parent_id = "PHYSGEN_PT_scene"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown once a scene with a photo was imported; before that the Scene panel shows all of it."""
        return bool(context.scene.physgen.folder) and context.scene.physgen_photo.image is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the same as in the image editor."""
        draw_photo(self.layout, context)
