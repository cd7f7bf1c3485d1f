# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene > Correct: the photo again, once a scene was made of it. After the panel Scene, because it is part of it."""

from __future__ import annotations

import bpy

from .photo import draw_photo
from .sidebar import Sidebar


class PHYSGEN_PT_correct(Sidebar, bpy.types.Panel):
    """The photo of a scene that was made of it, to correct what was guessed wrong"""

    bl_idname = "PHYSGEN_PT_correct"
    bl_label = "Correct"
    bl_parent_id = "PHYSGEN_PT_scene"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A scene has been imported, and it has a photo; before that the panel Scene itself shows all of it."""
        return bool(context.scene.physgen.folder) and context.scene.physgen_photo.image is not None

    def draw(self, context: bpy.types.Context) -> None:
        """The same as in the image editor."""
        draw_photo(self.layout, context)


CLASSES = (PHYSGEN_PT_correct,)
