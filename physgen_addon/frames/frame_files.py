# SPDX-License-Identifier: GPL-3.0-or-later
"""Image files of frames through OpenImageIO: PNG, EXR and multi-part EXR. Needs no bpy."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...sim import srgb
from ...sim.atomic import replacing
from ...sim.composite.compositing import FrameLayers
from ...sim.errors import InputError, openimageio_error
from ...sim.files import MAX_PICTURE_BYTES, require_file
from ...sim.version import VERSION
from ..render.render_options import FrameFormat, exact_rate


def read_layers(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels (H, W) of the data window, by name without the view layer: ``R``, ``Combined.R``,
    ``texture.A``.

    Blender 4.5 writes one part with all channels, 5.x a part for each pass. Raises InputError if unreadable.
    """
    try:
        require_file(path, MAX_PICTURE_BYTES, what="picture")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; restore it or make it again") from None
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(
            f"{path}: not a readable image ({openimageio_error(oiio.geterror)}); restore it or make it again"
        )
    channels: dict[str, NDArray[np.float32]] = {}
    try:
        part = 0
        while source.seek_subimage(part, 0):
            spec = source.spec()
            if spec.width * spec.height * spec.nchannels > MAX_NUMBERS:
                raise InputError(f"{path}: {spec.width}x{spec.height} pixels are too many; make it again")
            pixels = source.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
            if pixels is None:
                raise InputError(f"{path}: cut off or damaged ({openimageio_error(source.geterror)}); make it again")
            for index, name in enumerate(spec.channelnames):
                channels[".".join(name.split(".")[-2:])] = np.asarray(pixels[..., index], dtype=np.float32)
            part += 1
    except (UnicodeDecodeError, MemoryError) as error:
        # Damaged bytes can end up in channel names or request an enormous image.
        raise InputError(f"{path}: damaged; restore it or make it again") from error
    finally:
        source.close()
    return channels


