# SPDX-License-Identifier: MIT
"""Predict the hidden part of a surface from its visible part: kriging with the surface's own autocovariance.

A stationary surface has an autocovariance: the correlation of the colours of two points by their distance and
direction. Measured where the surface is visible, it predicts the rest: shades continue smoothly, wood grain along the
grain, tiles in their rows for as far as they correlate (simple kriging; for pictures, Galerne & Leclaire, SIAM J.
Imaging Sci. 10, 2017). It is the linear estimate of least squared error: a mean, without the unpredictable texture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

PADDING = 1.5
"""Size of the torus for convolutions over the picture's: covariances end before they wrap around."""
REACHES = (0.5, 0.1)
"""Candidate ranges of the covariance over the picture's sides: rows of tiles correlate far away, while in an unordered
pattern distant correlations are chance."""
TRIAL_PIXELS, TRIAL_SHARE = 25_000, 0.5
"""Pixels of the trials; least visible share of a trial hole."""
OVERLAP = 0.02
"""Least share of known pixels with a partner at a distance, for the covariance there to be used."""
NOISE = 0.01
"""Share of the variance that is pixel noise. It also conditions the equations."""
ROUNDS, CLOSE_ENOUGH = 150, 3e-3
"""Iterations of conjugate gradients, and the relative residual at which they stop."""


