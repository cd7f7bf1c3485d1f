# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: open a photo and draw boxes around its objects."""

from pathlib import Path
from typing import Any

import bpy
from bpy.props import EnumProperty, StringProperty

from ...sim.errors import InputError
from ..context import TAB, active, remove_entry, show_beside
from ..interpreter import photo_check
from ..photo.photo_image import (
    SUFFIXES,
    PhotoTool,
    drop_mask,
    load_photo_image,
    on_screen,
    place_under,
    shows_photo,
    why_not_seen,
)
from ..photo.photo_request import (
    LEAST_PX,
)
from ..props.preferences import python
from ..text import report_errors


def set_photo(scene: bpy.types.Scene, path: Path) -> None:
    """Set the photo of ``scene`` to ``path``; boxes of another photo are removed. Raises InputError if it is none."""
    image, size = load_photo_image(path)
    state = scene.physgen_photo
    old = state.image
    state.image, (state.width, state.height) = image, size
    if Path(bpy.path.abspath(state.path)) != path:
        for box in state.boxes:
            drop_mask(box)
        state.boxes.clear()
        state.has_found = False
    state.path = str(path)
    if not bpy.app.background:
        photo_check.begin(python(bpy.context))
    if old is not None and old.users == 0:
        bpy.data.images.remove(old)


class PHYSGEN_OT_open_photo(bpy.types.Operator):
    """Choose a photo to reconstruct: draw a box around each object, then press Reconstruct"""

    bl_idname = "physgen.open_photo"
    bl_label = "Start from a Photo"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: StringProperty(name="Photo", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{suffix}" for suffix in SUFFIXES), options={"HIDDEN"})
    # As Blender's file browser knows it: 3 are thumbnails.
    display_type: EnumProperty(items=[("THUMBNAIL", "Thumbnails", "", 3)], options={"HIDDEN", "SKIP_SAVE"})

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show it."""
        if not self.filepath.strip():
            raise InputError("no photo is chosen; choose a JPEG, PNG, TIFF or WebP file")
        set_photo(context.scene, Path(bpy.path.abspath(self.filepath)).resolve())
        show_beside(context, context.scene.physgen_photo.image, TAB)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Load a dropped file directly; otherwise ask for one."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


def image_here(context: bpy.types.Context) -> bpy.types.Image | None:
    """Return the image that the editor shows, or the one of the active empty: Blender makes one of a dropped file."""
    if getattr(context.space_data, "type", "") == "IMAGE_EDITOR":
        return context.space_data.image
    item = active(context)
    shows = item is not None and item.type == "EMPTY" and item.empty_display_type == "IMAGE"
    return item.data if shows else None


class PHYSGEN_OT_use_image(bpy.types.Operator):
    """Start from the photo that this image editor shows, or that the active empty shows"""

    bl_idname = "physgen.use_image"
    bl_label = "Use This Image"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the image is a file."""
        image = image_here(context)
        if image is None or image.source != "FILE" or not image.filepath:
            cls.poll_message_set("The image shown is not a file")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set it."""
        image = image_here(context)
        if image is None:
            raise InputError("no image is shown here; open one in an image editor, or select an empty that shows one")
        set_photo(context.scene, Path(bpy.path.abspath(image.filepath)).resolve())
        if getattr(context.space_data, "type", "") == "IMAGE_EDITOR":
            context.space_data.image = context.scene.physgen_photo.image
        else:
            # The empty has done its work: the camera's view will show the photo.
            active(context).hide_set(True)
            show_beside(context, context.scene.physgen_photo.image, TAB)
        return {"FINISHED"}


class PHYSGEN_OT_remove_box(bpy.types.Operator):
    """Remove the active box"""

    bl_idname = "physgen.remove_box"
    bl_label = "Remove Box"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with an active box."""
        state = context.scene.physgen_photo
        return 0 <= state.box_index < len(state.boxes)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it; the next one becomes active."""
        state = context.scene.physgen_photo
        drop_mask(state.boxes[state.box_index])
        state.box_index = remove_entry(state.boxes, state.box_index)
        return {"FINISHED"}


class PHYSGEN_FH_photo(bpy.types.FileHandler):
    """Drop of a photo on a 3D viewport or an image editor, where Blender asks which of its ways to take is meant."""

    bl_idname = "PHYSGEN_FH_photo"
    bl_label = "PhysGen: Start from This Photo"
    bl_import_operator = "physgen.open_photo"
    bl_file_extensions = ";".join(SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Accept drops on the view and on the sidebar, in Object Mode."""
        area, region = context.area, context.region
        if area is None or region is None or context.mode != "OBJECT":
            return False
        return area.type in ("VIEW_3D", "IMAGE_EDITOR") and region.type in ("WINDOW", "UI")


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_open_photo.bl_idname, text="PhysGen Photo (.jpg, .png)")


def register_photo_menu() -> None:
    """Add to File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister_photo_menu() -> None:
    """Remove from File > Import."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)


