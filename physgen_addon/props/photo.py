# SPDX-License-Identifier: GPL-3.0-or-later
"""A photo that is to become a scene, and the boxes that an artist has drawn around its objects.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..paths import RELATIVE
from ..views import redraw


def _on_box(self: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    # The image editors draw the boxes.
    redraw("IMAGE_EDITOR")


class PHYSGEN_PG_photo_box(bpy.types.PropertyGroup):
    """A box around an object, in pixels of the upright photo from its top left corner; ``name`` is the object's."""

    x0: IntProperty(name="Left", description="Left border in pixels", min=0, subtype="PIXEL", update=_on_box)
    y0: IntProperty(name="Top", description="Upper border in pixels", min=0, subtype="PIXEL", update=_on_box)
    x1: IntProperty(name="Right", description="Right border in pixels", min=0, subtype="PIXEL", update=_on_box)
    y1: IntProperty(name="Bottom", description="Lower border in pixels", min=0, subtype="PIXEL", update=_on_box)
    size_m: FloatProperty(
        name="Size",
        description=(
            "Largest extent of the object. One object with a size sets the scale of the scene; 0: judged by the photo"
        ),
        min=0.0,
        max=1e3,
        soft_max=2.0,
        precision=3,
        unit="LENGTH",
    )


class PHYSGEN_PG_photo(bpy.types.PropertyGroup):
    """A photo and what to make of it; ``Scene.physgen_photo``."""

    path: StringProperty(name="Photo", description="The photo's file", subtype="FILE_PATH", options=RELATIVE)
    image: PointerProperty(type=bpy.types.Image)
    """What is shown of it: upright."""
    width: IntProperty()
    height: IntProperty()
    """Pixels of the upright photo; what is shown may be smaller."""
    boxes: CollectionProperty(type=PHYSGEN_PG_photo_box)
    box_index: IntProperty(name="Box", description="The chosen box", update=_on_box)
    use_pitch: BoolProperty(
        name="Camera Pitch", description="Say how far the camera looked down; off: estimated from the photo"
    )
    pitch: FloatProperty(
        name="Pitch",
        description="Angle of the view below the horizontal: 20° for things on a table, 50° for a look down at them",
        default=0.349066,
        min=-0.349066,
        max=1.48353,
        subtype="ANGLE",
    )
    output: StringProperty(
        name="Scene Folder",
        description="Folder of the scene that is made; empty: NAME_scene beside the .blend, or the photo if it is new",
        subtype="DIR_PATH",
        options=RELATIVE,
    )


CLASSES = (PHYSGEN_PG_photo_box, PHYSGEN_PG_photo)


def register() -> None:
    """Let every scene have a ``physgen_photo``."""
    bpy.types.Scene.physgen_photo = PointerProperty(type=PHYSGEN_PG_photo)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Scene.physgen_photo
