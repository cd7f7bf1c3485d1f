# SPDX-License-Identifier: MIT
"""Environment maps: read from files, rotate to fit a camera, write; irradiance of the ground.

The orientation convention is in ``equirectangular``.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..errors import InputError, openimageio_error
from ..files import MAX_PICTURE_BYTES, require_file
from .equirectangular import FRAMES, LUMINANCE, Radiance, directions
from .model import Camera, Ground

SUFFIXES = (".exr", ".hdr")
MAX_PIXELS = 64_000_000
MAX_WIDTH = 2048
"""Width stored in a scene; larger maps are averaged down, which preserves their light."""
MIN_HEIGHT = 8
SPOT_DEG, SPOT_SHARE = 10.0, 0.2
"""A spot of this radius (degrees) that gives at least this share of the ground's light casts shadows like a sun."""


def read_environment(path: Path) -> Radiance:
    """Return the map (H, 2 H, 3) of a Radiance (.hdr) or OpenEXR file of up to 64 megapixels.

    Raises InputError for a file that is missing, unreadable, truncated, not twice as wide as high, not finite,
    negative, or black in the upper half.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"environment {path}: light is read from .hdr and .exr files, not {path.suffix or 'without suffix'!r}, for "
            "8-bit pictures have lost what is brighter than white; of DiffusionLight take hdr/NAME.exr, which its "
            "exposure2hdr.py makes of envmap/NAME_ev-*.png"
        )
    try:
        require_file(path, MAX_PICTURE_BYTES, what="environment map")
    except FileNotFoundError:
        raise InputError(f"environment {path}: there is no such file; check its name") from None
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(
            f"environment {path}: is not a readable picture ({openimageio_error(oiio.geterror)}); export it again"
        )
    try:
        spec = source.spec()
        width, height, names = int(spec.width), int(spec.height), [n.upper() for n in spec.channelnames]
        _check_shape(path, width, height)
        if {"R", "G", "B"} <= set(names):
            wanted = [names.index(name) for name in "RGB"]
        elif len(names) in (1, 2):
            wanted = [0, 0, 0]
        else:
            raise InputError(
                f"environment {path}: has the channels {', '.join(spec.channelnames)}; export it with R, G and B"
            )
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        if pixels is None:
            raise InputError(
                f"environment {path}: is cut off or damaged ({openimageio_error(source.geterror)}); export it again"
            )
    finally:
        source.close()
    return _checked(path, np.asarray(pixels, dtype=np.float32).reshape(height, width, -1)[..., wanted])


def _check_shape(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise InputError(
            f"environment {path}: {width}x{height} pixels are more than {MAX_PIXELS // 10**6} million; scale it down, "
            f"{MAX_WIDTH}x{MAX_WIDTH // 2} are kept"
        )
    if height < MIN_HEIGHT or abs(width - 2 * height) > max(1, 0.01 * width):
        raise InputError(
            f"environment {path}: is {width}x{height} pixels; an equirectangular map of all directions is "
            f"twice as wide as high, at least {2 * MIN_HEIGHT}x{MIN_HEIGHT}; a picture of a mirror ball has to be "
            "unwrapped first"
        )


def _checked(path: Path, radiance: Radiance) -> Radiance:
    bad = int((~np.isfinite(radiance)).any(axis=2).sum())
    if bad:
        raise InputError(f"environment {path}: {bad} pixels are not finite; export it again, as 32-bit float")
    darkest, brightest = float(radiance.min()), float(radiance.max())
    # Resampling filters undershoot beside very bright pixels.
    if darkest < -0.01 * brightest or darkest < -1e4:
        raise InputError(f"environment {path}: has negative light ({darkest:g}); export it again without grading")
    radiance = np.maximum(radiance, 0.0)
    upper = radiance[: radiance.shape[0] // 2] @ LUMINANCE
    if not float(upper.mean()) > 1e-9:
        raise InputError(
            f"environment {path}: is black where the sky should be; give a map with light above the horizon"
        )
    return radiance


def prepared(path: Path, frame: str, camera: Camera, ground: Ground | None) -> Radiance:
    """Return the environment in ``path`` as a scene stores it, rotated to fit ``camera``.

    frame: one of ``FRAMES``. Raises InputError as ``read_environment`` does.
    """
    if frame not in FRAMES:
        raise InputError(f"frame of the environment is {frame!r}: choose {', '.join(FRAMES)}")
    radiance = read_environment(path)
    # Normalised to mean 1: only the ratio of the sun to it matters.
    radiance = (radiance / float((radiance @ LUMINANCE).mean())).astype(np.float32)
    height, width = radiance.shape[:2]
    if width > MAX_WIDTH or width != 2 * height:
        kept = min(MAX_WIDTH, width) // 2 * 2
        radiance = np.asarray(cv2.resize(radiance, (kept, kept // 2), interpolation=cv2.INTER_AREA), dtype=np.float32)
    return turned(radiance, world_from_file(frame, camera, ground))


def world_from_file(frame: str, camera: Camera, ground: Ground | None) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from a map's axes (x: its centre, y: left of it, z: up) to the scene's."""
    if frame == "world":
        return np.eye(3)
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3]
    ahead, up = pose[:, 2], -pose[:, 1]
    if frame == "ahead":
        normal = np.array([0.0, 0.0, 1.0]) if ground is None else ground.unit_normal
        level = ahead - (ahead @ normal) * normal
        if np.linalg.norm(level) < 1e-6:
            # Looking straight down: the image's upper edge is ahead.
            level = up - (up @ normal) * normal
        ahead, up = level / np.linalg.norm(level), normal
    return np.column_stack([ahead, np.cross(up, ahead), up])


