# SPDX-License-Identifier: MIT
"""Light for the simulated objects, guessed from the photo: a soft sky, bounce from the ground, and one sun.

The photo's colours already hold the real light, so only tint, gradient and direction matter here: the environment's
mean luminance is 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.model import Camera, Vector
from .camera import on_ground
from .shadow import lit_over_shaded

Mask = NDArray[np.bool_]

ENVIRONMENT_SIZE = (64, 32)
DEFAULT_SUN = (-0.45, -0.35, 0.82)
"""Above, left and from behind the camera: where painters and windows put it."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def linear_light(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """sRGB (…, 3) 0 to 255 to linear light 0 to 1 (IEC 61966-2-1)."""
    value = pixels.astype(np.float64) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def environment_map(pixels: NDArray[np.uint8], background: NDArray[np.uint8], horizon: float) -> NDArray[np.float32]:
    """Equirectangular environment (32, 64, 3) in linear light with mean luminance 1; row 0 is the zenith.

    pixels, background: (H, W, 3) sRGB, with and without objects. horizon: row in pixels.
    """
    light = linear_light(pixels[::4, ::4]).reshape(-1, 3)
    ground = linear_light(background[max(0, int(horizon)) :: 4, ::4]).reshape(-1, 3)
    luminance = light @ _LUMINANCE
    bright = light[luminance >= np.percentile(luminance, 85)].mean(axis=0)
    # A lamp is seldom as coloured as the things it lights: pull its tint halfway to white.
    sky = 0.5 * bright / max(float(bright @ _LUMINANCE), 1e-4) + 0.5
    floor = ground.mean(axis=0) if len(ground) else light.mean(axis=0)
    bounce = floor / max(float(bright @ _LUMINANCE), 1e-4)
    width, height = ENVIRONMENT_SIZE
    elevation = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
    up = np.sin(elevation)[:, None]
    # Brighter towards the zenith, as rooms and overcast skies are (CIE overcast: zenith three times the horizon).
    rows = np.where(up > 0, sky * (1.0 + 2.0 * np.maximum(up, 0.0)) / 3.0, bounce[None])
    weight = np.cos(elevation)
    mean = float((rows @ _LUMINANCE * weight).sum() / weight.sum())
    return np.broadcast_to((rows / max(mean, 1e-6))[:, None, :], (height, width, 3)).astype(np.float32)


def write_environment(path: Path, environment: NDArray[np.float32]) -> None:
    """Write ``environment`` as 32-bit EXR. Raises InputError when it cannot be written."""
    height, width, channels = environment.shape
    spec = oiio.ImageSpec(width, height, channels, "float")
    spec.attribute("compression", "zip")
    output = oiio.ImageOutput.create(str(path))
    written = (
        output is not None
        and output.open(str(path), spec)
        and output.write_image(np.ascontiguousarray(environment))
        and output.close()
    )
    if not written:
        raise InputError(f"{path}: cannot be written ({oiio.geterror() or 'no space?'}); choose another folder")


def sun(
    camera: Camera, pixels: NDArray[np.uint8], masks: Sequence[Mask], shadows: Sequence[Mask], heights: Sequence[float]
) -> tuple[Vector, float, bool]:
    """Direction to the sun (unit), its strength, and whether the shadows told them.

    heights: of the objects in the camera's units. A shadow's centre lies about half a shadow length from the foot of
    an object, and the shadow is height / tan(elevation) long.
    """
    for mask, shadow, tall in zip(masks, shadows, heights, strict=True):
        ratio = lit_over_shaded(pixels, mask, shadow)
        if ratio is None or ratio < 1.25 or shadow.sum() < 0.04 * mask.sum():
            continue
        foot = on_ground(camera, _foot(mask))
        rows, columns = np.nonzero(shadow)
        cast = on_ground(camera, np.column_stack([columns + 0.5, rows + 0.5]))
        cast = cast[np.isfinite(cast).all(axis=1)]
        if len(cast) < 30:
            continue
        offset = (np.median(cast, axis=0) - foot)[:2]
        length = 2.0 * float(np.linalg.norm(offset))
        if length < 0.3 * tall:
            continue  # all around the contact: soft light from above
        elevation = float(np.clip(math.atan2(tall, length), math.radians(20), math.radians(75)))
        flat = -offset / np.linalg.norm(offset) * math.cos(elevation)
        direction = np.array([flat[0], flat[1], math.sin(elevation)])
        return _unit(direction), float(np.clip(ratio - 1.0, 0.2, 5.0)), True
    return _unit(np.array(DEFAULT_SUN)), 0.6, False


def _foot(mask: Mask) -> NDArray[np.float64]:
    rows, columns = np.nonzero(mask)
    low = rows > np.percentile(rows, 90)
    return np.array([columns[low].mean() + 0.5, float(np.percentile(rows, 97)) + 0.5])


def _unit(vector: NDArray[np.float64]) -> Vector:
    x, y, z = (float(v) for v in vector / np.linalg.norm(vector))
    return (x, y, z)
