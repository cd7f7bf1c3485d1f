# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo panel: the photo, its boxes and corrections, Reconstruct. In image editor and 3D viewport."""

from __future__ import annotations

import math
import re
from typing import Any

import bpy

from ...sim.errors import PhysGenError
from ...sim.reconstruct.models.known_models import ISNET
from ...sim.reconstruct.models.model_folder import model_status
from .. import text
from ..context import TAB
from ..interpreter import is_set_up, photo_check
from ..operators.install_ops import PHYSGEN_OT_improve_cutouts, PHYSGEN_OT_remove_model
from ..operators.mask_horizon_ops import PHYSGEN_OT_clear_mask, PHYSGEN_OT_paint_mask, PHYSGEN_OT_set_horizon
from ..operators.photo_object_ops import (
    PHYSGEN_OT_clear_strokes,
    PHYSGEN_OT_draw_strokes,
    PHYSGEN_OT_find_objects,
)
from ..operators.photo_ops import (
    PHYSGEN_OT_draw_box,
    PHYSGEN_OT_open_photo,
    PHYSGEN_OT_remove_box,
    PHYSGEN_OT_use_image,
)
from ..operators.reconstruct_ops import PHYSGEN_OT_open_photo_report, PHYSGEN_OT_reconstruct
from ..photo.photo_consent import OFFLINE, is_allowed
from ..photo.photo_image import tool_help
from ..photo.photo_request import made_folder, scene_folder
from ..props.preferences import python
from .sidebar import draw_job, edited_list, optional

KEY_VARIABLE = "PHYSGEN_API_KEY"


def _part(layout: bpy.types.UILayout, name: str, title: str) -> bpy.types.UILayout | None:
    """Return the layout of a part that is closed by default; None while it is closed."""
    header, body = layout.panel(f"PHYSGEN_{name}", default_closed=True)
    header.label(text=title)
    if body is None:
        return None
    column = body.column()
    column.use_property_split, column.use_property_decorate = True, False
    return column


def draw_details(layout: bpy.types.UILayout, context: bpy.types.Context, box: Any) -> None:
    """Draw the user-supplied properties of the active object."""
    column = _part(layout, "photo_details", f"Details of {box.name}")
    if column is None:
        return
    column.prop(box, "kind")
    column.prop(box, "preset")
    draw_mask(column, context, box)
    shape = column.column()
    shape.active = not box.mesh.strip()
    shape.prop(box, "shape")
    inflated = shape.column()
    inflated.active = box.shape in ("auto", "inflated")
    inflated.prop(box, "back")
    optional(inflated, box, "own_thickness", "thickness", "Thickness", otherwise="Automatic")
    column.prop(box, "mesh")
    if box.mesh.strip():
        column.prop(box, "mesh_up")
    grid = column.grid_flow(columns=2, row_major=True, even_columns=True, align=True)
    grid.use_property_split = False
    for name in ("x0", "x1", "y0", "y1"):
        grid.prop(box, name)


def draw_mask(layout: bpy.types.UILayout, context: bpy.types.Context, box: Any) -> None:
    """Draw buttons to paint, choose and remove a mask, and to draw and remove strokes."""
    column = layout.column(align=True)
    column.use_property_split = False
    row = column.row(align=True)
    row.operator(PHYSGEN_OT_paint_mask.bl_idname, icon="BRUSH_DATA")
    if box.mask is not None:
        row.operator(PHYSGEN_OT_clear_mask.bl_idname, text="", icon="X")
    column.template_ID(box, "mask", open="image.open")
    row = column.row(align=True)
    row.operator(PHYSGEN_OT_draw_strokes.bl_idname, icon="GREASEPENCIL")
    if box.keep or box.drop:
        row.operator(PHYSGEN_OT_clear_strokes.bl_idname, text="", icon="X")


