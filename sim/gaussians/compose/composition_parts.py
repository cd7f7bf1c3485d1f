# SPDX-License-Identifier: MIT
"""Parts of a composition: splats with a closed surface, the reference image and the result; simulated, and seated.

As a simulated body (Taichi) a part is its splats, skin particles on its surface, and its mesh. Splats are fitted
slightly under the surface that they show (``pair_fit.initial_splats``). If they alone met the boundary, the surface
would penetrate by as much. So vertices of the surface are particles too. They are invisible and have no gradient: their
velocity is the mean of the splats around them.

The points of a body leave an obstacle to a hundredth of a grid cell. A mesh bound to them follows by interpolation,
whose error is larger, and a flat face between two vertices may cut into a bulge. That is removed by projection: where a
face is in the obstacle, its corners move along the gradient of the signed distance, by least squares for every sample
of the face and smoothed over neighbours, until none is. The volume changes by no more than the layer that is lifted, as
thin as the interpolation is good.

Deformable parts are seated in the fixed ones, and on the ground, so that a composition stands under gravity. The
optimisation ends where nothing penetrates, with some air left between the parts and a base that is as uneven as its
particles. A rigid ring then slides down its finger until the air is used up, and a head rocks on its neck. What is soft
would lie against its neighbour on the whole area of contact and bulge beside it. So vertices near another part move out
along their normals by up to a thickness well below what the image shows: in the contact until the air is closed,
beside it by all of the thickness more than that, which makes a groove that the other part sits in: a wall measured
from the surface without its air would be thinner where there was more air, and none where the part narrows. A base
within the thickness of the ground becomes flat.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from ...errors import InputError
from ...events import IsCancelled, never
from ...mpm.colliders import Collider, Surface
from ...mpm.geometry.signed_distance import DistanceLattice, signed_distance
from ...mpm.geometry.triangles import area_normals
from ...scene.model import Camera, Ground
from ...skinning import bind, deform
from ...smoothstep import smoothstep
from ..splats import Splats
from .physical_body import PhysicalBody, StepOptions

Pixels = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CompositionPart:
    """One object of a composition, world metres. Raises InputError for fewer than 4 splats."""

    name: str

    splats: Splats
    """Its appearance; the centres are also the particles on which the gradient acts."""

    surface: Surface
    """Its closed surface: of the simulated body if deformable, of the collider if fixed."""

    def __post_init__(self) -> None:
        if len(self.splats) < 4:
            raise InputError(f"{self.name}: has {len(self.splats)} splats: give at least 4")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """The image that the composition has to match. Raises InputError on wrong shapes and non-finite values."""

    camera: Camera

    pixels: Pixels
    """(H, W, 3) sRGB 0 to 1, of the camera's size."""

    backdrop: Pixels
    """(H, W, 3) sRGB 0 to 1, background behind the objects: white for a cut-out, the inpainted photo in a scene."""

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width, 3)
        for name in ("pixels", "backdrop"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"reference {name} have shape {value.shape}: give finite {shape}, the camera's size")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """Measures of one optimisation step, before it moved anything."""

    part: str
    """Name of the deformable part."""

    step: int
    loss: float
    """Image loss (eq. 18); NaN in steps without images."""
    psnr: float
    """dB of the composition against the reference; NaN as above."""
    inside: float
    """Fraction of the deformable part's splats inside fixed parts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composition:
    """Result of ``compose``."""

    parts: tuple[CompositionPart, ...]
    """In the given order; fixed ones are the same objects."""

    history: tuple[StepRecord, ...]
    notes: tuple[str, ...]
    """Sentences for the user about irregularities and how they were handled."""


DISTANCE_CELLS = 96
"""Cells of the distance lattice along the part's longest side."""


def part_distances(part: CompositionPart) -> DistanceLattice:
    """Return signed distances in metres to the part's surface. Raises InputError where it is open or flat."""
    spacing = float(np.ptp(part.surface.vertices, axis=0).max()) / DISTANCE_CELLS
    try:
        return signed_distance(part.surface, spacing, margin=2 * spacing)
    except InputError as error:
        raise InputError(f"{part.name}: {error}") from None


