# SPDX-License-Identifier: MIT
"""The whole outline of a partly hidden solid: the projection of an upright box, or of a round body such as a mug or a
bottle, that fits what is seen of its outline.

The camera need not be known: how far it looks down and how strong its perspective is are fitted too, near what photos
of things on tables and floors have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .mask_geometry import Mask, extent_of, grown
from .outline_guesses import OutlineGuess, contour_of, filled_hull, known_share, on_own_edge

Points = NDArray[np.float64]
Values = NDArray[np.float64]

POINTS = 72
"""Points of the visible outline to which a solid is fitted."""
FEWEST = 16
"""Visible points of the outline below which none is fitted."""
TRUST = 0.35
"""Pixels of the outline, in the copy, that one spread of what is usual is worth."""
NOISE = 1.5
"""Distance in pixels of the copy from which a point of the outline counts linearly: a handle is no part of the fit."""

CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
BOX_STARTS = tuple((yaw, pitch) for pitch in (12.0, 30.0, 50.0) for yaw in (15.0, 45.0, 75.0))
"""Turns about the vertical and downward looks of the camera from which the fit of a box starts, degrees."""
BOX_SCALES = (10.0, 10.0, 0.3, 0.3, 15.0, 10.0, 0.1, 2.0, 0.3)
BOX_USUAL = ((2, 0.0, 0.7), (3, 0.0, 0.7), (5, 25.0, 15.0), (6, 0.2, 0.12), (7, 0.0, 2.0))
"""What photos show where the outline does not tell: number of a parameter (`_box`), its usual value and spread."""
DEEPEST = 0.45
"""Largest half depth of a box over its distance."""
BOX_MISFIT = 0.02
"""Largest misfit of a box: drawn boxes had up to 0.012, a cone in the pictures of the benchmark 0.036."""

CORNER, UNSEEN = 6.0, 0.03
"""Distance of a corner from a seen point of the outline, in pixels of the copy, up to which it is seen; cost of each
length of a box, and of the foot and either wall of a round body, that the outline does not show."""

AROUND = np.stack([np.cos(np.linspace(0.0, 2.0 * np.pi, 25)[:-1]), np.sin(np.linspace(0.0, 2.0 * np.pi, 25)[:-1])], 1)
ROUND_STARTS = (0.1, 0.3, 0.55)
"""Heights over widths of the foot's ellipse from which the fit of a round body starts."""
ROUND_SCALES = (5.0, 5.0, 0.2, 0.2, 10.0, 0.1, 0.1, 2.0)
THICK, ASIDE = 0.2, 0.1
"""Radius over the width of what is seen from which a part is of the round body itself, not of a handle or a neck; cost
of such a part, over that of the same area which the body covers but is not there."""
ROUND_USUAL = ((5, -1.2, 0.6), (6, 0.1, 0.1), (7, 0.0, 2.0))


def _box(parameters: Values) -> Points:
    """Return the corners (8, 2) in pixels of the box with ``parameters``: x, y of its middle, logarithms of its two
    horizontal lengths over its height, yaw, downward look of the camera and half depth of the longest side over its
    distance, roll, and logarithm of half its height in pixels; angles in degrees."""
    x, y, across, along, yaw, pitch, depth, roll, size = parameters
    a, b = np.exp(np.clip([across, along], -4.0, 4.0))
    turn, down = np.radians([yaw, pitch])
    points = CORNERS * np.array([a, b, 1.0])
    right = points[:, 0] * np.cos(turn) - points[:, 1] * np.sin(turn)
    ahead = points[:, 0] * np.sin(turn) + points[:, 1] * np.cos(turn)
    up = ahead * np.sin(down) + points[:, 2] * np.cos(down)
    far = ahead * np.cos(down) - points[:, 2] * np.sin(down)
    scale = np.exp(np.clip(size, -2.0, 7.0)) / (1.0 + np.clip(depth, -DEEPEST, DEEPEST) * far / max(1.0, a, b))
    return _rolled(np.stack([right, -up], axis=1) * scale[:, None], roll) + np.array([x, y])


def _round_body(parameters: Values) -> Points:
    """Return points (n, 2) in pixels around the foot and the top of the frustum with ``parameters``: x, y of the foot's
    middle, logarithms of its radius and of the top's over it, height, logarithm of the height over width of the foot's
    ellipse, how much flatter the top's is in its logarithm, and roll in degrees."""
    x, y, size, taper, height, flat, flatter, roll = parameters
    foot, top = np.exp(np.clip(size, -2.0, 7.0)), np.exp(np.clip(size + taper, -4.0, 7.0))
    low, high = np.exp(np.clip([flat, flat - flatter], -6.0, 0.0))
    rings = [AROUND * [foot, foot * low], AROUND * [top, top * high] - [0.0, height]]
    return _rolled(np.concatenate(rings), roll) + np.array([x, y])


def _rolled(points: Points, degrees: float) -> Points:
    turn = np.radians(degrees)
    return np.asarray(points @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]))


def _signed_distance(points: Points, solid: Points) -> Values:
    """Distance (n,) of ``points`` (n, 2) to the convex hull of ``solid``, in pixels, negative inside."""
    # The order alone: single precision has no derivatives by differences.
    hull = solid[cv2.convexHull(solid.astype(np.float32), returnPoints=False)[:, 0]]
    along = np.roll(hull, -1, axis=0) - hull
    length = np.linalg.norm(along, axis=1)
    keep = length > 1e-3
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)[keep] / length[keep, None]
    if float(((hull.mean(axis=0) - hull[keep]) * normal).sum(axis=1).mean()) > 0.0:
        normal = -normal
    return np.asarray(((points[:, None] - hull[None, keep]) * normal[None]).sum(axis=2).max(axis=1))


