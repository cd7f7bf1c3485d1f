# SPDX-License-Identifier: MIT
"""Read a depth map that another program made of the photo: MoGe, Depth Anything, DUSt3R and their like.

| file | what it may hold |
| --- | --- |
| .npy | (H, W) numbers; or (H, W, 3) points in the camera's axes (x right, y down, z forward) |
| .npz | ``depth`` or ``disparity`` (H, W), or ``points`` (H, W, 3); ``mask``, ``intrinsics`` |
| .exr, .pfm | one channel of numbers, or three of points |
| .png | 16 bits: millimetres; or disparity, stretched over all 16 bits |

A mask (H, W) tells where to look. Intrinsics (3, 3) are in pixels or, as MoGe's, of a picture of size 1.

Numbers are depth along the optical axis, or disparity, which is larger for what is nearer and may be shifted and
scaled. Which of them is told by the array's or the file's name (disparity, disp, inverse), else by the picture: below
the middle of a photo of things on a ground, what is lower is nearer. Lengths are metres in a PNG of millimetres, and
where the array's or the file's name has ``metric`` in it; else their scale is open.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .depth_files import SUFFIXES, Arrays, read_arrays

SAME_SHAPE = 0.02
"""Depth maps are of the photo's proportions, up to this; networks round to multiples of 14."""
LEAST_KNOWN = 0.02
"""Share of pixels that must hold a number."""
STRETCHED = 0.98
"""A PNG that reaches from 0 to this share of 65535 was stretched over it, and holds no millimetres."""
NORMALIZED_FOCAL = 20.0
"""Focal lengths below this are of a picture of size 1, not of pixels."""


@dataclass(frozen=True)
class DepthMap:
    """A depth map of the photo's size.

    values: (H, W) float32; depth along the optical axis where ``disparity`` is False, else disparity; NaN where
    unknown.
    metric: whether they are metres. focal: focal length in the photo's pixels that goes with them, or None.
    """

    values: NDArray[np.float32]
    disparity: bool
    metric: bool
    focal: float | None

    @property
    def nearness(self) -> NDArray[np.float32]:
        """(H, W), larger for what is nearer; NaN where unknown."""
        if self.disparity:
            return self.values
        return np.asarray(1.0 / self.values, dtype=np.float32)


