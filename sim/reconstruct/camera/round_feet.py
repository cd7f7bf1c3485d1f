# SPDX-License-Identifier: MIT
"""Pitch of the camera from the round feet of upright things, such as cups, cans, jars and bottles.

Seen at an angle d below the horizontal, a circle on the ground is an ellipse whose axes are to each other as sin d, to
first order in its size over its distance. What stands on one shows the lower half of it between two straight sides. A
box shows corners there, and a ball no sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from .pose_posterior import Gaussian

Array = NDArray[np.float64]
Distances = Callable[[Array, Array], Array]
Mask = NDArray[np.bool_]

LOWER = (0.5, 1.2)
"""Height of the outline's lower part: at most these shares of its height and of its width."""
LEAST_WIDTH_PX, LEAST_DEPTH_PX = 24.0, 3.0
"""Least width of a foot, and least depth of its half ellipse: below these pixels decide."""
STRAIGHT, TAPER = 0.5, 0.25
"""Least length of the straight sides, over the foot's radius, and their largest slope towards each other."""
FLATTEST_DEG, STEEPEST_DEG = 5.0, 50.0
"""Angles below the horizontal between which a foot tells the pitch. Flatter ones may be straight edges, and what is
seen more steeply hides its sides."""
ROUGH = 0.015
"""Distance over the foot's radius within which 80 % of the outline keep to the ellipse: 0.009 on photos of cans."""
BETTER = 1.4
"""How many times as far the same share has to be from the foot of a box: 1.8 to 2.3 on those photos."""
SHARE = 0.8
SIGMA_DEG = 4.0
"""Standard deviation of a pitch that a foot tells: chamfered edges and what a mask takes of the shadow deepen it."""
ROBUST = 0.01
"""Scale of the robust loss, over the radius."""
CORNERS = 0.1
"""Height above the ends of the sides, over the radius, from which on what is below counts as the foot."""
BORDER_PX = 2
"""Width of the photo's border, along which the outline is the photo's."""


@dataclass(frozen=True)
class RoundFoot:
    """Lower half of an ellipse: the row of its centre, and half its width and height, in pixels."""

    row: float
    radius: float
    depth: float


def pitch_from_round_feet(masks: Sequence[Mask], size: tuple[int, int], focal: float) -> Gaussian | None:
    """Return the pitch in radians that the round feet of the things of ``masks`` (H, W) tell; None where none does.

    size: width and height of the photo in pixels; focal: focal length in pixels. Of several feet the mean counts, with
    the standard deviation of one: their errors are alike.
    """
    found = []
    for mask in masks:
        foot = round_foot(mask)
        if foot is None:
            continue
        below = math.asin(foot.depth / foot.radius)
        if math.radians(FLATTEST_DEG) <= below <= math.radians(STEEPEST_DEG):
            found.append(below - math.atan((foot.row - size[1] / 2.0) / focal))
    return Gaussian(float(np.mean(found)), math.radians(SIGMA_DEG)) if found else None


def round_foot(mask: Mask) -> RoundFoot | None:
    """Return the foot on which the thing of ``mask`` (H, W) stands if it is round and has straight sides above it."""
    points = _lower_outline(mask)
    if points is None:
        return None
    bottom = float(points[:, 1].max())
    middle, radius = float(points[:, 0].min() + points[:, 0].max()) / 2.0, float(np.ptp(points[:, 0])) / 2.0
    if 2.0 * radius < LEAST_WIDTH_PX:
        return None
    local = (points - [middle, bottom]) / radius
    arc = _fitted(local, _from_half_ellipse, [(0.0, -depth, 0.0, 0.0, 0.0, depth) for depth in (0.1, 0.3, 0.6)])
    # A box shows one corner of its foot, or none.
    box = _fitted(local, _from_corner, [(0.0, -0.2, 0.0, 0.0, 0.0, 0.2, at) for at in (-0.6, 0.0, 0.6)])
    across, depth = 1.0 + float(arc[2]), float(arc[5])
    straight = float(arc[1]) - float(local[:, 1].min())
    if not 0.0 < depth < across or depth * radius < LEAST_DEPTH_PX or abs(float(arc[3])) > TAPER:
        return None
    low = local[local[:, 1] > min(arc[1], box[1]) - CORNERS]
    if straight < STRAIGHT * across or len(low) == 0:
        return None
    apart = [float(np.quantile(np.abs(off), SHARE)) for off in (_from_half_ellipse(low, arc), _from_corner(low, box))]
    if apart[0] > ROUGH * across or apart[1] < BETTER * apart[0]:
        return None
    return RoundFoot(row=bottom + radius * float(arc[1]), radius=radius * across, depth=radius * depth)


def _lower_outline(mask: Mask) -> Array | None:
    """Points (n, 2) of the lower part of the outline; None where the photo's border cuts it."""
    height, width = mask.shape
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    loop = max(contours, key=cv2.contourArea)[:, 0, :].astype(np.float64)
    low, high = loop.min(axis=0), loop.max(axis=0)
    extent = high - low + 1.0
    split = high[1] - min(LOWER[0] * extent[1], LOWER[1] * extent[0])
    points = loop[loop[:, 1] > split]
    x, y = points.T
    if (x < BORDER_PX).any() or (x >= width - BORDER_PX).any() or (y >= height - BORDER_PX).any():
        return None
    return points + 0.5


def _fitted(local: Array, distances: Distances, starts: Sequence[tuple[float, ...]]) -> Array:
    """The parameters for which the ``distances`` from ``local`` (n, 2) are smallest."""
    found = [
        least_squares(lambda values: distances(local, values), start, loss="soft_l1", f_scale=ROBUST, max_nfev=60)
        for start in starts
    ]
    return np.asarray(min(found, key=lambda item: float(item.cost)).x)


def _from_sides(local: Array, values: Array) -> Array:
    """Distance (n,) from two straight sides, outwards. values: place of the middle of their lower ends, half their
    distance there less 1, slope towards each other, slope of both."""
    x, y, wider, taper, lean = values[:5]
    down = local[:, 1] - y
    return np.asarray((np.abs(local[:, 0] - x - lean * down) - (1.0 + wider - taper * down)) / math.hypot(1.0, taper))


def _from_half_ellipse(local: Array, values: Array) -> Array:
    """Distance (n,) from two sides, and from half an ellipse between their lower ends; its depth is the last value."""
    across, deep = max(1.0 + values[2], 0.1), max(values[5], 0.01)
    u, v = (local[:, 0] - values[0]) / across, (local[:, 1] - values[1]) / deep
    # To first order.
    radius = np.maximum(np.hypot(u, v), 1e-6)
    arc = (radius - 1.0) * radius / np.maximum(np.hypot(u / across, v / deep), 1e-6)
    return np.where(local[:, 1] < values[1], _from_sides(local, values), arc)


def _from_corner(local: Array, values: Array) -> Array:
    """Distance (n,) from two sides, and from two lines between their lower ends. values: at the end the corner's depth
    and its place between the sides, −1 to 1."""
    across, deep, at = max(1.0 + values[2], 0.1), values[5], float(np.clip(values[6], -0.98, 0.98))
    u, down = (local[:, 0] - values[0]) / across, local[:, 1] - values[1]
    left, right = deep * (u + 1.0) / (1.0 + at), deep * (1.0 - u) / (1.0 - at)
    slopes = np.where(u < at, deep / (1.0 + at), deep / (1.0 - at)) / across
    foot = (down - np.minimum(left, right)) / np.hypot(1.0, slopes)
    side = _from_sides(local, values)
    # Of a convex outline the farther line counts.
    return np.maximum(foot, side)
