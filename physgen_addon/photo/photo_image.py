# SPDX-License-Identifier: GPL-3.0-or-later
"""The photo in Blender: loaded upright, located in the image editors, with masks of its objects."""

from __future__ import annotations

import filecmp
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from ...sim.errors import InputError
from ..compat import OperatorMixin
from ..context import redraw, scene_with
from ..paths import load_image
from .photo_maths import Mask, ellipse, extent, resized

MAX_TURNED = 2048
"""Maximum side in pixels of a rotated photo, to bound the time; boxes are in its pixels."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
_HEAD_BYTES = 256 * 1024
_UPRIGHT, _ORIENTATION = 1, 0x0112


def load_photo_image(path: Path) -> tuple[bpy.types.Image, tuple[int, int]]:
    """Return the photo at ``path`` upright, and its width and height in pixels.

    Raises InputError if it is missing, a folder, of another type, or unreadable; then no image is left behind.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; choose a photo in it")
    if not path.is_file():
        raise InputError(f"{path}: there is no such photo; check its name")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: is no photo; give a JPEG, PNG, TIFF or WebP file")
    image = load_image(path)
    try:
        turn = orientation(path)
    except OSError as error:
        bpy.data.images.remove(image)
        raise InputError(f"{path}: cannot be read ({error}); check that the file may be read") from None
    width, height = image.size
    if not width or not height:
        bpy.data.images.remove(image)
        raise InputError(f"{path}: is not a readable picture; it may be damaged, save it again")
    if turn == _UPRIGHT:
        return image, (width, height)
    image = _turned(image, turn)
    return image, ((height, width) if turn >= 5 else (width, height))