def fraction_inside(splats: Splats, lattices: Sequence[DistanceLattice]) -> float:
    """Return the fraction of the splats' centres inside any of the surfaces."""
    inside = np.zeros(len(splats), dtype=np.bool_)
    for lattice in lattices:
        inside |= lattice.at(splats.centres)[0] < 0
    return float(inside.mean())


Array = NDArray[np.float64]

FACE_SUBDIVISIONS = 4
"""Subdivisions of a triangle's side at whose points penetration is tested."""

MAX_ITERATIONS = 60
"""Iterations of the correction for each obstacle."""

CLEARANCE = 0.02
"""Lattice spacings that faces keep from the surface: of the order of the lattice's error."""

SMOOTHING_RINGS = 3
"""Rings of neighbours over which a correction is smoothed."""


class BoundMesh:
    """A mesh (vertices (V, 3), faces (T, 3), world metres) bound to a body in its rest state.

    Raises InputError where the mesh exceeds the body by a tenth of its size, because it is of another object then.
    """

    def __init__(self, surface: Surface, body: PhysicalBody) -> None:
        self._surface, self._body = surface, body
        rest = body.rest
        low, high = rest.min(axis=0), rest.max(axis=0)
        reach = 0.1 * float((high - low).max())
        if not ((surface.vertices > low - reach) & (surface.vertices < high + reach)).all():
            raise InputError("bound mesh: it extends far beyond the body's points: give the mesh of the same object")
        self._binding = bind(surface.vertices, rest)

    def deformed(self) -> Surface:
        """Return the mesh deformed with the body's particles."""
        body = self._body
        return Surface(
            vertices=deform(self._binding, body.particles, body.particle_gradients), faces=self._surface.faces
        )

    def resolved(self) -> Surface:
        """Return the same without residual penetration of the obstacles, which must be at rest."""
        return resolve_penetration(self.deformed(), self._body.lattices)


def resolve_penetration(surface: Surface, lattices: Sequence[DistanceLattice]) -> Surface:
    """Return ``surface`` with its faces moved out of where ``lattices`` are negative.

    Meant for the residual penetration of a simulation, a small fraction of a grid cell; deeper penetration is removed,
    too, but distorts the mesh.
    """
    vertices = surface.vertices.copy()
    i, j = (
        n.ravel()
        for n in np.meshgrid(np.arange(FACE_SUBDIVISIONS + 1), np.arange(FACE_SUBDIVISIONS + 1), indexing="ij")
    )
    held = i + j <= FACE_SUBDIVISIONS
    shares = np.stack([FACE_SUBDIVISIONS - i - j, i, j], axis=1)[held] / FACE_SUBDIVISIONS
    neighbours = _neighbour_means(len(vertices), surface.faces)
    for lattice in lattices:
        for _ in range(MAX_ITERATIONS):
            moved = _face_corrections(vertices, surface.faces, shares, lattice)
            if moved is None:
                break
            vertices = vertices + _smoothed(moved, neighbours)
    return Surface(vertices=vertices, faces=surface.faces)


def _face_corrections(
    vertices: Array, faces: NDArray[np.int64], shares: Array, lattice: DistanceLattice
) -> Array | None:
    """Return displacements (V, 3), metres, that move the faces out of the lattice's inside; None where none is."""
    corners = vertices[faces]
    reach = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    near = np.flatnonzero(lattice.at(corners.mean(axis=1))[0] < reach + lattice.spacing)
    places = np.einsum("sb,tbc->tsc", shares, corners[near])
    distance, slope = lattice.at(places.reshape(-1, 3))
    lack = CLEARANCE * lattice.spacing - distance
    if not (lack > 0.5 * CLEARANCE * lattice.spacing).any():
        return None
    face, place = np.divmod(np.flatnonzero(lack > 0), len(shares))
    weights = shares[place]
    away = slope[lack > 0] / np.maximum(np.linalg.norm(slope[lack > 0], axis=1), 1e-9)[:, None]
    # A single sample is moved by least squares over its three corners; several are averaged.
    ways = (lack[lack > 0] / (weights**2).sum(axis=1))[:, None] * away
    owner = faces[near[face]].ravel()
    total = np.stack(
        [np.bincount(owner, (weights**2 * ways[:, k, None]).ravel(), len(vertices)) for k in range(3)], axis=1
    )
    weight = np.bincount(owner, weights.ravel(), len(vertices))
    return np.asarray(total / np.maximum(weight, 1e-12)[:, None])


