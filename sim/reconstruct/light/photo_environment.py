# SPDX-License-Identifier: MIT
"""Light from all around, guessed from the photo: a soft sky, what the photo shows of its surroundings, the ground.

The photo's colours already hold the real light, so only tint, gradient and direction matter here: the map's mean
luminance is 1.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.transfer import bytes_to_linear
from ...scene.equirectangular import LUMINANCE, directions
from ...scene.model import Camera

SIZE = (64, 32)
BLUR = 0.04
"""Of the photo's longer side: surroundings are light, not pictures."""
EDGE = 0.12
"""Of the photo's sides, over which what it shows gives way to the guess beyond."""


def photo_environment(pixels: NDArray[np.uint8], background: NDArray[np.uint8], camera: Camera) -> NDArray[np.float32]:
    """Equirectangular environment (32, 64, 3) in linear light with mean luminance 1 (``sim/scene/equirectangular``).

    pixels, background: (H, W, 3) sRGB, with and without objects. camera: above the ground z = 0, without roll.
    """
    behind = bytes_to_linear(background)
    light = bytes_to_linear(pixels[::4, ::4]).reshape(-1, 3).astype(np.float64)
    luminance = light @ LUMINANCE
    bright = light[luminance >= np.percentile(luminance, 85)].mean(axis=0)
    white = max(float(bright @ LUMINANCE), 1e-4)
    # A lamp is seldom as coloured as the things it lights: pull its tint halfway to white.
    sky = 0.5 * bright / white + 0.5
    horizon = camera.cy + camera.fy * float(np.tan(np.arcsin(np.clip(camera.world_from_camera[2][2], -1.0, 1.0))))
    ground = behind[int(np.clip(horizon, 0, behind.shape[0])) :: 4, ::4].reshape(-1, 3)
    bounce = (ground.mean(axis=0) if len(ground) else light.mean(axis=0)) / white
    width, height = SIZE
    towards, solid = directions(height, width)
    up = towards[..., 2:]
    # Brighter towards the zenith, as rooms and overcast skies are (CIE overcast: zenith three times the horizon).
    radiance = np.where(up > 0, sky * (1.0 + 2.0 * np.maximum(up, 0.0)) / 3.0, bounce)
    seen, share = _seen(behind, camera, towards)
    share = share * (up > 0)
    radiance = radiance * (1.0 - share) + seen / white * share
    mean = float(((radiance @ LUMINANCE) * solid).sum() / solid.sum())
    return (radiance / mean if mean > 1e-6 else np.ones_like(radiance)).astype(np.float32)


def _seen(
    behind: NDArray[np.float32], camera: Camera, towards: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the photo shows in the directions ``towards`` (h, w, 3): light (h, w, 3), and whether it does (h, w, 1)."""
    height, width = behind.shape[:2]
    pixels = camera.project(camera.position + towards)
    x, y = pixels[..., 0], pixels[..., 1]
    # In a small picture, where a blur over a large part of it is cheap.
    small = cv2.resize(behind, (max(8, min(width, 128)), max(8, min(height, 128))), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), BLUR * max(small.shape[:2]))
    column = np.clip(np.nan_to_num(x * small.shape[1] / width - 0.5), -1e3, 1e3).astype(np.float32)
    row = np.clip(np.nan_to_num(y * small.shape[0] / height - 0.5), -1e3, 1e3).astype(np.float32)
    light = np.asarray(cv2.remap(blurred, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    with np.errstate(invalid="ignore"):
        margin = np.minimum.reduce([x / width, 1 - x / width, y / height, 1 - y / height])
        inside = np.where(pixels[..., 2] > 0, np.clip(margin / EDGE, 0.0, 1.0), 0.0)
    return light.astype(np.float64), np.nan_to_num(inside)[..., None]
