# SPDX-License-Identifier: MIT
"""Inpaint one surface seen in a view in which its texture is stationary.

Slowly varying illumination is separated from the pattern in log space. The predictable part of the pattern comes from
``texture_prediction``; the rest from PatchMatch guided by it, with the contrast of the surface at each scale less what
is predicted. The result stays within the range of colours around the hole.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from ...composite.inpaint import FillOptions, inpaint_once
from ...robust_deviation import robust_deviation
from .texture_prediction import predict_texture, stretches

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

DARKEST = 6.0
"""Least value of 255; below, logarithms show the noise of black rather than light."""
FIELD_PIXELS = 6_000
"""Pixels of the copy on which fields are fitted."""
PULL = 1e-3
"""Regularisation of all coefficients, relative to the data."""
DEGREE = 2
"""Degree of the polynomial; higher ones diverge where little is visible."""
FADING = (0.06, 0.2, 0.6)
"""Decay lengths, over the hole's size, of the loss of light around the hole."""
CHANCE = (0.05, 0.2)
"""Share of the residual variance explained by the loss: possibly by chance; certainly not."""
MOST_LACK = 0.12
"""Largest loss in logarithms; darker pixels are shadow, and in the hole."""


def logarithms(picture: Picture) -> Picture:
    """Return logarithms of values 0 to 255."""
    return np.log(np.maximum(picture, DARKEST))


def light_field(logs: Picture, known: Mask, hole: Mask) -> tuple[Picture, Picture]:
    """Return the smooth part (h, w, c) of ``logs`` (h, w, c), a polynomial, and the loss of light around ``hole`` (h,
    w, 1).

    Illumination and reflectance multiply, so they are separated in logarithms. Around a removed object the surroundings
    still lack the light that it blocked beyond its shadow mask; that loss decays away from the hole and is fitted too,
    so that it is not carried inside. known: (h, w) valid pixels of ``logs``. The loss is <= 0, and 0 within the hole.
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
    """Coefficients (count, c) of the first ``count`` columns per channel, and of the others, common to all channels, <=
    0."""
    weights = np.ones(len(basis))
    lack = np.zeros(basis.shape[1] - count)
    field = np.zeros((count, target.shape[1]))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        # The loss of light is equal in all channels: fit it to their mean.
        mean = target.mean(axis=1)
        # Weak regularisation: where little is visible, the polynomial must not oscillate in the hole.
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
        # Patterns may be darker around the hole by chance: the loss must explain a good part of the residual.
        gained = 1.0 - solved.cost / max(alone.cost, 1e-12)
        lack = solved.x[count:] * np.clip((gained - CHANCE[0]) / (CHANCE[1] - CHANCE[0]), 0.0, 1.0)
        without = target - (basis[:, count:] @ lack)[:, None]
        powers = basis[:, :count] * root
        squares = powers.T @ powers + PULL * len(basis) * np.diag([0.0] + [1.0] * (count - 1))
        field = np.linalg.solve(squares, powers.T @ (without * root))
        error = np.abs(without - basis[:, :count] @ field).mean(axis=1)
        # Downweight outliers such as small objects.
        weights = 1.0 / (1.0 + np.square(error / (2.5 * max(float(np.median(error)), 1e-3))))
    return field, lack


PERCENTILES = (2.0, 98.0)
SLACK = 0.02
"""Tolerance, in logarithms, of the smooth part beyond the range of its surroundings."""
RIM = 0.35
"""Width of the surroundings in which illumination is compared, over the hole's size."""
SLOW = 0.06
"""Blur for the comparison, over the hole's size."""
PIXELS = 60_000
"""Largest size of the copy for the comparison."""

# Lightness and two colour differences: a coloured glow may stay within each channel's own range.
AXES = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]], dtype=np.float32)