def _smoothed(ways: Array, neighbours: csr_matrix) -> Array:
    """Return displacements (V, 3) smoothed over neighbours; vertices with their own keep it."""
    own = np.linalg.norm(ways, axis=1) > 0
    result = ways
    for _ in range(SMOOTHING_RINGS):
        result = np.where(own[:, None], ways, 0.5 * (neighbours @ result))
    return result


def _neighbour_means(count: int, faces: NDArray[np.int64]) -> csr_matrix:
    """Return the matrix (V, V) that averages over the vertices that share an edge with each."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    linked = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    linked.data[:] = 1.0
    degree = np.maximum(np.asarray(linked.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(coo_matrix((1.0 / degree, (np.arange(count), np.arange(count)))).tocsr() @ linked)


SKIN_NEIGHBOURS = 8
"""Splats from which a skin particle takes its velocity, and the like."""

MIN_SKIN = 2_000
"""Least number of skin particles, if the surface has as many vertices; at most as many as splats beyond that."""


class DeformablePart:
    """``part`` as an elastic body beside obstacles. Raises what ``PhysicalBody`` raises."""

    def __init__(
        self, part: CompositionPart, obstacles: Sequence[Collider], options: StepOptions, *, seed: int = 0
    ) -> None:
        centres, vertices = part.splats.centres, part.surface.vertices
        self._count = len(centres)
        most = max(MIN_SKIN, self._count)
        kept = np.arange(len(vertices))
        if len(kept) > most:
            kept = np.sort(np.random.default_rng(seed).choice(kept, most, replace=False))
        skin = vertices[kept]
        self._follow = nearest_weights(centres, skin)
        self._body = PhysicalBody(
            points=np.concatenate([centres, skin]), surface=part.surface, obstacles=obstacles, options=options
        )
        self._mesh = BoundMesh(part.surface, self._body)

    @property
    def cell(self) -> float:
        """Side of the grid's cells in metres."""
        return self._body.cell

    @property
    def points(self) -> Array:
        """Current centres of the splats, (N, 3) world metres."""
        return self._body.points[: self._count]

    @property
    def gradients(self) -> Array:
        """Deformation gradients (N, 3, 3) of the splats since the start."""
        return self._body.gradients[: self._count]

    def step(self, velocities: Array, stop: IsCancelled = never) -> None:
        """Advance the simulator by one step from velocities (N, 3) of the splats, metres a step."""
        self._body.step(self._with_skin(velocities), stop=stop)

    def place(self, points: Array) -> None:
        """Move the splats to (N, 3), world metres, without simulation; skin and filling follow."""
        now = self._body.points
        self._body.place(now + self._with_skin(points - now[: self._count]))

    def surface(self) -> Surface:
        """Return the part's surface deformed with its particles."""
        return self._mesh.deformed()

    def resolved_surface(self) -> Surface:
        """Return the same with residual penetration of the obstacles removed."""
        return self._mesh.resolved()

    def _with_skin(self, values: Array) -> Array:
        return np.concatenate([values, self._follow @ values])


def nearest_weights(centres: Array, places: Array) -> csr_matrix:
    """Return the matrix (M, N) of the mean over the nearest ``centres`` (N, 3) at each of ``places`` (M, 3).

    Weighted by 1 / distance².
    """
    distance, nearest = cKDTree(centres).query(places, k=min(SKIN_NEIGHBOURS, len(centres)))
    weights = 1.0 / np.maximum(distance, 1e-9 + 1e-3 * np.median(distance)) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(places)), weights.shape[1])
    return csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=(len(places), len(centres)))


REACH = 4.0
"""Thicknesses from another part within which a vertex moves by the whole thickness; none beyond twice that. Several
spacings of a mesh, else the groove has no wall."""

HEAD_ON = 1.2
"""Longest way of a vertex to another part that faces it, over the air there. Beyond, it met an edge."""

