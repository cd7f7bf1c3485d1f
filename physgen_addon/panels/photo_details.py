# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be corrected of a reconstruction: the chosen object, the camera, other files, a model that is asked."""

from __future__ import annotations

import math
from typing import Any

import bpy

from .. import text
from ..asking import OFFLINE, is_allowed
from ..operators.paint_mask import PHYSGEN_OT_clear_mask, PHYSGEN_OT_paint_mask
from ..operators.reconstruct import PHYSGEN_OT_open_photo_report
from ..operators.set_horizon import PHYSGEN_OT_set_horizon

KEY_VARIABLE = "PHYSGEN_API_KEY"


def _part(layout: bpy.types.UILayout, name: str, title: str) -> bpy.types.UILayout | None:
    """A part that begins closed; None while it is closed."""
    header, body = layout.panel(f"PHYSGEN_{name}", default_closed=True)
    header.label(text=title)
    if body is None:
        return None
    column = body.column()
    column.use_property_split, column.use_property_decorate = True, False
    return column


def draw_details(layout: bpy.types.UILayout, context: bpy.types.Context, box: Any) -> None:
    """What is known of the chosen object."""
    column = _part(layout, "photo_details", f"Details of {box.name}")
    if column is None:
        return
    column.prop(box, "kind")
    draw_mask(column, context, box)
    shape = column.column()
    shape.active = not box.mesh.strip()
    shape.prop(box, "shape")
    inflated = shape.column()
    inflated.active = box.shape in ("auto", "inflated")
    inflated.prop(box, "back")
    inflated.prop(box, "thickness")
    column.prop(box, "mesh")
    if box.mesh.strip():
        column.prop(box, "mesh_up")
    grid = column.grid_flow(columns=2, row_major=True, even_columns=True, align=True)
    grid.use_property_split = False
    for name in ("x0", "x1", "y0", "y1"):
        grid.prop(box, name)


def draw_mask(layout: bpy.types.UILayout, context: bpy.types.Context, box: Any) -> None:
    """Paint one, choose one, forget it."""
    column = layout.column(align=True)
    column.use_property_split = False
    row = column.row(align=True)
    row.operator(PHYSGEN_OT_paint_mask.bl_idname, icon="BRUSH_DATA")
    if box.mask is not None:
        row.operator(PHYSGEN_OT_clear_mask.bl_idname, text="", icon="X")
    column.template_ID(box, "mask", open="image.open")


def draw_camera(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """How the camera looked."""
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
    """A depth map, the report."""
    column = _part(layout, "photo_files", "Depth Map and Report")
    if column is None:
        return
    column.prop(state, "depth")
    column.prop(state, "report")
    column.operator(PHYSGEN_OT_open_photo_report.bl_idname, icon="URL")


def draw_asking(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    """Whom to ask what the objects are made of."""
    column = _part(layout, "photo_asking", "Ask a Model")
    if column is None:
        return
    text.sentences(column, context, "What the objects are made of, by a chat endpoint that sees pictures.")
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
        f"Nobody is asked without it. The key, where one is needed, is read from the environment variable "
        f"{KEY_VARIABLE} that Blender was started with.",
    )
