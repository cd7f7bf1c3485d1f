# SPDX-License-Identifier: MIT
"""Mixtures of Gaussians over colours: how likely a colour is on an object, or on what surrounds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Features = NDArray[np.float32]

SAMPLES = 6000
"""At most this many pixels are learned from: more tell no more."""


@dataclass(frozen=True)
class ColourModel:
    """A mixture of ``k`` Gaussians over features of ``d`` numbers.

    weights: (k,), sum 1. means: (k, d). precisions: (k, d, d) inverse covariances. log_norms: (k,).
    """

    weights: NDArray[np.float64]
    means: NDArray[np.float64]
    precisions: NDArray[np.float64]
    log_norms: NDArray[np.float64]

    def log_likelihood(self, features: Features) -> NDArray[np.float32]:
        """Natural logarithm of the density (n,) at ``features`` (n, d)."""
        terms = np.empty((len(self.weights), len(features)), dtype=np.float32)
        for index, (mean, precision) in enumerate(zip(self.means, self.precisions, strict=True)):
            # Whitened: a plain sum of squares is several times faster than a quadratic form.
            white = (features - mean.astype(np.float32)) @ np.linalg.cholesky(precision).astype(np.float32)
            squares = np.square(white).sum(axis=1)
            terms[index] = np.log(self.weights[index]) + self.log_norms[index] - 0.5 * squares
        top = terms.max(axis=0)
        return np.asarray(top + np.log(np.exp(terms - top).sum(axis=0)), dtype=np.float32)


def learn(features: Features, parts: int, spread: float | Sequence[float] = 3.0, seed: int = 0) -> ColourModel:
    """Cluster ``features`` (n, d) into at most ``parts`` Gaussians (k-means, as GrabCut does).

    spread: standard deviation that every Gaussian has at least, in units of the features, one for all or (d,). Raises
    ValueError for no pixels.
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