def clamp_to_surroundings(logs: Picture, hole: Mask, known: Mask) -> Picture:
    """Return ``logs`` (h, w, 3) of an inpainted picture without glow or gloom in ``hole`` that its surroundings lack.

    known: valid pixels around the hole.
    """
    scale = min(1.0, float(np.sqrt(PIXELS / hole.size)))
    size = (max(8, round(hole.shape[1] * scale)), max(8, round(hole.shape[0] * scale)))
    small = cv2.resize(logs, size, interpolation=cv2.INTER_AREA) @ AXES.T
    cut, seen = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (hole, known))
    side = float(np.sqrt(max(float(cut.sum()), 1.0)))
    away = cv2.distanceTransform((cut < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    rim = (seen > 0.9) & (away <= max(RIM * side, 4.0))
    inside = cut > 0.5
    if rim.sum() < 30 or not inside.any():
        return logs
    around, own = _slow(small, seen > 0.9, SLOW * side), _slow(small, inside, SLOW * side)
    low, high = np.percentile(around[rim], PERCENTILES, axis=0)
    change = np.clip(own, low - SLACK, high + SLACK) - own
    change = np.where(inside[..., None], change, 0.0).astype(np.float32) @ np.linalg.inv(AXES).T.astype(np.float32)
    if not change.any():
        return logs
    # Extrapolated over the border of the hole, so that enlarging it mixes in no zeros.
    change = _slow(change, inside, max(0.5 * SLOW * side, 1.0))
    whole = cv2.resize(change, (hole.shape[1], hole.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(hole[..., None], logs + whole, logs), dtype=np.float32)


def _slow(values: Picture, where: Mask, blur: float) -> Picture:
    """``values`` (h, w, 3) averaged over pixels ``where``."""
    weight = where.astype(np.float32)
    blur = max(blur, 0.8)
    total = cv2.GaussianBlur(np.ascontiguousarray(values * weight[..., None], dtype=np.float32), (0, 0), blur)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), blur), 1e-4)[..., None], dtype=np.float32)


FORESEEN_PIXELS = 70_000
"""Pixels on which the mean is solved for."""
SOLVE_SIDE = 150.0
"""Hole size in pixels for PatchMatch; larger ones are scaled down, as the prediction contains the structure."""
LED = 1.0
"""Weight of the prediction in PatchMatch's guide, over its standard deviation."""
CONTRAST = 60.0
"""Standard deviation of the surface's pattern in PatchMatch's 256 steps."""
GRAIN = 0.06
"""Scales up to this share of the hole's size are grain, which may be added from elsewhere."""
DONORS = 4
"""Largest number of source patches for grain."""


