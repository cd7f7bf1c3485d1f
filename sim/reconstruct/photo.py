# SPDX-License-Identifier: MIT
"""Read a photo upright, in 8-bit sRGB, at working size, with its focal length by Exif 2.32."""

from __future__ import annotations

import io
import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError

from ..errors import InputError
from ..files import MAX_PICTURE_BYTES, open_file
from ..memory import DECODED_BYTES, available_memory, require_memory

FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
ROUNDING_SIGMA = 0.02
"""Standard deviation of the logarithm: rounding to millimetres, focusing, distortion correction."""
SENSOR_SIGMA = 0.03
CROPPED_SIGMA = 0.15
SAME_SHAPE = 0.015
"""Relative difference of aspect ratio above which a photo counts as cropped."""
_FOCAL_35MM, _FOCAL, _DIGITAL_ZOOM = 0xA405, 0x920A, 0xA404
_WIDTH, _HEIGHT = 0xA002, 0xA003
_PLANE_X, _PLANE_Y, _PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
_MAKE, _MODEL = 0x010F, 0x0110
_MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}

SENSORS_MM: tuple[tuple[str, float, float], ...] = (
    ("CANON EOS 5D", 36.0, 24.0),
    ("CANON EOS 6D", 36.0, 24.0),
    ("CANON EOS-1D X", 36.0, 24.0),
    ("CANON EOS R5", 36.0, 24.0),
    ("CANON EOS R6", 36.0, 24.0),
    ("CANON EOS RP", 36.0, 24.0),
    ("CANON EOS R8", 36.0, 24.0),
    ("CANON EOS R3", 36.0, 24.0),
    ("CANON EOS-1D", 28.7, 19.1),
    ("CANON EOS", 22.3, 14.9),
    ("SONY ILCE-7", 35.7, 23.8),
    ("SONY ILCE-9", 35.6, 23.8),
    ("SONY ILCE-1", 35.9, 24.0),
    ("SONY ILCE", 23.5, 15.6),
    ("SONY NEX", 23.5, 15.6),
    ("LEICA M8", 27.0, 18.0),
    ("LEICA M", 36.0, 24.0),
    ("LEICA SL", 36.0, 24.0),
    ("FUJIFILM GFX", 43.8, 32.9),
    ("FUJIFILM X", 23.5, 15.6),
    ("NIKON D1", 23.7, 15.6),
    ("OLYMPUS E-", 17.3, 13.0),
    ("OM DIGITAL", 17.3, 13.0),
    ("PANASONIC DMC-G", 17.3, 13.0),
    ("PANASONIC DC-G", 17.3, 13.0),
    ("RICOH GR", 23.5, 15.7),
)
"""Width and height of sensors by prefix of maker and model, the first match: for cameras whose 35 mm equivalent is not
in the file. Phones write it."""


@dataclass(frozen=True)
class ExifFocal:
    """Focal length in diagonals of the photo, the standard deviation of its logarithm, and the tags it was read
    from."""

    per_diagonal: float
    sigma: float
    source: str


def focal_from_exif(base: Mapping[int, Any], details: Mapping[int, Any], width: int, height: int) -> ExifFocal | None:
    """Return the focal length by the tags of a photo of ``width`` by ``height`` pixels as stored; None if undetermined.

    base, details: tags of the first and of the Exif directory, with values of any type, since files hold anything. The
    35 mm equivalent compares diagonals (CIPA DCG-001). A photo whose aspect ratio differs from the camera's is assumed
    to be cropped along one side only.
    """
    taken = _number(details.get(_WIDTH)), _number(details.get(_HEIGHT))
    found = _equivalent(details) or _by_resolution(details, taken) or _by_sensor(base, details)
    if found is None:
        return None
    value, sigma, source = found
    if not 0.1 <= value <= 50.0:
        return None
    if taken[0] is None or taken[1] is None or not _cropped(taken[0], taken[1], width, height):
        return ExifFocal(value, sigma, source)
    scale = max(width / taken[0], height / taken[1])
    uncut = math.hypot(taken[0], taken[1]) * scale
    return ExifFocal(value * uncut / math.hypot(width, height), CROPPED_SIGMA, f"{source}, of a photo that was cropped")


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _equivalent(details: Mapping[int, Any]) -> tuple[float, float, str] | None:
    focal = _number(details.get(_FOCAL_35MM))
    if focal is None or not 5 <= focal <= 2000:
        return None
    return focal / FULL_FRAME_DIAGONAL_MM, ROUNDING_SIGMA, "EXIF (35 mm equivalent)"


