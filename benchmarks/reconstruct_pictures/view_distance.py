# SPDX-License-Identifier: GPL-3.0-or-later
"""Distance between two views of a body: statistics of colour and gradients at several scales, no learned weights.

Two furs of one colour have no pixel in common and look alike; a mirrored face differs from fur in few pixels and looks
wrong. So not pixels are compared but what small neighbourhoods have in common (as metamers have: Portilla and
Simoncelli, A Parametric Texture Model Based on Joint Statistics of Complex Wavelet Coefficients, 2000; Freeman and
Simoncelli, Metamers of the Ventral Stream, 2011).

At each scale s = 0 … 3 of a Gaussian pyramid, and in each Gaussian window w of a fixed share of the picture:

- mean m (3,) and covariance C (3, 3) of CIE L*a*b*;
- e (4,) the root of the mean energy of the gradient along 0, 45, 90 and 135 degrees, L*, a* and b* together: first
  derivatives are steerable (Freeman and Adelson, 1991), and four directions are a histogram of oriented gradients;
- k the share of the window that the body covers, times ``COVER_UNITS``.

The distance of two windows is

    d² = |m - m'|² + tr C + tr C' - 2 tr (C^½ C' C^½)^½ + |e - e'|² + (k - k')²,

whose first part is the squared 2-Wasserstein distance of two normal distributions (Dowson and Landau, 1982); the
picture's is D = sqrt(mean over scales of the mean over windows of d²), windows weighted by the larger of both covers.
All terms are in units of Delta E (1976): D = 0 for equal statistics, and 2.3 would be a just noticeable difference of
plain colours. It is symmetric. Outside of both bodies everything has their common mean colour, so that no backdrop
has a part in it; outlines count through k alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

SCALES = 4
WINDOW = 1 / 16
"""Standard deviation of a window in sides of the picture."""
COVER_UNITS = 50.0
"""Delta E that a body and nothing are apart: as black and mid grey."""


@dataclass(frozen=True, eq=False)
class Look:
    """A body in a picture: ``pixels`` (n, n, 3) uint8 sRGB, meaningful where ``cover`` (n, n), 0 to 1, is above 0."""

    pixels: NDArray[np.uint8]
    cover: Floats


def distance(first: Look, second: Look) -> float:
    """D of the module's formula for two pictures of one size, in Delta E.

    Raises ValueError when they are of different sizes, or when one shows nothing.
    """
    if first.pixels.shape != second.pixels.shape:
        raise ValueError(f"pictures of {first.pixels.shape} and {second.pixels.shape} pixels: give two of one size")
    if not first.cover.any() or not second.cover.any():
        raise ValueError("a picture shows no body")
    means = [_mean_colour(look) for look in (first, second)]
    outside = (means[0] + means[1]) / 2
    one, other = _pyramid(first, outside), _pyramid(second, outside)
    return float(np.sqrt(np.mean([_at_scale(a, b) for a, b in zip(one, other, strict=True)])))


def lab_of(pixels: NDArray[np.uint8]) -> Floats:
    """CIE L*a*b* (h, w, 3) of sRGB pixels, L* 0 to 100."""
    return np.asarray(cv2.cvtColor(pixels.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB), dtype=np.float32)


def _mean_colour(look: Look) -> Floats:
    weights = look.cover[..., None]
    return np.asarray((lab_of(look.pixels) * weights).sum(axis=(0, 1)) / weights.sum(), dtype=np.float32)


def _pyramid(look: Look, outside: Floats) -> list[tuple[Floats, Floats]]:
    """(Lab over ``outside``, cover) at each scale."""
    cover = look.cover.astype(np.float32)
    lab = lab_of(look.pixels) * cover[..., None] + outside * (1.0 - cover[..., None])
    levels = [(lab, cover)]
    for _ in range(SCALES - 1):
        lab, cover = cv2.pyrDown(lab), cv2.pyrDown(cover)
        levels.append((np.asarray(lab, np.float32), np.asarray(cover, np.float32)))
    return levels


@dataclass(frozen=True, eq=False)
class _Windows:
    """Statistics of n windows: mean (n, 3), covariance (n, 3, 3), energy (n, 4), cover (n,) 0 to 1."""

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    energy: NDArray[np.float64]
    cover: NDArray[np.float64]


def _windows(lab: Floats, cover: Floats) -> _Windows:
    sigma = WINDOW * len(lab)
    step = max(1, round(sigma))

    def pooled(values: Floats) -> NDArray[np.float64]:
        blurred = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        some = blurred[step // 2 :: step, step // 2 :: step]
        return np.asarray(some.reshape(-1, *some.shape[2:]), dtype=np.float64)

    # Differences from the mean keep single precision exact enough for the covariance.
    centre = lab.mean(axis=(0, 1))
    centred = lab - centre
    mean = pooled(centred)
    products = np.stack([centred[..., i] * centred[..., j] for i, j in _PAIRS], axis=-1)
    moments = pooled(products[..., :3]), pooled(products[..., 3:])
    covariance = np.empty((len(mean), 3, 3))
    for number, (i, j) in enumerate(_PAIRS):
        value = moments[number // 3][:, number % 3] - mean[:, i] * mean[:, j]
        covariance[:, i, j] = covariance[:, j, i] = value
    return _Windows(mean + centre, covariance, np.sqrt(np.maximum(pooled(_energies(lab, cover)), 0.0)), pooled(cover))


_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _energies(lab: Floats, cover: Floats) -> Floats:
    """(h, w, 4) squared derivatives along four directions, summed over channels, well inside the body."""
    inside = cv2.erode((cover > 0.99).astype(np.float32), np.ones((3, 3)))[..., None]
    across = cv2.Sobel(lab, cv2.CV_32F, 1, 0, scale=1 / 8) * inside
    down = cv2.Sobel(lab, cv2.CV_32F, 0, 1, scale=1 / 8) * inside
    xx, yy, xy = (across**2).sum(axis=-1), (down**2).sum(axis=-1), (across * down).sum(axis=-1)
    return np.asarray(np.stack([xx, (xx + yy) / 2 + xy, yy, (xx + yy) / 2 - xy], axis=-1), dtype=np.float32)


def _at_scale(first: tuple[Floats, Floats], second: tuple[Floats, Floats]) -> float:
    one, other = _windows(*first), _windows(*second)
    squared = ((one.mean - other.mean) ** 2).sum(axis=-1) + _bures(one.covariance, other.covariance)
    squared += ((one.energy - other.energy) ** 2).sum(axis=-1)
    squared += (COVER_UNITS * (one.cover - other.cover)) ** 2
    weights = np.maximum(one.cover, other.cover)
    return float((weights * squared).sum() / weights.sum())


def _bures(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) tr A + tr B - 2 tr (A^½ B A^½)^½ of covariances (n, 3, 3), at least 0."""
    values, vectors = np.linalg.eigh(first)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    cross = np.linalg.eigvalsh(root @ second @ root)
    traces = np.trace(first, axis1=1, axis2=2) + np.trace(second, axis1=1, axis2=2)
    return np.maximum(traces - 2.0 * np.sqrt(np.maximum(cross, 0.0)).sum(axis=-1), 0.0)
