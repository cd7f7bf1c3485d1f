# SPDX-License-Identifier: MIT
"""Focal length from what a camera wrote into its photo (Exif 2.32)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
ROUNDING_SIGMA = 0.02
"""Of the logarithm: whole millimetres, focusing, correction of distortion."""
SENSOR_SIGMA = 0.03
CROPPED_SIGMA = 0.15
SAME_SHAPE = 0.015
"""Proportions that differ by more than this are those of a cropped photo."""
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
"""Width and height of sensors by the beginning of maker and model, the first that fits: for those whose 35 mm
equivalent is not in the file. Phones write it."""


@dataclass(frozen=True)
class ExifFocal:
    """Focal length in diagonals of the photo, the standard deviation of its logarithm, and what it was read from."""

    per_diagonal: float
    sigma: float
    source: str


def focal_from_exif(base: Mapping[int, Any], details: Mapping[int, Any], width: int, height: int) -> ExifFocal | None:
    """Focal length by the tags of a photo of ``width`` by ``height`` pixels as stored; None where they do not tell.

    base, details: tags of the first and of the Exif directory, with values of any kind: files hold anything. The 35 mm
    equivalent compares diagonals (CIPA DCG-001). A photo of other proportions than the camera took is taken to be cut
    along one side only.
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
    # Some cameras count the thumbnail's pixels: no sensor is that large or small.
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
    # Some programs turn the pixels and leave the tags.
    turned = math.log(taken_height / taken_width) - math.log(width / height)
    return min(abs(ratio), abs(turned)) > SAME_SHAPE
