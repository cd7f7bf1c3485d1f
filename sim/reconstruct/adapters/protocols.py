# SPDX-License-Identifier: MIT
"""The protocol of a user's own model for each stage, and checks of what it returns.

Pictures are (H, W, 3) uint8 sRGB, masks (H, W) bool; the centre of the top left pixel is (0.5, 0.5). Functions must
not modify their arguments, and must be deterministic if the reconstruction is to be repeatable. Error messages of the
checks name the adapter and the remedy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.meshes import MESH_SUFFIXES, read_mesh

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

STAGES = ("segmenter", "inpainter", "depth_estimator", "mesher")
"""Named like the options of the reconstruction."""
MEANINGS = ("metric", "relative", "inverse")


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth along the camera's axis.

    values: (H, W) float; NaN or infinite where undefined, as in the sky.
    meaning: ``metric`` metres; ``relative`` depth of unknown scale; ``inverse`` one over depth, of unknown scale and
        shift, as by Depth Anything and MiDaS.
    focal_px: focal length in pixels of the picture, or None.
    """

    values: NDArray[np.float32]
    meaning: str = "relative"
    focal_px: float | None = None


class Segmenter(Protocol):
    """Masks of the objects in boxes."""

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return masks (N, H, W) bool of the objects in ``boxes`` (N, 4): x0, y0, x1, y1 in pixels, x1 and y1
        exclusive."""


@runtime_checkable
class SoftSegmenter(Protocol):
    """Opacity of what stands out in a box, which the colours around it then refine (``alpha_masks``)."""

    def alpha(self, pixels: Pixels, box: tuple[int, int, int, int]) -> NDArray[np.float32]:
        """Return the opacity (H, W), 0 to 1, of the object in ``box`` (x0, y0, x1, y1 in whole pixels, x1 and y1
        exclusive); 0 outside it."""


class Inpainter(Protocol):
    """Inpainting of a hole."""

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """Return ``pixels`` (H, W, 3) with ``hole`` (H, W) inpainted and unchanged outside it."""


class DepthEstimator(Protocol):
    """Depth of a photo."""

    def __call__(self, pixels: Pixels) -> Depth:
        """Return the depth of each pixel."""


class Mesher(Protocol):
    """A mesh of one object of the photo."""

    def __call__(self, pixels: Pixels, mask: Mask, folder: Path) -> Path:
        """Write a mesh (.glb, .gltf, .obj, .ply, .stl) of the object in ``mask`` into ``folder`` and return its path.

        Its scale and axes are free; ``object_crop`` makes the input of most models.
        """


LEAST_DEPTH = 0.05
"""Smallest share of the picture with a valid depth."""


def checked_masks(value: Any, shape: tuple[int, int], count: int, where: str) -> NDArray[np.bool_]:
    """Return masks (N, H, W) bool from a stack or a list; numbers must be 0 and 1, or 0 and 255. Raises InputError."""
    array = _array(value, where)
    if array.ndim == 4 and array.shape[1] == 1:
        array = array[:, 0]
    if array.shape != (count, *shape):
        raise InputError(
            f"{where}: returned an array of {array.shape}, expected one mask of the photo's size per box, "
            f"{(count, *shape)}"
        )
    if array.dtype != bool and not np.isin(array, (0, 1, 255)).all():
        raise InputError(f"{where}: returned masks of {array.dtype} that are not 0 and 1; make them booleans")
    masks = np.array(array != 0)
    for index, mask in enumerate(masks):
        if not mask.any():
            raise InputError(f"{where}: mask {index + 1} of {count} is empty; give a better box")
    return masks


def checked_pixels(value: Any, pixels: Pixels, hole: Mask, where: str) -> Pixels:
    """Return ``value`` (H, W, 3) uint8 inside ``hole`` and ``pixels`` outside it. Raises InputError."""
    array = _array(value, where)
    if array.shape != pixels.shape or array.dtype != np.uint8:
        raise InputError(
            f"{where}: returned an array of {array.shape} {array.dtype}, expected {pixels.shape} uint8, the picture "
            "with its hole filled"
        )
    result = pixels.copy()
    result[hole] = array[hole]
    return result


def checked_depth(value: Any, shape: tuple[int, int], meaning: str, where: str) -> Depth:
    """Return a depth of ``shape`` from a Depth, an array, or a dict with ``depth`` and optionally ``focal_px`` and
    ``meaning``.

    meaning: used where ``value`` has none. Values that are not finite, or not above 0, become NaN, except that an
    inverse depth of 0 or less is infinitely far. Raises InputError where less than 5 % of the picture is left.
    """
    focal: Any = None
    if isinstance(value, Depth):
        value, meaning, focal = value.values, value.meaning, value.focal_px
    elif isinstance(value, dict):
        if "depth" not in value:
            raise InputError(f"{where}: returned a dict without depth; its keys are {', '.join(map(str, value))[:100]}")
        focal, meaning = value.get("focal_px"), value.get("meaning", meaning)
        value = value["depth"]
    array = np.squeeze(_array(value, where))
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise InputError(f"{where}: returned an array of {array.shape} {array.dtype}, expected a depth of {shape}")
    if meaning not in MEANINGS:
        raise InputError(f"{where}: meaning is {meaning!r}, expected one of {', '.join(MEANINGS)}")
    values = np.array(array, dtype=np.float32)
    values[~np.isfinite(values)] = np.nan
    if meaning != "inverse":
        values[~(values > 0)] = np.nan
    known = float(np.isfinite(values).mean())
    if known < LEAST_DEPTH:
        raise InputError(f"{where}: returned a depth that is finite and above 0 in {known:.1%} of the picture only")
    if float(np.nanmax(values)) == float(np.nanmin(values)):
        raise InputError(f"{where}: returned the same depth everywhere, {float(np.nanmax(values)):g}")
    return Depth(values, meaning, _focal(focal, shape, where))


def _focal(value: Any, shape: tuple[int, int], where: str) -> float | None:
    if value is None:
        return None
    try:
        focal = float(np.asarray(value).reshape(()))
    except (TypeError, ValueError):
        focal = math.nan
    if not 0.05 * max(shape) <= focal <= 100 * max(shape):
        raise InputError(f"{where}: focal_px is {str(value)[:60]}, expected the focal length in pixels of the picture")
    return focal


def checked_mesh(value: Any, folder: Path, where: str) -> Path:
    """Return the path of a readable mesh inside ``folder``. Raises InputError."""
    if not isinstance(value, str | Path):
        raise InputError(f"{where}: returned {type(value).__name__}, expected the path of the mesh that it wrote")
    path = folder / value
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{where}: wrote {path}, outside of the folder that it was given, {folder}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{where}: wrote {path.name}; mesh files are {', '.join(MESH_SUFFIXES)}")
    try:
        read_mesh(path)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return path


def _array(value: Any, where: str) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except Exception as error:  # __array__ may raise anything: a tensor on a GPU, lists of unequal lengths.
        raise InputError(
            f"{where}: returned {type(value).__name__}, no array ({type(error).__name__}: {error})"
        ) from error
    if array.dtype.kind not in "biuf":
        raise InputError(f"{where}: returned {type(value).__name__}, expected an array of numbers")
    return array