def _fitted(
    own: Points,
    solid: Callable[[Values], Points],
    starts: Sequence[Values],
    scales: Sequence[float],
    usual: Sequence[tuple[int, float, float]],
) -> Points | None:
    """Return the points of ``solid`` at the parameters whose hull passes best through ``own`` (n, 2)."""
    # Half a second of imports that every bake and command would pay.
    from scipy.optimize import least_squares

    index = [row[0] for row in usual]
    middle, spread = (np.array([row[k] for row in usual]) for k in (1, 2))
    weight = TRUST * np.sqrt(len(own)) / spread

    def residuals(parameters: Values) -> Values:
        return np.concatenate([_signed_distance(own, solid(parameters)), (parameters[index] - middle) * weight])

    fits = [
        least_squares(residuals, start, loss="soft_l1", f_scale=NOISE, x_scale=scales, max_nfev=40) for start in starts
    ]
    result = solid(min(fits, key=lambda fit: float(fit.cost)).x)
    return result if np.isfinite(result).all() and np.abs(result).max() < 1e4 else None


def _own_points(seen: Mask, unknown: Mask, among: Mask) -> Points | None:
    """Points (n, 2) ``among`` those (h, w) of the object's own outline; None where they are too few."""
    contour = contour_of(seen)
    own = contour[on_own_edge(contour, unknown)]
    own = own[among[own[:, 1].astype(int), own[:, 0].astype(int)]]
    if len(own) < FEWEST:
        return None
    return np.asarray(own[np.linspace(0, len(own) - 1, min(POINTS, len(own))).round().astype(int)])


def box(seen: Mask, unknown: Mask) -> OutlineGuess | None:
    """Return the box whose outline fits that of ``seen`` (h, w); None where none does."""
    own = _own_points(seen, unknown, seen)
    if own is None:
        return None
    x0, y0, x1, y1 = extent_of(seen)
    low, high = np.array([x0, y0], dtype=np.float64), np.array([x1, y1], dtype=np.float64)
    size = np.log(0.35 * float(max(high - low)) + 1.0)
    starts = [np.array([*(0.5 * (low + high)), 0.0, 0.0, yaw, pitch, 0.2, 0.0, size]) for yaw, pitch in BOX_STARTS]
    corners = _fitted(own, _box, starts, BOX_SCALES, BOX_USUAL)
    if corners is None:
        return None
    outline = filled_hull(corners, seen.shape)
    misfit = known_share(outline ^ seen, seen, unknown)
    if misfit > BOX_MISFIT:
        return None
    return OutlineGuess("box", outline, misfit + UNSEEN * _unseen_lengths(corners, own))


def _distances(points: Points, own: Points) -> Values:
    """Distance (n,) of each of ``points`` (n, 2) to the nearest of ``own`` (m, 2)."""
    return np.asarray(np.linalg.norm(points[:, None] - own[None], axis=2).min(axis=1))


def _unseen_lengths(corners: Points, own: Points) -> int:
    """For how many of the box's three lengths no edge of its outline is seen with both ends in ``own`` (n, 2)."""
    hull = cv2.convexHull(corners.astype(np.float32), returnPoints=False)[:, 0]
    seen = _distances(corners, own) < CORNER
    lengths: dict[int, bool] = {}
    for first, second in zip(hull, np.roll(hull, -1), strict=True):
        axes = np.flatnonzero(CORNERS[first] != CORNERS[second])
        if len(axes) == 1:
            lengths[int(axes[0])] = lengths.get(int(axes[0]), False) or bool(seen[first] and seen[second])
    return sum(not known for known in lengths.values())


def round_body(seen: Mask, unknown: Mask) -> OutlineGuess | None:
    """Return ``seen`` (h, w) with the upright frustum that fits its outline; None where none does. A handle, a neck or
    a spout may stick out of it."""
    x0, y0, x1, y1 = extent_of(seen)
    side = 2 * max(1, round(THICK * (x1 - x0))) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    trunk = (cv2.morphologyEx((seen | unknown).astype(np.uint8), cv2.MORPH_OPEN, disc) > 0) & seen
    own = _own_points(seen, unknown, grown(trunk, 1))
    if own is None:
        return None
    x0, y0, x1, y1 = extent_of(trunk)
    low, high = np.array([x0, y0], dtype=np.float64), np.array([x1, y1], dtype=np.float64)
    radius, height = 0.5 * float(high[0] - low[0]) + 1.0, float(high[1] - low[1])
    starts = [
        np.array(
            [0.5 * (low[0] + high[0]), high[1] - flat * radius, np.log(radius), 0.0, height, np.log(flat), 0.1, 0.0]
        )
        for flat in ROUND_STARTS
    ]
    rings = _fitted(own, _round_body, starts, ROUND_SCALES, ROUND_USUAL)
    if rings is None:
        return None
    body = filled_hull(rings, seen.shape)
    misfit = known_share(body & ~seen, seen, unknown) + known_share(trunk & ~body, seen, unknown)
    misfit += ASIDE * known_share(seen & ~trunk, seen, unknown)
    foot, top = np.split(rings, 2)
    front = foot[AROUND[:, 1] > -0.01]
    ends = ([ring[np.argmax(side * ring[:, 0])] for ring in (foot, top)] for side in (-1.0, 1.0))
    told = (front, *(np.linspace(low, high, 9)[2:-2] for low, high in ends))
    misfit += UNSEEN * sum(float(_distances(part, own).min()) > CORNER for part in told)
    return OutlineGuess("round_body", body | seen, misfit)
