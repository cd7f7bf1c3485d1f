# SPDX-License-Identifier: MIT
"""Whether what an adapter gave is what its stage needs; the messages name the adapter and say what to change."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.meshes import MESH_SUFFIXES, read_mesh
from .protocols import MEANINGS, Depth, Mask, Pixels

LEAST_DEPTH = 0.05
"""Share of the picture that must have a depth."""


def checked_masks(value: Any, shape: tuple[int, int], count: int, where: str) -> NDArray[np.bool_]:
    """Masks (N, H, W) bool from a stack or a list of them; numbers must be 0 and 1, or 0 and 255. InputError."""
    array = _array(value, where)
    if array.ndim == 4 and array.shape[1] == 1:
        array = array[:, 0]
    if array.shape != (count, *shape):
        raise InputError(
            f"{where}: gave an array of {array.shape}, expected one mask of the photo's size for each of the boxes, "
            f"{(count, *shape)}"
        )
    if array.dtype != bool and not np.isin(array, (0, 1, 255)).all():
        raise InputError(f"{where}: gave masks of {array.dtype} that are not 0 and 1; make them booleans")
    masks = np.array(array != 0)
    for index, mask in enumerate(masks):
        if not mask.any():
            raise InputError(f"{where}: mask {index + 1} of {count} is empty; give a better box")
    return masks


def checked_pixels(value: Any, pixels: Pixels, hole: Mask, where: str) -> Pixels:
    """``value`` as (H, W, 3) uint8 inside ``hole`` and ``pixels`` outside it. Raises InputError."""
    array = _array(value, where)
    if array.shape != pixels.shape or array.dtype != np.uint8:
        raise InputError(
            f"{where}: gave an array of {array.shape} {array.dtype}, expected {pixels.shape} uint8, the picture itself "
            "with its hole filled"
        )
    result = pixels.copy()
    result[hole] = array[hole]
    return result


def checked_depth(value: Any, shape: tuple[int, int], meaning: str, where: str) -> Depth:
    """A depth of ``shape`` from a Depth, an array, or a dict with ``depth`` and perhaps ``focal_px`` and ``meaning``.

    meaning: where ``value`` does not say. What is not finite, or not above 0, has no depth: it becomes NaN, except that
    an inverse depth of 0 or less is far away. Raises InputError where less than 5 % of the picture is left.
    """
    focal: Any = None
    if isinstance(value, Depth):
        value, meaning, focal = value.values, value.meaning, value.focal_px
    elif isinstance(value, dict):
        if "depth" not in value:
            raise InputError(f"{where}: gave a dict without depth; its keys are {', '.join(map(str, value))[:100]}")
        focal, meaning = value.get("focal_px"), value.get("meaning", meaning)
        value = value["depth"]
    array = np.squeeze(_array(value, where))
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise InputError(f"{where}: gave an array of {array.shape} {array.dtype}, expected a depth of {shape}")
    if meaning not in MEANINGS:
        raise InputError(f"{where}: meaning is {meaning!r}, expected one of {', '.join(MEANINGS)}")
    values = np.array(array, dtype=np.float32)
    values[~np.isfinite(values)] = np.nan
    if meaning != "inverse":
        values[~(values > 0)] = np.nan
    known = float(np.isfinite(values).mean())
    if known < LEAST_DEPTH:
        raise InputError(f"{where}: gave a depth that is finite and above 0 in {known:.1%} of the picture only")
    if float(np.nanmax(values)) == float(np.nanmin(values)):
        raise InputError(f"{where}: gave the same depth everywhere, {float(np.nanmax(values)):g}")
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
    """The path of a mesh inside ``folder`` that can be read. Raises InputError."""
    if not isinstance(value, str | Path):
        raise InputError(f"{where}: gave {type(value).__name__}, expected the path of the mesh that it wrote")
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
    except Exception as error:  # Whatever its __array__ raises: a tensor on a GPU, lists of unequal lengths.
        raise InputError(f"{where}: gave {type(value).__name__}, no array ({type(error).__name__}: {error})") from error
    if array.dtype.kind not in "biuf":
        raise InputError(f"{where}: gave {type(value).__name__}, expected an array of numbers")
    return array