def predict_texture(values: Picture, known: Mask, hole: Mask) -> tuple[Picture, float]:
    """Return ``values`` (h, w, c) of mean 0 where ``known``, predicted in ``hole``, and the predictable share of
    variance.

    The share is between 0 and 1. A hole of the same form is cut where the values are known. The range of covariance
    that predicts it best is used, and the prediction is scaled by its reliability there.
    """
    scale = min(1.0, float(np.sqrt(TRIAL_PIXELS / known.size)))
    size = (max(8, round(known.shape[1] * scale)), max(8, round(known.shape[0] * scale)))
    share, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    sums = cv2.resize(values * known[..., None].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small: Picture = np.asarray(sums / np.maximum(share, 1e-6)[..., None], dtype=np.float32)
    seen = share > 0.999
    trial = _elsewhere(np.asarray(cut > 0.5), seen)
    if trial is None:
        return conditional_mean(values, known, REACHES[-1]), 0.0
    truth = small[trial]
    best, belief, least = REACHES[-1], 0.0, np.inf
    for reach in REACHES:
        guess = conditional_mean(small, seen & ~trial, reach)[trial]
        slope = float(np.clip((guess * truth).sum() / max(float((guess * guess).sum()), 1e-12), 0.0, 1.0))
        error = float(np.square(truth - slope * guess).sum())
        if error < least:
            best, belief, least = reach, slope, error
    found = conditional_mean(values, known, best)
    certain = 1.0 - least / max(float(np.square(truth).sum()), 1e-12)
    return np.where(hole[..., None], np.float32(belief) * found, found), float(np.clip(certain, 0.0, 1.0))


def _elsewhere(hole: Mask, known: Mask) -> Mask | None:
    """``hole`` (h, w) shifted to where most of it is ``known``, restricted to known pixels. None if too few are."""
    shift = shift_to_known(hole, known)
    if shift is None:
        return None
    trial = shifted(hole, *shift) & known
    return trial if trial.sum() >= TRIAL_SHARE * hole.sum() else None


def shift_to_known(hole: Mask, known: Mask, pixels: int = 60_000, level: float = 0.0) -> tuple[int, int] | None:
    """Return the shift (rows, columns) of ``hole`` (h, w) after which most of it is ``known``, preferring short ones.

    level: further cost of a shift by the picture's height, over what is known. None if there is none.
    """
    scale = min(1.0, float(np.sqrt(pixels / known.size)))
    size = (max(8, round(known.shape[1] * scale)), max(8, round(known.shape[0] * scale)))
    seen, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    torus = tuple(fft.next_fast_len(2 * count, real=True) for count in seen.shape)
    overlap = fft.irfft2(fft.rfft2(np.floor(seen + 1e-3), torus) * np.conj(fft.rfft2(cut, torus)), torus)
    # Prefer short shifts: similar light and sharpness.
    rows, columns = (_offsets(count) for count in torus)
    away = np.hypot(rows[:, None] / seen.shape[0], columns[None, :] / seen.shape[1])
    total = max(float(cut.sum()), 1e-6)
    score = overlap / total - 0.1 * away - level * np.abs(rows / seen.shape[0])[:, None]
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    if overlap[row, column] < 0.02 * total:
        return None
    return (
        round(int(rows[row]) * known.shape[0] / seen.shape[0]),
        round(int(columns[column]) * known.shape[1] / seen.shape[1]),
    )


def shifted(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return ``image`` (h, w, …) shifted down and to the right, padded with 0."""
    height, width = image.shape[:2]
    result = np.zeros_like(image)
    if abs(rows) >= height or abs(columns) >= width:
        return result
    to = (slice(max(rows, 0), height + min(rows, 0)), slice(max(columns, 0), width + min(columns, 0)))
    of = (slice(max(-rows, 0), height + min(-rows, 0)), slice(max(-columns, 0), width + min(-columns, 0)))
    result[to] = image[of]
    return result


NEWLY = 0.01
"""Share of a hole left below which no further stretch is looked for."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """shift: rows and columns from the hole to its source. there: (h, w) pixels of the hole that have a source. new:
    those that no stretch before it covers."""

    shift: tuple[int, int]
    there: Mask
    new: Mask

    def copied(self, picture: Picture) -> Picture:
        """Return ``picture`` (h, w, …) with the source moved to the hole."""
        return np.asarray(shifted(picture, -self.shift[0], -self.shift[1]))


def stretches(hole: Mask, source: Mask, *, most: int, level: float = 0.0) -> Iterator[Stretch]:
    """Yield at most ``most`` copies of ``source`` (h, w) that cover ``hole`` (h, w), each as large as possible.

    level: cost of a source at another height, over the picture's height and what it covers.
    """
    left = hole.copy()
    for _ in range(most):
        shift = shift_to_known(left, source, level=level)
        if shift is None:
            return
        there = hole & shifted(source, -shift[0], -shift[1])
        new = there & left
        left &= ~new
        yield Stretch(shift, there, new)
        if left.sum() < NEWLY * hole.sum():
            return


def conditional_mean(values: Picture, known: Mask, reach: float) -> Picture:
    """Return the conditional mean (h, w, c) everywhere of ``values`` (h, w, c) of mean 0 where ``known``.

    At known pixels it is the values without pixel noise. reach: share of the picture's sides at which covariance ends.
    """
    height, width = known.shape
    inside = values[known]
    if len(inside) < 16:
        return np.zeros_like(values)
    # Along the principal axes colours are uncorrelated: solve each with its own covariance.
    axes = np.linalg.eigh(np.cov(inside.astype(np.float64), rowvar=False) + 1e-12 * np.eye(values.shape[2]))[1]
    turned = np.where(known[..., None], values, 0.0) @ axes.astype(np.float32)
    size = (fft.next_fast_len(round(height * PADDING), real=True), fft.next_fast_len(round(width * PADDING), real=True))
    planes = np.ascontiguousarray(np.moveaxis(turned, -1, 0), dtype=np.float32)
    spectrum, variance = _power(planes, known, size, reach)
    found = _solve(planes, known, spectrum, NOISE * variance, size)
    return np.asarray(np.moveaxis(found, 0, -1) @ axes.T.astype(np.float32), dtype=np.float32)


def _power(
    planes: Picture, known: Mask, size: tuple[int, int], reach: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Power spectrum (c, …) of the covariance of ``planes`` (c, h, w), 0 where unknown, and the variances (c,)."""
    height, width = known.shape
    # On a torus of twice the size there is no wrap-around.
    twice = (fft.next_fast_len(2 * height, real=True), fft.next_fast_len(2 * width, real=True))
    weight = fft.rfft2(known.astype(np.float32), twice)
    pairs = fft.irfft2(np.abs(weight) ** 2, twice)
    products = fft.irfft2(np.abs(fft.rfft2(planes, twice)) ** 2, twice)
    enough = pairs > OVERLAP * known.sum()
    covariance = np.where(enough, products / np.maximum(pairs, 1.0), 0.0)
    rows, columns = (_offsets(count) for count in size)
    ends = (reach * height, reach * width)
    window = np.maximum(1.0 - np.hypot(rows[:, None] / ends[0], columns[None, :] / ends[1]), 0.0)
    window = np.sqrt(window, dtype=np.float32)
    folded = covariance[:, rows][:, :, columns] * window
    spectrum = np.maximum(fft.rfft2(folded).real, 0.0).astype(np.float32)
    variance = np.maximum(covariance[:, 0, 0], 1e-12).astype(np.float32)
    return spectrum, variance


def _offsets(count: int) -> NDArray[np.int64]:
    """Signed offsets on a torus: 0, 1, …, −2, −1."""
    return np.asarray((np.arange(count) + count // 2) % count - count // 2, dtype=np.int64)


def _solve(
    planes: Picture, known: Mask, spectrum: NDArray[np.float32], noise: NDArray[np.float32], size: tuple[int, int]
) -> Picture:
    """Σ v for (Σ + noise) v = ``planes`` on the known pixels, by conjugate gradients."""
    height, width = known.shape
    seen = known.astype(np.float32)
    least = noise[:, None, None]

    scale = np.float32(1.0 / (size[0] * size[1]))

    def convolved(value: Picture, kernel: NDArray[np.float32]) -> Picture:
        # Axis by axis: rows of padding are 0 before, and are not needed after.
        image = fft.fft(fft.rfft(value, size[1], axis=2), size[0], axis=1, overwrite_x=True)
        image *= kernel
        rows = fft.ifft(image, axis=1, norm="forward", overwrite_x=True)[:, :height]
        return np.asarray(scale * fft.irfft(rows, size[1], axis=2, norm="forward")[..., :width], dtype=np.float32)

    def inner(first: Picture, second: Picture) -> NDArray[np.float32]:
        total = np.einsum("chw,chw->c", first, second, dtype=np.float64)
        return np.asarray(total, dtype=np.float32)[:, None, None]

    weights = np.zeros_like(planes)
    rest = planes * seen
    direction = rest.copy()
    gain = inner(rest, rest)
    enough = CLOSE_ENOUGH**2 * np.maximum(gain, 1e-20)
    # No preconditioner: the large, regular part of the pattern converges first, and early stopping damps what
    # the data hardly determine.
    for _ in range(ROUNDS):
        image = convolved(direction, spectrum)
        image *= seen
        image += least * direction
        length = gain / np.maximum(inner(direction, image), 1e-30)
        weights += length * direction
        image *= length
        rest -= image
        following = inner(rest, rest)
        if (following < enough).all():
            break
        direction *= following / np.maximum(gain, 1e-30)
        direction += rest
        gain = following
    return convolved(weights, spectrum)
