# SPDX-License-Identifier: MIT
"""A view: an image with its camera, mask and object labels; the image files it comes from, and cameras on orbits."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import ndimage

from ...errors import InputError
from ...files import MAX_PICTURE_BYTES, open_file
from ...scene.folder import inside
from ...scene.model import Camera, Matrix4

Picture = NDArray[np.float32]
Labels = NDArray[np.int8]

OUTSIDE, BACKGROUND, FOREGROUND = -1, 1, 2
"""Labels of pixels and vertices: no object; O1, the partly occluded object; O2, the object that occludes it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """An image with its camera; the arrays are copied and read-only. Raises InputError on wrong shapes or values."""

    name: str
    """For messages and file names; unique among the views of an object."""

    camera: Camera
    """Of the image's size; its pose in world metres."""

    pixels: Picture
    """(H, W, 3) sRGB, 0 to 1; over white where there is a mask."""

    mask: Picture | None = None
    """(H, W) coverage of each pixel by the objects, 0 to 1; None: unknown."""

    labels: Labels | None = None
    """(H, W) object of each pixel: -1 none, 1 the background object O1, 2 the foreground object O2, then others; None:
    unknown (S in PhyCAGE, section 4.1)."""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        object.__setattr__(self, "pixels", self._checked("pixels", self.pixels, (*size, 3)))
        if self.mask is not None:
            object.__setattr__(self, "mask", self._checked("mask", self.mask, size))
        if self.labels is not None:
            given = np.asarray(self.labels)
            if given.shape != size or not np.isin(given, (OUTSIDE, *range(1, 128))).all():
                raise InputError(
                    f"view {self.name!r}: labels have shape {given.shape} and values {_some(given)}: give {size} of -1 "
                    "outside, 1, 2 and so on for objects"
                )
            labels = given.astype(np.int8)
            labels.flags.writeable = False
            object.__setattr__(self, "labels", labels)

    def _checked(self, what: str, value: Picture, shape: tuple[int, ...]) -> Picture:
        array = np.array(value, dtype=np.float32)
        if array.shape != shape:
            raise InputError(f"view {self.name!r}: {what} have shape {array.shape}, the camera's is {shape}")
        # A comparison with NaN is false.
        if not (array.min(initial=0.0) >= 0 and array.max(initial=0.0) <= 1):
            raise InputError(f"view {self.name!r}: {what} are beyond 0 to 1, or not numbers: divide bytes by 255")
        array.flags.writeable = False
        return array


def _some(values: NDArray[np.generic]) -> str:
    found = np.unique(values)
    return ", ".join(str(value) for value in found[:6]) + (" …" if len(found) > 6 else "")


def over_white(colours: Picture, mask: Picture) -> Picture:
    """Return (H, W, 3) ``colours`` (H, W, 3) composited over white by the coverage ``mask`` (H, W)."""
    return colours * mask[..., None] + (1 - mask[..., None])


def orbit_camera(
    azimuth: float, elevation: float, distance: float, *, side: int, focal: float, target: tuple[float, ...] = (0, 0, 0)
) -> Camera:
    """Return the camera of a square image at ``distance`` m from ``target`` (3,), upright, looking at it.

    azimuth: degrees counter-clockwise seen from above, 0 at +x; elevation: degrees above the horizontal. side: pixels;
    focal: focal length over the side.
    """
    around, up = math.radians(azimuth), math.radians(elevation)
    outward = np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])
    right = np.array([-math.sin(around), math.cos(around), 0.0])
    matrix = np.eye(4)
    # Outward from the target is backward for the camera; right and down complete the frame.
    matrix[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], axis=1)
    matrix[:3, 3] = np.asarray(target, dtype=np.float64) + distance * outward
    return Camera(
        width=side,
        height=side,
        fx=focal * side,
        fy=focal * side,
        cx=side / 2,
        cy=side / 2,
        world_from_camera=cast(Matrix4, tuple(tuple(row) for row in matrix.tolist())),
    )


ORBIT_VIEWS = 16
ORBIT_ELEVATION = 30.0
"""Degrees."""

FIELD_OF_VIEW = 49.1
"""Degrees, as published for SyncDreamer (Liu et al. 2023): a 35 mm lens on a 32 mm sensor."""

ORBIT_MARGIN = 1.1
"""Radius that has to fit into the image, over the object's."""


