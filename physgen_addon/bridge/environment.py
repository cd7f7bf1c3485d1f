# SPDX-License-Identifier: GPL-3.0-or-later
"""How strongly an environment map lights the ground. Needs no bpy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def environment_irradiance(radiance: NDArray[np.floating], normal: NDArray[np.floating]) -> NDArray[np.float64]:
    """RGB irradiance (3,) of an equirectangular map (H, W, 3) on open ground with unit ``normal``.

    The map's middle column looks along +X, as Blender has it.
    """
    directions, solid_angle = _directions(*radiance.shape[:2])
    cosine = np.clip(directions @ np.asarray(normal, dtype=float), 0.0, None)
    return np.einsum("hwc,hw,hw->c", radiance[..., :3].astype(np.float64), cosine, solid_angle)


def _directions(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World direction (H, W, 3) and solid angle (H, W) of each pixel of an equirectangular map, row 0 on top.

    Blender: u = 1/2 - atan2(y, x) / 2π, v = 1/2 + latitude / π.
    """
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * math.pi
    edges = np.sin((0.5 - np.arange(height + 1) / height) * math.pi)
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
    x = np.cos(latitude)[:, None] * np.cos(azimuth)
    y = np.cos(latitude)[:, None] * np.sin(azimuth)
    z = np.broadcast_to(np.sin(latitude)[:, None], x.shape)
    solid = np.broadcast_to(((edges[:-1] - edges[1:]) * 2 * math.pi / width)[:, None], x.shape)
    return np.stack([x, y, z], axis=-1), solid
