# SPDX-License-Identifier: MIT
"""How finely a scene is simulated: the cell size that its quality asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..mpm.estimate import SAMPLING_BYTES, available_memory, require_memory
from ..mpm.options import SolverOptions
from ..mpm.placement import centred
from ..scene.meshes import ObjectMesh
from ..scene.units import Similarity
from .quality import Quality

BOX_BODIES = 4.0
"""Side of the box that ``Quality.grid`` divides, over the largest side of the box around all bodies at the start.
Chosen: the papers say how many cells their box has, not how much of it a scene fills."""

MAX_PARTICLES = 50_000_000
"""More is refused, whatever the memory."""


def resolve(
    names: Sequence[str], meshes: Sequence[ObjectMesh], quality: Quality, arch: str
) -> tuple[SolverOptions, Similarity]:
    """Solver options and similarity whose cells are as fine as ``quality`` wants for these bodies.

    Raises InputError when that would take absurdly many particles.
    """
    cell = cell_size(meshes, quality)
    _refuse_absurd(names, meshes, quality, cell)
    return _place(meshes, cell, quality, arch)


def cell_size(meshes: Sequence[ObjectMesh], quality: Quality) -> float:
    """Side of a grid cell in m."""
    points = np.concatenate([mesh.vertices for mesh in meshes])
    if quality.grid is not None:
        return BOX_BODIES * float(np.ptp(points, axis=0).max()) / quality.grid
    volume = max(sum(abs(mesh_volume(mesh)) for mesh in meshes), 1e-18)
    wanted = (volume * quality.particles_per_cell / quality.particles) ** (1 / 3)
    return min(wanted, min(_length(mesh) for mesh in meshes) / quality.smallest_cells)


def _refuse_absurd(names: Sequence[str], meshes: Sequence[ObjectMesh], quality: Quality, cell: float) -> None:
    lengths = [_length(mesh) for mesh in meshes]
    small, large = int(np.argmin(lengths)), int(np.argmax(lengths))
    if lengths[small] <= 0:
        raise InputError(f"object {names[small]}: mesh has no extent: give one whose vertices are not all in one place")
    each = [abs(mesh_volume(mesh)) / cell**3 * quality.particles_per_cell for mesh in meshes]
    count = sum(each)
    if count > MAX_PARTICLES:
        raise InputError(
            f"this would take about {count:.2g} particles, more than {MAX_PARTICLES:.2g}: cells of {cell:.2g} m, which "
            f"object {names[small]} ({lengths[small]:.2g} m) asks for, are too fine for object {names[large]} "
            f"({lengths[large]:.2g} m); choose a coarser quality, make one of them a collider, or check their sizes"
        )
    require_memory(int(count * SAMPLING_BYTES), int(count), available_memory())


def _place(meshes: Sequence[ObjectMesh], cell: float, quality: Quality, arch: str) -> tuple[SolverOptions, Similarity]:
    """Where the world stands in the engine's box: the bodies in its middle. They may leave it."""
    options = SolverOptions(grid=quality.grid or 256, particles_per_cell=quality.particles_per_cell, arch=arch)
    points = np.concatenate([mesh.vertices for mesh in meshes])
    return options, centred(0.5 * (points.min(axis=0) + points.max(axis=0)), cell, options)


def _length(mesh: ObjectMesh) -> float:
    return float(np.ptp(mesh.vertices, axis=0).max())


def mesh_volume(mesh: ObjectMesh) -> float:
    """Signed volume in m³ of a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)
