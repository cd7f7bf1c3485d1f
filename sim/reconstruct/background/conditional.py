# SPDX-License-Identifier: MIT
"""The most likely picture of what is hidden, given what is seen of the same surface.

A surface that looks alike everywhere has an autocovariance: how much the colours of two of its points agree, by their
distance and direction. It can be measured where the surface is seen, and tells what to expect where it is not: shades
go on smoothly, grain of wood along the grain, tiles in their rows for as far as they agree with each other (simple
kriging; for pictures, Galerne & Leclaire, SIAM J. Imaging Sci. 10, 2017). It is the linear estimate of the least
squared error. What cannot be known is missing from it: it is a mean, and lacks the texture that nobody can foresee.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

PADDING = 1.5
"""Size of the torus on which convolutions are done, over the picture's: covariances are cut off before they meet
around it."""
REACHES = (0.5, 0.1)
"""Shares of the picture's width and height at which covariance may be taken to end: rows of tiles agree far away, while
in a pattern without order what seems to agree there does so by chance."""
TRIAL_PIXELS, TRIAL_SHARE = 25_000, 0.5
"""Pixels on which reaches are tried; share of a trial hole that must be seen, or nothing can be tried."""
OVERLAP = 0.02
"""Share of the known pixels that must have a partner at a distance, for the covariance there to be believed."""
NOISE = 0.01
"""Variance that belongs to single pixels, over all of it. It also keeps the equations well conditioned."""
ROUNDS, CLOSE_ENOUGH = 150, 3e-3
"""Of conjugate gradients; and the residual over the right hand side at which they end."""


def foreseen(values: Picture, known: Mask, hole: Mask) -> tuple[Picture, float]:
    """``values`` (h, w, c) of mean 0 where ``known``, continued to what can be foreseen in ``hole``, (h, w, c).

    Also the share of the variance in such a hole that is foreseen, 0 to 1.

    A hole of the same form is cut where the values are known. The reach of covariance that does best there is taken,
    and its guess is believed as far as it proved right there.
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
    """``hole`` (h, w) shifted to where most of it is ``known``; only that part. None where too little is."""
    shift = shift_to_known(hole, known)
    if shift is None:
        return None
    trial = shifted(hole, *shift) & known
    return trial if trial.sum() >= TRIAL_SHARE * hole.sum() else None


def shift_to_known(hole: Mask, known: Mask, pixels: int = 60_000) -> tuple[int, int] | None:
    """Rows and columns by which ``hole`` (h, w) is to be moved so that most of it lies where ``known``, and not far.

    None where nothing of it would.
    """
    scale = min(1.0, float(np.sqrt(pixels / known.size)))
    size = (max(8, round(known.shape[1] * scale)), max(8, round(known.shape[0] * scale)))
    seen, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    torus = tuple(fft.next_fast_len(2 * count, real=True) for count in seen.shape)
    overlap = fft.irfft2(fft.rfft2(np.floor(seen + 1e-3), torus) * np.conj(fft.rfft2(cut, torus)), torus)
    # Near is better than far: the same light, the same sharpness.
    rows, columns = (_offsets(count) for count in torus)
    away = np.hypot(rows[:, None] / seen.shape[0], columns[None, :] / seen.shape[1])
    total = max(float(cut.sum()), 1e-6)
    score = overlap / total - 0.1 * away
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    if overlap[row, column] < 0.02 * total:
        return None
    return (
        round(int(rows[row]) * known.shape[0] / seen.shape[0]),
        round(int(columns[column]) * known.shape[1] / seen.shape[1]),
    )


def shifted(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """``image`` (h, w, …) moved down and to the right, 0 where nothing comes from."""
    height, width = image.shape[:2]
    result = np.zeros_like(image)
    if abs(rows) >= height or abs(columns) >= width:
        return result
    to = (slice(max(rows, 0), height + min(rows, 0)), slice(max(columns, 0), width + min(columns, 0)))
    of = (slice(max(-rows, 0), height + min(-rows, 0)), slice(max(-columns, 0), width + min(-columns, 0)))
    result[to] = image[of]
    return result


def conditional_mean(values: Picture, known: Mask, reach: float) -> Picture:
    """``values`` (h, w, c) of mean 0 where ``known``, continued to the best guess everywhere, (h, w, c).

    Where known it is a guess too: the values without what single pixels have to themselves. reach: share of the
    picture's sides at which covariance ends.
    """
    height, width = known.shape
    inside = values[known]
    if len(inside) < 16:
        return np.zeros_like(values)
    # Along the principal axes colours do not covary: each is a problem of its own, with a covariance of its own.
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
    """Power spectrum (c, …) of the covariance of ``planes`` (c, h, w), 0 where not known, and the variances (c,)."""
    height, width = known.shape
    # On a torus of twice the size, no pixel meets another around it: distances are counted truly.
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
    """0, 1, … and back from … −2, −1, as on a torus."""
    return np.asarray((np.arange(count) + count // 2) % count - count // 2, dtype=np.int64)


def _solve(
    planes: Picture, known: Mask, spectrum: NDArray[np.float32], noise: NDArray[np.float32], size: tuple[int, int]
) -> Picture:
    """Σ v for (Σ + noise) v = ``planes`` on the known pixels, by preconditioned conjugate gradients."""
    height, width = known.shape
    seen = known.astype(np.float32)
    least = noise[:, None, None]

    def convolved(value: Picture, kernel: NDArray[np.float32]) -> Picture:
        return np.asarray(fft.irfft2(fft.rfft2(value, size) * kernel, size)[:, :height, :width], dtype=np.float32)

    def inner(first: Picture, second: Picture) -> NDArray[np.float32]:
        total = np.einsum("chw,chw->c", first, second, dtype=np.float64)
        return np.asarray(total, dtype=np.float32)[:, None, None]

    weights = np.zeros_like(planes)
    rest = planes * seen
    direction = rest
    gain = inner(rest, rest)
    enough = CLOSE_ENOUGH**2 * np.maximum(gain, 1e-20)
    # Without a preconditioner: the large, regular part of the pattern is found first, and stopping early damps what
    # the data hardly determine.
    for _ in range(ROUNDS):
        image = seen * convolved(direction, spectrum) + least * direction
        length = gain / np.maximum(inner(direction, image), 1e-30)
        weights = weights + length * direction
        rest = rest - length * image
        following = inner(rest, rest)
        if (following < enough).all():
            break
        direction = rest + following / np.maximum(gain, 1e-30) * direction
        gain = following
    return convolved(weights, spectrum)
