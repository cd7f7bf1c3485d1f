# SPDX-License-Identifier: MIT
"""Parts of a composition: splats with a closed surface, the reference image and the result; parts as simulated bodies.

As a simulated body (Taichi) a part is its splats, skin particles on its surface, and its mesh. Splats are fitted
slightly under the surface that they show (``pair_fit.initial_splats``). If they alone met the boundary, the surface
would penetrate by as much. So vertices of the surface are particles too. They are invisible and have no gradient: their
velocity is the mean of the splats around them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ...errors import InputError
from ...events import IsCancelled, never
from ...mpm.colliders import Collider, Surface
from ...mpm.geometry.signed_distance import DistanceLattice, signed_distance
from ...scene.model import Camera, Ground
from ...skinning import bind, deform
from ..splats import Splats
from .physical_body import PhysicalBody, StepOptions
from .seating import resolve_penetration, seated

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