def turned(radiance: Radiance, rotation: NDArray[np.float64]) -> Radiance:
    """Return ``radiance`` resampled by ``rotation`` (3, 3) from the map's axes to the scene's."""
    if np.allclose(rotation, np.eye(3)):
        return radiance
    height, width = radiance.shape[:2]
    x, y, z = np.moveaxis(directions(height, width)[0] @ rotation, -1, 0)
    column = (0.5 - np.arctan2(y, x) / (2 * math.pi)) * width - 0.5
    row = (0.5 - np.arcsin(np.clip(z, -1, 1)) / math.pi) * height - 0.5
    around = np.concatenate([radiance[:, -1:], radiance, radiance[:, :1]], axis=1)
    return np.asarray(
        cv2.remap(
            around,
            (column + 1).astype(np.float32),
            row.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def ground_light(radiance: Radiance, axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors (D, 3) above the ground, in its axes, and the irradiance from each (D,).

    axes: (3, 3), rows two unit vectors along the ground and its normal. The map is averaged down to 32 by 16 pixels.
    """
    small = cv2.resize(radiance, (32, 16), interpolation=cv2.INTER_AREA)
    towards, solid = directions(16, 32)
    local = (towards @ axes.T).reshape(-1, 3)
    weight = ((small @ LUMINANCE) * solid).reshape(-1) * np.maximum(local[:, 2], 0.0)
    above = weight > 0
    return local[above], weight[above]


def sun_in(radiance: Radiance, normal: NDArray[np.float64]) -> float:
    """Return the share (0 to 1) of the light on ground of unit ``normal`` (3,) from the brightest spot of 10° radius.

    About 0.06 at most for an even sky.
    """
    height = min(radiance.shape[0], 128)
    small = cv2.resize(radiance, (2 * height, height), interpolation=cv2.INTER_AREA)
    towards, solid = directions(height, 2 * height)
    light = (small @ LUMINANCE) * solid * np.maximum(towards @ normal, 0.0)
    total = float(light.sum())
    if not total > 0:
        return 0.0
    # Smoothed to find the centre of a spot rather than the first of its equal pixels.
    smooth = cv2.GaussianBlur(light / solid, (0, 0), height * SPOT_DEG / 2 / 180)
    brightest = towards.reshape(-1, 3)[int(np.argmax(smooth))]
    return float(light[towards @ brightest > math.cos(math.radians(SPOT_DEG))].sum()) / total


LAMP_BRIGHTNESS = 8.0
"""Luminance over the map's mean from which a pixel belongs to a lamp; an overcast zenith has three times that of its
horizon."""
LAMP_SHARE = 0.04
"""Least share of the ground's light of a lamp whose shadows have borders worth rendering finely."""


def lamps_in(radiance: Radiance, normal: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]]:
    """Return the small bright spots above the ground of unit ``normal`` (3,): unit vectors (3,) towards their middles,
    and their diameters in radians. A spot across the map's left and right edge counts as two.
    """
    luminance = radiance @ LUMINANCE
    towards, solid = directions(*luminance.shape)
    light = luminance * solid * np.maximum(towards @ normal, 0.0)
    bright = luminance > LAMP_BRIGHTNESS * float((luminance * solid).sum() / solid.sum())
    number, labels = cv2.connectedComponents(bright.astype(np.uint8), connectivity=8)
    shares = np.bincount(labels.ravel(), light.ravel(), number) / max(float(light.sum()), 1e-12)
    found = []
    for label in np.flatnonzero(shares[1:] >= LAMP_SHARE) + 1:
        own = labels == label
        middle = (towards[own] * light[own][:, None]).sum(axis=0)
        middle /= np.linalg.norm(middle)
        lit = own & (light > 0)
        found.append((middle, 2.0 * float(np.arccos(np.clip(towards[lit] @ middle, -1.0, 1.0)).max())))
    return found


def write_environment(path: Path, radiance: Radiance) -> None:
    """Write ``radiance`` as a 32-bit EXR. Raises InputError if that fails."""
    height, width, channels = radiance.shape
    spec = oiio.ImageSpec(width, height, channels, "float")
    spec.attribute("compression", "zip")
    # Otherwise the current time is written, and equal maps would give different files.
    spec.attribute("DateTime", "")
    output = oiio.ImageOutput.create(str(path))
    written = (
        output is not None
        and output.open(str(path), spec)
        and output.write_image(np.ascontiguousarray(radiance, dtype=np.float32))
        and output.close()
    )
    if not written:
        raise InputError(f"{path}: cannot be written ({openimageio_error(oiio.geterror)}); choose another folder")