CHOSEN, OTHER, DRAGGED = (1.0, 0.55, 0.1, 1.0), (1.0, 1.0, 1.0, 0.8), (1.0, 0.8, 0.2, 1.0)
UNDER = (0.0, 0.0, 0.0, 0.9)
"""Below lines and names, which are else lost on photos of their own colour."""
_dragged: list[tuple[int, int, int, int]] = []
"""The rectangle being dragged, at most one; not stored in any file."""
_handlers: list[Any] = []


def add_box(scene: bpy.types.Scene, corners: tuple[int, int, int, int], name: str = "") -> bpy.types.PropertyGroup:
    """Add a box x0, y0, x1, y1 in pixels of the upright photo, clipped to it, and make it active."""
    state = scene.physgen_photo
    box = state.boxes.add()
    box.x0, box.x1 = (max(0, min(x, state.width)) for x in sorted(corners[0::2]))
    box.y0, box.y1 = (max(0, min(y, state.height)) for y in sorted(corners[1::2]))
    taken = {other.name for other in state.boxes}
    box.name = name or next(f"object {n}" for n in range(1, len(state.boxes) + 1) if f"object {n}" not in taken)
    state.box_index = len(state.boxes) - 1
    return box


class PHYSGEN_OT_draw_box(PhotoTool, bpy.types.Operator):
    """Drag boxes around objects of the photo in the image editor, one after the other; they need not be tight"""

    bl_idname = "physgen.draw_box"
    bl_label = "Draw Box"

    tool_help = "Drag a box around each object    Enter, Esc, right click: done"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        """Return why no box can be drawn: no photo; an editor that shows it is opened."""
        return "" if context.scene.physgen_photo.image is not None else "Open a photo first"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the photo if no editor does, and wait for drags."""
        if why_not_seen(context):
            show_beside(context, context.scene.physgen_photo.image, TAB)
        self._start: tuple[int, int] | None = None
        self._region: bpy.types.Region | None = None
        self._drawn = 0
        return self.begin(context)

    def press(self, state: bpy.types.PropertyGroup, event: bpy.types.Event, region: bpy.types.Region) -> None:
        """Begin a box."""
        self._region, self._start = region, _pixel(state, region, event)

    def handle(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> bool:
        """Draw the box while it is dragged; add it when the button is released."""
        if self._start is None:
            return False
        corners = (*self._start, *_pixel(state, self._region, event))
        if event.type == "MOUSEMOVE":
            _dragged[:] = [corners]
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._start = None
            self.forget()
            if min(abs(corners[2] - corners[0]), abs(corners[3] - corners[1])) >= LEAST_PX:
                add_box(context.scene, corners)
                self._drawn += 1
                # Each box is an undo step of its own.
                bpy.ops.ed.undo_push(message="Draw Box")
        return True

    def done(self, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> set[str]:
        """Finish; the boxes are steps of the undo history already."""
        return self.end(context, "FINISHED" if self._drawn else "CANCELLED")

    def forget(self) -> None:
        """Drop the dragged rectangle."""
        _dragged.clear()


def _pixel(state: bpy.types.PropertyGroup, region: bpy.types.Region, event: bpy.types.Event) -> tuple[int, int]:
    """Return the upright photo's pixel under the mouse, from its top left corner; may lie outside."""
    u, v = place_under(region, event)
    return round(u * state.width), round(v * state.height)


def _label(box: bpy.types.PropertyGroup) -> str:
    return box.name if box.mask is None else f"{box.name} (mask)"


def _draw_boxes() -> None:
    """Draw callback of image editors; in pixels of the region."""
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    state = context.scene.physgen_photo
    if not shows_photo(context):
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    scale = context.preferences.system.ui_scale
    lines = [
        ((box.x0, box.y0, box.x1, box.y1), CHOSEN if index == state.box_index else OTHER, _label(box))
        for index, box in enumerate(state.boxes)
    ]
    lines += [(corners, DRAGGED, "") for corners in _dragged]
    gpu.state.blend_set("ALPHA")
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 6, *UNDER)
    for (x0, y0, x1, y1), colour, name in lines:
        places = [
            on_screen(context.region, x / state.width, y / state.height)
            for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ]
        for drawn, width in ((UNDER, 4.0), (colour, 2.0)):
            gpu.state.line_width_set(width * scale)
            shader.uniform_float("color", drawn)
            batch_for_shader(shader, "LINE_LOOP", {"pos": [(*place, 0.0) for place in places]}).draw(shader)
        if name:
            top = max(place.y for place in places)
            blf.size(0, 12.0 * scale)
            blf.color(0, *colour)
            blf.position(0, min(place.x for place in places), top + 4 * scale, 0)
            blf.draw(0, name)
    blf.disable(0, blf.SHADOW)
    gpu.state.line_width_set(1.0)
    gpu.state.blend_set("NONE")


def register_box_drawing() -> None:
    """Add the draw callback of the boxes."""
    _handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw_boxes, (), "WINDOW", "POST_PIXEL"))


def unregister_box_drawing() -> None:
    """Remove the draw callback of the boxes."""
    for handler in _handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
    _dragged.clear()
