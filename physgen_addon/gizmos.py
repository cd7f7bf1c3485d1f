# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrows in the viewport that give the active body its velocity and spin: drag the tip.

Shift keeps the tip at its height, Ctrl moves it up and down. Escape or the right button gives the old value back.
"""

import itertools
import math
from typing import Any, ClassVar

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector

from . import gizmo_maths as maths
from .bridge.bounds import box_corners
from .bridge.export_units import metres_per_unit
from .views import redraw

SHOW_ARROWS = "physgen_show_arrows"
"""Name of the switch, a property of the window manager."""

STEM_PIXELS, TIP_PIXELS, GRAB_PIXELS = 1.6, 9.0, 14.0
ZERO_PIXELS = 7.5
NO_LENGTH_PIXELS = 4.0
"""An arrow shorter than this is drawn as a knob."""

SIDES = 12


def _cylinder() -> list[tuple[float, float, float]]:
    """Triangles of a cylinder of radius 1 from the origin to z = 1."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(ax, ay, 0.0), (bx, by, 0.0), (bx, by, 1.0), (ax, ay, 0.0), (bx, by, 1.0), (ax, ay, 1.0)]
    return triangles


def _cone() -> list[tuple[float, float, float]]:
    """Triangles of a cone with its tip at the origin, 2 long."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(0.0, 0.0, 0.0), (ax * 0.7, ay * 0.7, -2.0), (bx * 0.7, by * 0.7, -2.0)]
        triangles += [(0.0, 0.0, -2.0), (bx * 0.7, by * 0.7, -2.0), (ax * 0.7, ay * 0.7, -2.0)]
    return triangles


def _knob() -> list[tuple[float, float, float]]:
    """Triangles of a double pyramid of radius 1."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(0.0, 0.0, 1.0), (ax, ay, 0.0), (bx, by, 0.0), (0.0, 0.0, -1.0), (bx, by, 0.0), (ax, ay, 0.0)]
    return triangles


def _sides() -> list[tuple[tuple[float, float], tuple[float, float]]]:
    ring = [(math.cos(maths.TURN * i / SIDES), math.sin(maths.TURN * i / SIDES)) for i in range(SIDES + 1)]
    return list(itertools.pairwise(ring))


def box_of(item: bpy.types.Object) -> tuple[np.ndarray, float, float]:
    """Of ``item`` in the world: middle (3,) of its bounding box, its largest extent, height of its highest corner."""
    corners = box_corners(item)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return 0.5 * (low + high), max(float((high - low).max()), 1e-9), float(high[2])


