# SPDX-License-Identifier: MIT
"""The choice of the method that inpaints a hole, by trial.

Trial holes of the same shape are cut where the truth is known and inpainted by every method; the method whose results
are most similar to the truth is used. Squared error alone would favour blur, so the strength of details counts as
well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from .inpainting_methods import BY_STRETCHES, METHODS, InpaintingTask, around
from .stretch_inpainting import is_irregular
from .texture_prediction import shift_to_known, shifted

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

TRIALS = 2
PIXELS = 20_000
"""Largest size of the copy for trials."""
LEAST_SIDE = 6.0
SIZES = (1.0, 0.7)
"""Sizes of trial holes over the hole's, tried in turn."""
SEEN = 0.5
"""Least share of the hole's pixels in a trial hole."""
DETAIL = 3.0
"""Penalty in decibels for details too strong or too weak by a factor e."""
MORE = 0.3
"""Margin in decibels by which a method must beat those before it."""
IRREGULAR = 5.0
"""Decibels by which the best way may be ahead of a plain colour and of stretches, summed, on an irregular surface:
there a true copy errs by twice the variance, 3 dB more than the mean, but has the right detail. Grass and asphalt
had 0.1 to 3.1 dB; where it is more, the best way foretells the surface."""
BEHIND = 3.0
"""Deficit in decibels at which a method is dropped after one trial."""


@dataclass(frozen=True)
class MethodChoice:
    """way: its name in ``METHODS``. scores: decibels of each that was tried, empty where no trial hole fits.

    certain: decibels by which the best one beats a hole filled with the mean of its surroundings.
    """

    way: str
    scores: dict[str, float]
    certain: float


def choose_method(task: InpaintingTask, ways: Sequence[str]) -> MethodChoice:
    """Return the one of ``ways`` that does best around ``task``'s hole.

    Stretches are tried on irregular surfaces only (``stretch_inpainting``). If no trial is possible it is the first:
    where so little is seen, the same narrow stretch would be copied again and again.
    """
    if BY_STRETCHES in ways:
        rows, columns = around(task)
        if not is_irregular(task.picture[rows, columns], task.target[rows, columns], task.closed[rows, columns]):
            ways = tuple(way for way in ways if way != BY_STRETCHES)
    small = _smaller(task)
    trials = trial_holes(small.target, ~(small.closed | small.target))
    if not trials or len(ways) == 1:
        return MethodChoice(ways[0], {}, 0.0)
    scores: dict[str, list[float]] = {way: [] for way in ways}
    plain: list[float] = []
    left = list(ways)
    for hole in trials:
        closed = small.closed | small.target
        # Pixels hidden in the trial must not help any method.
        known = ~(closed | hole)
        near = known & (cv2.dilate(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)
        mean = small.picture[near if near.any() else known].mean(axis=0)
        emptied = np.where(hole[..., None], mean, small.picture).astype(np.float32)
        plain.append(similarity(emptied, small.picture, hole))
        for way in left:
            filled = METHODS[way](replace(small, picture=emptied, target=hole, closed=closed))
            scores[way].append(similarity(filled, small.picture, hole))
        # Drop methods that are far behind.
        most = max(scores[way][-1] for way in left)
        left = [way for way in left if scores[way][-1] > most - BEHIND]
        if len(left) == 1:
            break
    means = {way: float(np.mean(scores[way])) for way in ways}
    best = left[0]
    for way in left[1:]:
        if means[way] > means[best] + MORE:
            best = way
    certain = means[best] - float(np.mean(plain))
    if BY_STRETCHES in left and certain + means[best] - means[BY_STRETCHES] < IRREGULAR:
        best = BY_STRETCHES
    return MethodChoice(best, means, certain)


def trial_holes(hole: Mask, known: Mask) -> list[Mask]:
    """Return at most ``TRIALS`` disjoint copies of ``hole`` (h, w) where it is ``known``."""
    result: list[Mask] = []
    free = known.copy()
    for size in SIZES:
        form = hole if size == 1.0 else _shrunk(hole, size)
        while len(result) < TRIALS:
            shift = shift_to_known(form, free)
            if shift is None:
                break
            found = shifted(form, *shift) & free
            if found.sum() < max(SEEN * size * hole.sum(), LEAST_SIDE**2) * (1.0 if size == 1.0 else 0.8):
                break
            # Leave enough surroundings.
            if found.sum() > 0.6 * known.sum():
                break
            result.append(found)
            free &= ~found
        if result:
            break
    return result


def similarity(filled: Picture, truth: Picture, where: Mask) -> float:
    """Return the similarity of ``filled`` and ``truth`` ``where``, both (h, w, 3) of 0 to 255: PSNR in decibels less a
    penalty for different detail."""
    error = float(np.square(filled[where] - truth[where]).mean())
    lost = 0.0
    blurs = (0.0, 1.0, 2.0, 4.0)
    pictures = [
        np.asarray(np.where(where[..., None], picture, truth), np.float32).mean(axis=-1) for picture in (filled, truth)
    ]
    for fine, coarse in pairwise(blurs):
        sizes = []
        for picture in pictures:
            first = cv2.GaussianBlur(picture, (0, 0), fine) if fine else picture
            detail = np.square(first - cv2.GaussianBlur(picture, (0, 0), coarse))
            sizes.append(0.5 * np.log(cv2.GaussianBlur(detail, (0, 0), 4.0 + 2.0 * coarse) + 0.5))
        lost += float(np.abs(sizes[0] - sizes[1])[where].mean()) / (len(blurs) - 1)
    return 10.0 * float(np.log10(255.0**2 / max(error, 0.1))) - DETAIL * lost


def _smaller(task: InpaintingTask) -> InpaintingTask:
    height, width = task.target.shape
    scale = min(1.0, float(np.sqrt(PIXELS / task.target.size)))
    if scale > 0.9:
        return task
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    target, closed = (
        cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.02
        for mask in (task.target, task.closed)
    )
    across, down = size[0] / width, size[1] / height
    camera = task.camera
    return replace(
        task,
        picture=np.asarray(cv2.resize(task.picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32),
        target=np.asarray(target),
        closed=np.asarray(closed & ~target),
        lattice=None if task.lattice is None else task.lattice.scaled(across, down),
        camera=replace(
            camera,
            width=size[0],
            height=size[1],
            fx=camera.fx * across,
            fy=camera.fy * down,
            cx=camera.cx * across,
            cy=camera.cy * down,
        ),
    )


def _shrunk(mask: Mask, size: float) -> Mask:
    """``mask`` scaled by ``size`` about its centre."""
    y, x = (float(axis.mean()) for axis in np.nonzero(mask))
    matrix = np.array([[size, 0.0, (1.0 - size) * x], [0.0, size, (1.0 - size) * y]])
    return np.asarray(cv2.warpAffine(mask.astype(np.float32), matrix, (mask.shape[1], mask.shape[0])) > 0.5)
