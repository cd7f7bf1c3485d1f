# SPDX-License-Identifier: GPL-3.0-or-later
"""The photo in the image editors: where it is seen, and which place of it is under the mouse.

Places are fractions of the photo's width and height from its top left corner; they may lie outside 0 to 1.
"""

from __future__ import annotations

import bpy
from mathutils import Vector


def regions(context: bpy.types.Context, image: bpy.types.Image) -> list[bpy.types.Region]:
    """The regions of the window in which ``image`` is seen."""
    return [
        region
        for area in context.window.screen.areas
        if area.type == "IMAGE_EDITOR" and area.spaces.active.image == image
        for region in area.regions
        if region.type == "WINDOW"
    ]


def region_under(context: bpy.types.Context, image: bpy.types.Image, event: bpy.types.Event) -> bpy.types.Region | None:
    """The one under the mouse, unless a sidebar lies over it there."""
    x, y = event.mouse_x, event.mouse_y
    for region in regions(context, image):
        area = next(area for area in context.window.screen.areas if region in area.regions.values())
        covers = [r for r in area.regions if r.type != "WINDOW" and r.width > 1 and r.height > 1]
        if _inside(region, x, y) and not any(_inside(cover, x, y) for cover in covers):
            return region
    return None


def _inside(region: bpy.types.Region, x: int, y: int) -> bool:
    return 0 <= x - region.x < region.width and 0 <= y - region.y < region.height


def place_under(region: bpy.types.Region, event: bpy.types.Event) -> tuple[float, float]:
    """The place of the photo under the mouse."""
    u, v = region.view2d.region_to_view(event.mouse_x - region.x, event.mouse_y - region.y)
    return u, 1 - v


def width_of_pixel(region: bpy.types.Region) -> float:
    """How much of the photo's width a pixel of the screen shows."""
    return region.view2d.region_to_view(1, 0)[0] - region.view2d.region_to_view(0, 0)[0]


def on_screen(region: bpy.types.Region, u: float, v: float) -> Vector:
    """Where in ``region`` a place of the photo is, in pixels from its lower left corner."""
    return Vector(region.view2d.view_to_region(u, 1 - v, clip=False))


def shows_photo(context: bpy.types.Context) -> bool:
    """Whether the image editor that draws now shows the photo of its scene."""
    state = context.scene.physgen_photo
    return state.image is not None and bool(state.width) and context.space_data.image == state.image


def why_not_seen(context: bpy.types.Context) -> str:
    """What keeps from working on the photo in an image editor; empty when nothing does."""
    image = context.scene.physgen_photo.image
    if image is None:
        return "Open a photo first"
    if context.window is None or not regions(context, image):
        return "No image editor shows the photo"
    return ""
