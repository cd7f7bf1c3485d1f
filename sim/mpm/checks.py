# SPDX-License-Identifier: MIT
"""What is wrong with a world before it runs. No Taichi."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..scene.units import Similarity
from .setup import WorldSetup

DEEPEST_START = 1.0
"""Cells that a body may stand in the ground at the start; it is pushed out gently. Deeper is an error."""

FARTHEST_START = 100_000.0
"""Cells from the origin of the box that a body may start at; ``layout.FARTHEST_BLOCK`` sets the limit."""


def check_start(setup: WorldSetup, cells: Similarity) -> None:
    """Raise InputError for a body that is too far off or too deep in the ground.

    cells: the map from world metres to cells.
    """
    for body in setup.bodies:
        places = cells.points_to_engine(body.positions)
        if float(np.abs(places).max()) > FARTHEST_START:
            raise InputError(
                f"body {body.name!r}: positions reach {float(np.abs(places).max()):.3g} cells from the origin of the "
                f"box, {FARTHEST_START:.3g} are possible: use fit_similarity, or bring the bodies together"
            )
        if setup.ground is not None:
            assert body.contact_radii is not None
            gap = float((setup.ground.heights(body.positions) - body.contact_radii).min())
            if gap < -DEEPEST_START / cells.scale:
                raise InputError(
                    f"body {body.name!r}: positions reach {-gap:g} m below the ground: lift the body by that much"
                )
