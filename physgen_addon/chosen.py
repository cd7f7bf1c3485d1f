# SPDX-License-Identifier: GPL-3.0-or-later
"""What is active and selected, also where a script runs without a window: the context lacks both there."""

from __future__ import annotations

import bpy


def active(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active object."""
    return context.active_object if hasattr(context, "active_object") else context.view_layer.objects.active


def selected(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected objects."""
    found = context.selected_objects if hasattr(context, "selected_objects") else context.view_layer.objects.selected
    return list(found)