ITERATIONS = 30
"""Of the search for how far a vertex may move: each goes as far as the distance to the other part is."""


def seated_parts(
    parts: Sequence[CompositionPart], share: float, ground: Ground | None = None
) -> tuple[CompositionPart, ...]:
    """Return ``parts`` with the deformable ones (all but the first) seated in all others, one after another.

    share: thickness over each part's largest extent. ground: what supports parts that come within twice the thickness.
    """
    result = list(parts)
    lattices = [part_distances(part) for part in parts]
    for index, part in enumerate(parts[1:], start=1):
        thickness = share * float(np.ptp(part.surface.vertices, axis=0).max())
        others = [lattice for other, lattice in enumerate(lattices) if other != index]
        surface = seated(part.surface, others, thickness=thickness, ground=ground)
        moved = surface.vertices - part.surface.vertices
        centres = part.splats.centres + nearest_weights(part.surface.vertices, part.splats.centres) @ moved
        result[index] = dataclasses.replace(part, surface=surface, splats=part.splats.changed(centres=centres))
        if index + 1 < len(parts):
            lattices[index] = part_distances(result[index])
    return tuple(result)


def seated(
    surface: Surface, others: Sequence[DistanceLattice], *, thickness: float, ground: Ground | None = None
) -> Surface:
    """Return ``surface`` with its vertices near ``others``, and near the ``ground``, moved to lie against them.

    In contacts they move by up to ``thickness`` metres, the air there; beside them by the thickness more than that.
    others: signed distances to the other parts' surfaces, metres. Vertices keep their order.
    """
    vertices = surface.vertices
    normals = area_normals(vertices, surface.faces)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    air = _least_distance(others, vertices)
    weight = smoothstep(air, 2.0 * REACH * thickness, REACH * thickness)
    near = np.flatnonzero(weight > 0)
    room = thickness * weight[near]
    way = _moved_out(others, vertices[near], normals[near], np.zeros(len(near)), room)
    met = way < room
    faced = met & (way <= HEAD_ON * air[near])
    if faced.any():
        closed = way[faced][cKDTree(vertices[near][faced]).query(vertices[near])[1]]
        way = _moved_out(others, vertices[near], normals[near], way, np.where(met, way, room + closed * weight[near]))
    moved = vertices.copy()
    moved[near] += way[:, None] * normals[near]
    resolved = resolve_penetration(Surface(vertices=moved, faces=surface.faces), others)
    return resolved if ground is None else _on_ground(resolved, ground, thickness)


def _moved_out(others: Sequence[DistanceLattice], places: Array, normals: Array, way: Array, room: Array) -> Array:
    """Return how far (N,) in metres ``places`` move along ``normals`` until they meet a surface, by ``room`` at most.

    way: where the search begins.
    """
    for _ in range(ITERATIONS):
        way = np.clip(way + _least_distance(others, places + way[:, None] * normals), 0.0, room)
    return way


def _least_distance(lattices: Sequence[DistanceLattice], points: Array) -> Array:
    """Return the distance (N,) in metres to the nearest of the surfaces, negative inside."""
    return np.asarray(np.min([lattice.at(points)[0] for lattice in lattices], axis=0), dtype=np.float64)


SUNK = 0.02
"""Share of its largest extent by which a part may have sunk into the ground, which is no obstacle while it is composed,
and is still lifted onto it. What reaches deeper is not on the ground, but through it."""


def _on_ground(surface: Surface, ground: Ground, thickness: float) -> Surface:
    """Return ``surface`` flat where it is lower than ``thickness``; heights up to twice that are stretched.

    What reaches deeper than ``SUNK`` stays as it is.
    """
    heights = ground.heights(surface.vertices)
    if heights.min() < -max(2.0 * thickness, SUNK * float(np.ptp(surface.vertices, axis=0).max())):
        return surface
    wanted = np.where(heights < 2.0 * thickness, np.maximum(0.0, 2.0 * (heights - thickness)), heights)
    down = (wanted - heights)[:, None] * np.asarray(ground.unit_normal)
    return Surface(vertices=surface.vertices + down, faces=surface.faces)
