# SPDX-License-Identifier: MIT
"""Spatially varying blur, depth of field, and object outlines as soft as the photo's.

Depth of field adds only the blur gained by moving: an object's own blur is already in its colours, and what is blurred
in the photo cannot be sharpened. A rendered outline is one pixel sharp, a photographed one two or three; colours inside
the outline are the photo's own and are blurred only where magnification would show its pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera
from ..srgb import Linear
from .compositing import ObjectLayer

Image = NDArray[np.float32]
LEAST_PX = 0.25
"""Blur below this is invisible and not applied."""
STEP = 1.5
"""Ratio of successive blur levels; in between, blurred images are interpolated."""


def varying_blur(image: Image, strength: Image, blur: Callable[[Image, float], Image], most: float = 48.0) -> Image:
    """Return ``image`` (H, W, C) blurred by ``strength`` (H, W) pixels, up to ``most``; 0 leaves a pixel exactly.

    blur: returns an image blurred uniformly by a strength in pixels.
    """
    strongest = min(float(strength.max(initial=0.0)), most)
    if strongest < LEAST_PX:
        return image
    levels = [LEAST_PX]
    while levels[-1] < strongest:
        levels.append(levels[-1] * STEP)
    result, below_image, below = image, image, 0.0
    for level in levels:
        here = blur(image, level)
        share = np.clip((strength - below) / (level - below), 0.0, 1.0)[..., None]
        # Strengths beyond ``level`` are overwritten by the next round.
        result = np.where(strength[..., None] > below, below_image + (here - below_image) * share, result)
        below_image, below = here, level
    return np.asarray(result, dtype=np.float32)


def gaussian_blur(image: Image, sigma_x: float, sigma_y: float | None = None) -> Image:
    """Return ``image`` (H, W, C) under a Gaussian of these standard deviations in pixels."""
    blurred = cv2.GaussianBlur(image, (0, 0), sigma_x, sigmaY=sigma_y or sigma_x, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32).reshape(image.shape)


def disc_blur(image: Image, radius: float) -> Image:
    """Return ``image`` (H, W, C) under the disc of a circular aperture of ``radius`` pixels, with a smooth edge."""
    reach = int(np.ceil(radius + 0.5))
    axis = np.arange(-reach, reach + 1)
    kernel = np.clip(radius + 0.5 - np.hypot(*np.meshgrid(axis, axis)), 0.0, 1.0)
    blurred = cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32).reshape(image.shape)


SENSOR_MM = 36.0
"""Sensor width that f-numbers refer to, as in Blender: full frame."""


def blur_radius(
    camera: Camera, depth: NDArray[np.floating], focus: NDArray[np.floating] | float, f_number: float
) -> NDArray[np.float64]:
    """Return the circle of confusion's radius (N,) in photo pixels of points at ``depth`` (N,), focused at ``focus``.

    Both in metres along the optical axis. Thin lens: c = A f |d − F| / (d (F − f)), A = f / N (Potmesil and
    Chakravarty, "A lens and aperture camera model", SIGGRAPH 1981).
    """
    focal = camera.fx / camera.width * SENSOR_MM * 1e-3
    sharp = np.maximum(np.asarray(focus, dtype=np.float64), 1.01 * focal)
    far = np.maximum(np.asarray(depth, dtype=np.float64), 1e-6)
    diameter = focal**2 / f_number * np.abs(far - sharp) / (far * (sharp - focal))
    return np.asarray(0.5 * diameter / (SENSOR_MM * 1e-3) * camera.width)


def added_radius(now: NDArray[np.floating], rest: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the blur that turns one of radius ``rest`` into ``now``; variances add. 0 where ``now`` is less."""
    return np.sqrt(np.maximum(np.asarray(now, np.float64) ** 2 - np.asarray(rest, np.float64) ** 2, 0.0))


def defocused(layer: ObjectLayer, radius: NDArray[np.float32]) -> ObjectLayer:
    """Return ``layer`` blurred by discs of ``radius`` (H, W) pixels; 0 leaves it exactly. Light is smooth already."""
    both = varying_blur(np.concatenate([layer.texture, layer.alpha[..., None]], axis=-1), radius, disc_blur)
    return dataclasses.replace(layer, texture=both[..., :3], alpha=both[..., 3])


PIXEL_VARIANCE = 1 / 12
"""Variance of a pixel's box, px²: the blur of a rendered outline."""
SCALES = (1.0, 2.0)
DIFFERENCE_VARIANCE = 1 / 3
"""Variance of the central difference, a box two pixels wide, px²."""
OUTLINE_REACH_PX = 3
SQUARES = 0.4
"""Blur standard deviation over the side of a magnified pixel at which its square is no longer visible."""
STRONGEST = 0.4
"""Share of the strongest edge pixels that is used: weak edges are shading and texture."""
FEWEST = 24
MOST_SIGMA = 6.0


