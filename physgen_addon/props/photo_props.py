# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of a photo to be reconstructed, and of the boxes drawn around its objects.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

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

from ...sim.reconstruct.models.known_models import KNOWN
from ...sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from ..context import redraw
from ..paths import RELATIVE
from ..photo.photo_consent import agree, forget, is_agreed
from ..photo.photo_maths import USUAL_FOV, USUAL_PITCH
from .generated_properties import from_field, switch
from .material_props import shipped_items

UP_ITEMS = [
    ("auto", "Automatic", "By file format and fit"),
    *((axis, axis.upper(), f"The axis {axis.upper()} of the file") for axis in ("+x", "-x", "+y", "-y", "+z", "-z")),
]


def _models(stage: str, first: tuple[str, str, str]) -> list[tuple[str, str, str]]:
    """Items of the models that the command line knows for ``stage``, after the way without any."""
    known = [model for model in KNOWN if model.stage == stage]
    return [first, *((m.name, m.title, f"Installed by: physgen models install {m.name}") for m in known)]


def _preset_items() -> list[tuple[str, str, str, str, int]]:
    """Return the entries of a box's material, in the order of their titles.

    A .blend stores an entry's number: 0, and the places of the presets' own names in alphabetical order.
    """
    shipped = shipped_items()
    numbers = {name: place for place, name in enumerate(sorted(item[0] for item in shipped), start=1)}
    automatic = ("auto", "Automatic", "By what it is", "NONE", 0)
    return [automatic, *((*item, "NONE", numbers[item[0]]) for item in shipped)]


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
    size_m: from_field(
        ObjectRequest,
        "size_m",
        "Size",
        "Largest extent of the object. One known size sets the scale of the scene",
        min=0.0,
        soft_max=2.0,
        precision=3,
    )
    knows_size: switch("size_m", "Known Size", "Give the object's size; off: estimated from the photo", 0.15)
    kind: StringProperty(
        name="What It Is",
        description=(
            "In a word or two, in English: orange, book, teddy. Sets material, thickness and shape unless given; "
            "empty: by the object's name"
        ),
        maxlen=80,
    )
    mask: PointerProperty(
        name="Mask",
        description=(
            "Mask image of the whole photo: bright, or opaque, on the object. Replaces the automatic segmentation "
            "of the box"
        ),
        type=bpy.types.Image,
        update=_on_box,
    )
    keep: StringProperty(
        name="Keep",
        description="Strokes over parts of the object: x,y,x,y,… in pixels of the upright photo",
        update=_on_box,
    )
    drop: StringProperty(
        name="Drop",
        description="Strokes over background, such as the floor in a hole",
        update=_on_box,
    )
    preset: EnumProperty(
        name="Material",
        description="Material of the reconstructed object; it can be changed afterwards, too",
        items=_preset_items(),
    )
    shape: from_field(
        ObjectRequest,
        "shape",
        "Shape",
        "Shape of the object's body",
        items=[
            ("auto", "Automatic", "Estimated from mask and kind"),
            ("inflated", "Inflated", "The silhouette, inflated"),
            ("box", "Box", "A book, a carton"),
            ("cylinder", "Cylinder", "A cup, a tin"),
            ("sphere", "Sphere", "An orange, a ball"),
        ],
    )
    back: from_field(
        ObjectRequest,
        "back",
        "Back",
        "Hidden side of an inflated body",
        items=[
            ("auto", "Automatic", "Estimated from mask and kind"),
            ("symmetric", "Symmetric", "Symmetric: as deep behind the silhouette as in front"),
            ("flat", "Flat", "Flat, as for objects that lean on a wall"),
        ],
    )
    thickness: from_field(
        ObjectRequest,
        "thickness",
        "Thickness",
        "Depth of the body over its width, 0.02 to 3; 1 makes a ball of a disc",
        min=0.0,
        precision=2,
        step=5,
    )
    own_thickness: switch("thickness", "Own Thickness", "Give its thickness; off: judged by what it is", 0.5)
    mesh: StringProperty(
        name="Mesh",
        description="OBJ, GLB, PLY or STL file that is fitted to the photo, in place of a body from the outline",
        subtype="FILE_PATH",
        options=RELATIVE,
    )
    mesh_up: from_field(ObjectRequest, "mesh_up", "Up", "Which axis of the mesh file points up", items=UP_ITEMS)


