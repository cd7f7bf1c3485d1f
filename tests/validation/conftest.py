# SPDX-License-Identifier: MIT
"""Bodies and grids that the validation of the engine shares.

Tolerances in this folder are requirements (see docs/physics.md), not fits to what the engine does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.materials import ElasticMaterial
from physgen.sim.mpm.options import SolverOptions
from physgen.sim.scene.units import Similarity

GRID = 64
CELL = 2.0 / GRID  # metres, with the similarity below

BoxFactory = Callable[..., BodyParticles]


@pytest.fixture
def options() -> SolverOptions:
    return SolverOptions(grid=GRID)


@pytest.fixture
def similarity() -> Similarity:
    """A box of 2 m around the world's origin."""
    return Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0))


def lattice_box(
    *,
    cells: tuple[int, int, int] = (6, 6, 6),
    cell: float = CELL,
    bottom: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation: np.ndarray | None = None,
    youngs_modulus: float = 1e6,
    density: float = 1000.0,
    poisson_ratio: float = 0.3,
    name: str = "box",
    **motion: object,
) -> BodyParticles:
    """Box of 8 particles a cell, standing with the centre of its underside on ``bottom``, then rotated about it."""
    spacing = cell / 2
    counts = [2 * c for c in cells]
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    local = (index + 0.5) * spacing - np.array([counts[0], counts[1], 0]) * spacing / 2
    if rotation is not None:
        local = local @ rotation.T
    return BodyParticles(
        name=name,
        positions=local + np.asarray(bottom),
        volumes=np.full(len(local), spacing**3),
        material=ElasticMaterial(density=density, youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio),
        contact_radii=np.full(len(local), spacing / 2),
        **motion,
    )


@pytest.fixture
def box() -> BoxFactory:
    return lattice_box


@pytest.fixture
def cell() -> float:
    """Side of a grid cell in metres under ``options`` and ``similarity``."""
    return CELL