def _millimetres(details: Mapping[int, Any]) -> float | None:
    focal = _number(details.get(_FOCAL))
    zoom = _number(details.get(_DIGITAL_ZOOM))
    return None if focal is None else focal * max(1.0, min(zoom or 1.0, 20.0))


def _by_resolution(
    details: Mapping[int, Any], taken: tuple[float | None, float | None]
) -> tuple[float, float, str] | None:
    """FocalPlaneXResolution counts the pixels of the picture as taken in a unit of length of the sensor."""
    focal, per_unit = _millimetres(details), _number(details.get(_PLANE_X))
    unit = _MM_OF_UNIT.get(int(_number(details.get(_PLANE_UNIT)) or 2))
    if focal is None or per_unit is None or unit is None or taken[0] is None or taken[1] is None:
        return None
    across = _number(details.get(_PLANE_Y)) or per_unit
    diagonal = math.hypot(taken[0] / per_unit * unit, taken[1] / across * unit)
    # Some cameras count the thumbnail's pixels; no sensor is that large or small.
    if not 3.0 <= diagonal <= 80.0:
        return None
    return focal / diagonal, SENSOR_SIGMA, "EXIF (focal length and sensor resolution)"


def _by_sensor(base: Mapping[int, Any], details: Mapping[int, Any]) -> tuple[float, float, str] | None:
    focal = _millimetres(details)
    make, model = (str(base.get(tag, "")).strip("\0 ").upper() for tag in (_MAKE, _MODEL))
    # Some makers repeat themselves in the model.
    name = model if model.startswith(make.split(" ")[0]) else f"{make.removesuffix(' CORPORATION')} {model}"
    for beginning, width, height in SENSORS_MM:
        if focal is not None and name.startswith(beginning):
            return focal / math.hypot(width, height), SENSOR_SIGMA, f"EXIF (focal length, and the sensor of {name})"
    return None


def _cropped(taken_width: float, taken_height: float, width: int, height: int) -> bool:
    if taken_width < 16 or taken_height < 16:
        return False
    ratio = math.log(taken_width / taken_height) - math.log(width / height)
    # Some programs rotate the pixels and leave the tags.
    turned = math.log(taken_height / taken_width) - math.log(width / height)
    return min(abs(ratio), abs(turned)) > SAME_SHAPE


FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "MPO")
MAX_PIXELS = 200_000_000
"""Above the largest phone sensors; a file that claims more is treated as a decompression bomb."""
MIN_SIDE = 32
_EXIF_IFD = 0x8769


@dataclass(frozen=True)
class Photo:
    """A photo at working size.

    pixels: (H, W, 3) uint8 sRGB, read-only.
    scale: working pixels per pixel of the upright original, at most 1.
    original_size: width and height of the upright original in pixels.
    focal_35mm: focal length in millimetres for a 36x24 mm frame with the same diagonal, or None.
    exif_focal_sigma: standard deviation of the logarithm of that focal length. exif_source: which tags it is from.
    """

    pixels: NDArray[np.uint8]
    scale: float
    original_size: tuple[int, int]
    focal_35mm: float | None
    exif_focal_sigma: float = ROUNDING_SIGMA
    exif_source: str = "EXIF"

    @property
    def width(self) -> int:
        """Pixels of the working photo."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Pixels of the working photo."""
        return int(self.pixels.shape[0])

    @property
    def exif_focal_px(self) -> float | None:
        """Focal length in working pixels by EXIF (the 35 mm equivalent compares diagonals, CIPA DCG-001)."""
        if self.focal_35mm is None:
            return None
        return self.focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(self.width, self.height)


SMALL, MOST_A_BYTE = 2**24, 2000
"""Pixels of a photo that are decoded whatever the file says, and beyond them pixels a byte of the file: JPEG and PNG
have at most some 1,000, photos less than 100. Others keep a decoder busy for long with nothing."""


def load_photo(path: Path, max_size: int) -> Photo:
    """Read ``path`` and scale it down so that its longest side has at most ``max_size`` pixels.

    Raises InputError when the file is missing, empty, truncated, too large, of an unsupported format, or not an image.
    """
    try:
        with warnings.catch_warnings():
            # Pillow only warns between its limit and twice that; our own check below has the better message.
            warnings.simplefilter("ignore")
            with open_file(path, MAX_PICTURE_BYTES, what="picture") as file, Image.open(file) as image:
                width, height = image.size
                if width * height > max(SMALL, MOST_A_BYTE * os.fstat(file.fileno()).st_size):
                    raise InputError(f"{path}: claims {width}x{height} pixels and is too short for them; save it again")
                return _decode(path, image, max_size)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such photo; check the path") from None
    except UnidentifiedImageError:
        raise InputError(f"{path}: is not an image; give a JPEG, PNG, TIFF or WebP file") from None
    except Image.DecompressionBombError:
        raise _too_large(path, "far more") from None
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory; give a smaller photo") from None
    # Decoders of damaged files raise arbitrary exceptions (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(
            f"{path}: cannot be read as an image ({type(error).__name__}: {error}); it may be damaged, save it again"
        ) from error


