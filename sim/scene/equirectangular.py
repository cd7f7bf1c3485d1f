# SPDX-License-Identifier: MIT
"""Equirectangular environment maps in linear light: directions, solid angles, irradiance.

Row 0 is the zenith, the middle column looks along +X, and columns to its right turn to the right, as in Blender. Needs
only numpy: the extension imports this when it is enabled, and Blender may lack image libraries.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Radiance = NDArray[np.float32]
"""(H, 2 H, 3), linear Rec. 709."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
FRAMES = ("ahead", "camera", "world")
"""Direction of a file's centre: ahead of the camera with a level horizon; along the camera's axis, as in
DiffusionLight; or along the scene's +X."""


def directions(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the world direction (H, W, 3) and solid angle (H, W) in sr of each pixel of a map."""
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * math.pi
    edges = np.sin((0.5 - np.arange(height + 1) / height) * math.pi)
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
    x = np.cos(latitude)[:, None] * np.cos(azimuth)
    y = np.cos(latitude)[:, None] * np.sin(azimuth)
    z = np.broadcast_to(np.sin(latitude)[:, None], x.shape)
    solid = np.broadcast_to(((edges[:-1] - edges[1:]) * 2 * math.pi / width)[:, None], x.shape)
    return np.stack([x, y, z], axis=-1), solid


def irradiance(radiance: NDArray[np.floating], normal: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the RGB irradiance (3,) of a map (H, W, 3) on open ground with unit ``normal``."""
    towards, solid = directions(*radiance.shape[:2])
    cosine = np.clip(towards @ np.asarray(normal, dtype=float), 0.0, None)
    return np.einsum("hwc,hw,hw->c", radiance[..., :3].astype(np.float64), cosine, solid)
