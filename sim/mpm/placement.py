# SPDX-License-Identifier: MIT
"""Choosing the similarity map: how large the scene stands in the engine's box, and where."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.units import ENGINE_BOX_SIZE, Similarity
from .options import PADDING_CELLS, Ground, SolverOptions

MIN_CELLS_ACROSS = 3.0
"""Fewest cells that the longest side of a body may have."""


def fit_similarity(
    bodies: Sequence[NDArray[np.floating]],
    ground: Ground | None,
    *,
    motion_margin: float | None = None,
    cells_across: float = 32.0,
    options: SolverOptions | None = None,
) -> Similarity:
    """The map that puts the bodies into the engine's box with room to move.

    bodies: points (N, 3) of each body in world metres: mesh vertices before sampling, or particles.
    motion_margin: metres that bodies may move beyond where they start, besides down to the ground; None takes the
        larger of the longest body's length and the height of fall.
    cells_across: grid cells wanted along the longest side of the largest body. Fewer result when the box is too small
        for it; the box is never made smaller than the margin needs.

    Raises InputError when a body would get fewer than 3 cells along its longest side.
    """
    options = options or SolverOptions()
    if not bodies:
        raise InputError("bodies is empty: give the points of at least one body")
    for i, points in enumerate(bodies):
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
            raise InputError(f"bodies[{i}] has shape {points.shape}: give finite points (N, 3), N above 0")
    boxes = [(np.min(points, axis=0), np.max(points, axis=0)) for points in bodies]
    lengths = [float((high - low).max()) for low, high in boxes]
    low = np.min([b[0] for b in boxes], axis=0).astype(np.float64)
    high = np.max([b[1] for b in boxes], axis=0).astype(np.float64)
    fall = 0.0
    if ground is not None:
        normal = np.asarray(ground.normal, dtype=np.float64)
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        heights = (corners - np.asarray(ground.point)) @ normal
        fall = max(0.0, float(heights.min()))
        feet = corners - np.outer(np.clip(heights, 0.0, fall), normal)
        low, high = np.minimum(low, feet.min(axis=0)), np.maximum(high, feet.max(axis=0))
    if motion_margin is None:
        motion_margin = max(max(lengths), fall)
    if not (math.isfinite(motion_margin) and motion_margin >= 0):
        raise InputError(f"motion_margin is {motion_margin!r}: give metres, 0 or more")
    largest = max(lengths)
    if largest <= 0:
        raise InputError("bodies have no extent: give points that are not all in one place")
    side = float(np.max(high - low)) + 2 * motion_margin
    usable = options.grid - 2 * PADDING_CELLS
    cells_per_metre = min(usable / side, cells_across / largest)
    smallest = min(lengths)
    if smallest * cells_per_metre < MIN_CELLS_ACROSS:
        raise InputError(
            f"a body of {smallest:g} m gets {smallest * cells_per_metre:.1f} cells along its longest side in a box of "
            f"{options.grid / cells_per_metre:g} m: reduce motion_margin ({motion_margin:g} m), simulate fewer bodies "
            f"at once, or raise the solver option grid ({options.grid})"
        )
    scale = cells_per_metre * ENGINE_BOX_SIZE / options.grid
    centre = 0.5 * (low + high)
    origin = centre - 0.5 * ENGINE_BOX_SIZE / scale
    return Similarity(scale=scale, origin=(float(origin[0]), float(origin[1]), float(origin[2])))