class PHYSGEN_GT_arrow(bpy.types.Gizmo):
    """An arrow for a vector property of the active body; its tip can be dragged."""

    bl_idname = "PHYSGEN_GT_arrow"
    __slots__ = ("before", "cone", "cylinder", "grabbed", "grabbed_tip", "key", "knob", "title")

    def setup(self) -> None:
        """Shapes, once."""
        if not hasattr(self, "cone"):
            self.cone = self.new_custom_shape("TRIS", _cone())
            self.cylinder = self.new_custom_shape("TRIS", _cylinder())
            self.knob = self.new_custom_shape("TRIS", _knob())

    def draw(self, context: bpy.types.Context) -> None:
        """Stem and tip; a knob where the vector is zero."""
        base, way = self._arrow(context)
        tip = base + way
        pixel = maths.pixel_size(_perspective(context), tip, context.region.width)
        scale = context.preferences.system.ui_scale * pixel
        length = float(np.linalg.norm(way))
        if length < NO_LENGTH_PIXELS * scale:
            self.draw_custom_shape(self.knob, matrix=_matrix(base, np.eye(3), [ZERO_PIXELS * scale] * 3))
            return
        turn = maths.frame_along(way)
        size = TIP_PIXELS * scale
        stem = max(length - 2 * size, 0.0)
        self.draw_custom_shape(self.cylinder, matrix=_matrix(base, turn, [STEM_PIXELS * scale] * 2 + [stem]))
        self.draw_custom_shape(self.cone, matrix=_matrix(tip, turn, [size, size, min(size, length / 2)]))

    def test_select(self, context: bpy.types.Context, location: Any) -> int:
        """Whether the mouse is at the tip."""
        base, way = self._arrow(context)
        region, perspective = context.region, _perspective(context)
        seen = maths.on_screen(perspective, base + way, region.width, region.height)
        if seen is None:
            return -1
        # The cone lies before its tip; the middle of it is what people aim at.
        pixel = maths.pixel_size(perspective, base + way, region.width)
        scale = context.preferences.system.ui_scale
        length = float(np.linalg.norm(way))
        if length > NO_LENGTH_PIXELS * scale * pixel:
            back = base + way * (1 - min(0.5, TIP_PIXELS * scale * pixel / length))
            middle = maths.on_screen(perspective, back, region.width, region.height)
            seen = seen if middle is None else middle
        return 0 if float(np.hypot(*(seen - np.array(location)))) <= GRAB_PIXELS * scale else -1

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Take hold of the tip."""
        base, way = self._arrow(context)
        self.before = tuple(getattr(context.object.physgen, self.key))
        self.grabbed_tip = base + way
        under = self._under_mouse(context, event, maths.FREE)
        self.grabbed = self.grabbed_tip - under if under is not None else np.zeros(3)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event, tweak: Any) -> set[str]:
        """Move the tip with the mouse and write the property."""
        item = context.object
        if item is None:
            return {"CANCELLED"}
        mode = maths.LEVEL if event.shift else maths.UPRIGHT if event.ctrl else maths.FREE
        under = self._under_mouse(context, event, mode)
        if under is not None:
            base, _ = self._arrow(context)
            tip = under + self.grabbed
            if mode == maths.LEVEL:
                tip[2] = self.grabbed_tip[2]
            elif mode == maths.UPRIGHT:
                tip[:2] = self.grabbed_tip[:2]
            value = (tip - base) / self._length(context, item)
            setattr(item.physgen, self.key, value)
            self._say(context, value)
            redraw("VIEW_3D")
        return {"RUNNING_MODAL"}

    def exit(self, context: bpy.types.Context, cancel: bool) -> None:
        """Let go: one step of undo, or the value from before."""
        context.area.header_text_set(None)
        if context.object is None:
            return
        if cancel:
            setattr(context.object.physgen, self.key, self.before)
        elif tuple(getattr(context.object.physgen, self.key)) != self.before:
            bpy.ops.ed.undo_push(message=f"{self.title} of {context.object.name}")

    def _length(self, context: bpy.types.Context, item: bpy.types.Object) -> float:
        """Length of the arrow for each unit of the property."""
        _, size, _ = box_of(item)
        if self.key == "velocity":
            return maths.seconds_shown(size, metres_per_unit(context.scene))
        return maths.spin_length(size)

    def _arrow(self, context: bpy.types.Context) -> tuple[np.ndarray, np.ndarray]:
        """Where the arrow begins and where it leads, (3,) each."""
        item = context.object
        middle, size, top = box_of(item)
        base = middle if self.key == "velocity" else np.array([middle[0], middle[1], top + 0.15 * size])
        return base, np.array(getattr(item.physgen, self.key), dtype=np.float64) * self._length(context, item)

    def _under_mouse(self, context: bpy.types.Context, event: bpy.types.Event, mode: str) -> np.ndarray | None:
        region, view = context.region, context.region_data
        mouse = (event.mouse_region_x, event.mouse_region_y)
        origin = view3d_utils.region_2d_to_origin_3d(region, view, mouse)
        ray = view3d_utils.region_2d_to_vector_3d(region, view, mouse)
        forward = view.view_rotation @ Vector((0.0, 0.0, -1.0))
        return maths.dragged(self.grabbed_tip, np.array(origin), np.array(ray), np.array(forward), mode)

    def _say(self, context: bpy.types.Context, value: np.ndarray) -> None:
        x, y, z = value
        size = float(np.linalg.norm(value))
        unit = metres_per_unit(context.scene) if self.key == "velocity" else 1.0
        words = (
            f"{size * unit:.3g} m/s" if self.key == "velocity" else f"{size:.3g} rad/s, {size / maths.TURN:.2g} turns/s"
        )
        context.area.header_text_set(
            f"{self.title} {words}   ({x * unit:.3g}, {y * unit:.3g}, {z * unit:.3g})   "
            "Shift: level   Ctrl: up and down   Esc: as before"
        )


class PHYSGEN_GGT_arrows(bpy.types.GizmoGroup):
    """The arrows of the active body."""

    bl_idname = "PHYSGEN_GGT_arrows"
    bl_label = "PhysGen Motion"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options: ClassVar[set[str]] = {"3D", "PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The active object moves, and arrows are wanted."""
        item = context.object
        return (
            getattr(context.window_manager, SHOW_ARROWS)
            and item is not None
            and item.type == "MESH"
            and item.mode == "OBJECT"
            and item.physgen.enabled
            and item.physgen.role == "dynamic"
            and item.visible_get()
        )

    def setup(self, context: bpy.types.Context) -> None:
        """One arrow each; colours that are told apart on light and dark."""
        for key, title, colour in (
            ("velocity", "Velocity", (1.0, 0.55, 0.05)),
            ("spin", "Spin", (0.75, 0.25, 0.95)),
        ):
            arrow = self.gizmos.new(PHYSGEN_GT_arrow.bl_idname)
            arrow.key, arrow.title = key, title
            arrow.color, arrow.alpha = colour, 0.95
            arrow.color_highlight, arrow.alpha_highlight = (1.0, 1.0, 0.4), 1.0
            arrow.use_draw_modal = True


def _perspective(context: bpy.types.Context) -> np.ndarray:
    return np.array(context.region_data.perspective_matrix, dtype=np.float64)


def _matrix(place: np.ndarray, turn: np.ndarray, size: list[float]) -> Matrix:
    result = np.eye(4)
    result[:3, :3] = turn * np.array(size)
    result[:3, 3] = place
    return Matrix(result.tolist())


def _on_switch(self: bpy.types.WindowManager, context: bpy.types.Context) -> None:
    redraw("VIEW_3D")


CLASSES = (PHYSGEN_GT_arrow, PHYSGEN_GGT_arrows)


def register() -> None:
    """The switch, on at first; it belongs to the window manager and no file keeps it."""
    switch = bpy.props.BoolProperty(
        name="Arrows in Viewport",
        description="Show velocity and spin of the active object as arrows whose tips can be dragged",
        default=True,
        options={"SKIP_SAVE"},
        update=_on_switch,
    )
    setattr(bpy.types.WindowManager, SHOW_ARROWS, switch)


def unregister() -> None:
    """Take the switch away."""
    delattr(bpy.types.WindowManager, SHOW_ARROWS)
