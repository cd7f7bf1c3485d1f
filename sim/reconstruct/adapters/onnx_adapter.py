# SPDX-License-Identifier: MIT
"""Models in ONNX files, through onnxruntime on the CPU: segmentation by IS-Net, inpainting by LaMa, or similar ones.

IS-Net (Qin et al., ECCV 2022): a picture 1x3x1024x1024, (value - 128) / 256 of sRGB, becomes opacities 1x1x1024x1024
from 0 to 1, of what stands out in it; the first output counts. The picture is the box with a margin, since the network
expects objects with some room.

LaMa (Suvorov et al., WACV 2022): a picture 1x3xHxW from 0 to 1 and a mask 1x1xHxW, 1 in the hole; or both as 1x4xHxW,
the picture black in the hole; H and W fixed (512) or free. It returns 1x3xHxW from 0 to 1, or to 255. The variant is
detected from the file or from its output.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..models.model_folder import check_installed
from .protocols import Mask, Pixels, checked_pixels

MAX_MODEL_BYTES = 8 * 2**30


def open_session(path: Path, where: str) -> Any:
    """Return an ``onnxruntime.InferenceSession`` of the file ``path``. Raises InputError that names ``where``."""
    if not path.is_file():
        raise InputError(f"{where}: there is no such file; bring your own model, nothing is downloaded")
    if path.stat().st_size > MAX_MODEL_BYTES:
        raise InputError(f"{where}: {path.stat().st_size >> 30} GiB is larger than any supported model")
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(f"{where}: needs onnxruntime ({error}); install physgen[models]") from None
    # Its builds for Windows report to their maker otherwise.
    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    # onnxruntime's exceptions have no common base class.
    except Exception as error:
        raise InputError(f"{where}: is not a model that onnxruntime can read ({str(error)[:300]})") from error


SIDE = 1024
MARGIN = 0.3
"""Of the box's longer side, added all around: closely cropped, it missed a foot and a book's white spine."""

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class IsnetSegmenter:
    """``protocols.SoftSegmenter`` and, by its opacities alone, ``protocols.Segmenter``."""

    session: Any
    where: str

    def alpha(self, pixels: Pixels, box: Box) -> NDArray[np.float32]:
        """As the protocol says. Raises InputError where the model fails or answers nonsense."""
        height, width = pixels.shape[:2]
        x0, y0, x1, y1 = box
        margin = round(MARGIN * max(x1 - x0, y1 - y0))
        left, top = max(0, x0 - margin), max(0, y0 - margin)
        right, bottom = min(width, x1 + margin), min(height, y1 + margin)
        answer = self._answer(np.ascontiguousarray(pixels[top:bottom, left:right]))
        result = np.zeros((height, width), dtype=np.float32)
        result[y0:y1, x0:x1] = answer[y0 - top : y1 - top, x0 - left : x1 - left]
        return result

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As the protocol says, without the colours' refinement. Raises InputError."""
        masks = []
        for index, (x0, y0, x1, y1) in enumerate(np.asarray(boxes).round().astype(int).tolist()):
            mask = self.alpha(pixels, (x0, y0, x1, y1)) > 0.5
            if not mask.any():
                raise InputError(f"{self.where}: found nothing in box {index + 1}; draw it closer, or paint a mask")
            masks.append(mask)
        return np.stack(masks)

    def _answer(self, crop: Pixels) -> NDArray[np.float32]:
        """The network's opacities (h, w) of ``crop`` (h, w, 3)."""
        height, width = crop.shape[:2]
        way = cv2.INTER_AREA if max(height, width) > SIDE else cv2.INTER_LINEAR
        square = cv2.resize(crop, (SIDE, SIDE), interpolation=way).astype(np.float32)
        planes = np.ascontiguousarray(((square - 128.0) / 256.0).transpose(2, 0, 1)[None])
        try:
            found = np.asarray(self.session.run(None, {self.session.get_inputs()[0].name: planes})[0], dtype=np.float32)
        # onnxruntime raises its own exceptions, depending on the operator.
        except Exception as error:
            raise InputError(f"{self.where}: the model failed ({type(error).__name__}: {str(error)[:300]})") from error
        if found.shape != (1, 1, SIDE, SIDE):
            raise InputError(f"{self.where}: returned {found.shape}, expected opacities of (1, 1, {SIDE}, {SIDE})")
        if not np.isfinite(found).all() or found.min() < -0.01 or found.max() > 1.01:
            raise InputError(f"{self.where}: returned numbers that are no opacities from 0 to 1; install it again")
        way = cv2.INTER_AREA if max(height, width) < SIDE else cv2.INTER_LINEAR
        alpha = cv2.resize(np.clip(found[0, 0], 0.0, 1.0), (width, height), interpolation=way)
        return np.asarray(alpha, dtype=np.float32)


