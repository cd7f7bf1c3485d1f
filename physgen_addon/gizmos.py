# SPDX-License-Identifier: GPL-3.0-or-later
"""Viewport arrows for the velocity and spin of the active body; drag the tip to change them."""

from __future__ import annotations

import itertools
import math
from typing import Any, ClassVar

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from .context import redraw
from .scene_io.export_animation import metres_per_unit
from .scene_io.export_meshes import box_corners

Array = NDArray[np.float64]

GRAVITY = 9.81
TURN = 2 * math.pi

FREE, LEVEL, UPRIGHT = "free", "level", "upright"
"""Drag modes: in the view plane, in a horizontal plane, vertically."""


def seconds_shown(size: float, metres_per_unit: float) -> float:
    """Return the travel time in seconds that a velocity arrow's length represents, for a body of ``size``.

    It is the time to fall about half the body's size: an arrow as long as the body throws it about that high.
    """
    return math.sqrt(max(size, 1e-9) * metres_per_unit / GRAVITY)


def spin_length(size: float) -> float:
    """Return the arrow length per radian a second: one turn a second is as long as the body."""
    return max(size, 1e-9) / TURN


def pixel_size(perspective: Array, point: Array, width: int) -> float:
    """Return the size of a pixel at ``point`` (3,) in a view of ``width`` pixels with matrix ``perspective`` (4, 4)."""
    depth = float(perspective[3, :3] @ point + perspective[3, 3])
    return 2.0 * abs(depth) / (width * max(float(np.linalg.norm(perspective[0, :3])), 1e-30))


def on_screen(perspective: Array, point: Array, width: int, height: int) -> Array | None:
    """Return the pixel (2,), from the lower left corner, where ``point`` (3,) is seen; None behind the viewer."""
    x, y, _, w = perspective @ np.append(point, 1.0)
    if w <= 0:
        return None
    return np.array([(x / w + 1) * width / 2, (y / w + 1) * height / 2])


def dragged(start: Array, origin: Array, ray: Array, forward: Array, mode: str) -> Array | None:
    """Return the position (3,) of a tip dragged from ``start`` (3,) to the mouse.

    origin, ray: line of sight through the mouse, (3,). forward: unit viewing direction (3,). mode: ``FREE``, ``LEVEL``
    or ``UPRIGHT``. None if the line of sight does not meet the drag plane in front of the viewer.
    """
    normal = forward
    if mode == LEVEL:
        normal = np.array([0.0, 0.0, 1.0])
    elif mode == UPRIGHT:
        # The vertical plane that faces the viewer most.
        normal = np.array([forward[0], forward[1], 0.0])
    slope = float(ray @ normal)
    length = float(np.linalg.norm(normal))
    if abs(slope) <= 0.02 * length * float(np.linalg.norm(ray)) or length < 1e-6:
        return None
    found: Array = origin + ray * (float((start - origin) @ normal) / slope)
    if mode == UPRIGHT:
        found = np.array([start[0], start[1], found[2]])
    return found


def frame_along(direction: Array) -> Array:
    """Return a rotation (3, 3) with its third column along ``direction`` (3,); identity-like (up) for zero length."""
    length = float(np.linalg.norm(direction))
    z = direction / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


SHOW_ARROWS = "physgen_show_arrows"
"""Name of the toggle, a property of the window manager."""

STEM_PIXELS, TIP_PIXELS, GRAB_PIXELS = 1.6, 9.0, 14.0
ZERO_PIXELS = 7.5
NO_LENGTH_PIXELS = 4.0
"""An arrow shorter than this is drawn as a knob."""

SIDES = 12


def _cylinder() -> list[tuple[float, float, float]]:
    """Return triangles of a cylinder of radius 1 from the origin to z = 1."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(ax, ay, 0.0), (bx, by, 0.0), (bx, by, 1.0), (ax, ay, 0.0), (bx, by, 1.0), (ax, ay, 1.0)]
    return triangles


def _cone() -> list[tuple[float, float, float]]:
    """Return triangles of a cone with its tip at the origin, length 2."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(0.0, 0.0, 0.0), (ax * 0.7, ay * 0.7, -2.0), (bx * 0.7, by * 0.7, -2.0)]
        triangles += [(0.0, 0.0, -2.0), (bx * 0.7, by * 0.7, -2.0), (ax * 0.7, ay * 0.7, -2.0)]
    return triangles


def _knob() -> list[tuple[float, float, float]]:
    """Return triangles of a double pyramid of radius 1."""
    triangles = []
    for (ax, ay), (bx, by) in _sides():
        triangles += [(0.0, 0.0, 1.0), (ax, ay, 0.0), (bx, by, 0.0), (0.0, 0.0, -1.0), (bx, by, 0.0), (ax, ay, 0.0)]
    return triangles


def _sides() -> list[tuple[tuple[float, float], tuple[float, float]]]:
    ring = [(math.cos(TURN * i / SIDES), math.sin(TURN * i / SIDES)) for i in range(SIDES + 1)]
    return list(itertools.pairwise(ring))


def box_of(item: bpy.types.Object) -> tuple[np.ndarray, float, float]:
    """Return the world-space bounding box centre (3,) of ``item``, its largest extent, and its top z."""
    corners = box_corners(item)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return 0.5 * (low + high), max(float((high - low).max()), 1e-9), float(high[2])


