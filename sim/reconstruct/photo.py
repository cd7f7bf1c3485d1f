# SPDX-License-Identifier: MIT
"""Read a photo as a person would see it: upright, sRGB, 8 bits, at a size that can be worked with."""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError

from ..errors import InputError
from .view.exif_focal import FULL_FRAME_DIAGONAL_MM, ROUNDING_SIGMA, ExifFocal, focal_from_exif

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "MPO")
MAX_PIXELS = 200_000_000
"""More than the largest phone sensors have; a file that claims more is taken for a decompression bomb."""
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


def load_photo(path: Path, max_size: int) -> Photo:
    """Read ``path`` and scale it down so that its longest side has at most ``max_size`` pixels.

    Raises InputError when the file is missing, empty, truncated, too large, of another kind, or no image.
    """
    try:
        with warnings.catch_warnings():
            # Pillow only warns between its limit and twice that; our own check below has the better message.
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
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
    # Decoders of damaged files fail in whatever way the garbage leads them to (SyntaxError, struct.error, …).
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
    """Focal length by EXIF, when it is there and believable."""
    try:
        exif = image.getexif()
        return focal_from_exif(exif, exif.get_ifd(_EXIF_IFD), *image.size)
    except (TypeError, ValueError, KeyError, ZeroDivisionError, OSError, SyntaxError, OverflowError):
        # Damaged EXIF beside a sound picture: the picture counts.
        return None


def _to_rgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    """8-bit RGB in sRGB; transparent pixels go onto white."""
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
