# SPDX-License-Identifier: MIT
"""Checks before a world is set up: cell size of a quality, usable meshes, bodies above the ground and apart.

Also the positions of a collider's vertices over time. Bodies that share space at the start are made to share none:
overlap of less than a grid cell is left to contact, which pushes bodies apart gently. More would throw them apart, or
lock them into each other. Then the body that loses the smaller share of its material is simulated without what lies in
the other: a chair has a hollow where a toy sits deep in it. Only the simulation knows: meshes are rendered whole, so
the first frame is what it was.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from ..errors import InputError
from ..memory import available_memory, require_memory
from ..mpm.bodies import THIN_CELLS, BodyParticles
from ..mpm.colliders import Collider, Surface, Track
from ..mpm.cost_estimate import sampling_bytes
from ..mpm.geometry.inside_test import bounding_faces
from ..mpm.geometry.interior_sampling import MIN_PARTICLES
from ..mpm.geometry.mesh_checks import check_surface, thickness_of
from ..mpm.geometry.signed_distance import DistanceLattice, overlap, signed_distance
from ..mpm.geometry.triangles import validated
from ..mpm.solver_options import SolverOptions, centred
from ..scene.bake_quality import Quality
from ..scene.meshes import ObjectMesh
from ..scene.model import Ground
from ..scene.units import Similarity


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
        sampling_bytes(count, max(each)),
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


THINNEST_CELLS = 0.5
"""Cells from which on contact of a body that is thin all over and deforms is right."""


def surface_warnings(surface: Surface, name: str, cell: float, *, deforms: bool) -> list[str]:
    """Return warnings about the mesh of object ``name``. Raises InputError for an unusable one."""
    least = THINNEST_CELLS * cell if deforms else None
    return list(check_surface(surface, name=f"object {name}", cell_size=cell, least_thickness=least))


def thickness_in(surface: Surface, cell: float) -> float | None:
    """Return the thickness in m of a body thin all over whose contact has to know it; None of others."""
    points, triangles = validated(surface.vertices, surface.faces)
    return thickness_of(points, bounding_faces(points, triangles).triangles, THIN_CELLS * cell)


def require_above_ground(name: str, vertices: Array, ground: Ground, cell: float) -> None:
    """Raise InputError when object ``name`` reaches more than ``DEEPEST_CELLS`` into the ground."""
    depth = -float(ground.heights(vertices).min())
    if depth > DEEPEST_CELLS * cell:
        raise InputError(
            f"object {name}: its lowest vertex is {depth:.3g} m below the ground: lift it by that much "
            "(world_from_mesh), lower ground.point, or make it a collider"
        )


TOUCHING = 0.05
"""Share of the particle spacing below which two bodies touch and do not overlap."""
MOST_LOST = 0.5
"""Largest share of its particles that a body is simulated without; one that lies deeper in another stays in place."""
CLEARANCE = 0.5
"""Distance in particle spacings of particles around a hollow from what lies in it: half a particle fills that."""
SKIN = 0.05
"""The same for surfaces, which touch without particles: what the lattice of distances rounds off."""
LATTICE_CELLS = 80
"""Lattice cells along the longest side of a surface with a hollow."""
SMALLEST_PART = 0.02
"""Share of the inside below which what a hollow cuts off is dropped."""
NEVER = 1e6
"""Start time in s, after any bake, of a body that stays where it is and touches nothing."""

PER_PARTICLE = ("positions", "volumes", "contact_radii", "material_index", "density_scale", "stiffness_scale", "pins")


@dataclasses.dataclass(frozen=True)
class Separated:
    """Bodies and colliders in their order, no two of them more than a cell deep in each other, and what was done."""

    bodies: tuple[BodyParticles, ...]
    colliders: tuple[Collider, ...]
    notices: tuple[str, ...]


def separate(
    bodies: Sequence[BodyParticles], colliders: Sequence[Collider], *, spacing: float, cell: float
) -> Separated:
    """Return ``bodies`` and ``colliders`` apart at the start.

    bodies: with their surfaces. spacing: of the particles in m; cell: side of a grid cell in m. Bodies that come in at
    different times do not meet at the start, nor does one that comes in later meet a collider where that rests.
    """
    placed, obstacles, notices = list(bodies), list(colliders), list[str]()
    for i, j in itertools.combinations(range(len(placed)), 2):
        a, b = placed[i], placed[j]
        depth = 0.0 if a.start_time != b.start_time else body_overlap(a, b, spacing)
        if depth > DEEPEST_CELLS * cell:
            placed[i], placed[j], text = _without_shared(a, b, depth, spacing)
            notices.append(text)
        elif depth > 0:
            notices.append(
                f"{a.name} and {b.name} overlap a little at the start ({depth * 1000:.2g} mm) and will be pushed apart"
            )
    for i, j in itertools.product(range(len(placed)), range(len(obstacles))):
        placed[i], obstacles[j], text = _out_of_collider(placed[i], obstacles[j], spacing, cell)
        notices += [text] if text else []
    return Separated(tuple(placed), tuple(obstacles), tuple(notices))


def _without_shared(
    a: BodyParticles, b: BodyParticles, depth: float, spacing: float
) -> tuple[BodyParticles, BodyParticles, str]:
    """The two bodies apart, and what was done."""
    in_b, in_a = _inside(a, b, spacing), _inside(b, a, spacing)
    first = in_b.mean() < in_a.mean()
    kept, cut, inside = (b, a, in_b) if first else (a, b, in_a)
    if inside.mean() > MOST_LOST or (~inside).sum() < MIN_PARTICLES:
        # Both lie in each other: neither has a place of its own.
        small, large = (a, b) if a.volumes.sum() < b.volumes.sum() else (b, a)
        still = dataclasses.replace(small, start_time=NEVER)
        text = f"{small.name} lies inside {large.name}: it stays where it is and takes no part in the simulation"
        return (still, b, text) if small is a else (a, still, text)
    hollow = _cut(cut, ~inside, kept, spacing)
    text = (
        f"{a.name} and {b.name} share space at the start, {depth * 1000:.2g} mm deep: {cut.name} is simulated with a "
        f"hollow there ({inside.mean():.0%} of it)"
    )
    return (hollow, b, text) if first else (a, hollow, text)


def _out_of_collider(
    body: BodyParticles, collider: Collider, spacing: float, cell: float
) -> tuple[BodyParticles, Collider, str]:
    """The two apart, and what was done, '' for nothing. What moves by itself keeps its shape: the body yields then."""
    surface = collider.surface.vertices
    low, high = body.positions.min(axis=0) - cell, body.positions.max(axis=0) + cell
    if body.start_time > 0 or (surface.max(axis=0) < low).any() or (surface.min(axis=0) > high).any():
        return body, collider, ""
    # No finer than the lattice of a large collider bears; bodies and colliders are then judged more coarsely.
    coarse = max(cell, float(np.ptp(surface, axis=0).max()) / 200)
    lattice = signed_distance(collider.surface, coarse, margin=0.0)
    depth = overlap(body.positions, lattice)
    if depth <= TOUCHING * coarse:
        return body, collider, ""
    if depth <= DEEPEST_CELLS * coarse:
        return body, collider, f"{body.name} stands {depth * 1000:.2g} mm in {collider.name} and will be pushed out"
    deep = f"{body.name} is {depth * 1000:.2g} mm deep in {collider.name} at the start"
    if not collider.moves and body.surface is not None:
        hollow = _hollowed(collider.surface, body.surface, spacing)
        if hollow is not None:
            return body, dataclasses.replace(collider, surface=hollow), f"{deep}: {collider.name} has a hollow there"
    inside = lattice.at(body.positions)[0] < CLEARANCE * spacing
    if inside.mean() > MOST_LOST or (~inside).sum() < MIN_PARTICLES:
        return dataclasses.replace(body, start_time=NEVER), collider, f"{deep}: it stays where it is and does not move"
    return _cut(body, ~inside, collider, spacing), collider, f"{deep}: it is simulated without that part"


def _inside(body: BodyParticles, other: BodyParticles, spacing: float) -> NDArray[np.bool_]:
    """Particles (N,) of ``body`` in ``other`` or nearer to it than particles should be."""
    near = np.zeros(body.count, dtype=np.bool_)
    low, high = other.positions.min(axis=0) - spacing, other.positions.max(axis=0) + spacing
    boxed = ((body.positions > low) & (body.positions < high)).all(axis=1)
    if other.surface is None:
        near[boxed] = cKDTree(other.positions).query(body.positions[boxed])[0] < spacing
    elif boxed.any():
        near[boxed] = _distances(other.surface, spacing).at(body.positions[boxed])[0] < CLEARANCE * spacing
    return near


def _distances(surface: Surface, spacing: float) -> DistanceLattice:
    finest = float(np.ptp(surface.vertices, axis=0).max()) / 200
    return signed_distance(surface, max(spacing, finest), margin=2.0 * spacing)


def _cut(
    body: BodyParticles, kept: NDArray[np.bool_], other: BodyParticles | Collider, spacing: float
) -> BodyParticles:
    """``body`` with the particles ``kept`` (N,), and a surface that leaves out ``other``."""
    fields = {name: getattr(body, name) for name in PER_PARTICLE}
    fields = {name: None if values is None else values[kept] for name, values in fields.items()}
    surface = body.surface
    # Only what is rigid touches with its surface; other bodies do so with their particles.
    if body.rigid and surface is not None and other.surface is not None:
        surface = _hollowed(surface, other.surface, spacing) or surface
    return dataclasses.replace(body, surface=surface, **fields)


def _hollowed(surface: Surface, other: Surface, spacing: float) -> Surface | None:
    """``surface`` without what lies in ``other`` and around it; None where hardly anything is left."""
    # Late: it takes a quarter of a second, and hardly any scene needs it.
    from skimage.measure import marching_cubes

    step = max(0.5 * spacing, float(np.ptp(surface.vertices, axis=0).max()) / LATTICE_CELLS)
    lattice = signed_distance(surface, step, margin=2.0 * step)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in lattice.distances.shape), indexing="ij"), axis=-1)
    away = _distances(other, spacing).at(lattice.origin + lattice.spacing * grid.reshape(-1, 3))[0]
    distances = np.maximum(lattice.distances, SKIN * spacing - away.reshape(lattice.distances.shape))
    labels, count = ndimage.label(distances < 0)
    sizes = ndimage.sum_labels(distances < 0, labels, np.arange(count + 1))
    if not count or sizes.sum() < (1.0 - MOST_LOST) * (lattice.distances < 0).sum():
        return None
    distances[(distances < 0) & (sizes[labels] < SMALLEST_PART * sizes.sum())] = lattice.spacing
    # A node exactly on the surface would make faces without area.
    distances[np.abs(distances) < 1e-4 * lattice.spacing] = -1e-4 * lattice.spacing
    vertices, faces, _, _ = marching_cubes(distances, level=0.0, gradient_direction="ascent")
    return Surface(vertices=lattice.origin + lattice.spacing * vertices.astype(np.float64), faces=faces)


def body_overlap(a: BodyParticles, b: BodyParticles, spacing: float) -> float:
    """Return about how deep in m two bodies are in each other, 0 when they are not.

    A ball of the contact radius around a particle lies inside its body; where two of them meet, the bodies do.
    """
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
    """Return how far the marked particle that is deepest among the marked is from the others."""
    if marked.all():
        return float(np.ptp(positions, axis=0).max())
    return float(cKDTree(positions[~marked]).query(positions[marked])[0].max())