def read_depth(path: Path, width: int, height: int) -> DepthMap:
    """The depth map in the file ``path``, for a photo of ``width`` by ``height`` pixels.

    Raises InputError for a file that is missing, damaged, too large, of other proportions, or without depth.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"depth {path}: depth maps are read from {', '.join(SUFFIXES)}, not {path.suffix or 'without suffix'!r}; "
            "8-bit pictures of a depth map have lost the depth"
        )
    if not path.is_file():
        raise InputError(f"depth {path}: there is no such file; check its name")
    try:
        arrays = read_arrays(path)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"depth {path}: does not fit in memory; give a smaller one") from None
    # Readers of damaged files fail in whatever way the garbage leads them to (TokenError, BadZipFile, struct.error, …).
    except Exception as error:
        raise InputError(
            f"depth {path}: cannot be read ({type(error).__name__}: {error}); it may be damaged, write it again"
        ) from error
    return _for_photo(path, arrays, width, height)


def _for_photo(path: Path, arrays: Arrays, width: int, height: int) -> DepthMap:
    rows, columns = arrays.values.shape[:2]
    if min(rows, columns) < 8 or abs(np.log(columns / rows) - np.log(width / height)) > SAME_SHAPE:
        raise InputError(
            f"depth {path}: is {columns}x{rows} pixels, the upright photo {width}x{height}; give one of the same "
            "proportions"
        )
    values = arrays.values.astype(np.float32)
    known = np.isfinite(values).all(axis=-1) if values.ndim == 3 else np.isfinite(values)
    if arrays.mask is not None:
        if arrays.mask.shape != known.shape:
            raise InputError(f"depth {path}: its mask is of shape {arrays.mask.shape}, the map {known.shape}")
        known &= arrays.mask
    focal = _focal(path, arrays.intrinsics, width, columns)
    if values.ndim == 3:
        known &= values[..., 2] > 0
        focal = focal or _focal_of_points(values, known, width)
        values = values[..., 2]
    low, high = (float(v) for v in np.percentile(values[known], [1, 99])) if known.any() else (0.0, 0.0)
    if known.mean() < LEAST_KNOWN or not high > low:
        raise InputError(f"depth {path}: holds no depth (the same number everywhere, or none); write it again")
    disparity = arrays.disparity
    stretched = arrays.sixteen_bits and low < 65535 * (1 - STRETCHED) and high > 65535 * (STRETCHED - 0.05)
    if disparity is None:
        disparity = arrays.values.ndim == 2 and _grows_downward(values, known)
    if not disparity:
        known &= values > 0
    if arrays.sixteen_bits and not disparity:
        values = values / np.float32(1000.0)
    values = np.where(known, values, np.float32(np.nan))
    return DepthMap(
        values=_resized(values, width, height),
        disparity=disparity,
        metric=not disparity and (arrays.metric or (arrays.sixteen_bits and not stretched)),
        focal=focal,
    )


def _grows_downward(values: NDArray[np.float32], known: NDArray[np.bool_]) -> bool:
    """Whether values grow from the middle of the picture downward: then they are of nearness."""
    half = values.shape[0] // 2
    lower = np.where(known[half:], values[half:], np.nan)
    rows = np.flatnonzero(np.isfinite(lower).any(axis=1))
    if len(rows) < 4:
        return False
    medians = np.nanmedian(lower[rows], axis=1)
    return bool(np.corrcoef(np.argsort(np.argsort(medians)), rows)[0, 1] > 0)


def _focal(path: Path, intrinsics: NDArray[Any] | None, width: int, columns: int) -> float | None:
    if intrinsics is None:
        return None
    if intrinsics.shape[-2:] != (3, 3) or not np.isfinite(intrinsics).all():
        raise InputError(f"depth {path}: its intrinsics are of shape {intrinsics.shape}; they are a finite 3x3 matrix")
    value = float(intrinsics.reshape(-1, 3, 3)[0, 0, 0])
    value *= width if value < NORMALIZED_FOCAL else width / columns
    if not 0.1 * width < value < 100.0 * width:
        raise InputError(f"depth {path}: its intrinsics have a focal length of {value:.3g} pixels; check them")
    return value


def _focal_of_points(points: NDArray[np.float32], known: NDArray[np.bool_], width: int) -> float | None:
    """Focal length at which ``points`` (H, W, 3) are seen in their pixels; None when they are of other axes."""
    rows, columns = np.nonzero(known)
    step = max(1, len(rows) // 20_000)
    rows, columns = rows[::step], columns[::step]
    if len(rows) < 16:
        return None
    height, size = known.shape
    seen = np.concatenate([columns + 0.5 - size / 2.0, rows + 0.5 - height / 2.0])
    place = points[rows, columns].astype(np.float64)
    slope = np.concatenate([place[:, 0], place[:, 1]]) / np.tile(place[:, 2], 2)
    if not np.isfinite(slope).all() or not float(slope @ slope) > 0:
        return None
    focal = float(slope @ seen / (slope @ slope))
    off = float(np.median(np.abs(focal * slope - seen)))
    return focal * width / size if focal > 0.1 * size and off < 0.02 * size else None


def _resized(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """``values`` at the photo's size: between neighbours where all are known, NaN spreading no further than a pixel."""
    if values.shape == (height, width):
        return values
    known = np.isfinite(values)
    filled = np.where(known, values, np.float32(0.0))
    if width > values.shape[1]:
        share = cv2.resize(known.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        mixed = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    else:
        share = cv2.resize(known.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        mixed = cv2.resize(filled, (width, height), interpolation=cv2.INTER_AREA)
    return np.where(share > 0.5, mixed / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)
