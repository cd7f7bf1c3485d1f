# SPDX-License-Identifier: MIT
"""Which points of a piece are inside the pieces that stay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...errors import InputError
from ...mpm.distance import DistanceLattice, signed_distance
from ..splats import Splats
from .asset import Piece

LATTICE_CELLS = 96
"""Of the lattice of signed distances, across the piece's longest side."""


def lattice_of(piece: Piece) -> DistanceLattice:
    """Signed distances to the piece's surface. Raises InputError, which names the piece, where it is open or flat."""
    spacing = float(np.ptp(piece.surface.vertices, axis=0).max()) / LATTICE_CELLS
    try:
        return signed_distance(piece.surface, spacing, margin=2 * spacing)
    except InputError as error:
        raise InputError(f"{piece.name}: {error}") from None


def share_inside(splats: Splats, lattices: Sequence[DistanceLattice]) -> float:
    """Share of the splats' centres that are inside one of the surfaces."""
    inside = np.zeros(len(splats), dtype=np.bool_)
    for lattice in lattices:
        inside |= lattice.at(splats.centres)[0] < 0
    return float(inside.mean())
