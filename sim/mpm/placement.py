# SPDX-License-Identifier: MIT
"""Choosing the similarity map: how many cells a body gets, and where it stands in the engine's box."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.units import ENGINE_BOX_SIZE, Similarity
from .options import SolverOptions

MIN_CELLS_ACROSS = 3.0
"""Fewest cells that the longest side of a body may have."""


def fit_similarity(
    bodies: Sequence[NDArray[np.floating]], *, cells_across: float = 32.0, options: SolverOptions | None = None
) -> Similarity:
    """The map that gives the largest body ``cells_across`` cells along its longest side, the bodies amid the box.

    bodies: points (N, 3) of each body in world metres: mesh vertices before sampling, or particles.

    The box is a place to count cells from, not a limit: bodies may start and go outside of it. Raises InputError when
    a body would get fewer than 3 cells along its longest side.
    """
    options = options or SolverOptions()
    if not bodies:
        raise InputError("bodies is empty: give the points of at least one body")
    if not (math.isfinite(cells_across) and cells_across >= MIN_CELLS_ACROSS):
        raise InputError(f"cells_across is {cells_across!r}: give {MIN_CELLS_ACROSS:g} or more")
    for i, points in enumerate(bodies):
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
            raise InputError(f"bodies[{i}] has shape {points.shape}: give finite points (N, 3), N above 0")
    boxes = [(np.min(points, axis=0), np.max(points, axis=0)) for points in bodies]
    lengths = [float((high - low).max()) for low, high in boxes]
    if max(lengths) <= 0:
        raise InputError("bodies have no extent: give points that are not all in one place")
    cells_per_metre = cells_across / max(lengths)
    if min(lengths) * cells_per_metre < MIN_CELLS_ACROSS:
        raise InputError(
            f"a body of {min(lengths):g} m gets {min(lengths) * cells_per_metre:.1f} cells along its longest side "
            f"beside one of {max(lengths):g} m: raise cells_across ({cells_across:g}), or simulate them apart"
        )
    low = np.min([b[0] for b in boxes], axis=0).astype(np.float64)
    high = np.max([b[1] for b in boxes], axis=0).astype(np.float64)
    return centred(0.5 * (low + high), 1.0 / cells_per_metre, options)


def centred(middle: NDArray[np.float64], cell: float, options: SolverOptions) -> Similarity:
    """The map with cells of ``cell`` metres and the world point ``middle`` (3,) amid the box."""
    scale = ENGINE_BOX_SIZE / (options.grid * cell)
    origin = middle - 0.5 * ENGINE_BOX_SIZE / scale
    return Similarity(scale=scale, origin=(float(origin[0]), float(origin[1]), float(origin[2])))