class PHYSGEN_PG_photo(bpy.types.PropertyGroup):
    """A photo and its reconstruction settings; ``Scene.physgen_photo``."""

    path: StringProperty(name="Photo", description="The photo's file", subtype="FILE_PATH", options=RELATIVE)
    image: PointerProperty(type=bpy.types.Image)
    """The upright photo as shown."""
    width: IntProperty()
    height: IntProperty()
    """Pixels of the upright photo; the shown image may be smaller."""
    boxes: CollectionProperty(type=PHYSGEN_PG_photo_box)
    box_index: IntProperty(name="Box", description="Active box", update=_on_box)
    camera: EnumProperty(
        name="Camera",
        description="Source of the camera's tilt",
        items=[
            ("AUTO", "Automatic", "Estimated from the photo"),
            ("PITCH", "Pitch", "Enter the pitch"),
            ("HORIZON", "Horizon", "Place the horizon in the photo, or above it"),
        ],
        update=_on_box,
    )
    pitch: from_field(
        ReconstructOptions,
        "pitch_deg",
        "Pitch",
        "Angle of the view below the horizontal: 20° for objects on a table, 50° for a steep view",
        default=USUAL_PITCH,
    )
    horizon: from_field(
        ReconstructOptions,
        "horizon_y",
        "Horizon",
        (
            "Height of the horizon in the middle of the photo: 0 is the upper border, 1 the lower one. In a steep "
            "view it lies above the photo, below 0"
        ),
        default=-0.1,
        soft_min=-2.0,
        precision=3,
        step=1,
        update=_on_box,
    )
    roll: from_field(
        ReconstructOptions,
        "roll_deg",
        "Roll",
        "Roll of the camera; positive if the horizon falls to the right",
        update=_on_box,
    )
    use_fov: BoolProperty(name="Field of View", description="Set the field of view; off: from EXIF or vanishing points")
    fov: from_field(
        ReconstructOptions,
        "fov_deg",
        "Field of View",
        "Angle of view along the photo's longer side: about 65° for a phone, 40° for a portrait",
        default=USUAL_FOV,
    )
    segmenter: EnumProperty(
        name="Cut-outs",
        description="Method that segments objects in boxes without a mask",
        items=[
            ("auto", "Automatic", "The installed model (Improve Cut-outs), without one colour and texture"),
            *_models("segmenter", ("none", "Without a Model", "Colour and texture")),
        ],
    )
    depth_estimator: EnumProperty(
        name="Depth",
        description="Model that estimates the photo's depth, used for ground and order",
        items=_models("depth_estimator", ("none", "Without a Model", "Ground and order by the objects' outlines")),
    )
    inpainter: EnumProperty(
        name="Background",
        description="Method that inpaints the background behind the objects",
        items=_models("inpainter", ("none", "Without a Model", "The background's own texture and edges")),
    )
    depth: StringProperty(
        name="Depth Map",
        description="Depth map of the photo, made elsewhere: .npy, .npz, .exr, .pfm, 16-bit .png. For ground and order",
        subtype="FILE_PATH",
        options=RELATIVE,
    )
    report: BoolProperty(name="Write Report", description="Also write a report with images of every stage")
    default_motion: BoolProperty(
        name="Default Motion",
        description="Let the objects hop where they have room in the picture; off: everything is at rest",
        default=True,
    )
    has_found: BoolProperty()
    found_horizon: FloatProperty()
    found_roll: FloatProperty()
    found_pitch: FloatProperty()
    found_fov: FloatProperty()
    """Camera of the last reconstruction; angles in radians."""
    ask_url: StringProperty(
        name="Address",
        description=(
            "OpenAI-compatible chat endpoint with vision, such as https://host/v1 or http://127.0.0.1:11434, "
            "queried for the objects' materials; empty: no queries"
        ),
        maxlen=2000,
    )
    ask_model: StringProperty(name="Model", description="Model name at the endpoint", maxlen=200)
    send_photo: BoolProperty(
        name="Send the Photo to This Address",
        description=(
            "Consent to send the photo, downscaled and without EXIF, to this address. Never saved: reset for another "
            "address or file"
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


def register_photo_properties() -> None:
    """Add ``physgen_photo`` to scenes."""
    bpy.types.Scene.physgen_photo = PointerProperty(type=PHYSGEN_PG_photo)


def unregister_photo_properties() -> None:
    """Remove it; values stored in files are kept."""
    del bpy.types.Scene.physgen_photo
    forget()
