# SPDX-License-Identifier: MIT
"""Where the vertices of a collider are at a time, for its cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..mpm.colliders import Collider
from ..mpm.tracks import Track


def moves(collider: Collider) -> bool:
    """Whether ``collider`` ever leaves its place."""
    return any(track is not None for track in (collider.translations, collider.rotations, collider.vertices))


def vertices_at(collider: Collider, time: float) -> NDArray[np.float64]:
    """Vertices (V, 3) of ``collider`` in world metres at ``time`` in s."""
    if collider.vertices is not None:
        return collider.vertices.at(time)
    vertices = collider.surface.vertices
    if collider.rotations is not None:
        vertices = (vertices - collider.middle) @ _turn(collider.rotations, time).T + collider.middle
    if collider.translations is not None:
        vertices = vertices + collider.translations.at(time)
    return vertices


def _turn(rotations: Track, time: float) -> NDArray[np.float64]:
    keys = Rotation.from_rotvec(rotations.values)
    if len(rotations.times) == 1:
        return np.asarray(keys[0].as_matrix())
    clamped = float(np.clip(time, rotations.times[0], rotations.times[-1]))
    return np.asarray(Slerp(rotations.times, keys)(clamped).as_matrix())
