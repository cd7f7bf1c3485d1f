# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of the photo's objects as Blender's images, packed in the .blend, and as the files that the command reads."""

from __future__ import annotations

import filecmp
import tempfile
from collections.abc import Mapping
from pathlib import Path

import bpy
import numpy as np

from ..sim.errors import InputError
from .mask_painting import Mask, ellipse, extent, resized

MOST_PX = 2048
"""Longest side of a painted mask; the reconstruction works with a smaller photo than that."""
_MARK = "physgen_mask"
"""Custom property of images that were painted here; others are the artist's and are not painted over."""


def mask_size(state: bpy.types.PropertyGroup) -> tuple[int, int]:
    """Width and height in pixels of a mask for the photo that is shown."""
    width, height = state.image.size
    shrink = min(1.0, MOST_PX / max(width, height, 1))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def first_mask(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup, found: Path) -> Mask:
    """What painting ``box`` begins with, of ``mask_size``: its mask, else the file ``found``, else an ellipse in it."""
    width, height = mask_size(state)
    if box.mask is not None and all(box.mask.size):
        return resized(read_mask_image(box.mask), width, height)
    if found.is_file():
        image = bpy.data.images.load(str(found), check_existing=False)
        try:
            if all(image.size):
                return resized(read_mask_image(image), width, height)
        finally:
            bpy.data.images.remove(image)
    across, down = width / max(state.width, 1), height / max(state.height, 1)
    return ellipse(width, height, (box.x0 * across, box.y0 * down, box.x1 * across, box.y1 * down))


def read_mask_image(image: bpy.types.Image) -> Mask:
    """The mask that ``image`` is: what is opaque where its transparency varies, else what is brighter than the middle.

    As the reconstruction reads files (sim/reconstruct/cut/given.py).
    """
    pixels = _pixels(image)
    values = pixels[..., :3].mean(axis=2) if image.channels >= 3 else pixels[..., 0]
    if image.channels == 4 and np.ptp(pixels[..., 3]) > 0:
        values = pixels[..., 3]
    low, high = float(values.min()), float(values.max())
    return values > (low + high) / 2 if high > low else np.full(values.shape, high > 0.5)


def store_mask(box: bpy.types.PropertyGroup, mask: Mask) -> bpy.types.Image | None:
    """Make ``mask`` the one of ``box``, as the packed image ``NAME mask``; None, and no mask, when it is empty."""
    if not mask.any():
        drop_mask(box)
        return None
    height, width = mask.shape
    image = box.mask
    # An artist's own image stays as it is.
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
    """Leave ``box`` without a mask; one that was painted and that nobody else uses goes."""
    image = box.mask
    box.mask = None
    if image is not None and _MARK in image and image.users == 0:
        bpy.data.images.remove(image)


def widen(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup, mask: Mask) -> None:
    """Let ``box`` hold all of its ``mask``."""
    found = extent(mask)
    if found is None:
        return
    across, down = state.width / mask.shape[1], state.height / mask.shape[0]
    box.x0, box.y0 = min(box.x0, int(found[0] * across)), min(box.y0, int(found[1] * down))
    box.x1 = min(max(box.x1, round(found[2] * across + 0.5)), state.width)
    box.y1 = min(max(box.y1, round(found[3] * down + 0.5)), state.height)


def write_masks(masks: Mapping[Path, bpy.types.Image]) -> None:
    """Write each image as a PNG file. One that holds the same already is left as it is.

    Raises InputError for an image that is not there, or a folder that cannot be written.
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
    # A copy, because how and where the artist's own image is saved must not change.
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
    """Its pixels (H, W, channels) from the top, 0 to 1."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, image.channels)[::-1]
