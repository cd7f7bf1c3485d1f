# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of single frames, through OpenImageIO: PNG, EXR, EXR of several parts. Needs no bpy.

A file is written under another name and renamed, so that it is whole or not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.composite import transfer
from ...sim.errors import InputError
from ...sim.openimageio import last_error
from ...sim.version import VERSION
from .formats import exact_rate

SOFTWARE = f"PhysGen {VERSION}"
PNG_COMPRESSION = 3
"""Of 9: more takes far longer and saves little of a photo."""
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x, y of red, green, blue and white (ITU-R BT.709-6), which are those of sRGB."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of an EXR file.

    channels: their names in the file. The first part's are plain (``R``), others carry the part's (``depth.Z``).
    pixels: (H, W, C), all parts of one size.
    bits: 16 (half) or 32 (float) a channel. compression: ``zip``, ``dwaa`` or ``none``.
    attributes: of this part, text by name.
    """

    name: str
    channels: tuple[str, ...]
    pixels: NDArray[np.floating]
    bits: int = 16
    compression: str = "zip"
    attributes: dict[str, str] = field(default_factory=dict)


def write_png(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write (H, W, 3) sRGB of 8 or 16 bits. Raises InputError when ``path`` cannot be written."""
    spec = _spec(pixels, oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", PNG_COMPRESSION)
    with replacing(path) as partial:
        _write(path, partial, [spec], [pixels])
        # OpenImageIO keeps it to itself when the disk is full while it writes a PNG.
        if not _holds(partial, pixels):
            raise _unwritable(path, "the file came out incomplete")


def _holds(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bool:
    try:
        return np.array_equal(_read(path, oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8), pixels)
    except OSError:
        return False


def encoded(linear: transfer.Linear, bits: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Linear light (H, W, 3) as sRGB of 8 or 16 bits, rounded to the nearest."""
    if bits == 8:
        return transfer.linear_to_bytes(linear)
    return np.rint(transfer.linear_to_srgb(linear).astype(np.float64) * 65535.0).astype(np.uint16)


def write_exr(path: Path, parts: Sequence[Part], *, fps: float) -> None:
    """Write ``parts`` in linear light with Rec. 709 primaries, several as a multi-part file.

    Raises InputError when ``path`` cannot be written.
    """
    specs = []
    for part in parts:
        spec = _spec(part.pixels, oiio.HALF if part.bits == 16 else oiio.FLOAT)
        spec.channelnames = part.channels
        spec.attribute("oiio:ColorSpace", "lin_rec709")
        # These must be the same in all parts.
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), REC_709)
        rate = exact_rate(fps)
        spec.attribute("FramesPerSecond", oiio.TypeDesc("rational"), (rate.numerator, rate.denominator))
        spec.attribute("compression", part.compression)
        if len(parts) > 1:
            spec.attribute("oiio:subimagename", part.name)
        for name, text in part.attributes.items():
            spec.attribute(name, text)
        specs.append(spec)
    with replacing(path) as partial:
        _write(path, partial, specs, [np.ascontiguousarray(part.pixels, dtype=np.float32) for part in parts])


def read_picture(path: Path) -> NDArray[np.uint8]:
    """The picture of a PNG or EXR frame, (H, W, 3) 8-bit sRGB; what is brighter than white is white.

    Raises InputError when it is missing or not readable.
    """
    linear = path.suffix.lower() == ".exr"
    try:
        pixels = _read(path, oiio.FLOAT if linear else oiio.UINT8)
    except OSError as error:
        raise InputError(f"{path}: not a readable frame ({error}); render it again") from error
    # Grey pictures have one channel, or two with alpha.
    pixels = np.broadcast_to(pixels[..., : 3 if pixels.shape[2] >= 3 else 1], (*pixels.shape[:2], 3))
    if linear:
        return transfer.linear_to_bytes(np.nan_to_num(pixels, nan=0.0))
    return np.ascontiguousarray(pixels)


def _read(path: Path, kind: oiio.BASETYPE) -> NDArray[Any]:
    """The first part (H, W, C) of an image file. Raises OSError when it is not whole."""
    try:
        source = oiio.ImageInput.open(str(path))
        if source is None:
            raise OSError(last_error(oiio.geterror))
        try:
            pixels = source.read_image(0, 0, 0, source.spec().nchannels, kind)
            if pixels is None:
                raise OSError(last_error(source.geterror))
        finally:
            source.close()
    except (UnicodeDecodeError, MemoryError) as error:
        # Damaged bytes reach the names of channels, or ask for an enormous picture.
        raise OSError("damaged") from error
    return np.asarray(pixels)


def _spec(pixels: NDArray[np.generic], kind: oiio.BASETYPE) -> oiio.ImageSpec:
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.attribute("Software", SOFTWARE)
    # Otherwise the time of writing goes in, and the same picture never is the same file.
    spec.attribute("DateTime", "")
    return spec


def _write(path: Path, partial: Path, specs: Sequence[oiio.ImageSpec], pictures: Sequence[NDArray[np.generic]]) -> None:
    """Write ``partial``, which is to become ``path``."""
    target = oiio.ImageOutput.create(str(partial))
    if target is None:
        raise InputError(f"{path}: OpenImageIO cannot write {path.suffix} files ({last_error(oiio.geterror)})")
    good = target.open(str(partial), tuple(specs)) if len(specs) > 1 else target.open(str(partial), specs[0])
    for index, (spec, picture) in enumerate(zip(specs, pictures, strict=True)):
        if good and index > 0:
            good = target.open(str(partial), spec, "AppendSubimage")
        good = good and target.write_image(picture)
    said = target.geterror()
    # What is still in buffers is written here, so a full disk may show only now.
    if not (target.close() and good):
        raise _unwritable(path, last_error(lambda: said or target.geterror()))


def _unwritable(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: cannot be written ({reason}); free space or choose another folder")
