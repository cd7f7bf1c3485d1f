# SPDX-License-Identifier: MIT
"""The arrays in files of depth maps, read within bounds whatever a file says of itself."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from PIL import Image

from ...errors import InputError
from ...openimageio import last_error

SUFFIXES = (".npy", ".npz", ".exr", ".png", ".pfm")
MAX_PIXELS = 64_000_000
MAX_BYTES = 8 * 4 * MAX_PIXELS
DISPARITY_NAMES = ("disparity", "disp", "inverse", "inv_depth", "invdepth")
POINT_NAMES = ("points", "pts3d", "point_map", "pointmap")


@dataclass(frozen=True)
class Arrays:
    """What a file holds.

    values: (H, W), or (H, W, 3) points. mask: (H, W) bool or None. intrinsics: as stored, or None. disparity: None
    where names do not tell. metric: whether names tell metres. sixteen_bits: whether they are a PNG's whole numbers.
    """

    values: NDArray[Any]
    mask: NDArray[np.bool_] | None = None
    intrinsics: NDArray[Any] | None = None
    disparity: bool | None = None
    metric: bool = False
    sixteen_bits: bool = False


def read_arrays(path: Path) -> Arrays:
    """The arrays in ``path``. Raises InputError for what cannot be a depth map, and what readers raise for garbage."""
    name = path.name.lower()
    disparity = True if any(word in name for word in DISPARITY_NAMES) else None
    metric = "metric" in name
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _from_npz(path, disparity, metric)
    if suffix == ".npy":
        with path.open("rb") as file:
            return Arrays(_picture(path, _array(path, file)), disparity=disparity, metric=metric)
    if suffix == ".png":
        return Arrays(_from_png(path), disparity=disparity, metric=metric, sixteen_bits=True)
    values = _from_pfm(path) if suffix == ".pfm" else _from_exr(path)
    return Arrays(_picture(path, values), disparity=disparity, metric=metric)


def _too_large(path: Path, shape: object) -> InputError:
    return InputError(f"depth {path}: {shape} are more than {MAX_PIXELS // 10**6} million pixels; scale it down")


def _picture(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    """``values`` as (H, W) or (H, W, 3), leading axes of length 1 removed."""
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
    """One array in NumPy's format, whose header is looked at before memory is asked for. Never unpickles."""
    version = np.lib.format.read_magic(file)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(
        version
    )
    if read_header is None:
        raise ValueError(f"version {version} of NumPy's format")
    shape, fortran, dtype = read_header(file)
    # Python's integers do not overflow; NumPy's would.
    count = 1
    for side in shape:
        count *= int(side)
    if dtype.hasobject or dtype.kind not in "fiub":
        raise InputError(f"depth {path}: holds {dtype}, not numbers; save the depth as float32")
    if count < 0 or count * dtype.itemsize > MAX_BYTES:
        raise _too_large(path, shape)
    data = file.read(count * dtype.itemsize)
    return np.frombuffer(data, dtype=dtype, count=count).reshape(shape, order="F" if fortran else "C")


def _from_npz(path: Path, disparity: bool | None, metric: bool) -> Arrays:
    with zipfile.ZipFile(path) as archive:
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

        # What is called depth may still be disparity, where Depth Anything's relative models wrote it.
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
    with Image.open(path, formats=("PNG",)) as image:
        if image.width * image.height > MAX_PIXELS:
            raise _too_large(path, f"{image.width}x{image.height}")
        if image.mode not in ("I;16", "I;16B", "I;16L", "I;16N", "I"):
            raise InputError(
                f"depth {path}: is a picture of {image.mode}, not of 16-bit grey; 8 bits have lost the depth, save it "
                "as .npy or a 16-bit PNG"
            )
        values = np.asarray(image).astype(np.float32)
    # 0 is "unknown" in PNGs of millimetres, and the farthest in those of disparity; neither is a length.
    return np.where(values > 0, values, np.float32(np.nan))


def _from_pfm(path: Path) -> NDArray[Any]:
    """Portable float map: Pf or PF, width and height, a scale whose sign is the byte order, rows from the bottom up."""
    with path.open("rb") as file:
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
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"depth {path}: is not a readable picture ({last_error(oiio.geterror)}); export it again")
    try:
        spec = source.spec()
        width, height, channels = int(spec.width), int(spec.height), int(spec.nchannels)
        if width * height > MAX_PIXELS or channels > 16:
            raise _too_large(path, f"{width}x{height} with {channels} channels")
        names = [str(name).upper() for name in spec.channelnames]
        pixels = source.read_image(0, 0, 0, channels, oiio.FLOAT)
        if pixels is None:
            raise InputError(f"depth {path}: is cut off or damaged ({last_error(source.geterror)}); export it again")
    finally:
        source.close()
    values = np.asarray(pixels, dtype=np.float32).reshape(height, width, channels)
    if {"R", "G", "B"} <= set(names):
        values = values[..., [names.index(name) for name in "RGB"]]
        # Grey written as three equal channels is a map of numbers; points never have x = y = z everywhere.
        return values[..., 0] if np.array_equal(values[..., 0], values[..., 2], equal_nan=True) else values
    for name in ("Z", "DEPTH.Z", "DEPTH.V", "Y", "V"):
        if name in names:
            return values[..., names.index(name)]
    return values[..., 0]
