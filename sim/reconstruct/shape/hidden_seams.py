# SPDX-License-Identifier: MIT
"""Seams on the side that the photo does not show, between parts whose colours come from different places of it.

Neighbours there may have counterparts far from each other: one has its own behind an ear, the next one behind the
belly. Between them the colours would change along the edges of faces, in teeth, through whatever the photo shows in
between. Around such seams the colours are harmonic instead: they change evenly from one side to the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from ...smoothstep import smoothstep
from .body_texture import distance_behind
from .inflated_mesh import BodyMesh

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

JUMP = (3.0, 0.02)
"""Distance of two neighbours' counterparts above which there is a seam between them: over that of the neighbours, and
added to that, over the object's size."""
WIDTH = 0.08
"""Distance from a seam up to which colours are blended, over the object's size."""
WHOLE = 0.3
"""Share of that within which nothing is left of the counterparts' own colours."""
WEAK = 1e-6
"""Weight of a vertex' own colour where it is free, so that parts without anything fixed keep a mean of theirs."""


def blended(body: BodyMesh, seen: Mask, like: Points, colours: Points, size: float) -> tuple[Points, Points]:
    """Return colours (V, 3) without seams, and how much (V,) of a vertex' colour they are, 0 to 1.

    seen: (V,) what the photo shows; like: (V, 2) the counterparts in pixels, whose ``colours`` are (V, 3); size: of the
    object in pixels.
    """
    none = colours, np.zeros(len(colours))
    ends = np.concatenate([body.faces, np.roll(body.faces, -1, axis=1)], axis=0).reshape(2, -1).T
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    first, second = ends.T
    extent = np.ptp(body.pixels, axis=0).max() / max(float(np.ptp(body.vertices, axis=0).max()), 1e-12)
    length = np.linalg.norm(body.vertices[first] - body.vertices[second], axis=1) * extent
    apart = np.linalg.norm(like[first] - like[second], axis=1)
    torn = (apart > JUMP[0] * length + JUMP[1] * size) & ~(seen[first] & seen[second])
    if not torn.any():
        return none
    seam = np.zeros(len(colours), dtype=bool)
    seam[ends[torn]] = True
    away = distance_behind(body, seam, size) / (WIDTH * size)
    share = (1.0 - smoothstep(away, WHOLE, 1.0)) * ~seen
    free = share > 0.0
    if not free.any():
        return none
    count = len(colours)
    links = sparse.coo_matrix((np.ones(2 * len(ends)), (np.r_[first, second], np.r_[second, first])), (count, count))
    rows = links.tocsr()[free]
    inner = rows[:, free]
    matrix = sparse.diags(np.asarray(rows.sum(axis=1)).ravel() + WEAK) - inner
    right = rows[:, ~free] @ colours[~free] + WEAK * colours[free]
    made = colours.copy()
    made[free] = spsolve(matrix.tocsc(), right).reshape(-1, 3)
    return made, share