def orientation(path: Path) -> int:
    """Return the EXIF orientation of a JPEG, 1 (upright) to 8; 1 if absent or invalid."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    try:
        return _of_jpeg(head)
    except (struct.error, IndexError):
        return _UPRIGHT


def _of_jpeg(head: bytes) -> int:
    if head[:2] != b"\xff\xd8":
        return _UPRIGHT
    place = 2
    while True:
        marker, kind, length = struct.unpack_from(">BBH", head, place)
        if marker != 0xFF or kind == 0xDA or length < 2:
            return _UPRIGHT
        if kind == 0xE1 and head[place + 4 : place + 10] == b"Exif\0\0":
            return _of_tiff(head[place + 10 : place + 2 + length])
        place += 2 + length


def _of_tiff(data: bytes) -> int:
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        return _UPRIGHT
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    for entry in range(count):
        tag, _, _, value = struct.unpack_from(order + "HHIH", data, start + 2 + 12 * entry)
        if tag == _ORIENTATION:
            return value if 1 <= value <= 8 else _UPRIGHT
    return _UPRIGHT


def _turned(image: bpy.types.Image, turn: int) -> bpy.types.Image:
    """Return a packed copy transformed by the EXIF orientation ``turn`` (rows of Blender's pixels go upward); ``image``
    is removed.
    """
    width, height = image.size
    shrink = min(1.0, MAX_TURNED / max(width, height))
    if shrink < 1:
        image.scale(max(1, round(width * shrink)), max(1, round(height * shrink)))
    pixels = np.empty(image.size[0] * image.size[1] * image.channels, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    array = pixels.reshape(image.size[1], image.size[0], image.channels)[::-1]
    if turn >= 5:
        array = array.transpose(1, 0, 2)
    if turn in (3, 4, 7, 8):
        array = array[::-1]
    if turn in (2, 3, 6, 7):
        array = array[:, ::-1]
    name = image.name
    bpy.data.images.remove(image)
    upright = bpy.data.images.new(name, array.shape[1], array.shape[0], alpha=array.shape[2] == 4)
    full = np.ones((*array.shape[:2], 4), dtype=np.float32)
    full[..., : array.shape[2]] = array
    upright.pixels.foreach_set(np.ascontiguousarray(full[::-1]).ravel())
    upright.update()
    upright.pack()
    return upright


def regions(context: bpy.types.Context, image: bpy.types.Image) -> list[bpy.types.Region]:
    """Return the regions of the window that show ``image``."""
    return [
        region
        for area in context.window.screen.areas
        if area.type == "IMAGE_EDITOR" and area.spaces.active.image == image
        for region in area.regions
        if region.type == "WINDOW"
    ]


def region_under(context: bpy.types.Context, image: bpy.types.Image, event: bpy.types.Event) -> bpy.types.Region | None:
    """Return the region under the mouse, unless a sidebar covers it there."""
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
    """Return the position (u, v) on the photo under the mouse."""
    u, v = region.view2d.region_to_view(event.mouse_x - region.x, event.mouse_y - region.y)
    return u, 1 - v


def width_of_pixel(region: bpy.types.Region) -> float:
    """Return the share of the photo's width that a screen pixel covers."""
    return region.view2d.region_to_view(1, 0)[0] - region.view2d.region_to_view(0, 0)[0]


def on_screen(region: bpy.types.Region, u: float, v: float) -> Vector:
    """Return pixel coordinates in ``region``, from its lower left corner, of a position on the photo."""
    return Vector(region.view2d.view_to_region(u, 1 - v, clip=False))


def shows_photo(context: bpy.types.Context) -> bool:
    """Return whether the image editor being drawn shows the photo of its scene."""
    state = context.scene.physgen_photo
    return state.image is not None and bool(state.width) and context.space_data.image == state.image


def why_not_seen(context: bpy.types.Context) -> str:
    """Return why the photo cannot be edited in an image editor; empty if it can."""
    image = context.scene.physgen_photo.image
    if image is None:
        return "Open a photo first"
    if context.window is None or not regions(context, image):
        return "No image editor shows the photo"
    return ""


MOST_PX = 2048
"""Maximum side of a painted mask; the reconstruction uses a smaller photo than that."""
_MARK = "physgen_mask"
"""Custom property of images painted here; a user's own images are not painted over."""


def mask_size(state: bpy.types.PropertyGroup) -> tuple[int, int]:
    """Return width and height in pixels of a mask for the shown photo."""
    width, height = state.image.size
    shrink = min(1.0, MOST_PX / max(width, height, 1))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def first_mask(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup, found: Path) -> Mask:
    """Return the initial mask of ``box``, of ``mask_size``: its mask, else the file ``found``, else an ellipse."""
    width, height = mask_size(state)
    if box.mask is not None and all(box.mask.size):
        return resized(read_mask_image(box.mask), width, height)
    if found.is_file():
        image = load_image(found)
        try:
            if all(image.size):
                return resized(read_mask_image(image), width, height)
        finally:
            bpy.data.images.remove(image)
    across, down = width / max(state.width, 1), height / max(state.height, 1)
    return ellipse(width, height, (box.x0 * across, box.y0 * down, box.x1 * across, box.y1 * down))


def read_mask_image(image: bpy.types.Image) -> Mask:
    """Return ``image`` as a mask: alpha above half if it varies, else brightness above half.

    Same rule as the reconstruction's for mask files.
    """
    pixels = _pixels(image)
    values = pixels[..., :3].mean(axis=2) if image.channels >= 3 else pixels[..., 0]
    if image.channels == 4 and np.ptp(pixels[..., 3]) > 0:
        values = pixels[..., 3]
    low, high = float(values.min()), float(values.max())
    return values > (low + high) / 2 if high > low else np.full(values.shape, high > 0.5)


def store_mask(box: bpy.types.PropertyGroup, mask: Mask) -> bpy.types.Image | None:
    """Store ``mask`` for ``box`` as the packed image ``NAME mask``; an empty one is removed and None returned."""
    if not mask.any():
        drop_mask(box)
        return None
    height, width = mask.shape
    image = box.mask
    # A user's own image is not modified.
    if image is None or _MARK not in image or tuple(image.size) != (width, height):
        drop_mask(box)
        image = bpy.data.images.new(f"{box.name} mask", width, height, alpha=False, is_data=True)
        image[_MARK] = True
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = mask[::-1, :, None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    box.mask = image
    return image


def drop_mask(box: bpy.types.PropertyGroup) -> None:
    """Remove the mask of ``box``, and its image if painted here and unused elsewhere."""
    image = box.mask
    box.mask = None
    if image is not None and _MARK in image and image.users == 0:
        bpy.data.images.remove(image)


def widen(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup, mask: Mask) -> None:
    """Grow ``box`` to contain its ``mask``."""
    found = extent(mask)
    if found is None:
        return
    across, down = state.width / mask.shape[1], state.height / mask.shape[0]
    box.x0, box.y0 = min(box.x0, int(found[0] * across)), min(box.y0, int(found[1] * down))
    box.x1 = min(max(box.x1, round(found[2] * across + 0.5)), state.width)
    box.y1 = min(max(box.y1, round(found[3] * down + 0.5)), state.height)


def write_masks(masks: Mapping[Path, bpy.types.Image]) -> None:
    """Write each image as a PNG file, unless the file already has that content.

    Raises InputError for a missing image, or a folder that cannot be written.
    """
    for path, image in masks.items():
        if not all(image.size):
            raise InputError(f"mask {image.name}: its picture cannot be read; choose another, or paint one")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                partial = Path(folder) / path.name
                _write_png(image, partial)
                if not path.is_file() or not filecmp.cmp(partial, path, shallow=False):
                    partial.replace(path)
        except (OSError, RuntimeError) as error:
            raise InputError(f"{path}: the mask cannot be written ({error}); choose another Scene Folder") from None


def _write_png(image: bpy.types.Image, path: Path) -> None:
    # A copy, because format and path of the user's own image must not change.
    width, height = image.size
    pixels = _pixels(image)[::-1]
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., : image.channels] = pixels
    if image.channels < 3:
        rgba[..., :3] = pixels[..., :1]
    copy = bpy.data.images.new(image.name, width, height, alpha=image.channels == 4, is_data=True)
    try:
        copy.pixels.foreach_set(np.ascontiguousarray(rgba).ravel())
        copy.file_format = "PNG"
        copy.save(filepath=str(path))
    finally:
        bpy.data.images.remove(copy)


def _pixels(image: bpy.types.Image) -> np.ndarray:
    """Return pixels (H, W, channels), top row first, 0 to 1."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, image.channels)[::-1]


ENDING = ("RET", "NUMPAD_ENTER", "ESC", "RIGHTMOUSE")
"""Keys and buttons that end a tool."""


_help: list[str] = []
"""Of the tool that is in use, at most one."""


def tool_help() -> str:
    """Return how to use and end the tool that works over the photo now, in sentences; empty if there is none."""
    return ". ".join(_help[0].split("    ")) if _help else ""


class PhotoTool(OperatorMixin):
    """Mixin of modal operators that work over the photo in the image editor: enabled while it is visible, with a cursor
    and a line of help until Enter, Esc, the right button or a click outside the photo ends it.

    tool_cursor: one of Blender's cursors. tool_help: shown in the status bar and the panel. tool_box: index of the box
    that it changes; None for none.
    """

    tool_cursor = "CROSSHAIR"
    tool_help = ""
    tool_box: int | None = None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled unless ``why_not`` gives a reason."""
        why = cls.why_not(context)
        if why:
            cls.poll_message_set(why)
        return not why

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        """Return why the tool cannot be used now; empty if it can."""
        return why_not_seen(context)

    def begin(self, context: bpy.types.Context) -> set[str]:
        """Start to receive events; return the result of ``invoke``."""
        self.tool_scene = context.scene.session_uid
        context.window.cursor_modal_set(self.tool_cursor)
        context.workspace.status_text_set(self.tool_help)
        context.window_manager.modal_handler_add(self)
        _help[:] = [self.tool_help]
        for editor in ("IMAGE_EDITOR", "VIEW_3D"):
            redraw(editor)
        return {"RUNNING_MODAL"}

    def photo_state(self) -> bpy.types.PropertyGroup | None:
        """Return the photo's settings in the scene that the tool works on; None if photo, box or scene are gone."""
        scene = scene_with(self.tool_scene)
        if scene is None or scene.physgen_photo.image is None:
            return None
        state = scene.physgen_photo
        return state if self.tool_box is None or self.tool_box < len(state.boxes) else None

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Handle events until the tool ends."""
        state = self.photo_state()
        if state is None:
            return self.end(context, "CANCELLED")
        if event.type in ENDING and event.value == "PRESS":
            return self.done(context, state)
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            region = region_under(context, state.image, event)
            if region is None:
                # The click is for whatever lies there, such as a button.
                return self.done(context, state) | {"PASS_THROUGH"}
            self.press(state, event, region)
        elif not self.handle(context, state, event):
            # Zooming and panning stay available.
            return {"PASS_THROUGH"}
        redraw("IMAGE_EDITOR", "WINDOW")
        return {"RUNNING_MODAL"}

    def press(self, state: bpy.types.PropertyGroup, event: bpy.types.Event, region: bpy.types.Region) -> None:
        """Handle the left button, pressed over the photo in ``region``."""

    def handle(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> bool:
        """Handle any other event; return whether it was one of the tool's own."""
        return False

    def done(self, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> set[str]:
        """Finish; return the result of ``modal``."""
        return self.end(context, "FINISHED")

    def end(self, context: bpy.types.Context, how: str) -> set[str]:
        """Give cursor and status bar back; return the result ``how``, FINISHED or CANCELLED, of ``modal``."""
        self.forget()
        _help.clear()
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        for editor in ("IMAGE_EDITOR", "VIEW_3D"):
            redraw(editor)
        return {how}

    def forget(self) -> None:
        """Drop what the tool draws; called at its end."""

    def cancel(self, context: bpy.types.Context) -> None:
        """Called by Blender when another file is loaded or Blender quits."""
        self.end(context, "CANCELLED")
