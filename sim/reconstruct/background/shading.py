# SPDX-License-Identifier: MIT
"""Light that changes slowly over a surface, told from the surface's own pattern.

Light and reflectance multiply, so they are told apart in logarithms of the photo's values. Where an object is taken
out, its surroundings still lack the light that it took from them beyond the edge of what counts as its shadow. That
lack fades away from the hole; what it is at the edge is estimated with the rest, so that it is not carried inside.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

DARKEST = 6.0
"""Of 255; below, logarithms show the noise of black rather than light."""
FIELD_PIXELS = 6_000
"""Of the copy on which fields are fitted."""
PULL = 1e-3
"""Of all weights to zero, over the weight of the data."""
DEGREE = 2
"""Of the polynomial; higher ones run away where little is seen."""
FADING = (0.06, 0.2, 0.6)
"""Distances over the hole's size at which parts of the lack of light have fallen to 1/e."""
CHANCE = (0.05, 0.2)
"""Share of the variance left over by the field that a lack of light explains: by chance; beyond doubt."""
MOST_LACK = 0.12
"""Logarithm; what lacks more light than this counts as shadow, and is in the hole."""


def logarithms(picture: Picture) -> Picture:
    """Of values 0 to 255."""
    return np.log(np.maximum(picture, DARKEST))


def light_field(logs: Picture, known: Mask, hole: Mask) -> tuple[Picture, Picture]:
    """Slow part (h, w, c) of ``logs`` (h, w, c) as a polynomial, and the lack of light around ``hole`` (h, w, 1), <= 0.

    logs: logarithms, of which ``known`` (h, w) are true. The lack is 0 within the hole.
    """
    scale = min(1.0, float(np.sqrt(FIELD_PIXELS / known.size)))
    size = (max(8, round(known.shape[1] * scale)), max(8, round(known.shape[0] * scale)))
    share, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    small = cv2.resize(np.where(known[..., None], logs, 0.0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    seen, inside = share > 0.6, cut > 0.5
    rows, columns = np.meshgrid(np.linspace(-1, 1, size[1]), np.linspace(-1, 1, size[0]), indexing="ij")
    away = ndimage.distance_transform_edt(~inside) if inside.any() else np.full(inside.shape, 1e6)
    side = float(np.sqrt(max(int(inside.sum()), 1)))
    fading = [np.exp(-np.maximum(away - 0.5, 0.0) / max(part * side, 0.5)) for part in FADING]
    terms = [rows**i * columns**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    every = np.stack([*terms, *fading], axis=-1)
    count = len(terms)
    if seen.sum() < 4 * every.shape[-1]:
        mean = small.sum(axis=(0, 1)) / max(float(share.sum()), 1e-6)
        return np.broadcast_to(mean, logs.shape).astype(np.float32), np.zeros((*known.shape, 1), np.float32)
    basis, target = every[seen], (small[seen] / share[seen][:, None]).astype(np.float64)
    field, lack = _fitted(basis, target, count)
    slow = np.tensordot(every[..., :count], field, axes=1).astype(np.float32)
    lost = np.maximum(every[..., count:] @ lack, -MOST_LACK).astype(np.float32)
    whole = (known.shape[1], known.shape[0])
    lost = np.asarray(cv2.resize(lost, whole, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    lost[hole] = 0.0
    return np.asarray(cv2.resize(slow, whole, interpolation=cv2.INTER_LINEAR), dtype=np.float32), lost[..., None]


def _fitted(
    basis: NDArray[np.float64], target: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of the first ``count`` columns for each channel, (count, c), and of the others for all alike, <= 0."""
    weights = np.ones(len(basis))
    lack = np.zeros(basis.shape[1] - count)
    field = np.zeros((count, target.shape[1]))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        # Light that lacks, lacks in all channels alike: it is told from their mean.
        mean = target.mean(axis=1)
        # A weak pull to zero: where little is seen, powers must not swing up in the hole.
        pull = np.sqrt(PULL * len(basis)) * np.eye(basis.shape[1])
        pull[0, 0] = 0.0
        bounds = (np.full(basis.shape[1], -np.inf), np.concatenate([np.full(count, np.inf), np.full(len(lack), 1e-9)]))
        solved = optimize.lsq_linear(
            np.concatenate([basis * root, pull]), np.concatenate([mean * root[:, 0], np.zeros(len(pull))]), bounds
        )
        alone = optimize.lsq_linear(
            np.concatenate([basis[:, :count] * root, pull[:count, :count]]),
            np.concatenate([mean * root[:, 0], np.zeros(count)]),
        )
        # Patterns may be darker around the hole by chance: it must explain a good part of what the field leaves over.
        gained = 1.0 - solved.cost / max(alone.cost, 1e-12)
        lack = solved.x[count:] * np.clip((gained - CHANCE[0]) / (CHANCE[1] - CHANCE[0]), 0.0, 1.0)
        without = target - (basis[:, count:] @ lack)[:, None]
        powers = basis[:, :count] * root
        squares = powers.T @ powers + PULL * len(basis) * np.diag([0.0] + [1.0] * (count - 1))
        field = np.linalg.solve(squares, powers.T @ (without * root))
        error = np.abs(without - basis[:, :count] @ field).mean(axis=1)
        # What stands out (things that lie about) has no say.
        weights = 1.0 / (1.0 + np.square(error / (2.5 * max(float(np.median(error)), 1e-3))))
    return field, lack
