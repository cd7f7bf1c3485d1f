# SPDX-License-Identifier: GPL-3.0-or-later
"""Operator: open a sample, so that Reconstruct or Bake is the next click."""

import math
import shutil
from pathlib import Path

import bpy
from bpy.props import EnumProperty

from ...sim.errors import InputError
from ...sim.files import read_toml
from .. import paths
from ..context import TAB, show_beside, show_whole
from ..photo.photo_image import drop_mask
from ..props.body_props import is_body
from ..scene_io.sample_scene import add_sample
from ..text import report_errors
from .bake_ops import warm_up
from .import_ops import choose, hide_all
from .photo_ops import add_box, set_photo

DEMO = Path(__file__).resolve().parents[2] / "presets" / "demo"
NAME = "coffee"
"""The demo's photo and its boxes: ``NAME.jpg``, ``NAME.toml``."""
MAX_BYTES = 1 << 20
LAST_FRAME = 40
"""Of the mesh sample: the jelly has come to rest and the sand has spread."""


class PHYSGEN_OT_open_sample(bpy.types.Operator):
    """Open a sample to try PhysGen with: the next click is Bake, or Reconstruct"""

    bl_idname = "physgen.open_sample"
    bl_label = "Open Sample"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    sample: EnumProperty(
        name="Sample",
        description="What to open",
        items=[
            ("MESHES", "Meshes", "Jelly, sand, wood and a ramp; press Bake. What is in the scene is hidden"),
            ("PHOTO", "Photo", "A cup of coffee with a box around it; press Reconstruct"),
        ],
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Return that of the sample."""
        return str(cls.bl_rna.properties["sample"].enum_items[properties.sample].description)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave Edit Mode first")
        return context.mode == "OBJECT"

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open it."""
        if self.sample == "PHOTO":
            self.report({"INFO"}, open_photo(context))
        else:
            self.report({"INFO"}, open_meshes(context))
        return {"FINISHED"}


def open_meshes(context: bpy.types.Context) -> str:
    """Add the mesh sample to the context's scene and look through its camera; return what to report."""
    scene = context.scene
    hidden = hide_all(item for item in scene.objects if not is_body(item))
    simulation = scene.physgen.simulation
    choose(scene, add_sample(scene))
    simulation.frame_start, simulation.frame_end = 1, LAST_FRAME
    warm_up(context)
    show_whole(context, scene, colours="MATERIAL", light="STUDIO")
    return f"The sample is open: press Bake{hidden}"


def open_photo(context: bpy.types.Context) -> str:
    """Open a copy of the demo's photo with its boxes; return what to report. InputError if it cannot be copied.

    The copy is among the user's files: the scene folder is made beside it while the .blend is unsaved.
    """
    photo = paths.user_folder("samples", create=True) / f"{NAME}.jpg"
    try:
        if not photo.is_file():
            shutil.copyfile(DEMO / photo.name, photo)
        known = read_toml(DEMO / f"{NAME}.toml", MAX_BYTES, what="sample")
    except OSError as error:
        raise InputError(f"{photo}: cannot be written ({error.strerror or error}); check the permissions") from error
    scene = context.scene
    set_photo(scene, photo)
    state = scene.physgen_photo
    for box in state.boxes:
        drop_mask(box)
    state.boxes.clear()
    state.camera, state.pitch = "PITCH", math.radians(known["pitch"])
    given = zip(known["boxes"], known["names"], known["sizes"], known["presets"], strict=True)
    for corners, name, size, preset in given:
        x0, y0, x1, y1 = (round(number) for number in corners)
        box = add_box(scene, (x0, y0, x1, y1), name)
        # Of jelly, as in the demo: one of plastic bakes seven times as long and shows nothing but that it slides.
        box.size_m, box.preset = size, preset
    show_beside(context, state.image, TAB)
    return "The sample is open: press Reconstruct"
