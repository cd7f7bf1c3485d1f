# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: find the objects of a photo, and draw strokes over what belongs to one and what does not."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty
from numpy.typing import NDArray

from ...sim.app.propose import best_proposals
from ...sim.app.stage_process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.reconstruct.reconstruct_options import Proposal
from ..background_jobs import JobOperator, Work
from ..context import TAB, redraw, show_beside
from ..interpreter import cli_command, find_python
from ..paths import load_image, require_folder
from ..photo.photo_image import PhotoTool, on_screen, place_under, shows_photo
from ..photo.photo_maths import box_overlap, simplified
from ..photo.photo_request import photo_file, scene_folder
from ..props.preferences import python
from ..text import count, report_errors
from .mask_horizon_ops import chosen_box
from .photo_ops import add_box

SAME = 0.5
"""Overlap (intersection over union) with a box that is there, above which a found one is not added."""
KEEP_COLOUR, DROP_COLOUR = (0.2, 1.0, 0.3, 1.0), (1.0, 0.25, 0.2, 1.0)
STROKE_HELP = (
    "Left: belongs to the object    Ctrl or Shift + Left: does not    Ctrl + Z: undo stroke    "
    "Enter, Esc, right click: done"
)
_handlers: list[Any] = []


def add_found(scene: bpy.types.Scene, found: list[Proposal], *, every: bool) -> int:
    """Add boxes around the best objects ``found``, or around ``every`` one, unless one is there; return how many."""
    state = scene.physgen_photo
    chosen = range(len(found)) if every else best_proposals(found)
    added = 0
    for index in chosen:
        if _is_new(state, found[index]):
            x0, y0, x1, y1 = (round(value) for value in found[index].box)
            add_box(scene, (x0, y0, x1, y1))
            added += 1
    return added


def _is_new(state: bpy.types.PropertyGroup, item: Proposal) -> bool:
    there = [(other.x0, other.y0, other.x1, other.y1) for other in state.boxes]
    return all(box_overlap(item.box, other) < SAME for other in there)


def found_words(scene: bpy.types.Scene, found: list[Proposal], added: int) -> str:
    """Return the report of the objects ``found``, of which as many as ``added`` have just got a box."""
    if not found:
        return "Nothing stands out in this photo: draw a box around each object"
    rest = sum(_is_new(scene.physgen_photo, item) for item in found)
    more = f"; All adds {rest} more" if rest else ""
    return f"{count(added, 'box')} added{more}. Name them, then Reconstruct"


EVERY = "Add a box around every object found, up to 20"


