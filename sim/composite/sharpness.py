# SPDX-License-Identifier: MIT
"""How sharp the photo is along an object's outline, and rendered outlines as soft as that.

A rendered outline is as sharp as a pixel's area allows; a lens and a sensor draw it over two or three pixels. The
colours within are the photo's own and need nothing, unless they come nearer and their pixels would show as squares.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from .blur import Image, gaussian, varied
from .layers import ObjectLayer
from .transfer import Linear

PIXEL_VARIANCE = 1 / 12
"""Variance of a pixel's area, px²: the blur that a rendered outline has."""
SCALES = (1.0, 2.0)
DIFFERENCE_VARIANCE = 1 / 3
"""Variance of the central difference, a box two pixels wide, px²."""
OUTLINE_REACH_PX = 3
SQUARES = 0.4
"""Standard deviation of the blur, over the side of a magnified pixel, under which squares can no longer be told."""
STRONGEST = 0.4
"""Share of the edge pixels that is believed: weak edges are shading and texture."""
FEWEST = 24
MOST_SIGMA = 6.0


def outline_sigma(photo: Linear, mask: NDArray[np.bool_]) -> float | None:
    """Standard deviation in pixels of the photo's blur along the outline of ``mask`` (H, W); None: too few edges.

    An edge's gradient falls with blur of known width by a ratio that tells its own width: Zhuo and Sim, "Defocus map
    estimation from a single image", Pattern Recognition 44 (2011), equation 6, here between two known widths.
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
    dx, dy = _gradient(gaussian(grey, SCALES[0]))
    fine, wide = _strength(dx, dy), _strength(*_gradient(gaussian(grey, SCALES[1])))
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
    # A central difference along x or y blurs a slanted edge less.
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
    """``strength`` (H, W) one pixel ahead and one behind along unit vectors ``across``."""
    rows, columns = np.indices(strength.shape, dtype=np.float32)

    def at(steps: float) -> Image:
        x, y = columns + np.float32(steps) * across[0], rows + np.float32(steps) * across[1]
        return np.asarray(cv2.remap(strength, x, y, cv2.INTER_CUBIC), dtype=np.float32)

    return at(1.0), at(-1.0)


def _crest(strength: Image, sides: tuple[Image, Image], peaks: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Height of the gradient at ``peaks`` (N,), between pixels too: an edge's is a Gaussian, its log a parabola."""
    here, ahead, behind = (np.log(np.maximum(np.asarray(v[peaks], np.float64), 1e-9)) for v in (strength, *sides))
    bend = np.maximum(2.0 * here - ahead - behind, 1e-3)
    return np.asarray(np.exp(here + np.minimum((ahead - behind) ** 2 / (8.0 * bend), 0.25)))


def soften_outlines(layer: ObjectLayer, sigma: NDArray[np.float32], moved: NDArray[np.float32]) -> ObjectLayer:
    """``layer`` with outlines as soft as ``sigma`` (H, W), where ``moved`` (H, W, 0 to 1) says; 0 leaves it exactly.

    Only coverage is blurred: colours inside stay, and beyond the outline they go on.
    """
    added = np.sqrt(np.maximum(sigma**2 - PIXEL_VARIANCE, 0.0)) * (moved > 0)
    alpha = layer.alpha[..., None]
    both = varied(np.concatenate([layer.texture, alpha], axis=-1), added.astype(np.float32), gaussian)
    soft = layer.alpha + (both[..., 3] - layer.alpha) * moved
    # Where little of a pixel is covered, its colour is its neighbours'.
    beyond = both[..., :3] / np.maximum(both[..., 3:], 1e-6)
    own = layer.texture / np.maximum(alpha, 1e-6)
    colour = beyond + (own - beyond) * alpha
    texture = np.where((moved > 0)[..., None], colour * soft[..., None], layer.texture)
    return dataclasses.replace(
        layer, texture=texture.astype(np.float32), alpha=np.where(moved > 0, soft, layer.alpha).astype(np.float32)
    )


def soften_squares(layer: ObjectLayer, magnification: NDArray[np.float32]) -> ObjectLayer:
    """``layer`` without the squares that photo pixels become when drawn ``magnification`` (H, W) times larger.

    Colours alone are blurred; up to 1, which no blur is needed for, they stay exactly.
    """
    sigma = SQUARES * np.sqrt(np.maximum(magnification**2 - 1.0, 0.0))
    alpha = layer.alpha[..., None]
    both = varied(np.concatenate([layer.texture, alpha], axis=-1), sigma.astype(np.float32), gaussian)
    colour = both[..., :3] / np.maximum(both[..., 3:], 1e-6)
    blurred = (sigma > 0)[..., None] & (both[..., 3:] > 1e-6)
    texture = np.where(blurred, colour * alpha, layer.texture)
    return dataclasses.replace(layer, texture=texture.astype(np.float32))
