# SPDX-License-Identifier: MIT
"""The ground below objects that are brought to fit: what yields must not be pushed into it. No Taichi."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..mpm.colliders import Surface
from ..scene.model import Ground

Array = NDArray[np.float64]

NEAR = 0.5
"""Share of an object's size; what is higher above the ground does not come down to it."""

SUNK = 0.02
"""Share of an object's size by which it may reach into the ground and still be held by it. What is deeper was put there
on purpose, and lifting it out would tear it from where the picture shows it."""

MARGIN = 0.3
"""How far the slab reaches beyond the objects, as a share of their extent."""

THICKNESS = 0.3
"""Of the slab, as the same share."""

_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def holds(ground: Ground | None, surface: Surface) -> bool:
    """Whether the ground is in reach of ``surface``, and not already passed by it."""
    if ground is None:
        return False
    size = float(np.ptp(surface.vertices, axis=0).max())
    lowest = float(ground.heights(surface.vertices).min())
    return -SUNK * size <= lowest <= NEAR * size


def with_ground(surface: Surface, ground: Ground, others: Sequence[Surface]) -> Surface:
    """``surface``, of what stays, and a slab of ground below it and ``others``, as one surface of two parts.

    They may overlap: inside is what is in either. The slab is closed and as small as it can be, because distances to it
    are kept on a lattice. Its upper face is the plane; where ``others`` reach below it by a hair, so much lower.
    """
    normal = ground.unit_normal
    side = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(normal, side), normal])
    points = np.concatenate([surface.vertices, *(other.vertices for other in others)]) - np.asarray(ground.point)
    local = points @ frame.T
    extent = float(np.ptp(local, axis=0).max())
    low, high = local.min(axis=0) - MARGIN * extent, local.max(axis=0) + MARGIN * extent
    reach = np.concatenate([other.vertices for other in others]) - np.asarray(ground.point)
    high[2] = min(0.0, float((reach @ normal).min()))
    low[2] = high[2] - THICKNESS * extent
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    faces = np.array([[q[0], q[1], q[2]] for q in _QUADS] + [[q[0], q[2], q[3]] for q in _QUADS])
    return Surface(
        vertices=np.concatenate([surface.vertices, corners @ frame + np.asarray(ground.point)]),
        faces=np.concatenate([surface.faces, faces + len(surface.vertices)]),
    )


def depth_below(ground: Ground | None, surface: Surface) -> float:
    """How far ``surface`` reaches below the ground, in metres; 0 where it does not, or there is none."""
    return 0.0 if ground is None else max(0.0, -float(ground.heights(surface.vertices).min()))
