# SPDX-License-Identifier: MIT
"""A piece as matter: its splats, and a skin of places on its surface, which is what touches.

Splats are fitted a little under the surface that they show (``fit.start``). If they alone met the boundary, the surface
would stay in it by as much. So vertices of the surface are particles too. They are not seen and have no gradient: their
velocity is the mean of the splats around them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ...events import IsCancelled, never
from ...mpm.colliders import Collider, Surface
from ..physics.carry import CarriedMesh
from ..physics.options import StepOptions
from ..physics.step import PhysicalBody
from .asset import Piece

Array = NDArray[np.float64]

NEIGHBOURS = 8
"""Splats from which a place of the skin takes its velocity."""

LEAST_SKIN = 2_000
"""Places of the skin at least, where the surface has as many vertices; else as many as there are splats."""


class Matter:
    """``piece`` as a body that obstacles hold back. Raises what ``PhysicalBody`` raises."""

    def __init__(self, piece: Piece, obstacles: Sequence[Collider], options: StepOptions, *, seed: int = 0) -> None:
        centres, vertices = piece.splats.centres, piece.surface.vertices
        self._count = len(centres)
        most = max(LEAST_SKIN, self._count)
        kept = np.arange(len(vertices))
        if len(kept) > most:
            kept = np.sort(np.random.default_rng(seed).choice(kept, most, replace=False))
        skin = vertices[kept]
        self._follow = _means(centres, skin)
        self._body = PhysicalBody(
            points=np.concatenate([centres, skin]), surface=piece.surface, obstacles=obstacles, options=options
        )
        self._mesh = CarriedMesh(piece.surface, self._body)

    @property
    def cell(self) -> float:
        """Side of the grid's cells in metres."""
        return self._body.cell

    @property
    def points(self) -> Array:
        """Where the splats' centres are, (N, 3) world metres."""
        return self._body.points[: self._count]

    @property
    def gradients(self) -> Array:
        """Deformation gradients (N, 3, 3) of the splats since the start."""
        return self._body.gradients[: self._count]

    def step(self, velocities: Array, stop: IsCancelled = never) -> None:
        """One step of the simulator from velocities (N, 3) of the splats, metres a step."""
        self._body.step(self._with_skin(velocities), stop=stop)

    def place(self, points: Array) -> None:
        """Put the splats at (N, 3) without physics; skin and filling go along."""
        now = self._body.points
        self._body.place(now + self._with_skin(points - now[: self._count]))

    def surface(self) -> Surface:
        """The piece's surface as its particles carry it."""
        return self._mesh.now()

    def cleared_surface(self) -> Surface:
        """The same with its faces lifted out of the obstacles where interpolation has left them in."""
        return self._mesh.cleared()

    def _with_skin(self, values: Array) -> Array:
        return np.concatenate([values, self._follow @ values])


def _means(centres: Array, skin: Array) -> csr_matrix:
    """The matrix (M, N) that gives each place of the skin the mean of its nearest centres, by 1 / distance²."""
    distance, nearest = cKDTree(centres).query(skin, k=min(NEIGHBOURS, len(centres)))
    weights = 1.0 / np.maximum(distance, 1e-9 + 1e-3 * np.median(distance)) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(skin)), weights.shape[1])
    return csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=(len(skin), len(centres)))
