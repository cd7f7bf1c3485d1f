# SPDX-License-Identifier: MIT
"""The camera's pitch from many things of alike size, such as coins on a table: where those at the top of the photo are
as large as those at its bottom, it looks down steeply.

Size and viewpoint tell each other: Hoiem, Efros, Hebert, Putting Objects in Perspective (2006), equation 3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .ground_camera import DEFAULT_PITCH_DEG
from .pose_posterior import Gaussian

Box = tuple[float, float, float, float]
LEAST_THINGS = 5
"""Things from which their sizes count; with fewer, chance makes them alike."""
ALIKE = (0.05, 0.25)
"""Least standard deviation of the logarithm of alike sizes, and largest."""
STEEP_DEG, STEEPEST_DEG = 45.0, 88.0
"""Pitch from which a view is one from above, and the steepest; other photos keep the usual pose."""
ABOVE_SHARE = 0.15
"""Share of photos from above, of any pitch up to ``STEEPEST_DEG``, among those of things on a surface."""
SURE = 0.95
"""Probability of a view from above from which it is taken."""
LEAST_SIGMA_DEG = 6.0
"""Least standard deviation of the pitch: the sizes of real things are not independent of where they lie."""


def pitch_from_alike_sizes(
    boxes: Sequence[Box], size: tuple[int, int], focal: float, usual_sigma_deg: float
) -> Gaussian | None:
    """Return the pitch in radians of a camera that looks down on things of alike size, or None.

    boxes: x0, y0, x1, y1 in pixels of a photo of ``size`` (width, height); those that its border cuts do not count.
    focal: focal length in pixels. usual_sigma_deg: standard deviation of the usual pose, about ``DEFAULT_PITCH_DEG``.
    """
    width, height = size
    corners = np.array([box for box in boxes if min(box[:2]) > 1 and box[2] < width - 1 and box[3] < height - 1])
    if len(corners) < LEAST_THINGS:
        return None
    extents = np.sqrt((corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1]))
    rows = (corners[:, 1] + corners[:, 3]) / 2.0 - height / 2.0
    degrees = np.arange(5.0, STEEPEST_DEG + 1.0)
    pitch = np.radians(degrees)[:, None]
    # Inverse depth of a point of the ground at each thing's row, times the camera's height.
    nearness = np.sin(pitch) + rows / focal * np.cos(pitch)
    real = np.log(extents) - np.log(np.maximum(nearness, 1e-9))
    spread = np.where((nearness > 0.02).all(axis=1), real.std(axis=1, ddof=1), np.inf)
    likelihood = -(len(extents) - 1) * np.log(np.maximum(spread, ALIKE[0]))
    usual = np.exp(-0.5 * np.square((degrees - DEFAULT_PITCH_DEG) / usual_sigma_deg))
    prior = (1.0 - ABOVE_SHARE) * usual / usual.sum() + ABOVE_SHARE / len(degrees)
    weight = prior * np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    above = degrees >= STEEP_DEG
    if weight[above].sum() < SURE or float(spread[above].min()) > ALIKE[1]:
        return None
    mean = float(weight @ degrees)
    sigma = max(LEAST_SIGMA_DEG, math.sqrt(float(weight @ np.square(degrees - mean))))
    return Gaussian(math.radians(mean), math.radians(sigma))