class PHYSGEN_GT_arrow(bpy.types.Gizmo):
    """Arrow gizmo of a vector property of the active body; its tip can be dragged."""

    bl_idname = "PHYSGEN_GT_arrow"
    __slots__ = ("before", "cone", "cylinder", "grabbed", "grabbed_tip", "key", "knob", "title")

    def setup(self) -> None:
        """Create the shapes once."""
        if not hasattr(self, "cone"):
            self.cone = self.new_custom_shape("TRIS", _cone())
            self.cylinder = self.new_custom_shape("TRIS", _cylinder())
            self.knob = self.new_custom_shape("TRIS", _knob())

    def draw(self, context: bpy.types.Context) -> None:
        """Draw stem and tip, or a knob for a zero vector."""
        base, way = self._arrow(context)
        tip = base + way
        pixel = pixel_size(_perspective(context), tip, context.region.width)
        scale = context.preferences.system.ui_scale * pixel
        length = float(np.linalg.norm(way))
        if length < NO_LENGTH_PIXELS * scale:
            self.draw_custom_shape(self.knob, matrix=_matrix(base, np.eye(3), [ZERO_PIXELS * scale] * 3))
            return
        turn = frame_along(way)
        size = TIP_PIXELS * scale
        stem = max(length - 2 * size, 0.0)
        self.draw_custom_shape(self.cylinder, matrix=_matrix(base, turn, [STEM_PIXELS * scale] * 2 + [stem]))
        self.draw_custom_shape(self.cone, matrix=_matrix(tip, turn, [size, size, min(size, length / 2)]))

    def test_select(self, context: bpy.types.Context, location: Any) -> int:
        """Return 0 if the mouse is at the tip, else -1."""
        base, way = self._arrow(context)
        region, perspective = context.region, _perspective(context)
        seen = on_screen(perspective, base + way, region.width, region.height)
        if seen is None:
            return -1
        # The cone lies before its tip; users aim at its middle.
        pixel = pixel_size(perspective, base + way, region.width)
        scale = context.preferences.system.ui_scale
        length = float(np.linalg.norm(way))
        if length > NO_LENGTH_PIXELS * scale * pixel:
            back = base + way * (1 - min(0.5, TIP_PIXELS * scale * pixel / length))
            middle = on_screen(perspective, back, region.width, region.height)
            seen = seen if middle is None else middle
        return 0 if float(np.hypot(*(seen - np.array(location)))) <= GRAB_PIXELS * scale else -1

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start dragging the tip."""
        base, way = self._arrow(context)
        self.before = tuple(getattr(context.object.physgen, self.key))
        self.grabbed_tip = base + way
        under = self._under_mouse(context, event, FREE)
        self.grabbed = self.grabbed_tip - under if under is not None else np.zeros(3)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event, tweak: Any) -> set[str]:
        """Move the tip with the mouse and write the property."""
        item = context.object
        if item is None:
            return {"CANCELLED"}
        mode = LEVEL if event.shift else UPRIGHT if event.ctrl else FREE
        under = self._under_mouse(context, event, mode)
        if under is not None:
            base, _ = self._arrow(context)
            tip = under + self.grabbed
            if mode == LEVEL:
                tip[2] = self.grabbed_tip[2]
            elif mode == UPRIGHT:
                tip[:2] = self.grabbed_tip[:2]
            value = (tip - base) / self._length(context, item)
            setattr(item.physgen, self.key, value)
            self._say(context, value)
            redraw("VIEW_3D")
        return {"RUNNING_MODAL"}

    def exit(self, context: bpy.types.Context, cancel: bool) -> None:
        """End dragging: push one undo step, or restore the value."""
        context.area.header_text_set(None)
        if context.object is None:
            return
        if cancel:
            setattr(context.object.physgen, self.key, self.before)
        elif tuple(getattr(context.object.physgen, self.key)) != self.before:
            bpy.ops.ed.undo_push(message=f"{self.title} of {context.object.name}")

    def _length(self, context: bpy.types.Context, item: bpy.types.Object) -> float:
        """Return arrow length per unit of the property."""
        _, size, _ = box_of(item)
        if self.key == "velocity":
            return seconds_shown(size, metres_per_unit(context.scene))
        return spin_length(size)

    def _arrow(self, context: bpy.types.Context) -> tuple[np.ndarray, np.ndarray]:
        """Return start and direction vector of the arrow, (3,) each."""
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
        return dragged(self.grabbed_tip, np.array(origin), np.array(ray), np.array(forward), mode)

    def _say(self, context: bpy.types.Context, value: np.ndarray) -> None:
        x, y, z = value
        size = float(np.linalg.norm(value))
        unit = metres_per_unit(context.scene) if self.key == "velocity" else 1.0
        words = f"{size * unit:.3g} m/s" if self.key == "velocity" else f"{size:.3g} rad/s, {size / TURN:.2g} turns/s"
        context.area.header_text_set(
            f"{self.title} {words}   ({x * unit:.3g}, {y * unit:.3g}, {z * unit:.3g})   "
            "Shift: level   Ctrl: up and down   Esc: as before"
        )


class PHYSGEN_GGT_arrows(bpy.types.GizmoGroup):
    """Arrow gizmos of the active body"""

    bl_idname = "PHYSGEN_GGT_arrows"
    bl_label = "PhysGen Motion"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options: ClassVar[set[str]] = {"3D", "PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled when the active object moves and arrows are switched on."""
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
        """Create one arrow each, in colours distinguishable on light and dark backgrounds."""
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


def register_arrow_switch() -> None:
    """Add the toggle to the window manager, on by default and not saved in files."""
    switch = bpy.props.BoolProperty(
        name="Arrows in Viewport",
        description="Show velocity and spin of the active object as arrows whose tips can be dragged",
        default=True,
        options={"SKIP_SAVE"},
        update=_on_switch,
    )
    setattr(bpy.types.WindowManager, SHOW_ARROWS, switch)


def unregister_arrow_switch() -> None:
    """Remove the toggle."""
    delattr(bpy.types.WindowManager, SHOW_ARROWS)