def fill_surface(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """Return ``picture`` (h, w, 3), values 0 to 255, with ``hole`` (h, w) inpainted from pixels in neither it nor
    ``barred``.

    Raises InputError when nothing is left to inpaint from, or the native library is missing.
    """
    known = ~(hole | barred)
    logs = logarithms(picture)
    slow, lack = light_field(logs, known, hole)
    pattern = logs - slow - lack
    centre = pattern[known].mean(axis=0) if known.any() else np.zeros(3, np.float32)
    pattern = np.where(known[..., None], pattern - centre, 0.0).astype(np.float32)
    mean = _mean(pattern, known, hole)
    texture = _texture(pattern, mean, hole, barred, options)
    merged = mean + _balanced(pattern, mean, texture - mean, known, hole)
    new = np.where(hole[..., None], merged + slow + centre, logs).astype(np.float32)
    filled = np.exp(clamp_to_surroundings(new, hole, known))
    return np.asarray(np.where(hole[..., None], filled, picture), dtype=np.float32)


def _mean(pattern: Picture, known: Mask, hole: Mask) -> Picture:
    """The predictable part of the pattern."""
    height, width = known.shape
    scale = min(1.0, float(np.sqrt(FORESEEN_PIXELS / known.size)))
    if scale > 0.9:
        return predict_texture(pattern, known, hole)[0]
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    share, cut = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, hole))
    small = cv2.resize(pattern, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)[..., None]
    found, _ = predict_texture(np.asarray(small, dtype=np.float32), np.asarray(share > 0.999), np.asarray(cut > 0.0))
    whole = cv2.resize(found, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(whole, dtype=np.float32)


def _texture(pattern: Picture, mean: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    """The pattern with its hole inpainted by PatchMatch."""
    known = ~(hole | barred)
    spread = max(float(pattern[known].std()), 1e-3)
    gain = min(CONTRAST / spread, 500.0)
    pixels = np.clip(127.5 + gain * np.where(hole[..., None], mean, pattern), 0, 255).astype(np.uint8)
    axes = np.linalg.eigh(np.cov(mean[known].astype(np.float64), rowvar=False))[1][:, :0:-1]
    guide = (mean @ axes.astype(np.float32)) / spread * LED
    filled = inpaint_once(pixels, hole, barred, options, np.ascontiguousarray(guide, dtype=np.float32), SOLVE_SIDE)
    return np.asarray((filled.astype(np.float32) - 127.5) / gain, dtype=np.float32)


def _balanced(pattern: Picture, mean: Picture, rest: Picture, known: Mask, hole: Mask) -> Picture:
    """``rest``, the unpredictable part, with the contrast that the surface lacks at each scale.

    The variance of a surface is that of its conditional mean plus that of the deviation from it (law of total
    variance): excess contrast from PatchMatch is reduced; lost contrast comes from ``_donor``.
    """
    side = float(np.sqrt(hole.sum()))
    levels = max(1, min(round(np.log2(max(side / 3.0, 2.0))), int(np.log2(min(hole.shape))) - 2))
    masks = np.stack([known, hole, hole], axis=-1).astype(np.float32)
    bands: list[Picture] = []
    stack = np.concatenate([pattern, mean, rest, _donor(pattern, known, hole), masks], axis=-1)
    for level in range(levels + 1):
        coarser = stack if level == levels else _down(stack)
        back = np.zeros_like(stack) if level == levels else _up(coarser, stack)
        own, predicted, given, donor = (stack[..., i : i + 3] - back[..., i : i + 3] for i in (0, 3, 6, 9))
        # Next to unknown pixels, blurs are contaminated.
        seen, filled = _inner(stack[..., 12] > 0.98, 3), stack[..., 13] > 0.5
        if seen.sum() >= 16 and filled.sum() >= 4:
            missing = max(float(own[seen].var() - predicted[filled].var()), 0.0)
            given = min(1.0, float(np.sqrt(missing / max(float(given[filled].var()), 1e-12)))) * given
            if 2.0**level <= GRAIN * side:
                # Use medians: edges and single spots add variance, but are not grain.
                grain, has = _deviations(own[seen]), _deviations((predicted + given)[filled])
                share = np.sqrt(np.maximum(1.0 - np.square(has / np.maximum(grain, 1e-6)), 0.0))
                share = share * np.clip((grain / np.maximum(own[seen].std(axis=0), 1e-6) - 0.5) / 0.3, 0.0, 1.0)
                given = given + share * np.clip(donor, -3.0 * grain, 3.0 * grain)
        bands.append(given)
        stack = coarser
    total = bands[-1]
    for band in bands[-2::-1]:
        total = _up(total, band) + band
    return total


def _deviations(values: Picture) -> Picture:
    """Robust standard deviations (c,) of ``values`` (n, c) about 0, by a sample of them."""
    return np.asarray(robust_deviation(values[:: max(1, len(values) // 20_000)], axis=0), dtype=np.float32)


def _donor(pattern: Picture, known: Mask, hole: Mask) -> Picture:
    """``pattern`` with its hole covered by shifted copies of itself, each as large as possible; 0 where there is
    none."""
    # Clip single spots, or they would be copied as ghosts.
    middle = np.median(pattern[known][:: max(1, int(known.sum()) // 20_000)], axis=0)
    most = 3.0 * _deviations(pattern[known] - middle)
    pattern = np.clip(pattern, middle - most, middle + most)
    result = np.where(known[..., None], pattern, 0.0).astype(np.float32)
    for stretch in stretches(hole, known, most=DONORS):
        result[stretch.new] = stretch.copied(pattern)[stretch.new]
    return result


def _down(image: Picture) -> Picture:
    halves = [
        cv2.pyrDown(np.ascontiguousarray(part)) for part in np.array_split(image, range(3, image.shape[2], 3), axis=-1)
    ]
    return np.concatenate([half.reshape(*half.shape[:2], -1) for half in halves], axis=-1)


def _up(image: Picture, like: Picture) -> Picture:
    size = (like.shape[1], like.shape[0])
    parts = np.array_split(image, range(3, image.shape[2], 3), axis=-1)
    wholes = [cv2.pyrUp(np.ascontiguousarray(part), dstsize=size) for part in parts]
    return np.concatenate([whole.reshape(*whole.shape[:2], -1) for whole in wholes], axis=-1)


def _inner(known: Mask, side: int) -> Mask:
    """``known`` without its border, unless hardly anything would be left."""
    inner = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    return np.asarray(inner) if inner.sum() > 100 else known
