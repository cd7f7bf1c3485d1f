# SPDX-License-Identifier: MIT
"""Checks and measures before a world is set up: the cell size of a quality, usable meshes, bodies above the ground, and
the positions of a collider's vertices over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..errors import InputError
from ..memory import available_memory, require_memory
from ..mpm.colliders import Collider, Surface, Track
from ..mpm.cost_estimate import SAMPLING_BYTES
from ..mpm.geometry.mesh_checks import check_surface
from ..mpm.solver_options import SolverOptions, centred
from ..scene.bake_quality import Quality
from ..scene.meshes import ObjectMesh
from ..scene.model import Ground
from ..scene.units import Similarity


def moves(collider: Collider) -> bool:
    """Return whether ``collider`` ever moves."""
    return any(track is not None for track in (collider.translations, collider.rotations, collider.vertices))


def vertices_at(collider: Collider, time: float) -> NDArray[np.float64]:
    """Return the vertices (V, 3) of ``collider`` in world metres at ``time`` in s."""
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


BOX_BODIES = 4.0
"""Side of the box that ``Quality.grid`` divides, over the largest side of the box around all bodies at the start.
Chosen: the papers say how many cells their box has, not how much of it a scene fills."""

MAX_PARTICLES = 50_000_000
"""More is refused, whatever the memory."""


def resolve(
    names: Sequence[str], meshes: Sequence[ObjectMesh], quality: Quality, arch: str
) -> tuple[SolverOptions, Similarity]:
    """Return solver options and similarity whose cells are as fine as ``quality`` asks for these bodies.

    Raises InputError when that would take absurdly many particles.
    """
    cell = cell_size(meshes, quality)
    _refuse_absurd(names, meshes, quality, cell)
    return _place(meshes, cell, quality, arch)


def cell_size(meshes: Sequence[ObjectMesh], quality: Quality) -> float:
    """Return the side of a grid cell in m."""
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
    require_memory(
        int(count * SAMPLING_BYTES),
        available_memory(),
        what=f"{int(count)} particles",
        remedy="choose a coarser quality, make more objects colliders",
    )


def _place(meshes: Sequence[ObjectMesh], cell: float, quality: Quality, arch: str) -> tuple[SolverOptions, Similarity]:
    """Where the world stands in the engine's box: the bodies in its middle. They may leave it."""
    options = SolverOptions(grid=quality.grid or 256, particles_per_cell=quality.particles_per_cell, arch=arch)
    points = np.concatenate([mesh.vertices for mesh in meshes])
    return options, centred(0.5 * (points.min(axis=0) + points.max(axis=0)), cell, options)


def _length(mesh: ObjectMesh) -> float:
    return float(np.ptp(mesh.vertices, axis=0).max())


def mesh_volume(mesh: ObjectMesh) -> float:
    """Return the signed volume in m³ of a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


Array = NDArray[np.float64]

DEEPEST_CELLS = 1.0
"""Cells that a body may stand in the ground, or two in each other, at the start: contact pushes them out gently."""


def surface_warnings(surface: Surface, name: str, cell: float) -> list[str]:
    """Return warnings about the mesh of object ``name``. Raises InputError for an unusable one."""
    return [str(warning) for warning in check_surface(surface, name=f"object {name}", cell_size=cell)]


def require_above_ground(name: str, vertices: Array, ground: Ground, cell: float) -> None:
    """Raise InputError when object ``name`` reaches more than ``DEEPEST_CELLS`` into the ground."""
    depth = -float(ground.heights(vertices).min())
    if depth > DEEPEST_CELLS * cell:
        raise InputError(
            f"object {name}: its lowest vertex is {depth:.3g} m below the ground: lift it by that much "
            "(world_from_mesh), lower ground.point, or make it a collider"
        )