def load_isnet(path: Path, where: str) -> IsnetSegmenter:
    """Return the model in ``path``, checked to be of IS-Net's form, an installed one by its hash. Raises InputError."""
    check_installed(path, where)
    session = open_session(path, where)
    given = [(item.shape, item.type) for item in session.get_inputs()]
    if len(given) != 1 or given[0][1] != "tensor(float)" or not _fits(given[0][0]):
        found = ", ".join(f"{item.name} {item.shape} {item.type}" for item in session.get_inputs())
        raise InputError(f"{where}: takes {found[:300]}; expected a picture 1x3x{SIDE}x{SIDE} of floats")
    return IsnetSegmenter(session, where)


def _fits(shape: list[Any]) -> bool:
    # A size that the export left free is a text or None.
    wanted = (1, 3, SIDE, SIDE)
    return len(shape) == 4 and all(not isinstance(n, int) or n == w for n, w in zip(shape, wanted, strict=True))


CONTEXT = 2.0
"""Side of the model's crop over that of the hole."""
LEAST_SIDE, MOST_SIDE, STEP = 256, 1024, 32
"""Sides of the crop for a model of free size, in pixels: multiples that can be halved five times."""
BLEND_PX = 6.0
"""Distance from the hole's border, in the model's pixels, over which the result is corrected towards the surrounding
colours."""
_TYPES: dict[str, type[np.floating[Any]]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}

Array = NDArray[np.float32]


def filled_hole_by_hole(pixels: Pixels, hole: Mask, least: int, fill: Callable[[Pixels, Mask], Pixels]) -> Pixels:
    """Return ``pixels`` (H, W, 3) with each connected part of ``hole`` (H, W) filled in a square crop around it.

    least: side of the smallest crop, in pixels. fill: fills the hole of a crop; later parts see earlier ones filled.
    """
    result, left = pixels.copy(), hole.copy()
    count, labels = cv2.connectedComponents(cv2.dilate(hole.astype(np.uint8), np.ones((5, 5), np.uint8)))
    for label in range(1, count):
        part = hole & (labels == label)
        window = square_around(part, least)
        filled = fill(result[window], left[window])
        result[window][part[window]] = filled[part[window]]
        left &= ~part
    return result


def without_content(pixels: Pixels, hole: Mask) -> Pixels:
    """Return ``pixels`` with the nearest colours outside in ``hole``, whose content resizing would smear."""
    # Imported late: every command that chooses models imports this file.
    from scipy import ndimage

    if hole.all():
        return pixels
    near = ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True)
    return np.asarray(pixels[near[0], near[1]])


@dataclass(frozen=True, eq=False)
class LamaInpainter:
    """``protocols.Inpainter`` by an ONNX model. size: height and width of its input, or None for any.

    inputs: names of picture and mask, or of both in one; kind: number type.
    """

    session: Any
    inputs: tuple[str, ...]
    size: tuple[int, int] | None
    kind: type[np.floating[Any]]
    where: str

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """As the protocol says: hole by hole, each in a square crop around it. Raises InputError."""
        least = LEAST_SIDE if self.size is None else min(self.size)
        return checked_pixels(filled_hole_by_hole(pixels, hole, least, self._fill), pixels, hole, self.where)

    def _fill(self, pixels: Pixels, hole: Mask) -> Pixels:
        """``pixels`` (h, w, 3) with ``hole`` inpainted at the model's own size."""
        height, width = hole.shape
        size = self.size or _free_size(height, width)
        pixels = without_content(pixels, hole)
        way = cv2.INTER_AREA if size[0] < height else cv2.INTER_CUBIC
        picture = np.asarray(cv2.resize(pixels, size[::-1], interpolation=way), dtype=np.float32) / np.float32(255)
        # Every pixel of the model that overlaps the hole.
        share = cv2.resize(hole.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA)
        nearest = cv2.resize(hole.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST)
        mask = (share > 0) | (nearest > 0)
        filled = blended(picture, self._answer(picture, mask), mask)
        large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_CUBIC)
        return np.asarray(np.clip(large * 255 + 0.5, 0, 255), dtype=np.uint8)

    def _answer(self, picture: Array, mask: Mask) -> Array:
        """The model's output (h, w, 3), from 0 to 1, for ``picture`` (h, w, 3) and ``mask`` (h, w)."""
        planes = np.transpose(picture, (2, 0, 1))[None].astype(self.kind)
        holes = mask[None, None].astype(self.kind)
        if len(self.inputs) == 1:
            feed = {self.inputs[0]: np.concatenate([planes * (1 - holes), holes], axis=1)}
        else:
            feed = {self.inputs[0]: planes, self.inputs[1]: holes}
        try:
            answer = np.asarray(self.session.run(None, feed)[0], dtype=np.float32)
        # onnxruntime raises its own exceptions, depending on the operator.
        except Exception as error:
            raise InputError(f"{self.where}: the model failed ({type(error).__name__}: {str(error)[:300]})") from error
        if answer.shape != planes.shape:
            raise InputError(f"{self.where}: returned {answer.shape}, expected a picture of {planes.shape}")
        if not np.isfinite(answer).all():
            raise InputError(f"{self.where}: returned numbers that are not finite; try the model's 32 bit version")
        values = np.transpose(answer[0], (1, 2, 0))
        return np.clip(values * _unit(values, picture, mask), 0, 1)


