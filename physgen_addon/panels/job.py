# SPDX-License-Identifier: GPL-3.0-or-later
"""How far the running job is, and the way to stop it, for the panels that start one."""

from __future__ import annotations

import bpy

from ..jobs import Job, PHYSGEN_OT_cancel_job, progress_text, running


def draw_job(layout: bpy.types.UILayout) -> None:
    """Progress and Cancel of the running job; nothing when there is none."""
    job = running()
    if job is not None:
        draw_progress(layout, job).operator(PHYSGEN_OT_cancel_job.bl_idname, text="", icon="X")


def draw_progress(layout: bpy.types.UILayout, job: Job) -> bpy.types.UILayout:
    """A bar, and below it what ``job`` says of itself; the bar's row, for a button beside it."""
    column = layout.column(align=True)
    row = column.row(align=True)
    row.scale_y = 1.4
    row.progress(factor=job.fraction or 0.0, text=progress_text(job))
    if job.message:
        column.label(text=job.message)
    return row
