# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit Together: what is selected, by which method, and how far objects were in each other before and after."""

from __future__ import annotations

import bpy

from .. import text
from ..jobs import running
from ..operators.together import PHYSGEN_OT_fit_together, chosen_meshes
from .job import draw_job
from .sidebar import TOGETHER, Sidebar


class PHYSGEN_PT_together(Sidebar, bpy.types.Panel):
    """Objects that pass through each other"""

    bl_idname = "PHYSGEN_PT_together"
    bl_label = "Fit Together"
    bl_order = TOGETHER
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Who stays and who yields; method; the button; the last result."""
        layout, state = self.layout, context.scene.physgen_together
        items = chosen_meshes(context)
        if len(items) < 2:
            text.sentences(layout, context, "Select two or more meshes that pass through each other.", icon="INFO")
        else:
            text.sentences(layout, context, f"Stays: {items[0].name}", icon="PINNED")
            text.sentences(layout, context, f"Yields: {', '.join(item.name for item in items[1:])}", icon="MOD_CLOTH")
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(state, "method")
        column.prop(state, "steps")
        column.prop(state, "keep_strain")
        column.prop(state, "keep_original")
        if running() is not None:
            draw_job(layout)
        else:
            row = layout.row()
            row.scale_y = 1.4
            row.operator(PHYSGEN_OT_fit_together.bl_idname, icon="CON_SHRINKWRAP")
        if state.pairs:
            _draw_result(layout, state)


def _draw_result(layout: bpy.types.UILayout, state: bpy.types.PropertyGroup) -> None:
    box = layout.box()
    box.label(text="In each other, before → after")
    for pair in state.pairs:
        column = box.column(align=True)
        column.scale_y = 0.8
        column.label(text=pair.name)
        column.label(
            text=f"{text.volume(pair.volume_before)} ({100 * pair.share_before:.3g} %) → "
            f"{text.volume(pair.volume_after)} ({100 * pair.share_after:.3g} %)",
            icon="BLANK1",
        )
        deepest = f"{text.length(pair.deepest_before)} → {text.length(pair.deepest_after)}"
        column.label(text=f"deepest {deepest}", icon="BLANK1")


CLASSES = (PHYSGEN_PT_together,)