def _too_large(path: Path, found: str) -> InputError:
    return InputError(
        f"{path}: has {found} pixels than the {MAX_PIXELS // 1_000_000} million allowed; give a smaller photo"
    )


def _decode(path: Path, image: Image.Image, max_size: int) -> Photo:
    if image.format not in FORMATS:
        raise InputError(f"{path}: is a {image.format} file; give a JPEG, PNG, TIFF or WebP file")
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise _too_large(path, f"{width}x{height}, more")
    if min(width, height) < MIN_SIDE:
        raise InputError(f"{path}: is {width}x{height} pixels; give a photo of at least {MIN_SIDE}x{MIN_SIDE}")
    focal = _focal(image)
    profile = image.info.get("icc_profile")
    orientation = image.getexif().get(0x0112, 1)
    if image.format == "JPEG" and image.mode in ("RGB", "L"):
        # JPEG can be decoded at 1/2, 1/4 or 1/8: a 40-megapixel photo costs a fraction, and no sharpness is lost.
        image.draft(None, (max_size, max_size))
    # After draft: what is decoded, not what is stored.
    decoded = image.size[0] * image.size[1] * DECODED_BYTES
    require_memory(decoded, available_memory(), what=f"the photo {path}", remedy="scale it down")
    image.load()
    upright = ImageOps.exif_transpose(_to_rgb(image, profile)) if "exif" in image.info else _to_rgb(image, profile)
    if orientation in (5, 6, 7, 8):
        width, height = height, width
    scale = min(1.0, max_size / max(width, height))
    target = (max(1, round(width * scale)), max(1, round(height * scale)))
    if upright.size != target:
        upright = upright.resize(target, Image.Resampling.LANCZOS)
    pixels = np.array(upright, dtype=np.uint8)
    pixels.setflags(write=False)
    photo = Photo(pixels=pixels, scale=target[0] / width, original_size=(width, height), focal_35mm=None)
    if focal is None:
        return photo
    return replace(
        photo,
        focal_35mm=focal.per_diagonal * FULL_FRAME_DIAGONAL_MM,
        exif_focal_sigma=focal.sigma,
        exif_source=focal.source,
    )


def _focal(image: Image.Image) -> ExifFocal | None:
    """Focal length by EXIF, if present and plausible."""
    try:
        exif = image.getexif()
        return focal_from_exif(exif, exif.get_ifd(_EXIF_IFD), *image.size)
    except (TypeError, ValueError, KeyError, ZeroDivisionError, OSError, SyntaxError, OverflowError):
        # Damaged EXIF beside an intact picture: use the picture.
        return None


def _to_rgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    """8-bit RGB in sRGB; transparent pixels are composited on white."""
    exif = image.info.get("exif")
    result = _convert_mode(image)
    if profile:
        result = _to_srgb(image if image.mode == "CMYK" else result, profile) or result
    if exif is not None:
        result.info["exif"] = exif
    return result


def _convert_mode(image: Image.Image) -> Image.Image:
    if image.mode in ("I;16", "I;16B", "I;16L", "I;16N", "I"):
        # Pillow clips 16-bit grey at 255 when it converts; scale it instead. 65535 / 257 = 255.
        grey = np.clip(np.asarray(image, dtype=np.float64) / 257.0 + 0.5, 0, 255).astype(np.uint8)
        return Image.fromarray(grey).convert("RGB")
    if image.mode == "F":
        values = np.nan_to_num(np.asarray(image, dtype=np.float64))
        top = 1.0 if values.max(initial=0.0) <= 1.0 else 255.0
        return Image.fromarray(np.clip(values / top * 255.0 + 0.5, 0, 255).astype(np.uint8)).convert("RGB")
    if image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        rgba = image.convert("RGBA")
        canvas = Image.new("RGBA", rgba.size, (255, 255, 255, 255))
        return Image.alpha_composite(canvas, rgba).convert("RGB")
    return image.convert("RGB")


def _to_srgb(image: Image.Image, profile: bytes) -> Image.Image | None:
    """``image`` in sRGB by its embedded ICC profile; None when the profile does not fit or is damaged."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        result = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return None
    return result
