# SPDX-License-Identifier: MIT
"""Where the vertices of a collider are at a time, for its cache.

How finely a scene is simulated: the cell size that its quality asks for.

What a scene must hold at the start: bodies above the ground and beside one another, on sound meshes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..mpm.colliders import Collider, Surface, Track
from ..mpm.cost_estimate import SAMPLING_BYTES, available_memory, require_memory
from ..mpm.geometry.mesh_checks import check_surface
from ..mpm.geometry.signed_distance import overlap, signed_distance
from ..mpm.solver_options import SolverOptions, centred
from ..scene.meshes import ObjectMesh
from ..scene.model import Ground
from ..scene.units import Similarity
from .bake_quality import Quality


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


Array = NDArray[np.float64]

DEEPEST_CELLS = 1.0
"""Cells that a body may stand in the ground, or two in each other, at the start: contact pushes them out gently."""

TOUCHING = 0.05
"""Share of the particle spacing below which two bodies touch and do not overlap."""


def surface_warnings(surface: Surface, name: str, cell: float) -> list[str]:
    """What is unusual about the mesh of object ``name``. Raises InputError for one that cannot be used."""
    return [str(warning) for warning in check_surface(surface, name=f"object {name}", cell_size=cell)]


def collider_warnings(bodies: Sequence[BodyParticles], colliders: Sequence[Collider], cell: float) -> list[str]:
    """What stands a little in a collider. Raises InputError for a body more than a cell deep in one."""
    warnings: list[str] = []
    for body, collider in itertools.product(bodies, colliders):
        surface = collider.surface.vertices
        low, high = body.positions.min(axis=0) - cell, body.positions.max(axis=0) + cell
        # One that comes in later meets the collider wherever that has got to by then.
        if body.start_time > 0 or (surface.max(axis=0) < low).any() or (surface.min(axis=0) > high).any():
            continue
        # No finer than the lattice of a large collider bears; bodies and colliders are then judged more coarsely.
        spacing = max(cell, float(np.ptp(surface, axis=0).max()) / 200)
        depth = overlap(body.positions, signed_distance(collider.surface, spacing, margin=0.0))
        if depth > DEEPEST_CELLS * spacing:
            raise InputError(
                f"object {body.name}: is {depth:.2g} m deep in object {collider.name} at the start: move them apart "
                "(world_from_mesh), or let it come in later (start_time)"
            )
        if depth > TOUCHING * spacing:
            warnings.append(f"{body.name} stands {depth * 1000:.2g} mm in {collider.name} and will be pushed out")
    return warnings


def require_above_ground(name: str, vertices: Array, ground: Ground, cell: float) -> None:
    """Raise InputError when object ``name`` reaches more than ``DEEPEST_CELLS`` into the ground."""
    depth = -float(ground.heights(vertices).min())
    if depth > DEEPEST_CELLS * cell:
        raise InputError(
            f"object {name}: its lowest vertex is {depth:.3g} m below the ground: lift it by that much "
            "(world_from_mesh), lower ground.point, or make it a collider"
        )


def overlap_warnings(bodies: Sequence[BodyParticles], spacing: float, cell: float) -> list[str]:
    """What overlaps a little at the start. Raises InputError for bodies that are more than a cell inside each other.

    A ball of the contact radius around a particle lies inside its body; where two of them meet, the bodies do. Bodies
    that come in at different times do not count.
    """
    warnings = []
    for a, b in itertools.combinations(bodies, 2):
        if a.start_time != b.start_time:
            continue
        depth = _overlap(a, b, spacing)
        if depth > DEEPEST_CELLS * cell:
            raise InputError(
                f"object {a.name} and object {b.name}: they overlap at the start, {depth:.2g} m deep or more: move "
                "them apart (world_from_mesh), let one come in later (start_time), or make one a collider"
            )
        if depth > 0:
            warnings.append(
                f"{a.name} and {b.name} overlap a little at the start ({depth * 1000:.2g} mm) and will be pushed apart"
            )
    return warnings


def _overlap(a: BodyParticles, b: BodyParticles, spacing: float) -> float:
    """About how deep in m two bodies are in each other, 0 when they are not."""
    assert a.contact_radii is not None and b.contact_radii is not None
    boxes = [(body.positions.min(axis=0) - spacing, body.positions.max(axis=0) + spacing) for body in (a, b)]
    if (boxes[0][1] < boxes[1][0]).any() or (boxes[1][1] < boxes[0][0]).any():
        return 0.0
    distance, nearest = cKDTree(b.positions).query(a.positions, distance_upper_bound=spacing)
    near = np.isfinite(distance)
    touching = np.zeros(a.count)
    touching[near] = a.contact_radii[near] + b.contact_radii[nearest[near]] - distance[near]
    inside_a = touching > TOUCHING * spacing
    if not inside_a.any():
        return 0.0
    back = cKDTree(a.positions[inside_a]).query(b.positions, distance_upper_bound=spacing)[0]
    layers = min(_thickness(a.positions, inside_a), _thickness(b.positions, np.isfinite(back)))
    # One layer of particles reaches the other body's first layer only: no deeper than their balls do.
    return float(touching.max()) if layers <= 1.5 * spacing else layers


def _thickness(positions: Array, marked: NDArray[np.bool_]) -> float:
    """How far the marked particle that is deepest among the marked is from the others."""
    if marked.all():
        return float(np.ptp(positions, axis=0).max())
    return float(cKDTree(positions[~marked]).query(positions[marked])[0].max())
