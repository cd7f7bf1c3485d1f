# SPDX-License-Identifier: MIT
"""How large the world is: by objects whose size is known, by a depth map in metres, or as is usual."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...errors import InputError
from .estimate import ViewEstimate

CONTRADICTION = 1.5
"""Sizes that want scales further apart than this cannot both be right."""


def metres_per_unit(
    extents_units: Sequence[float],
    sizes_m: Sequence[float | None],
    estimate: ViewEstimate,
    default_size_m: float,
    notice: Callable[[str], None],
) -> float:
    """Metres of one unit of a world in which the camera is 1 unit above the ground.

    extents_units: largest extent of each object, above 0. sizes_m: what it is in metres, None where unknown. Several
    sizes are weighed by their objects' extents (weighted median), for a large object is measured better. Without any, a
    metric depth map decides, else the first object is ``default_size_m``. Raises InputError for an extent that is no
    length.
    """
    for extent in extents_units:
        if not (np.isfinite(extent) and extent > 0):
            raise InputError(f"extent of an object is {extent!r}: a body must have one; give another mask or mesh")
    known = [(size / extent, extent) for extent, size in zip(extents_units, sizes_m, strict=True) if size is not None]
    if known:
        scale = _weighted_median(known)
        low, high = min(s for s, _ in known), max(s for s, _ in known)
        if high > CONTRADICTION * low:
            notice(
                f"the sizes of the objects contradict each other by a factor of {high / low:.1f}: the scene's scale is "
                "that of the larger part of them; check size_m, or the camera (pitch_deg, fov_deg)"
            )
        measured = estimate.metres_per_unit
        if measured is not None and max(measured / scale, scale / measured) > CONTRADICTION:
            notice(
                f"by {estimate.scale_source} the objects are {measured / scale:.2g} times as large as size_m says; "
                "size_m counts"
            )
        return scale
    if estimate.metres_per_unit is not None:
        largest = max(extents_units, default=0.0) * estimate.metres_per_unit
        notice(f"scale by {estimate.scale_source}: the largest object is {largest:.2g} m; size_m corrects that")
        return estimate.metres_per_unit
    if not extents_units:
        raise InputError("objects: none given; the scale of a world cannot be told from nothing")
    notice(f"no object has a size: the first one is taken to be {default_size_m:g} m large; set its size_m")
    return default_size_m / extents_units[0]


def _weighted_median(values: Sequence[tuple[float, float]]) -> float:
    """The smallest value at which half of the weight is reached; of two of equal weight, their geometric mean."""
    ordered = sorted(values)
    half = sum(weight for _, weight in ordered) / 2.0
    reached = 0.0
    for index, (value, weight) in enumerate(ordered):
        reached += weight
        if abs(reached - half) < 1e-9 * half and index + 1 < len(ordered):
            return float(np.sqrt(value * ordered[index + 1][0]))
        if reached > half:
            return value
    return ordered[-1][0]