def orbit_cameras(points: NDArray[np.float64], size: int) -> tuple[Camera, ...]:
    """Return 16 cameras of ``size``² pixels around ``points`` (N, 3), world metres, z up, each seeing all of them.

    As SyncDreamer's: every 22.5°, from 30° above.
    """
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = ORBIT_MARGIN * float(np.linalg.norm(points - middle, axis=1).max())
    half = math.radians(FIELD_OF_VIEW / 2)
    x, y, z = (float(v) for v in middle)
    return tuple(
        orbit_camera(
            360.0 / ORBIT_VIEWS * i,
            ORBIT_ELEVATION,
            radius / math.sin(half),
            side=size,
            focal=0.5 / math.tan(half),
            target=(x, y, z),
        )
        for i in range(ORBIT_VIEWS)
    )


MAX_PIXELS = 2**26
"""Of all images of an object together: 1 GiB of colours and masks as float32."""

FORMATS = ("PNG", "JPEG", "WEBP", "BMP")
_DECODER_ERRORS = (OSError, UnidentifiedImageError, ValueError, SyntaxError, struct.error, Image.DecompressionBombError)
"""Raised by Pillow for damaged files."""

Colours = NDArray[np.float32]


class PixelBudget:
    """The number of pixels that may still be read."""

    def __init__(self) -> None:
        self._left = MAX_PIXELS

    def take(self, width: int, height: int, path: Path) -> None:
        """Subtract the pixels of ``path``. Raises InputError when the budget is exceeded."""
        self._left -= width * height
        if self._left < 0:
            raise InputError(
                f"{path}: with its {width}x{height} pixels the views exceed {MAX_PIXELS >> 20} Mi pixels: use fewer or "
                "smaller views"
            )


def read_image(path: Path, budget: PixelBudget) -> tuple[Colours, Colours | None]:
    """Return sRGB colours (H, W, 3) and opacity (H, W), both float32 0 to 1; None for images that are fully opaque.

    Raises InputError when the file is missing, not an image, or too large.
    """
    image = _open_image(path, budget)
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        pixels = _normalised(image.convert("RGBA"), 255)
        # Many programs write an alpha channel that is opaque everywhere.
        if pixels[..., 3].min() < 1:
            return pixels[..., :3], pixels[..., 3]
        return pixels[..., :3], None
    return _normalised(image.convert("RGB"), 255), None


def read_coverage(path: Path, size: tuple[int, int], budget: PixelBudget) -> Colours:
    """Return (H, W) coverage, 0 to 1, of a mask file: its opacity where it has one, else its brightness.

    size: the (H, W) it must have. Raises InputError as ``read_image``, and on another size.
    """
    image = _open_image(path, budget)
    _require_size(path, image, size)
    if image.mode.startswith("I"):
        return _normalised(image, 65535)
    if image.mode in ("RGBA", "LA"):
        alpha = _normalised(image.getchannel("A"), 255)
        if alpha.min(initial=1) < 1:
            return alpha
    return _normalised(image.convert("L"), 255)


def _normalised(image: Image.Image, most: int) -> Colours:
    return np.clip(np.asarray(image, dtype=np.float32) / np.float32(most), 0, 1, dtype=np.float32)


def read_label_image(path: Path, size: tuple[int, int], budget: PixelBudget) -> NDArray[np.int64]:
    """Return (H, W) the integers of a label image: grey values or palette indices.

    size: the (H, W) it must have. Raises InputError as ``read_image``, on another size, and on colour images.
    """
    image = _open_image(path, budget)
    _require_size(path, image, size)
    if image.mode not in ("1", "L", "P") and not image.mode.startswith("I"):
        raise InputError(f"{path}: labels are stored as colours ({image.mode}): write one channel, 0 outside, 1, 2 …")
    return np.asarray(image, dtype=np.int64)


def _require_size(path: Path, image: Image.Image, size: tuple[int, int]) -> None:
    if (image.height, image.width) != size:
        raise InputError(
            f"{path}: has {image.width}x{image.height} pixels, its image {size[1]}x{size[0]}: make them the same size"
        )


def _open_image(path: Path, budget: PixelBudget) -> Image.Image:
    try:
        with open_file(path, MAX_PICTURE_BYTES, what="picture") as file, Image.open(file, formats=FORMATS) as image:
            budget.take(image.width, image.height, path)
            image.load()
            return image
    except FileNotFoundError:
        raise InputError(f"{path}: no such image") from None
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory; give smaller images") from None
    except _DECODER_ERRORS as error:
        raise InputError(f"{path}: not a readable image ({str(error)[:120]}): write it again as PNG") from None


MIN_TOLERANCE, MAX_TOLERANCE = 0.03, 0.12
"""Range of the colour tolerance of a channel: compression alone reaches the first; above the second a background is not
plain."""
PLAIN_SHARE = 0.6
"""Fraction of border pixels that must show a plain background; the object may cover the others."""
SPECK_SHARE = 5e-4
"""Fraction of the image below which an isolated region is noise."""


