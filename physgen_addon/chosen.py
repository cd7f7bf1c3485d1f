# SPDX-License-Identifier: GPL-3.0-or-later
"""What is meant: the active and the selected objects, also where a script runs without a window and the context lacks
both, and a scene that undo, renaming and other files may have replaced meanwhile."""

from __future__ import annotations

import bpy


def active(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active object."""
    return context.active_object if hasattr(context, "active_object") else context.view_layer.objects.active


def selected(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected objects."""
    found = context.selected_objects if hasattr(context, "selected_objects") else context.view_layer.objects.selected
    return list(found)


def scene_with(uid: int) -> bpy.types.Scene | None:
    """The scene of that ``session_uid``, which undo and renaming keep; None when it is gone."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)
