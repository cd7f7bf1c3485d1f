# SPDX-License-Identifier: MIT
"""Depth of field: what leaves the plane of focus becomes blurred.

The blur that things had where they stood is in their colours. Only what is added by moving is applied; what was
blurred and comes into focus cannot become sharp, because the photo does not show it so.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera
from .blur import disc, varied
from .layers import ObjectLayer

SENSOR_MM = 36.0
"""Width of the sensor that f-numbers refer to, as in Blender: full frame."""


def blur_radius(
    camera: Camera, depth: NDArray[np.floating], focus: NDArray[np.floating] | float, f_number: float
) -> NDArray[np.float64]:
    """Radius of the circle of confusion in pixels of the photo, of points at ``depth`` (N,), the focus at ``focus``.

    Both in metres along the optical axis. Thin lens: c = A f |d − F| / (d (F − f)), A = f / N (for instance Potmesil
    and Chakravarty, "A lens and aperture camera model", SIGGRAPH 1981), infinite behind the lens.
    """
    focal = camera.fx / camera.width * SENSOR_MM * 1e-3
    sharp = np.maximum(np.asarray(focus, dtype=np.float64), 1.01 * focal)
    far = np.maximum(np.asarray(depth, dtype=np.float64), 1e-6)
    diameter = focal**2 / f_number * np.abs(far - sharp) / (far * (sharp - focal))
    return np.asarray(0.5 * diameter / (SENSOR_MM * 1e-3) * camera.width)


def added_radius(now: NDArray[np.floating], rest: NDArray[np.floating]) -> NDArray[np.float64]:
    """The blur that turns one of radius ``rest`` into one of ``now``; variances add. None where it would be less."""
    return np.sqrt(np.maximum(np.asarray(now, np.float64) ** 2 - np.asarray(rest, np.float64) ** 2, 0.0))


def defocused(layer: ObjectLayer, radius: NDArray[np.float32]) -> ObjectLayer:
    """``layer`` blurred by discs of ``radius`` (H, W) pixels; 0 leaves it exactly. Light is smooth already."""
    both = varied(np.concatenate([layer.texture, layer.alpha[..., None]], axis=-1), radius, disc)
    return dataclasses.replace(layer, texture=both[..., :3], alpha=both[..., 3])
