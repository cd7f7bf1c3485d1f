# SPDX-License-Identifier: MIT
"""Scenes of two to five things on a table that start in each other, for judging whether their compositions stand.

A scene has no picture and is composed by physics alone (method ppps); only whether it stands is judged. Its things
would be at rest, but they start in each other by 1 to 2.5 % of the scene's size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from physgen.sim.gaussians.compose.compose_options import ComposeOptions
from physgen.sim.gaussians.compose.composition import compose
from physgen.sim.gaussians.compose.composition_parts import CompositionPart
from physgen.sim.gaussians.mesh_to_splats import splats_on_mesh
from physgen.sim.mpm.colliders import Surface
from physgen.sim.scene.model import Ground

from .sdf import Field, Triple, above, below, box_sdf, difference, ellipsoid, intersection, mesh_of, revolved, sphere

SPLATS = 800
"""Of a thing: particles of its surface."""


def loaf() -> tuple[Surface, ...]:
    """A loaf on a board, 24 cm."""
    board = box_sdf((0, 0, 0.010), (0.12, 0.08, 0.010), 0.004)
    bread = intersection(ellipsoid((0, 0, 0.025), (0.09, 0.05, 0.06)), above(0.0165), blend=0.008)
    return _solid(board, (0.12, 0.08, 0.02), 0.004), _solid(bread, (0.09, 0.05, 0.09), 0.0035)


def burger() -> tuple[Surface, ...]:
    """Two halves of a bun and what is between them, 11 cm."""
    lower = intersection(ellipsoid((0, 0, 0.03), (0.055, 0.055, 0.032)), below(0.025), above(0.001), blend=0.004)
    filling = revolved([(0, 0.029), (0.047, 0.029), (0.047, 0.037), (0, 0.037)], 0.006)
    upper = intersection(ellipsoid((0, 0, 0.041), (0.056, 0.056, 0.04)), above(0.0415), blend=0.004)
    halves = _solid(lower, (0.055, 0.055, 0.03), 0.0025), _solid(upper, (0.056, 0.056, 0.085), 0.0025)
    return halves[0], _solid(filling, (0.055, 0.055, 0.05), 0.0025), halves[1]


def cushions() -> tuple[Surface, ...]:
    """Four cushions, one on another, 30 cm."""
    return tuple(
        _solid(
            intersection(
                ellipsoid((0.004 * (-1) ** i, 0, 0.03 + 0.047 * i), (0.2, 0.2, 0.034)),
                box_sdf((0.004 * (-1) ** i, 0, 0.03 + 0.047 * i), (0.15 - 0.012 * i, 0.13, 0.027), 0.02),
                blend=0.01,
            ),
            (0.17, 0.15, 0.07 + 0.047 * i),
            0.006,
        )
        for i in range(4)
    )


def fruit() -> tuple[Surface, ...]:
    """A bowl with three oranges in it and a fourth on these, 20 cm."""
    dish = difference(
        intersection(ellipsoid((0, 0, 0.085), (0.1, 0.1, 0.085)), below(0.07), above(0.004), blend=0.006),
        ellipsoid((0, 0, 0.085), (0.091, 0.091, 0.074)),
        blend=0.004,
    )
    radius, ring = 0.036, 0.0405
    around = [(ring * np.cos(a), ring * np.sin(a), 0.0565) for a in np.pi * np.array([0.5, 7 / 6, 11 / 6])]
    on_top = (0.0, 0.0, 0.0565 + float(np.sqrt((2 * radius - 0.0015) ** 2 - ring**2)))
    oranges = [_solid(sphere(centre, radius), (0.1, 0.1, 0.16), 0.003) for centre in (*around, on_top)]
    return _solid(dish, (0.1, 0.1, 0.08), 0.0025), *oranges


TABLES: dict[str, Callable[[], tuple[Surface, ...]]] = {
    "loaf": loaf,
    "burger": burger,
    "cushions": cushions,
    "fruit": fruit,
}
"""By name, of two, three, four and five things; the lowest, which stays as it is, first."""


def composed_table(name: str, options: ComposeOptions) -> tuple[Surface, ...]:
    """Return the surfaces of the scene ``name`` composed with ``options``, in their order."""
    parts = [
        CompositionPart(
            name=f"{name} {number}",
            splats=splats_on_mesh(thing.vertices, thing.faces, np.full(thing.vertices.shape, 0.5), SPLATS),
            surface=thing,
        )
        for number, thing in enumerate(TABLES[name](), start=1)
    ]
    return tuple(part.surface for part in compose(parts, reference=None, options=options, ground=Ground()).parts)


def _solid(shape: Field, reach: Triple, spacing: float) -> Surface:
    """The surface of ``shape``, which lies within ``reach`` of the origin and above the ground."""
    low = (-reach[0] - 0.01, -reach[1] - 0.01, -0.01)
    high = (reach[0] + 0.01, reach[1] + 0.01, reach[2] + 0.01)
    vertices, faces = mesh_of(shape, low, high, spacing)
    return Surface(vertices=vertices, faces=faces)