def plain_background_mask(pixels: Picture) -> Picture | None:
    """Return (H, W) 1 where ``pixels`` (H, W, 3) show an object, 0 where background; None where it is not plain.

    The background has the border's colour and is connected to the border. So an opening through which it shows counts
    as object, and an opaque object with areas of the background's colour stays whole.
    """
    border = np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])
    colour = np.median(border, axis=0)
    off = np.abs(border - colour).max(axis=1)
    close = off[off <= MAX_TOLERANCE]
    if len(close) < PLAIN_SHARE * len(border):
        return None
    tolerance = float(np.clip(2 * np.quantile(close, 0.95), MIN_TOLERANCE, MAX_TOLERANCE))
    alike = np.abs(pixels - colour).max(axis=2) <= tolerance
    regions, _ = ndimage.label(alike)
    at_border = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
    inside = _without_specks(~np.isin(regions, at_border[at_border > 0]))
    return inside.astype(np.float32) if inside.any() else None


def _without_specks(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    regions, count = ndimage.label(inside)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    large = sizes >= SPECK_SHARE * inside.size
    large[0] = False
    return np.asarray(large[regions])


KNOWN_FOLDERS = ("background", "foreground")
"""Folder names under ``masks`` whose order is known."""
MAX_LABEL = 16
MAX_STRAY = 0.2
"""Fraction of labelled pixels that may lie outside the mask: the outlines of two programs differ along their edge."""


def mask_folders(folder: Path, given: Sequence[str]) -> tuple[str, ...]:
    """Return the folder names under ``folder/masks``, the background object first; () where there are none.

    given: that order; may be empty where it is unambiguous. Raises InputError where it is not, or names other folders.
    """
    masks = folder / "masks"
    found = sorted(entry.name for entry in masks.iterdir() if entry.is_dir()) if masks.is_dir() else []
    if given:
        if missing := [name for name in given if name not in found]:
            raise InputError(
                f"{masks}: has no folder {missing[0]!r} with an object's masks (found: {', '.join(found) or 'none'})"
            )
        return tuple(given)
    if not found or found == list(KNOWN_FOLDERS):
        return tuple(found)
    if len(found) == 1:
        return tuple(found)
    raise InputError(
        f"{masks}: has the objects {', '.join(found)[:120]}: give their order, the occluded one first, for example "
        f"objects={found[0]},{found[1]}"
    )


def read_labels(
    folder: Path, name: str, objects: Sequence[str], size: tuple[int, int], budget: PixelBudget
) -> Labels | None:
    """Return (H, W) int8 the object of each pixel of the view ``name``, or None where there are no labels or masks.

    ``labels/NAME.png`` has priority. Where masks overlap, the later object wins: it occludes the other. Raises
    InputError on a missing mask, another size or labels out of range.
    """
    path = folder / "labels" / f"{name}.png"
    if path.exists():
        return _labels_from_image(read_label_image(inside(folder, f"labels/{name}.png"), size, budget), path)
    files = [f"masks/{entry}/{name}.png" for entry in objects]
    if not any((folder / file).exists() for file in files):
        return None
    labels = np.full(size, OUTSIDE, dtype=np.int8)
    for label, file in enumerate(files, start=1):
        if not (folder / file).exists():
            raise InputError(
                f"{folder / file}: no such mask, but another object has one: add it, black where the object is unseen"
            )
        labels[read_coverage(inside(folder, file), size, budget) > 0.5] = label
    return labels


def _labels_from_image(numbers: NDArray[np.int64], path: Path) -> Labels:
    if numbers.min() < 0 or numbers.max() > MAX_LABEL:
        values = ", ".join(str(v) for v in np.unique(numbers)[:6])
        raise InputError(
            f"{path}: holds {values}: use 0 outside, 1 on the background object, 2 on the foreground object (up to "
            f"{MAX_LABEL})"
        )
    return np.where(numbers == 0, OUTSIDE, numbers).astype(np.int8)


def check_labels_in_mask(name: str, mask: Picture, labels: Labels) -> None:
    """Raise InputError when too many pixels of ``labels`` (H, W) lie outside ``mask`` (H, W)."""
    owned = labels > 0
    stray = int((owned & (mask < 0.5)).sum())
    if stray > MAX_STRAY * max(1, int(owned.sum())):
        raise InputError(
            f"view {name!r}: {stray} of {int(owned.sum())} labelled pixels lie outside its mask: the two are not of "
            "the same image, or one of them is wrong"
        )
