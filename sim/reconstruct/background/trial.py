# SPDX-License-Identifier: MIT
"""Which way of filling suits a part of the hole: each is tried where the truth is known.

Holes of the same form are cut out of the surroundings, on the same surface, and filled. The way whose fillings are most
like what was there is taken. Squared errors alone would favour softness, so the strength of details counts as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from .conditional import shift_to_known, shifted
from .ways import WAYS, Task

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

TRIALS = 2
PIXELS = 20_000
"""Of the copy of the photo on which is tried, at most; and least side of a hole in it."""
LEAST_SIDE = 6.0
SIZES = (1.0, 0.7)
"""Of trial holes, over the hole's, where nothing larger fits."""
SEEN = 0.5
"""Share of the hole's pixels that a trial hole must have."""
DETAIL = 3.0
"""Decibels that details too strong or too weak by e cost."""
MORE = 0.3
"""Decibels by which a way must be better than those before it."""

BEHIND = 3.0
"""Decibels behind the best at which a way is given up after one trial."""


@dataclass(frozen=True)
class Choice:
    """way: its name in ``WAYS``. scores: decibels of each that was tried, empty where no trial hole fits.

    certain: decibels by which the best beats a hole filled with the mean of its surroundings.
    """

    way: str
    scores: dict[str, float]
    certain: float


def choose(task: Task, ways: Sequence[str]) -> Choice:
    """The one of ``ways`` that does best around ``task``'s hole; the first where nothing can be tried."""
    small = _smaller(task)
    trials = trial_holes(small.target, ~(small.closed | small.target))
    if not trials or len(ways) == 1:
        return Choice(ways[0], {}, 0.0)
    scores: dict[str, list[float]] = {way: [] for way in ways}
    plain: list[float] = []
    left = list(ways)
    for hole in trials:
        closed = small.closed | small.target
        # What is hidden in the trial must not help any way.
        known = ~(closed | hole)
        near = known & (cv2.dilate(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)
        mean = small.picture[near if near.any() else known].mean(axis=0)
        emptied = np.where(hole[..., None], mean, small.picture).astype(np.float32)
        plain.append(likeness(emptied, small.picture, hole))
        for way in left:
            filled = WAYS[way](replace(small, picture=emptied, target=hole, closed=closed))
            scores[way].append(likeness(filled, small.picture, hole))
        # What is far behind is not tried again.
        most = max(scores[way][-1] for way in left)
        left = [way for way in left if scores[way][-1] > most - BEHIND]
        if len(left) == 1:
            break
    means = {way: float(np.mean(scores[way])) for way in ways}
    best = left[0]
    for way in left[1:]:
        if means[way] > means[best] + MORE:
            best = way
    return Choice(best, means, means[best] - float(np.mean(plain)))


def trial_holes(hole: Mask, known: Mask) -> list[Mask]:
    """Holes like ``hole`` (h, w) where it is ``known``, at most ``TRIALS``, which hardly overlap."""
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
            # The surroundings must not be used up.
            if found.sum() > 0.6 * known.sum():
                break
            result.append(found)
            free &= ~found
        if result:
            break
    return result


def likeness(filled: Picture, truth: Picture, where: Mask) -> float:
    """How like ``filled`` is ``truth`` ``where``, both (h, w, 3) of 0 to 255: decibels, less for other details."""
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


def _smaller(task: Task) -> Task:
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
    """``mask`` made smaller by ``size`` about its middle."""
    y, x = (float(axis.mean()) for axis in np.nonzero(mask))
    matrix = np.array([[size, 0.0, (1.0 - size) * x], [0.0, size, (1.0 - size) * y]])
    return np.asarray(cv2.warpAffine(mask.astype(np.float32), matrix, (mask.shape[1], mask.shape[0])) > 0.5)