def draw_cutouts(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """Draw the button that installs the model for cut-outs, or the choice to use it."""
    if not model_status(ISNET).is_installed:
        layout.operator(PHYSGEN_OT_improve_cutouts.bl_idname, icon="IMPORT")
        return
    row = layout.row(align=True)
    row.prop(state, "segmenter")
    row.operator(PHYSGEN_OT_remove_model.bl_idname, text="", icon="TRASH")


def draw_models(layout: bpy.types.UILayout, state: Any) -> None:
    """Draw the choice among the models that the command line knows, each stage's."""
    column = _part(layout, "photo_models", "Models")
    if column is None:
        return
    if not model_status(ISNET).is_installed:
        column.prop(state, "segmenter")
    column.prop(state, "depth_estimator")
    column.prop(state, "inpainter")


def draw_camera(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """Draw camera settings."""
    column = _part(layout, "photo_camera", "Camera")
    if column is None:
        return
    column.prop(state, "camera", text="Tilt")
    if state.camera == "PITCH":
        column.prop(state, "pitch")
    if state.camera == "HORIZON":
        column.prop(state, "horizon")
        column.prop(state, "roll")
    column.operator(PHYSGEN_OT_set_horizon.bl_idname, icon="DRIVER_ROTATIONAL_DIFFERENCE")
    row = column.row(heading="Field of View")
    row.prop(state, "use_fov", text="")
    value = row.row()
    value.active = state.use_fov
    value.prop(state, "fov", text="")
    if state.has_found:
        pitch, fov = math.degrees(state.found_pitch), math.degrees(state.found_fov)
        words = f"Last time: pitch {pitch:.0f}°, horizon {state.found_horizon:.2f}, field of view {fov:.0f}°."
        text.sentences(column, context, words)


def draw_files(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """Draw depth map and report."""
    column = _part(layout, "photo_files", "Depth Map and Report")
    if column is None:
        return
    column.prop(state, "depth")
    column.prop(state, "report")
    column.operator(PHYSGEN_OT_open_photo_report.bl_idname, icon="URL")


def draw_asking(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """Draw the reasoning endpoint for materials."""
    column = _part(layout, "photo_asking", "Ask a Model")
    if column is None:
        return
    text.sentences(column, context, "Estimate materials with a vision-capable chat endpoint.")
    column.prop(state, "ask_url")
    column.prop(state, "ask_model")
    url = state.ask_url.strip()
    allowed = is_allowed(url, online=bpy.app.online_access)
    consent = column.row()
    consent.use_property_split = False
    consent.enabled = bool(url) and allowed
    consent.prop(state, "send_photo")
    if url and not allowed:
        text.sentences(column, context, f"{OFFLINE}.", icon="ERROR")
        return
    text.sentences(
        column,
        context,
        f"Without it nothing is sent. A key, where one is needed, is read from the environment variable "
        f"{KEY_VARIABLE} that Blender was started with.",
    )


JOBS = ("Reconstruction", "Finding objects", "Installation")
"""Titles of the jobs whose progress is drawn below the photo's buttons."""


class PHYSGEN_UL_boxes(bpy.types.UIList):
    """List of boxes: name of the object, and its size."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
    ) -> None:
        """Draw the name (double click to rename) and size."""
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon="SELECT_SET")
        right = row.row()
        right.alignment = "RIGHT"
        right.label(text=text.length(item.size_m) if item.size_m > 0 else "")


def draw_photo(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw everything from photo to scene."""
    state = context.scene.physgen_photo
    column = layout.column(align=True)
    column.operator(
        PHYSGEN_OT_open_photo.bl_idname,
        text="Open Photo" if state.image is None else state.image.name,
        icon="FILE_FOLDER",
    )
    editor = context.space_data.type == "IMAGE_EDITOR"
    if editor and context.space_data.image not in (None, state.image):
        column.operator(PHYSGEN_OT_use_image.bl_idname, icon="IMAGE_DATA")
    if state.image is None:
        text.sentences(layout, context, "A photo of objects on a table or floor. It can be dropped here.")
        return
    # The panel Scene of the viewport's sidebar says by itself that there is none.
    if photo_check.trouble and (editor or is_set_up(python(context))):
        text.sentences(layout, context, f"{photo_check.trouble}.", icon="ERROR")
        layout.operator("physgen.install_python", text="Install…", icon="IMPORT")
    _draw_boxes(layout, context, state)
    if 0 <= state.box_index < len(state.boxes):
        draw_details(layout, context, state.boxes[state.box_index])
    # What comes next is in sight, and what few need below it.
    layout.prop(state, "default_motion")
    row = layout.row()
    row.scale_y = 1.4
    again = made_folder(state) is not None
    row.operator(
        PHYSGEN_OT_reconstruct.bl_idname, text="Reconstruct Again" if again else "Reconstruct", icon="MESH_MONKEY"
    )
    if again:
        text.sentences(layout, context, "Only affected stages run again; your physics edits are kept.")
    draw_job(layout, context, *JOBS)
    draw_cutouts(layout, context, state)
    draw_models(layout, state)
    draw_camera(layout, context, state)
    draw_files(layout, context, state)
    draw_asking(layout, context, state)
    layout.prop(state, "output", text="Save To")
    if not state.output.strip():
        try:
            text.sentences(layout, context, f"Makes {scene_folder(state).name} beside the {_beside()}.")
        except PhysGenError as error:
            text.sentences(layout, context, str(error), icon="ERROR")


def _draw_boxes(layout: bpy.types.UILayout, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> None:
    if state.boxes:
        draw, remove = PHYSGEN_OT_draw_box.bl_idname, PHYSGEN_OT_remove_box.bl_idname
        edited_list(layout, "PHYSGEN_UL_boxes", state, "boxes", "box_index", draw, remove, rows=3)
    else:
        text.sentences(layout, context, "Draw a box around each object that is to move, or let them be found.")
    if tool_help():
        text.sentences(layout, context, tool_help(), icon="INFO")
    row = layout.row()
    row.scale_y = 1.0 if state.boxes else 1.4
    row.operator(PHYSGEN_OT_draw_box.bl_idname, icon="SELECT_SET")
    row = layout.row(align=True)
    row.operator(PHYSGEN_OT_find_objects.bl_idname, icon="VIEWZOOM").every = False
    row.operator(PHYSGEN_OT_find_objects.bl_idname, text="All").every = True
    if not 0 <= state.box_index < len(state.boxes):
        return
    box = state.boxes[state.box_index]
    if not box.kind.strip() and is_unnamed(box):
        words = "Double-click the name and write what it is, such as orange: that sets material and size."
        text.sentences(layout, context, words)
    column = layout.column(align=True)
    column.use_property_split, column.use_property_decorate = True, False
    optional(column, box, "knows_size", "size_m", "Size", otherwise="Estimated")
    if not any(other.size_m > 0 for other in state.boxes):
        text.sentences(layout, context, "Tick Size and enter it for one object; otherwise the scale is estimated.")


def is_unnamed(box: bpy.types.PropertyGroup) -> bool:
    """Return whether ``box`` has the name that it began with."""
    return re.fullmatch(r"object \d+", box.name) is not None


def _beside() -> str:
    return ".blend file" if bpy.data.filepath else "photo"


class PHYSGEN_PT_photo(bpy.types.Panel):
    """Reconstructs a scene from a photo"""

    bl_idname = "PHYSGEN_PT_photo"
    bl_label = "Start from a Photo"
    bl_space_type, bl_region_type, bl_category = "IMAGE_EDITOR", "UI", TAB

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the same as in the 3D viewport."""
        draw_photo(self.layout, context)
