# SPDX-License-Identifier: MIT
"""What colours the lit ground has: a smooth part over the plane, and how its texture spreads about it.

A shadow multiplies the ground's light by nearly one factor in all channels. So a pixel at log colour c that keeps the
share s of its light shows the texture c − log s, and how often the lit ground has that colour says how likely s is. A
dark tile that also lies in the light somewhere is no evidence for a shadow; a colour that occurs nowhere else is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .ground_pixels import GroundPixels

Values = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
BINS = (240, 13, 13)
LOW, HIGH = np.array([-3.2, -0.65, -0.65]), np.array([1.6, 0.65, 0.65])
"""Of luminance and two chromas about the smooth part, natural logarithms."""
_PER_UNIT = np.array(BINS) / (HIGH - LOW)
FINEST = np.array([1.0, 0.6, 0.6])
"""Bins; the least smoothing of the histogram."""
OTHER = 0.02
"""Share of pixels that are no ground: of any colour."""


def relative(colour: Values, smooth: Values) -> Values:
    """Log luminance and two log chromas (N, 3) of log colours (N, 3) relative to the ``smooth`` part (N, 3).

    A chroma counts as far as both its channels are there: the little blue of a yellow floor is mostly noise.
    """
    off = colour - smooth
    usual = np.exp(np.median(smooth, axis=0))
    present = np.minimum(1.0, 3.0 * usual / usual.sum())
    red, blue = min(present[0], present[1]), min(present[2], present[1])
    return np.column_stack([off @ LUMINANCE, red * (off[:, 0] - off[:, 1]), blue * (off[:, 2] - off[:, 1])])


def fit_smooth(colour: Values, terms: Values, weight: Values) -> Values:
    """Coefficients (6, 3) of the smooth part of ``colour`` (N, 3) in ``terms`` (N, 6), robust against texture.

    weight: (N,) how far a pixel counts.
    """
    # The ground's colour may pass for curvature: hold that back a little.
    prior = np.diag([1e-9, 0.002, 0.002, 0.01, 0.01, 0.01]) * max(float(weight.sum()), 1.0)
    current = weight
    found = np.zeros((terms.shape[1], 3))
    for _ in range(6):
        weighted = terms * current[:, None]
        found = np.linalg.solve(weighted.T @ terms + prior, weighted.T @ colour)
        apart = colour - terms @ found
        chroma = apart - (apart @ LUMINANCE)[:, None]
        current = weight
        for off in (np.abs(apart @ LUMINANCE), np.linalg.norm(chroma, axis=1)):
            scale = max(0.02, 1.48 * float(np.median(off[weight >= 0.5 * weight.max()])))
            current = current / np.maximum(1.0, off / (1.5 * scale))
    return np.asarray(found)


class Texture:
    """How often the lit ground has a colour, relative to its smooth part: a smoothed histogram of ``samples`` (N, 3)
    from ``relative``, with ``weight`` (N,).

    grain: (3,) how much neighbouring pixels differ; the histogram is no finer, or it would know its own samples again
    and call all others unlikely.
    """

    def __init__(self, samples: Values, weight: Values, grain: Values) -> None:
        counts = np.zeros(BINS)
        np.add.at(counts, self._bins(samples), weight)
        width = np.maximum(grain * _PER_UNIT * max(len(samples), 2) ** (-1.0 / 7.0), FINEST)
        counts = ndimage.gaussian_filter(counts, width, mode="nearest")
        self._density = (1.0 - OTHER) * counts / max(float(counts.sum()), 1e-12) + OTHER / counts.size
        self._logs: dict[tuple[float, float], Values] = {}

    def likelihood(self, samples: Values, spread: float = 0.0, tint: float = 0.0) -> Values:
        """Log likelihood (N,) of ``samples`` (N, 3) on lit ground. ``spread`` and ``tint``: how uncertain their log
        luminance and chromas are, where a shadow's depth and colour were taken off that are known roughly.
        """
        key = (round(spread, 3), round(tint, 3))
        if key not in self._logs:
            width = np.array([spread, tint, tint]) * _PER_UNIT
            blurred = np.log(ndimage.gaussian_filter(self._density, width, mode="nearest"))
            # All pixels of a shadow share its depth and tint: uncertainty about them must not count once for each.
            self._logs[key] = blurred + float((self._density * (np.log(self._density) - blurred)).sum())
        return np.asarray(self._logs[key][self._bins(samples)])

    @staticmethod
    def _bins(samples: Values) -> tuple[NDArray[np.int64], ...]:
        place = (samples - LOW) * _PER_UNIT
        return tuple(np.clip(place.astype(np.int64), 0, np.array(BINS) - 1).T)


def grain(ground: GroundPixels, samples: Values) -> Values:
    """How much ``samples`` (N, 3) of neighbouring pixels differ: the standard deviation (3,) of one, robustly."""
    found = []
    for column in samples.T:
        picture = ground.picture(column, np.nan)
        steps = np.abs(np.diff(picture, axis=1))
        steps = steps[np.isfinite(steps)]
        found.append(1.05 * float(np.median(steps)) if len(steps) else 0.0)
    return np.array(found)
