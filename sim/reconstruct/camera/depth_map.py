# SPDX-License-Identifier: MIT
"""Read a depth map that another program made of the photo: MoGe, Depth Anything, DUSt3R and similar.

| file | contents |
| --- | --- |
| .npy | (H, W) numbers; or (H, W, 3) points in the camera's axes (x right, y down, z forward) |
| .npz | ``depth`` or ``disparity`` (H, W), or ``points`` (H, W, 3); ``mask``, ``intrinsics`` |
| .exr, .pfm | one channel of numbers, or three of points |
| .png | 16 bits: millimetres; or disparity, stretched over all 16 bits |

A mask (H, W) marks valid pixels. Intrinsics (3, 3) are in pixels or, as MoGe's, of a picture of size 1.

Numbers are depth along the optical axis, or disparity, which is larger for nearer points and may be shifted and
scaled. Which of them is decided by the array's or the file's name (disparity, disp, inverse), else by the picture:
below the middle of a photo of things on a ground, lower points are nearer. Lengths are metres in a PNG of millimetres,
and where the array's or the file's name contains ``metric``; else their scale is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from PIL import Image

from ...errors import InputError, openimageio_error
from ...files import open_file, require_file
from ...npz import array_body, array_header, open_npz

SUFFIXES = (".npy", ".npz", ".exr", ".png", ".pfm")
MAX_PIXELS = 64_000_000
MAX_BYTES = 8 * 4 * MAX_PIXELS
MAX_FILE_BYTES = MAX_BYTES + 2**20
DISPARITY_NAMES = ("disparity", "disp", "inverse", "inv_depth", "invdepth")
POINT_NAMES = ("points", "pts3d", "point_map", "pointmap")


@dataclass(frozen=True)
class Arrays:
    """The arrays of a file.

    values: (H, W), or (H, W, 3) points. mask: (H, W) bool or None. intrinsics: as stored, or None. disparity: None
    where names do not say. metric: whether names say metres. sixteen_bits: whether the values are a PNG's integers.
    """

    values: NDArray[Any]
    mask: NDArray[np.bool_] | None = None
    intrinsics: NDArray[Any] | None = None
    disparity: bool | None = None
    metric: bool = False
    sixteen_bits: bool = False


def read_arrays(path: Path) -> Arrays:
    """Return the arrays in ``path``. Raises InputError for an unsuitable file, and arbitrary exceptions of readers for
    damaged ones."""
    name = path.name.lower()
    disparity = True if any(word in name for word in DISPARITY_NAMES) else None
    metric = "metric" in name
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _from_npz(path, disparity, metric)
    if suffix == ".npy":
        with open_file(path, MAX_FILE_BYTES, what="depth map") as file:
            return Arrays(_picture(path, _array(path, file)), disparity=disparity, metric=metric)
    if suffix == ".png":
        return Arrays(_from_png(path), disparity=disparity, metric=metric, sixteen_bits=True)
    values = _from_pfm(path) if suffix == ".pfm" else _from_exr(path)
    return Arrays(_picture(path, values), disparity=disparity, metric=metric)


def _too_large(path: Path, shape: object) -> InputError:
    return InputError(f"depth {path}: {shape} are more than {MAX_PIXELS // 10**6} million pixels; scale it down")


def _picture(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    """``values`` as (H, W) or (H, W, 3), with leading axes of length 1 removed."""
    while values.ndim > 2 and values.shape[0] == 1:
        values = values[0]
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] != 3) or values.dtype.kind not in "fiu":
        raise InputError(
            f"depth {path}: holds {values.dtype} of shape {values.shape}; give numbers of shape (H, W), or points of "
            "shape (H, W, 3)"
        )
    return values


def _array(path: Path, file: IO[bytes]) -> NDArray[Any]:
    """One array in NumPy's format; its header is validated before allocation. Never unpickles."""
    header = array_header(file, f"depth {path}")
    if header.dtype.kind not in "fiub":
        raise InputError(f"depth {path}: holds {header.dtype}, not numbers; save the depth as float32")
    if header.size > MAX_BYTES:
        raise _too_large(path, header.shape)
    return array_body(file, header, f"depth {path}")


def _from_npz(path: Path, disparity: bool | None, metric: bool) -> Arrays:
    with open_npz(path, 4 * MAX_BYTES) as archive:
        names = {
            Path(info.filename).stem.lower(): info for info in archive.infolist() if info.filename.endswith(".npy")
        }

        def array(name: str) -> NDArray[Any]:
            if names[name].file_size > MAX_BYTES + 4096:
                raise _too_large(path, f"{names[name].file_size} bytes of {name!r}")
            with archive.open(names[name]) as file:
                return _array(path, file)

        def first(words: tuple[str, ...]) -> str | None:
            return next((name for word in words for name in names if word in name), None)

        # Arrays named depth may still be disparity, as written by Depth Anything's relative models.
        choices = ((DISPARITY_NAMES, True), (POINT_NAMES, False), (("depth",), disparity))
        chosen, disparity = next(((found, kind) for words, kind in choices if (found := first(words))), (None, None))
        if chosen is None:
            raise InputError(
                f"depth {path}: holds {', '.join(sorted(names)[:8]) or 'no array'}; name one depth, disparity or points"
            )
        mask = array("mask") if "mask" in names else None
        intrinsics = array("intrinsics") if "intrinsics" in names else None
        return Arrays(
            values=_picture(path, array(chosen)),
            mask=None if mask is None else np.asarray(np.squeeze(mask), dtype=bool),
            intrinsics=intrinsics,
            disparity=disparity,
            metric=metric or any("metric" in name for name in names),
        )


