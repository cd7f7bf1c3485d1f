# SPDX-License-Identifier: GPL-3.0-or-later
"""A photo that is to become a scene, and the boxes that an artist has drawn around its objects.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import math

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..asking import agree, forget, is_agreed
from ..horizon_maths import HIGHEST, LOWEST, MOST_ROLL
from ..paths import RELATIVE
from ..views import redraw

UP_ITEMS = [
    ("auto", "Automatic", "By the file's format, and by trying"),
    *((axis, axis.upper(), f"The axis {axis.upper()} of the file") for axis in ("+x", "-x", "+y", "-y", "+z", "-z")),
]


def _on_box(self: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    # The image editors draw the boxes.
    redraw("IMAGE_EDITOR")


def _is_agreed(self: "PHYSGEN_PG_photo") -> bool:
    return bool(self.ask_url.strip()) and is_agreed(self.id_data.session_uid, self.ask_url.strip())


def _agree(self: "PHYSGEN_PG_photo", agreed: bool) -> None:
    agree(self.id_data.session_uid, self.ask_url.strip(), agreed=agreed)


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
    kind: StringProperty(
        name="What It Is",
        description=(
            "In a word or two, in English: orange, book, teddy. Gives material, thickness and shape where they are not "
            "told; empty: the object's name may tell"
        ),
        maxlen=80,
    )
    mask: PointerProperty(
        name="Mask",
        description=(
            "Picture of the whole photo that is bright, or opaque, where the object is seen. Replaces what is cut out "
            "of the box"
        ),
        type=bpy.types.Image,
        update=_on_box,
    )
    shape: EnumProperty(
        name="Shape",
        description="What the object's body is taken for",
        items=[
            ("auto", "Automatic", "As the outline and what it is tell"),
            ("inflated", "Inflated", "The outline, blown up like a cushion"),
            ("box", "Box", "A book, a carton"),
            ("cylinder", "Cylinder", "A cup, a tin"),
            ("sphere", "Sphere", "An orange, a ball"),
        ],
    )
    back: EnumProperty(
        name="Back",
        description="What is behind the outline of an inflated body",
        items=[
            ("auto", "Automatic", "As the outline and what it is tell"),
            ("symmetric", "Symmetric", "As much behind the outline as before it"),
            ("flat", "Flat", "Nothing behind it, as for what leans on a wall"),
        ],
    )
    thickness: FloatProperty(
        name="Thickness",
        description="Depth of the body over its width, 0.02 to 3; 1 makes a ball of a disc. 0: judged by what it is",
        min=0.0,
        max=3.0,
        precision=2,
        step=5,
    )
    mesh: StringProperty(
        name="Mesh",
        description="OBJ, GLB, PLY or STL file that is fitted to the photo, in place of a body from the outline",
        subtype="FILE_PATH",
        options=RELATIVE,
    )
    mesh_up: EnumProperty(
        name="Up",
        description="Which axis of the mesh file points up",
        items=UP_ITEMS,
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
    camera: EnumProperty(
        name="Camera",
        description="How the tilt of the camera is known",
        items=[
            ("AUTO", "Automatic", "Estimated from the photo"),
            ("PITCH", "Pitch", "Say how far the camera looked down"),
            ("HORIZON", "Horizon", "Show where the horizon runs through the photo, or above it"),
        ],
        update=_on_box,
    )
    pitch: FloatProperty(
        name="Pitch",
        description="Angle of the view below the horizontal: 20° for things on a table, 50° for a look down at them",
        default=math.radians(20),
        min=math.radians(-20),
        max=math.radians(85),
        subtype="ANGLE",
    )
    horizon: FloatProperty(
        name="Horizon",
        description=(
            "Height of the horizon in the middle of the photo: 0 is the upper border, 1 the lower one. Of a look down "
            "at a table it lies above the photo, below 0"
        ),
        default=-0.1,
        min=HIGHEST,
        max=LOWEST,
        soft_min=-2.0,
        precision=3,
        step=1,
        update=_on_box,
    )
    roll: FloatProperty(
        name="Roll",
        description="Turn of the camera; positive where the horizon falls to the right",
        min=-MOST_ROLL,
        max=MOST_ROLL,
        subtype="ANGLE",
        update=_on_box,
    )
    use_fov: BoolProperty(
        name="Field of View", description="Say how wide the lens looked; off: by the photo's EXIF, or by its lines"
    )
    fov: FloatProperty(
        name="Field of View",
        description="Angle of view along the photo's longer side: about 65° for a phone, 40° for a portrait",
        default=math.radians(50),
        min=math.radians(5),
        max=math.radians(150),
        subtype="ANGLE",
    )
    depth: StringProperty(
        name="Depth Map",
        description="Of the photo, made elsewhere: .npy, .npz, .exr, .pfm, or .png of 16 bits. Tells ground and order",
        subtype="FILE_PATH",
        options=RELATIVE,
    )
    report: BoolProperty(name="Write Report", description="Also write a page of pictures of every stage")
    has_found: BoolProperty()
    found_horizon: FloatProperty()
    found_roll: FloatProperty()
    found_pitch: FloatProperty()
    found_fov: FloatProperty()
    """The camera of the last reconstruction, whoever told it; angles in radians."""
    ask_url: StringProperty(
        name="Address",
        description=(
            "Of a chat endpoint that speaks as OpenAI's does and sees pictures, such as https://host/v1 or "
            "http://127.0.0.1:11434. It is asked what the objects are made of; empty: nobody is asked"
        ),
        maxlen=2000,
    )
    ask_model: StringProperty(name="Model", description="As the endpoint calls it", maxlen=200)
    send_photo: BoolProperty(
        name="Send the Photo to This Address",
        description=(
            "Agree that the photo, smaller and without EXIF, leaves for this address. Never remembered: with another "
            "address or file it is off again"
        ),
        get=_is_agreed,
        set=_agree,
        options={"SKIP_SAVE"},
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
    forget()