class PHYSGEN_OT_find_objects(JobOperator, bpy.types.Operator):
    """Find the objects of the photo that stand out, and add a box around the best of them"""

    bl_idname = "physgen.find_objects"
    bl_label = "Find Objects"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Finding objects"

    every: BoolProperty(name="All", description=EVERY, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Return the tooltip of *All*; empty for the operator's own."""
        return EVERY if properties.every else ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a photo."""
        if context.scene.physgen_photo.image is None:
            cls.poll_message_set("Open a photo first")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """Return the search as a child process, which writes beside the scene folder."""
        state = context.scene.physgen_photo
        path, scene = photo_file(state), scene_folder(state)
        if not path.is_file():
            raise InputError("there is no photo; open one first")
        out, preferred = scene.with_name(f"{scene.name}_proposals"), python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "propose", str(path), "--out", str(out))
            return run_stage(command, on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Add the boxes."""
        found = []
        for item in final["proposals"]:
            x0, y0, x1, y1 = (float(value) for value in item["box"])
            found.append(Proposal((x0, y0, x1, y1), float(item["score"])))
        added = add_found(scene, found, every=self.every)
        redraw("IMAGE_EDITOR")
        return found_words(scene, found, added)


DIM = 0.2
"""Share of the background's brightness in the picture of the cut-outs."""
OUTLINES = ((1.0, 0.55, 0.1), (0.2, 0.8, 1.0), (0.6, 1.0, 0.3), (1.0, 0.3, 0.8))
"""Of the objects, in turn."""
MOST_PX = 1600
"""Longest side of that picture."""


def cutouts_picture(root: Path) -> bpy.types.Image:
    """Return a new image of the photo of the scene folder ``root``: its objects bright and outlined, the rest dark.

    Raises InputError where the folder has no photo or no masks.
    """
    masks = sorted((root / "masks").glob("*.png"))
    if not masks or not (root / "photo.png").is_file():
        raise InputError(f"{root}: has no photo with masks; reconstruct it again")
    photo = _pixels(root / "photo.png")
    step = -(-max(photo.shape[:2]) // MOST_PX)
    shown = photo[::step, ::step].copy()
    inside = np.zeros(shown.shape[:2], dtype=bool)
    edges = []
    for path in masks:
        mask = _pixels(path)[..., 0] > 0.5
        if mask.shape != photo.shape[:2]:
            raise InputError(f"{path}: is of another size than photo.png; reconstruct the scene again")
        mask = mask[::step, ::step]
        inside |= mask
        edges.append(mask & ~_shrunk(mask, 2))
    shown[~inside, :3] *= DIM
    for edge, colour in zip(edges, itertools.cycle(OUTLINES), strict=False):
        shown[edge, :3] = colour
    shown[..., 3] = 1.0
    height, width = shown.shape[:2]
    image = bpy.data.images.new(f"Cut-outs of {root.name}", width, height)
    image.pixels.foreach_set(np.ascontiguousarray(shown, dtype=np.float32).ravel())
    return image


def _shrunk(mask: NDArray[np.bool_], times: int) -> NDArray[np.bool_]:
    """Return ``mask`` without its outermost ``times`` pixels."""
    for _ in range(times):
        wide = np.pad(mask, 1)
        mask = mask & wide[2:, 1:-1] & wide[:-2, 1:-1] & wide[1:-1, 2:] & wide[1:-1, :-2]
    return mask


def _pixels(path: Path) -> NDArray[np.float32]:
    """Return the values of a picture as stored, 0 to 1, (H, W, 4), first row at the bottom."""
    image = load_image(path)
    try:
        width, height = image.size
        values = np.empty(width * height * 4, dtype=np.float32)
        image.pixels.foreach_get(values)
    finally:
        bpy.data.images.remove(image)
    return values.reshape(height, width, 4)


class PHYSGEN_OT_show_cutouts(bpy.types.Operator):
    """Show what was cut out of the photo as objects, bright in an image editor: what is dark stays in the background"""

    bl_idname = "physgen.show_cutouts"
    bl_label = "Show Cut-outs"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled after a reconstruction."""
        if not context.scene.physgen.folder:
            cls.poll_message_set("Reconstruct a photo first")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the picture and show it beside the viewport."""
        image = cutouts_picture(require_folder(context.scene.physgen.folder, "Scene Folder"))
        for old in [other for other in bpy.data.images if other.get(CUTOUTS)]:
            bpy.data.images.remove(old)
        image[CUTOUTS] = True
        show_beside(context, image, TAB)
        self.report(
            {"INFO"}, "What is dark stays in the background; to change it, Correct > Draw Strokes or Paint Mask"
        )
        return {"FINISHED"}


CUTOUTS = "physgen_cutouts"
"""Custom property of the picture, so that a new one replaces it."""


class PHYSGEN_OT_draw_strokes(PhotoTool, bpy.types.Operator):
    """Draw strokes over lost parts of the active object, or over background, such as the floor in a hole"""

    bl_idname = "physgen.draw_strokes"
    bl_label = "Draw Strokes"
    bl_options = {"UNDO"}  # noqa: RUF012

    tool_cursor = "PAINT_CROSS"
    tool_help = STROKE_HELP

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        """Return why no stroke can be drawn: no active box, one with a mask, or no visible photo."""
        box = chosen_box(context)
        if box is None:
            return "Choose a box first"
        return "Clear the mask first: strokes refine a box" if box.mask is not None else super().why_not(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Wait for strokes."""
        self.tool_box = context.scene.physgen_photo.box_index
        self._region: bpy.types.Region | None = None
        self._places: list[tuple[float, float]] = []
        self._field, self._drawn = "", list[str]()
        return self.begin(context)

    def press(self, state: bpy.types.PropertyGroup, event: bpy.types.Event, region: bpy.types.Region) -> None:
        """Begin a stroke."""
        self._region = region
        self._field = "drop" if event.ctrl or event.shift else "keep"
        self._places = [self._place(state, event)]

    def handle(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> bool:
        """Draw, end or undo a stroke."""
        box = state.boxes[self.tool_box]
        if event.type == "LEFTMOUSE" and event.value == "RELEASE" and self._places:
            text = ",".join(f"{x:.0f},{y:.0f}" for x, y in simplified(self._places))
            setattr(box, self._field, f"{getattr(box, self._field)} {text}".strip())
            self._drawn.append(self._field)
            self._places = []
        elif event.type in ("MOUSEMOVE", "INBETWEEN_MOUSEMOVE") and self._places:
            self._places.append(self._place(state, event))
        elif event.type == "Z" and event.ctrl:
            if event.value == "PRESS" and self._drawn:
                field = self._drawn.pop()
                setattr(box, field, getattr(box, field).rpartition(" ")[0])
        else:
            return False
        return True

    def done(self, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> set[str]:
        """Finish; without strokes nothing has changed."""
        return self.end(context, "FINISHED" if self._drawn else "CANCELLED")

    def _place(self, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> tuple[float, float]:
        """Return the upright photo's pixel under the mouse, within the photo."""
        u, v = place_under(self._region, event)
        return min(max(u, 0.0), 1.0) * state.width, min(max(v, 0.0), 1.0) * state.height


class PHYSGEN_OT_clear_strokes(bpy.types.Operator):
    """Remove the strokes of the active box"""

    bl_idname = "physgen.clear_strokes"
    bl_label = "Clear Strokes"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the active box has strokes."""
        box = chosen_box(context)
        if box is None or not (box.keep or box.drop):
            cls.poll_message_set("Active box has no strokes")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clear them."""
        box = chosen_box(context)
        if box is not None:
            box.keep = box.drop = ""
        return {"FINISHED"}


def stroke_lines(text: str) -> list[list[tuple[float, float]]]:
    """Return the polylines in a box' property ``keep`` or ``drop``; nonsense in an edited file is left out."""
    lines = []
    for stroke in text.split():
        try:
            numbers = [float(part) for part in stroke.split(",")]
        except ValueError:
            continue
        if len(numbers) >= 2 and len(numbers) % 2 == 0:
            lines.append(list(zip(numbers[::2], numbers[1::2], strict=True)))
    return lines


def _draw_strokes() -> None:
    """Draw callback of image editors; in pixels of the region."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    if not shows_photo(context):
        return
    state = context.scene.physgen_photo
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.line_width_set(3.0 * context.preferences.system.ui_scale)
    for box in state.boxes if state.width and state.height else ():
        for text, colour in ((box.keep, KEEP_COLOUR), (box.drop, DROP_COLOUR)):
            shader.uniform_float("color", colour)
            for line in stroke_lines(text):
                places = [(*on_screen(context.region, x / state.width, y / state.height), 0.0) for x, y in line]
                kind = "LINE_STRIP" if len(places) > 1 else "POINTS"
                batch_for_shader(shader, kind, {"pos": places}).draw(shader)
    gpu.state.line_width_set(1.0)


def register_stroke_drawing() -> None:
    """Add the draw callback of the strokes."""
    _handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw_strokes, (), "WINDOW", "POST_PIXEL"))


def unregister_stroke_drawing() -> None:
    """Remove the draw callback of the strokes."""
    for handler in _handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