def _from_png(path: Path) -> NDArray[Any]:
    with open_file(path, MAX_FILE_BYTES, what="depth map") as file, Image.open(file, formats=("PNG",)) as image:
        if image.width * image.height > MAX_PIXELS:
            raise _too_large(path, f"{image.width}x{image.height}")
        if image.mode not in ("I;16", "I;16B", "I;16L", "I;16N", "I"):
            raise InputError(
                f"depth {path}: is an image of mode {image.mode}, not 16-bit grey; 8 bits are too coarse for depth, "
                "save it as .npy or a 16-bit PNG"
            )
        values = np.asarray(image).astype(np.float32)
    # 0 is "unknown" in PNGs of millimetres, and the farthest in those of disparity; neither is a length.
    return np.where(values > 0, values, np.float32(np.nan))


def _from_pfm(path: Path) -> NDArray[Any]:
    """Portable float map: Pf or PF, width and height, a scale whose sign is the byte order, rows from the bottom up."""
    with open_file(path, MAX_FILE_BYTES, what="depth map") as file:
        kind = file.readline(8).strip()
        words = file.readline(64).split()
        scale = float(file.readline(64))
        if kind not in (b"Pf", b"PF") or len(words) != 2:
            raise ValueError("no header of a PFM file")
        width, height, channels = int(words[0]), int(words[1]), 3 if kind == b"PF" else 1
        if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
            raise _too_large(path, f"{width}x{height}")
        data = file.read(width * height * channels * 4)
    values = np.frombuffer(data, dtype="<f4" if scale < 0 else ">f4", count=width * height * channels)
    return values.reshape(height, width, channels)[::-1]


def _from_exr(path: Path) -> NDArray[Any]:
    require_file(path, MAX_FILE_BYTES, what="depth map")
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(
            f"depth {path}: is not a readable picture ({openimageio_error(oiio.geterror)}); export it again"
        )
    try:
        spec = source.spec()
        width, height, channels = int(spec.width), int(spec.height), int(spec.nchannels)
        if width * height > MAX_PIXELS or channels > 16:
            raise _too_large(path, f"{width}x{height} with {channels} channels")
        names = [str(name).upper() for name in spec.channelnames]
        pixels = source.read_image(0, 0, 0, channels, oiio.FLOAT)
        if pixels is None:
            raise InputError(
                f"depth {path}: is cut off or damaged ({openimageio_error(source.geterror)}); export it again"
            )
    finally:
        source.close()
    values = np.asarray(pixels, dtype=np.float32).reshape(height, width, channels)
    if {"R", "G", "B"} <= set(names):
        values = values[..., [names.index(name) for name in "RGB"]]
        # Three equal channels are a scalar map; points never have x = y = z everywhere.
        return values[..., 0] if np.array_equal(values[..., 0], values[..., 2], equal_nan=True) else values
    for name in ("Z", "DEPTH.Z", "DEPTH.V", "Y", "V"):
        if name in names:
            return values[..., names.index(name)]
    return values[..., 0]


SAME_SHAPE = 0.02
"""Largest log difference of aspect ratios; networks round sizes to multiples of 14."""
LEAST_KNOWN = 0.02
"""Smallest share of valid pixels."""
STRETCHED = 0.98
"""A PNG whose values span this share of 65535 was stretched, and does not hold millimetres."""
NORMALIZED_FOCAL = 20.0
"""Focal lengths below this are relative to a picture of size 1, not in pixels."""


@dataclass(frozen=True)
class DepthMap:
    """A depth map of the photo's size.

    values: (H, W) float32; depth along the optical axis if ``disparity`` is False, else disparity; NaN where unknown.
    metric: whether they are metres. focal: its focal length in the photo's pixels, or None.
    """

    values: NDArray[np.float32]
    disparity: bool
    metric: bool
    focal: float | None

    @property
    def nearness(self) -> NDArray[np.float32]:
        """(H, W) inverse depth or disparity, larger for nearer points; NaN where unknown."""
        if self.disparity:
            return self.values
        return np.asarray(1.0 / self.values, dtype=np.float32)


def read_depth(path: Path, width: int, height: int) -> DepthMap:
    """Return the depth map in the file ``path``, for a photo of ``width`` by ``height`` pixels.

    Raises InputError for a file that is missing, damaged, too large, of another aspect ratio, or without depth.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"depth {path}: depth maps are read from {', '.join(SUFFIXES)}, not {path.suffix or 'without suffix'!r}; "
            "8-bit pictures are too coarse for depth"
        )
    try:
        arrays = read_arrays(path)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"depth {path}: there is no such file; check its name") from None
    except MemoryError:
        raise InputError(f"depth {path}: does not fit in memory; give a smaller one") from None
    # Readers of damaged files raise arbitrary exceptions (TokenError, BadZipFile, struct.error, …).
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
            "aspect ratio"
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
    """Return whether values increase from the middle of the picture downward: then they are disparity."""
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
    """Focal length at which ``points`` (H, W, 3) project to their pixels; None if their axes differ."""
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
    """``values`` resized to the photo's size; NaN spreads by at most a pixel."""
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
