# SPDX-License-Identifier: MIT
"""Models of an object's and the ground's colours and texture, and the cut of least cost between the two.

OpenCV's grabCut holds a fast max-flow solver for pixel grids (Boykov & Kolmogorov, PAMI 2004), but computes the
pixels' costs from its own colour models. With models frozen to one Gaussian each, equal but for their means along the
first channel, the difference of the two costs is linear in that channel, so arbitrary unary costs can be passed
through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .box_crop import BoxCrop
from .mask_geometry import Mask

Features = NDArray[np.float32]

OBJECT_PARTS, GROUND_PARTS = 5, 7
"""Gaussians of which the two models consist at most."""
SAMPLES = 6000
"""Largest number of pixels to learn from."""
PLACE = 18.0
"""Distance (CIELAB units) that the length of the crop adds to a background colour."""
REACH = 0.8
"""Standard deviation over which ground looks alike, over half the crop."""
SHADES = (0.7, 0.45, 0.28, 0.15)
"""Factors (linear light) of shaded ground on the ground's colour."""
SHADE_COST = 1.2
"""Log likelihood penalty of shaded ground: shadows are rarer."""
SMOOTHNESS = 4.0
"""Cost of a pixel of outline across equal colours, in log likelihood."""
LEVELS = 60.0
"""Grey values over which the costs are spread; few, because their differences count as contrast too."""
LIMIT = 10.0
"""Log likelihood ratios are clipped here."""


@dataclass(frozen=True)
class ColourModel:
    """A mixture of ``k`` Gaussians over ``d`` features.

    weights: (k,), sum 1. means: (k, d). precisions: (k, d, d) inverse covariances. log_norms: (k,).
    """

    weights: NDArray[np.float64]
    means: NDArray[np.float64]
    precisions: NDArray[np.float64]
    log_norms: NDArray[np.float64]

    def log_likelihood(self, features: Features) -> NDArray[np.float32]:
        """Natural logarithm of the density (n,) at ``features`` (n, d)."""
        terms = np.empty((len(self.weights), len(features)), dtype=np.float32)
        # One row a feature: five times faster than one row a pixel.
        rows = np.ascontiguousarray(features.T)
        for index, (mean, precision) in enumerate(zip(self.means, self.precisions, strict=True)):
            # Whitened: a plain sum of squares is several times faster than a quadratic form.
            white = np.linalg.cholesky(precision).astype(np.float32).T @ (rows - mean.astype(np.float32)[:, None])
            squares = np.square(white, out=white).sum(axis=0)
            terms[index] = np.log(self.weights[index]) + self.log_norms[index] - 0.5 * squares
        top = terms.max(axis=0)
        return np.asarray(top + np.log(np.exp(terms - top).sum(axis=0)), dtype=np.float32)