def outline_sigma(photo: Linear, mask: NDArray[np.bool_]) -> float | None:
    """Return the standard deviation in pixels of the photo's blur along the outline of ``mask`` (H, W), or None.

    None where there are too few edges. The ratio of an edge's gradients under two known blurs gives its own width: Zhuo
    and Sim, "Defocus map estimation from a single image", Pattern Recognition 44 (2011), equation 6.
    """
    inner = mask.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    near = cv2.dilate(inner, kernel, iterations=OUTLINE_REACH_PX) > cv2.erode(
        inner, kernel, iterations=OUTLINE_REACH_PX
    )
    if not near.any():
        return None
    rows, columns = np.nonzero(near)
    margin = 12
    window = (
        slice(max(0, rows.min() - margin), rows.max() + margin + 1),
        slice(max(0, columns.min() - margin), columns.max() + margin + 1),
    )
    grey = np.asarray(photo[window].mean(axis=-1), dtype=np.float32)
    dx, dy = _gradient(gaussian_blur(grey, SCALES[0]))
    fine, wide = _strength(dx, dy), _strength(*_gradient(gaussian_blur(grey, SCALES[1])))
    length = np.maximum(fine, np.float32(1e-9))
    across: tuple[Image, Image] = (np.asarray(dx / length), np.asarray(dy / length))
    sides = _beside(fine, across)
    peaks = near[window] & (fine > sides[0]) & (fine >= sides[1])
    if peaks.sum() < FEWEST:
        return None
    strength = _crest(fine, sides, peaks)
    blurred = _crest(wide, _beside(wide, across), peaks)
    strong = strength >= np.quantile(strength, 1.0 - STRONGEST)
    squared = (strength[strong] / np.maximum(blurred[strong], 1e-9)) ** 2
    # A central difference along x or y blurs a diagonal edge less.
    cosine, sine = (v[peaks][strong] for v in across)
    first, second = (scale**2 + DIFFERENCE_VARIANCE * (cosine**4 + sine**4) for scale in SCALES)
    variance = (second - squared * first) / np.maximum(squared - 1.0, 1e-3)
    return float(np.sqrt(np.clip(np.median(variance), PIXEL_VARIANCE, MOST_SIGMA**2)))


def _gradient(grey: Image) -> tuple[Image, Image]:
    kernel = np.array([[-0.5, 0.0, 0.5]])
    return (
        np.asarray(cv2.filter2D(grey, -1, kernel, borderType=cv2.BORDER_REPLICATE)),
        np.asarray(cv2.filter2D(grey, -1, kernel.T, borderType=cv2.BORDER_REPLICATE)),
    )


def _strength(dx: Image, dy: Image) -> Image:
    return np.asarray(np.hypot(dx, dy), dtype=np.float32)


def _beside(strength: Image, across: tuple[Image, Image]) -> tuple[Image, Image]:
    """Return ``strength`` (H, W) one pixel ahead and one behind along unit vectors ``across``."""
    rows, columns = np.indices(strength.shape, dtype=np.float32)

    def at(steps: float) -> Image:
        x, y = columns + np.float32(steps) * across[0], rows + np.float32(steps) * across[1]
        return np.asarray(cv2.remap(strength, x, y, cv2.INTER_CUBIC), dtype=np.float32)

    return at(1.0), at(-1.0)


def _crest(strength: Image, sides: tuple[Image, Image], peaks: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the gradient's subpixel maximum at ``peaks`` (N,): an edge's is a Gaussian, its log a parabola."""
    here, ahead, behind = (np.log(np.maximum(np.asarray(v[peaks], np.float64), 1e-9)) for v in (strength, *sides))
    bend = np.maximum(2.0 * here - ahead - behind, 1e-3)
    return np.asarray(np.exp(here + np.minimum((ahead - behind) ** 2 / (8.0 * bend), 0.25)))


def soften_outlines(layer: ObjectLayer, sigma: NDArray[np.float32], moved: NDArray[np.float32]) -> ObjectLayer:
    """Return ``layer`` with outlines blurred to ``sigma`` (H, W), weighted by ``moved`` (H, W, 0 to 1).

    Where ``moved`` is 0 nothing changes. Only coverage is blurred; colours inside stay and continue beyond the outline.
    """
    added = np.sqrt(np.maximum(sigma**2 - PIXEL_VARIANCE, 0.0)) * (moved > 0)
    alpha = layer.alpha[..., None]
    both = varying_blur(np.concatenate([layer.texture, alpha], axis=-1), added.astype(np.float32), gaussian_blur)
    soft = layer.alpha + (both[..., 3] - layer.alpha) * moved
    # A barely covered pixel takes its neighbours' colour.
    beyond = both[..., :3] / np.maximum(both[..., 3:], 1e-6)
    own = layer.texture / np.maximum(alpha, 1e-6)
    colour = beyond + (own - beyond) * alpha
    texture = np.where((moved > 0)[..., None], colour * soft[..., None], layer.texture)
    return dataclasses.replace(
        layer, texture=texture.astype(np.float32), alpha=np.where(moved > 0, soft, layer.alpha).astype(np.float32)
    )


def soften_squares(layer: ObjectLayer, magnification: NDArray[np.float32]) -> ObjectLayer:
    """Return ``layer`` blurred so that photo pixels magnified ``magnification`` (H, W) times do not show as squares.

    Only colours are blurred; up to magnification 1 they stay exactly.
    """
    sigma = SQUARES * np.sqrt(np.maximum(magnification**2 - 1.0, 0.0))
    alpha = layer.alpha[..., None]
    both = varying_blur(np.concatenate([layer.texture, alpha], axis=-1), sigma.astype(np.float32), gaussian_blur)
    colour = both[..., :3] / np.maximum(both[..., 3:], 1e-6)
    blurred = (sigma > 0)[..., None] & (both[..., 3:] > 1e-6)
    texture = np.where(blurred, colour * alpha, layer.texture)
    return dataclasses.replace(layer, texture=texture.astype(np.float32))