def _unit(values: Array, picture: Array, mask: Mask) -> float:
    """Factor that scales the model's ``values`` to 0 to 1: 1 or 1/255, whichever reproduces the picture outside the
    hole."""
    known = ~mask if not mask.all() else np.ones_like(mask)
    errors = {unit: float(np.abs(values[known] * unit - picture[known]).mean()) for unit in (1.0, 1 / 255)}
    if float(values.max()) > 2.0:
        return 1 / 255
    return min(errors, key=lambda unit: errors[unit]) if not mask.all() else 1.0


def _free_size(height: int, width: int) -> tuple[int, int]:
    scale = min(1.0, MOST_SIDE / max(height, width))
    return (
        max(STEP, math.ceil(height * scale / STEP) * STEP),
        max(STEP, math.ceil(width * scale / STEP) * STEP),
    )


def square_around(part: Mask, least: int) -> tuple[slice, slice]:
    """Return rows and columns of a square around ``part`` (H, W), ``CONTEXT`` times its size, shifted into the picture.

    least: smallest side in pixels; the square is cut where the picture is smaller.
    """
    places = []
    extents = [np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))]
    side = max(least, math.ceil(CONTEXT * max(int(e[-1]) + 1 - int(e[0]) for e in extents)))
    for extent, length in zip(extents, part.shape, strict=True):
        middle = (int(extent[0]) + int(extent[-1]) + 1) // 2
        start = min(max(0, middle - side // 2), max(0, length - side))
        places.append(slice(start, min(length, start + side)))
    return places[0], places[1]


def blended(picture: Array, filled: Array, mask: Mask) -> Array:
    """Return ``filled`` in ``mask`` and ``picture`` outside, (h, w, 3) and (h, w), without a visible edge between them.

    The model's error just outside the hole is extrapolated into it and fades there.
    """
    outside = (~mask).astype(np.float32)
    missed = (picture - filled) * outside[..., None]
    sigma = BLEND_PX / 2
    weight = cv2.GaussianBlur(outside, (0, 0), sigma)
    spread = cv2.GaussianBlur(missed, (0, 0), sigma) / np.maximum(weight, 1e-4)[..., None]
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    moved = filled + spread * np.exp(-np.maximum(depth - 1, 0) / BLEND_PX)[..., None]
    return np.asarray(np.where(mask[..., None], np.clip(moved, 0, 1), picture), dtype=np.float32)


def load_lama(path: Path, where: str) -> LamaInpainter:
    """Return the model in ``path``, checked to be an inpainting model. Raises InputError."""
    return _checked_session(open_session(path, where), where)


def _checked_session(session: Any, where: str) -> LamaInpainter:
    given = {item.name: item for item in session.get_inputs()}
    found = ", ".join(f"{name} {item.shape} {item.type}" for name, item in given.items())
    problem = InputError(
        f"{where}: takes {found[:300]}; expected a picture 1x3xHxW and a mask 1x1xHxW of floats, or both as 1x4xHxW"
    )
    by_channels: dict[int, str] = {}
    for name, item in given.items():
        channels = item.shape[1] if len(item.shape) == 4 else None
        if not isinstance(channels, int):
            # Left free by the export: decided by name.
            channels = 1 if "mask" in name.lower() else 3
        by_channels[channels] = name
    if len(given) == 1 and 4 in by_channels:
        inputs: tuple[str, ...] = (by_channels[4],)
    elif len(given) == 2 and {1, 3} == set(by_channels):
        inputs = (by_channels[3], by_channels[1])
    else:
        raise problem
    first = given[inputs[0]]
    kinds = {given[name].type for name in inputs}
    if len(kinds) != 1 or first.type not in _TYPES or len(first.shape) != 4:
        raise problem
    sides = [side if isinstance(side, int) and side > 0 else None for side in first.shape[2:]]
    if (None in sides and sides != [None, None]) or any(side is not None and not 32 <= side <= 4096 for side in sides):
        raise problem
    size = None if sides[0] is None or sides[1] is None else (sides[0], sides[1])
    return LamaInpainter(session, inputs, size, _TYPES[first.type], where)
