# SPDX-License-Identifier: GPL-3.0-or-later
"""A photo as a Blender image that stands upright: Blender does not turn a photo by what the camera wrote into it."""

from __future__ import annotations

import struct
from pathlib import Path

import bpy
import numpy as np

from ...sim.errors import InputError

MAX_TURNED = 2048
"""Longest side in pixels of a photo that is turned, so that it does not take seconds; boxes are in its own pixels."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
_HEAD_BYTES = 256 * 1024
_UPRIGHT, _ORIENTATION = 1, 0x0112


def load_photo_image(path: Path) -> tuple[bpy.types.Image, tuple[int, int]]:
    """The photo at ``path`` upright, and the width and height in pixels that it has then.

    Raises InputError when it is missing, of another kind, or no picture; then no image is left behind.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such photo; check its name")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: is no photo; give a JPEG, PNG, TIFF or WebP file")
    try:
        turn = orientation(path)
        image = bpy.data.images.load(str(path), check_existing=False)
    except (OSError, RuntimeError) as error:
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
    """How a JPEG is to be turned by its EXIF, 1 (not at all) to 8; 1 for what says nothing or nothing sensible."""
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
    """A packed copy turned as EXIF's ``turn`` says (rows of Blender's pixels go upward); ``image`` goes."""
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