def learn(features: Features, parts: int, spread: float | Sequence[float] = 3.0, seed: int = 0) -> ColourModel:
    """Fit at most ``parts`` Gaussians to ``features`` (n, d) by k-means, as GrabCut does.

    spread: least standard deviation of every Gaussian, in units of the features, one for all or (d,). Raises ValueError
    for no pixels.
    """
    if len(features) == 0:
        raise ValueError("no pixels to learn colours from")
    picked = np.ascontiguousarray(features[:: max(1, len(features) // SAMPLES)], dtype=np.float32)
    parts = max(1, min(parts, len(picked) // 20))
    cv2.setRNGSeed(seed)  # k-means starts from random centres; equal pixels must give equal models
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 12, 0.5)
    _, labels, _ = cv2.kmeans(picked, parts, np.empty((0, 0), dtype=np.int32), stop, 1, cv2.KMEANS_PP_CENTERS)
    weights, means, precisions, norms = [], [], [], []
    dimensions = picked.shape[1]
    for index in range(parts):
        members = picked[labels[:, 0] == index].astype(np.float64)
        if len(members) == 0:
            continue
        mean = members.mean(axis=0)
        covariance = (members - mean).T @ (members - mean) / len(members) + np.diag(
            np.broadcast_to(np.square(spread), dimensions)
        )
        weights.append(len(members) / len(picked))
        means.append(mean)
        precisions.append(np.linalg.inv(covariance))
        norms.append(-0.5 * (dimensions * np.log(2.0 * np.pi) + np.linalg.slogdet(covariance)[1]))
    return ColourModel(np.array(weights), np.array(means), np.array(precisions), np.array(norms))


def ground_likelihood(view: BoxCrop, where: Mask, asked: Mask, shades: Sequence[float] = SHADES) -> NDArray[np.float32]:
    """Return the log likelihood (n,) that the pixels ``asked`` (h, w) look like nearby pixels of ``where`` (h, w), lit
    or shaded."""
    height, width = where.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32) / max(height, width) * (PLACE * 2.0)
    features = np.dstack([view.lab, view.texture, columns, rows])
    # The ground inside the box is up to half the box' width away from the learned pixels.
    lit = learn(features[where], GROUND_PARTS, (3.0, 3.0, 3.0, 3.0, REACH * PLACE, REACH * PLACE))
    queried = features[asked]
    best = lit.log_likelihood(queried)
    for shade in shades:
        best = np.maximum(best, _shaded(lit, shade).log_likelihood(queried) - SHADE_COST)
    # The model has two more features than the object's, the position; spread over the crop they cost a constant.
    return best + np.float32(2.0 * np.log(2.0 * PLACE))


def _shaded(model: ColourModel, shade: float) -> ColourModel:
    """``model`` with all colours darkened: CIELAB scales with the cube root of light, and so does its spread."""
    factor = shade ** (1.0 / 3.0)
    means = model.means.copy()
    # L* = 116 f - 16, while a* and b* have no offset.
    means[:, 0] = (means[:, 0] + 16.0) * factor - 16.0
    means[:, 1:3] *= factor
    means[:, 3] *= factor
    return ColourModel(model.weights, means, model.precisions, model.log_norms)


def graph_cut(
    ratio: NDArray[np.float32],
    contrast: NDArray[np.uint8],
    smoothness: float,
    *,
    barred: Mask,
    certain: Mask | None = None,
) -> Mask:
    """Return the mask (H, W) of least cost.

    ratio: (H, W) log likelihood ratio of object to background. contrast: (H, W, 2) two channels whose differences
    attract the outline. smoothness: cost of a pixel of outline across equal colours, at least 1, in units of ``ratio``.
    barred: certainly not the object. certain: certainly the object.
    """
    level = (np.clip(ratio, -LIMIT, LIMIT) + LIMIT) / (2.0 * LIMIT) * LEVELS
    image = np.dstack([np.round(level).astype(np.uint8), contrast])
    # grabCut's smoothness is 50: costs are made as large as that asks. Between the two ends lies LEVELS² / variance.
    variance = LEVELS**2 / (2.0 * LIMIT * 50.0 / smoothness)
    rest, own = _single_gaussian(0.0, variance), _single_gaussian(LEVELS, variance)
    labels = np.where(ratio > 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[barred] = cv2.GC_BGD
    if certain is not None:
        labels[certain & ~barred] = cv2.GC_FGD
    cv2.grabCut(np.ascontiguousarray(image), labels, (0, 0, 1, 1), rest, own, 1, cv2.GC_EVAL_FREEZE_MODEL)
    return np.asarray((labels & 1).astype(bool))


def _single_gaussian(mean: float, variance: float) -> NDArray[np.float64]:
    """grabCut's model: 5 weights, 5 means of 3 numbers, 5 covariances of 9; only the first is used."""
    model = np.zeros((1, 65))
    model[0, 0] = 1.0
    model[0, 5] = mean
    # Neutralise the other two channels: equal means and a wide spread in both models.
    model[0, 20:29] = np.diag([variance, 1e8, 1e8]).ravel()
    return model


def principal_contrast(lab: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the first two principal components (h, w, 2) of colour."""
    flat = lab.reshape(-1, 3)
    away = flat - flat.mean(axis=0)
    vectors = np.linalg.eigh(away.T @ away)[1]
    projected = away @ vectors[:, :0:-1]
    return np.asarray(np.clip(projected + 128.0, 0, 255).astype(np.uint8).reshape(*lab.shape[:2], 2))