MAX_NUMBERS = 2**30
"""Of a part of a picture: pixels times channels."""
SOFTWARE = f"PhysGen {VERSION}"
PNG_COMPRESSION = 3
"""Of 9: higher levels take far longer and save little on photos."""
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x, y of red, green, blue and white (ITU-R BT.709-6), which are those of sRGB."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of an EXR file.

    channels: names in the file. The first part's are plain (``R``), others carry the part's name (``depth.Z``).
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
    """Write (H, W, 3) sRGB of 8 or 16 bits. Raises InputError if ``path`` cannot be written."""
    spec = _spec(pixels, oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", PNG_COMPRESSION)
    with replacing(path) as partial:
        _write(path, partial, [spec], [pixels])
        # OpenImageIO does not report a full disk while it writes a PNG.
        if not _holds(partial, pixels):
            raise _unwritable(path, "the file came out incomplete")


def _holds(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bool:
    try:
        return np.array_equal(_read(path, oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8), pixels)
    except OSError:
        return False


def encoded(linear: srgb.Linear, bits: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return linear light (H, W, 3) as sRGB of 8 or 16 bits, rounded to nearest."""
    if bits == 8:
        return srgb.linear_to_bytes(linear)
    return np.rint(srgb.linear_to_srgb(linear).astype(np.float64) * 65535.0).astype(np.uint16)


def write_exr(path: Path, parts: Sequence[Part], *, fps: float) -> None:
    """Write ``parts`` in linear light with Rec. 709 primaries, several as a multi-part file.

    Raises InputError if ``path`` cannot be written.
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
    """Return the image of a PNG or EXR frame, (H, W, 3) 8-bit sRGB, clipped to white.

    Raises InputError if it is missing or unreadable.
    """
    linear = path.suffix.lower() == ".exr"
    try:
        require_file(path, MAX_PICTURE_BYTES, what="frame")
        pixels = _read(path, oiio.FLOAT if linear else oiio.UINT8)
    except OSError as error:
        raise InputError(f"{path}: not a readable frame ({error}); render it again") from error
    # Grey images have one channel, or two with alpha.
    pixels = np.broadcast_to(pixels[..., : 3 if pixels.shape[2] >= 3 else 1], (*pixels.shape[:2], 3))
    if linear:
        return srgb.linear_to_bytes(np.nan_to_num(pixels, nan=0.0))
    return np.ascontiguousarray(pixels)


def _read(path: Path, kind: oiio.BASETYPE) -> NDArray[Any]:
    """Return the first part (H, W, C) of an image file. Raises OSError if it is incomplete."""
    try:
        source = oiio.ImageInput.open(str(path))
        if source is None:
            raise OSError(openimageio_error(oiio.geterror))
        try:
            spec = source.spec()
            if spec.width * spec.height * spec.nchannels > MAX_NUMBERS:
                raise OSError(f"{spec.width}x{spec.height} pixels of {spec.nchannels} channels are too many")
            pixels = source.read_image(0, 0, 0, spec.nchannels, kind)
            if pixels is None:
                raise OSError(openimageio_error(source.geterror))
        finally:
            source.close()
    except (UnicodeDecodeError, MemoryError) as error:
        # Damaged bytes can end up in channel names or request an enormous image.
        raise OSError("damaged") from error
    return np.asarray(pixels)


def _spec(pixels: NDArray[np.generic], kind: oiio.BASETYPE) -> oiio.ImageSpec:
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.attribute("Software", SOFTWARE)
    # Otherwise the current time is written, and equal images would give different files.
    spec.attribute("DateTime", "")
    return spec


def _write(path: Path, partial: Path, specs: Sequence[oiio.ImageSpec], pictures: Sequence[NDArray[np.generic]]) -> None:
    """Write ``partial``, which will be renamed to ``path``."""
    target = oiio.ImageOutput.create(str(partial))
    if target is None:
        raise InputError(f"{path}: OpenImageIO cannot write {path.suffix} files ({openimageio_error(oiio.geterror)})")
    good = target.open(str(partial), tuple(specs)) if len(specs) > 1 else target.open(str(partial), specs[0])
    for index, (spec, picture) in enumerate(zip(specs, pictures, strict=True)):
        if good and index > 0:
            good = target.open(str(partial), spec, "AppendSubimage")
        good = good and target.write_image(picture)
    cause = target.geterror()
    # Buffers are flushed here, so a full disk may show only now.
    if not (target.close() and good):
        raise _unwritable(path, openimageio_error(lambda: cause or target.geterror()))


def _unwritable(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: cannot be written ({reason}); free space or choose another folder")


class Data(Protocol):
    """``renderer.DataLayers``, which needs bpy to be created but not to be written."""

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) metres along the optical axis."""

    @property
    def object_id(self) -> NDArray[np.float32]:
        """(H, W) 0 without object, 1 for the first and so on."""

    @property
    def flow(self) -> NDArray[np.float32]:
        """(H, W, 4) pixels to the next frame and to the previous one."""


def write_frame(
    path: Path, layers: FrameLayers, data: Data | None, form: FrameFormat, *, fps: float, names: Sequence[str]
) -> None:
    """Write ``layers``, and ``data`` if ``form`` is layered, to ``path`` atomically.

    fps: frames a second of the clip. names: of the objects with the ids 1, 2, ….
    Raises InputError if ``path`` cannot be written.
    """
    if form.kind == "png":
        write_png(path, encoded(layers.beauty, form.depth))
        return
    parts = [_colour("beauty", layers.beauty, form)]
    if data is not None:
        objects = layers.objects
        light = np.dstack([objects.texture * objects.light, objects.alpha])
        ids = json.dumps({name: number for number, name in enumerate(names, start=1)}, ensure_ascii=False)
        parts = [
            _colour("beauty", np.dstack([layers.beauty, np.ones(layers.beauty.shape[:2], np.float32)]), form),
            _colour("objects", light, form),
            _colour("ground", layers.ground, form),
            _colour("shadow", layers.shadow, form),
            _numbers("depth", data.depth[..., None], "Z"),
            _numbers("object_id", data.object_id[..., None], "X", {"physgen:object_ids": ids}),
            _numbers("flow", data.flow, "XYZW"),
        ]
    write_exr(path, parts, fps=fps)


def _colour(name: str, pixels: NDArray[np.float32], form: FrameFormat) -> Part:
    prefix = "" if name == "beauty" else f"{name}."
    channels = tuple(f"{prefix}{c}" for c in "RGBA"[: pixels.shape[2]])
    return Part(name=name, channels=channels, pixels=pixels, bits=form.depth, compression=form.compression)


def _numbers(name: str, pixels: NDArray[np.float32], letters: str, attributes: dict[str, str] | None = None) -> Part:
    """Return a part of measured values: full precision, lossless."""
    channels = tuple(f"{name}.{c}" for c in letters)
    return Part(name=name, channels=channels, pixels=pixels, bits=32, attributes=attributes or {})
