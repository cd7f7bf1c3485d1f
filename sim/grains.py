# SPDX-License-Identifier: MIT
"""Grains of millimetre size for the few large particles that are simulated: where they are in a sample of the bake.

A simulated particle stands for hundreds of grains of sand or snow. Here each gets children, of which those near the
free surface are drawn (upsampling, after [Ihmsen 2012]; without its integration over time, so that any frame can be
rendered alone). A child at the rest offset o of particle i is at

    x_i + s_i^b A_i o,

A_i the deformation gradient of the particle's neighbours at rest with a bounded stretch, s_i ≥ 1 how sparse the
particles are there, b an exponent of the child's own, so that what flies apart becomes a cloud and not a clump. All of
it is continuous in the particles' positions: nothing flickers. Below the surface the particles themselves are drawn as
balls (the core), which hide what lies deeper.

[Ihmsen 2012] Ihmsen, Wahl, Teschner, *High-resolution simulation of granular material with SPH*, VRIPHYS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .smoothstep import smoothstep

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

PACKING = 0.6
"""Share of the space that grains fill: random close packing is 0.64, loose 0.55."""

MOST_CHILDREN, MOST_CANDIDATES, MOST_SHOWN = 400, 1_500_000, 400_000
"""Bounds on the children of a particle, on those looked at in a frame, and on those drawn."""

SURFACE_SHARE = 12.0
"""Particles near the seen surface of a body that spreads, over N^(2/3)."""

REACH = 0.68
"""Radius of a particle's children over the spacing. A ball of the particle's own volume has 0.62."""

STRETCH = (0.85, 1.6)
"""Bounds on the mean stretch of A, √(tr AᵀA / 3): beyond, neighbours at rest are neighbours no more."""

SPARSEST, FARTHEST = 2.2, 2.5
"""Largest s; and farthest that a child is from its particle, in spacings."""

NEAREST = 6
"""Neighbours at rest that tell whether matter has come apart."""

NEIGHBOURS, STILL_NEAR, GONE, RIDGE = 12, 2.5, 4.0, 0.5
"""Neighbours at rest that tell a particle's A; distances in spacings at which one begins and ends to count as gone; and
the weight of the identity, in squared spacings."""

SMOOTHING, CELLS = 1.0, 2.0
"""Standard deviation of the density field in spacings, and its cells per spacing."""

MOST_CELLS = 8_000_000
"""Of the density field."""

BULK, DEEP, CORE = 0.42, 0.93, 0.62
"""Densities, over that of undisturbed matter: of the envelope of grains (a plane's surface has 0.5), above which grains
are hidden, and from which on particles are drawn as balls."""

CORE_RADIUS = 0.72
"""Of those balls, in spacings; 0.87 closes a lattice without gaps."""

LEVEL = 0.1
"""Change of the density over a spacing below which it has no direction."""

BEHIND = -0.35
"""Cosine between outward normal and view below which a grain is on the far side."""

SHADES, CREVICE = 0.1, 0.45
"""Standard deviation of the logarithm of grains' shades; and how much darker those are that lie below the others."""

TABLE = 1 << 14


@dataclass(frozen=True, kw_only=True)
class GrainSize:
    """Resolution at which a body is drawn.

    diameter: of the mean grain, m. children: per particle, 1 to ``MOST_CHILDREN``.
    """

    diameter: float
    children: int


def grain_size(*, particles: int, spacing: float, wanted: float) -> GrainSize:
    """Return the grains of a body with so many ``particles``, ``spacing`` (m) apart, near the ``wanted`` diameter (m).

    They fill ``PACKING`` of a particle's volume. Where that would be too many they are larger; never larger than 0.9 of
    the spacing. Raises InputError where a number is not above 0.
    """
    for name, value in (("particles", particles), ("spacing", spacing), ("wanted", wanted)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"grains: {name} is {value!r}: give a number above 0")
    seen = min(particles, SURFACE_SHARE * particles ** (2.0 / 3.0))
    most = int(np.clip(MOST_CANDIDATES / seen, 1, MOST_CHILDREN))
    filled = PACKING * 6.0 / math.pi * spacing**3
    children = int(np.clip(math.ceil(filled / min(wanted, 0.9 * spacing) ** 3), 1, most))
    return GrainSize(diameter=min((filled / children) ** (1.0 / 3.0), 0.9 * spacing), children=children)


class DensityField:
    """Smoothed number density of particles over that of undisturbed matter, on a grid, and its gradient."""

    def __init__(self, positions: Array, spacing: float) -> None:
        """positions: (N, 3), those that are not finite left out; spacing: of undisturbed matter, m."""
        from scipy.ndimage import gaussian_filter

        points = positions[np.isfinite(positions).all(axis=1)]
        if len(points) == 0:
            points = np.zeros((1, 3))
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 4.0 * SMOOTHING * spacing
        self._cell = spacing / CELLS
        if _cells(low, high, margin, self._cell) > MOST_CELLS:
            # A few that flew far away shall not coarsen the rest.
            low, high = np.percentile(points, 1, axis=0), np.percentile(points, 99, axis=0)
            while _cells(low, high, margin, self._cell) > MOST_CELLS:
                self._cell *= 1.25
        self._low = low - margin
        shape = np.ceil((high - low + 2 * margin) / self._cell).astype(int) + 2
        place = (points - self._low) / self._cell
        place = place[((place >= 0) & (place < shape - 1)).all(axis=1)]
        base = place.astype(np.int64)
        part = place - base
        flat = np.zeros(int(shape.prod()))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
            index = np.ravel_multi_index(tuple((base + corner).T), tuple(shape))
            flat += np.bincount(index, weight, minlength=len(flat))
        grid = gaussian_filter(flat.reshape(shape), SMOOTHING * spacing / self._cell, truncate=3.0, mode="constant")
        self._grid = (grid * (spacing / self._cell) ** 3).astype(np.float32)

    def at(self, points: Array) -> Array:
        """Return the density (N,) at ``points`` (N, 3); 0 outside the grid."""
        from scipy.ndimage import map_coordinates

        place = ((points - self._low) / self._cell).T
        return np.asarray(map_coordinates(self._grid, place, order=1, mode="constant", output=np.float64))

    def surface(self, level: float) -> tuple[Array, Ints]:
        """Return vertices (V, 3) and triangles (F, 3), outside in front, of where the density is ``level``; none where
        nothing is as dense.
        """
        from skimage.measure import marching_cubes

        if not float(self._grid.max()) > level:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        vertices, faces, _, _ = marching_cubes(self._grid, level, gradient_direction="ascent")
        return self._low + np.asarray(vertices, dtype=np.float64) * self._cell, np.asarray(faces, dtype=np.int64)

    def gradient(self, points: Array) -> Array:
        """Return the gradient (N, 3) at ``points`` (N, 3), 1/m."""
        step = self._cell
        return np.stack([(self.at(points + e) - self.at(points - e)) / (2 * step) for e in np.eye(3) * step], axis=1)


def _cells(low: Array, high: Array, margin: float, cell: float) -> float:
    return float(np.prod((high - low + 2 * margin) / cell + 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudState:
    """The particles of one sample: positions (N, 3), their density field, the density (N,) at each, and its gradient
    (N, 3)."""

    positions: Array
    field: DensityField
    density: Array
    gradient: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownGrains:
    """Grains of one sample.

    parents, children: (G,) particle of each, and its number among that particle's children; -1 for a ball of the core.
    positions: (G, 3) m. radii: (G,) m. shades: (G,) factor of its colour: each its own, darker in crevices.
    """

    parents: Ints
    children: Ints
    positions: Array
    radii: Array
    shades: Array


class GrainCloud:
    """The grains of one body."""

    def __init__(
        self,
        rest: NDArray[np.floating],
        *,
        spacing: float,
        size: GrainSize,
        ground: tuple[Array, Array] | None = None,
        seed: int = 0,
    ) -> None:
        """rest: (N, 3) particles at rest, world metres. ground: a point and the unit normal of a plane that grains stay
        above. Raises InputError for less than 4 particles, or places that are not finite.
        """
        from scipy.spatial import cKDTree

        self.rest: Array = np.array(rest, dtype=np.float64)
        if len(self.rest) < 4 or not np.isfinite(self.rest).all():
            raise InputError(f"grains: {len(self.rest)} particles, or places that are not finite; bake again")
        self.spacing, self.size = spacing, size
        self._ground = ground
        count = min(NEIGHBOURS, len(self.rest) - 1)
        self._neighbours = cKDTree(self.rest).query(self.rest, k=count + 1)[1][:, 1:]
        self._offsets = self.rest[self._neighbours] - self.rest[:, None, :]
        table = np.random.default_rng(seed)
        self._start = table.integers(0, TABLE, len(self.rest))
        self._places = _ball_sequence(TABLE) * (REACH * spacing)
        self._stray = table.uniform(0.0, 2.0, TABLE)
        self._radius = 0.5 * size.diameter * np.exp(table.normal(0.0, 0.18, TABLE).clip(-0.4, 0.4))
        self._shades = np.exp(table.normal(0.0, 1.0, TABLE).clip(-2.0, 2.0) * SHADES)

    @property
    def reach(self) -> float:
        """The farthest that the outside of a grain or ball is from its particle, m."""
        return FARTHEST * self.spacing + 2.0 * float(self._radius.max())

    def numbers(self, parents: Ints, children: Ints) -> Ints:
        """Return the place (G,) of each child in tables of ``TABLE`` entries."""
        return (self._start[parents] + np.maximum(children, 0)) % TABLE

    def parted(self, state: CloudState) -> Array:
        """Return how much farther (N,) each particle is from the farthest gone of its nearest neighbours at rest."""
        nearest = slice(0, NEAREST)
        there = state.positions[self._neighbours[:, nearest]] - state.positions[:, None, :]
        here = np.linalg.norm(self._offsets[:, nearest], axis=2)
        return np.asarray((np.linalg.norm(there, axis=2) / np.maximum(here, 1e-12)).max(axis=1))

    def turns(self, grains: ShownGrains) -> Array:
        """Return at which share (G,) of the time in which ``grains`` come each one does, 0 to 1, evenly spread."""
        # The golden ratio's multiples spread evenly, whatever part of the table a particle has.
        return np.asarray(self.numbers(grains.parents, grains.children) * 0.6180339887498949 % 1.0)

    def at_rest(self, parents: Ints, children: Ints) -> Array:
        """Return the rest positions (G, 3) of ``children`` of ``parents`` (G,); of the particle itself for -1."""
        offset = self._places[self.numbers(parents, children)]
        return np.asarray(self.rest[parents] + np.where((children >= 0)[:, None], offset, 0.0))

    def state(self, positions: NDArray[np.floating]) -> CloudState:
        """Return what a sample with particles at ``positions`` (N, 3) needs, once for all its grains."""
        points: Array = np.asarray(positions, dtype=np.float64)
        points = np.where(np.isfinite(points).all(axis=1)[:, None], points, self.rest)
        field = DensityField(points, self.spacing)
        return CloudState(positions=points, field=field, density=field.at(points), gradient=field.gradient(points))

    def shown(self, state: CloudState, eye: Array | None = None) -> ShownGrains:
        """Return the grains near the surface of ``state``, and the core below; only the side seen from ``eye`` (3,)."""
        dense = state.density
        near = np.flatnonzero((dense < DEEP + 0.04) & self._facing(state, eye))
        children = self.size.children
        if len(near) * children > 2 * MOST_CANDIDATES:
            children = max(1, 2 * MOST_CANDIDATES // len(near))
        parents = np.repeat(near, children)
        numbers = np.tile(np.arange(children), len(near))
        places = self.places(state, parents, numbers)
        density = state.field.at(places)
        keep = np.flatnonzero(density < DEEP)
        if len(keep) > MOST_SHOWN:
            # Evenly over all particles, and the same ones in every frame that has so many.
            keep = keep[np.argsort(numbers[keep], kind="stable")[:MOST_SHOWN]]
        core = np.flatnonzero(dense > CORE)
        entry = self.numbers(parents[keep], numbers[keep])
        radii = self._radius[entry]
        shades = self._shades[entry] * (1.0 - CREVICE * smoothstep(density[keep], BULK, DEEP))
        return ShownGrains(
            parents=np.concatenate([parents[keep], core]),
            children=np.concatenate([numbers[keep], np.full(len(core), -1)]),
            positions=np.concatenate([places[keep], state.positions[core]]),
            radii=np.concatenate([radii, np.full(len(core), CORE_RADIUS * self.spacing)]),
            shades=np.concatenate([shades, np.full(len(core), 1.0 - CREVICE)]),
        )

    def places(self, state: CloudState, parents: Ints, children: Ints) -> Array:
        """Return the positions (G, 3) in ``state`` of ``children`` of ``parents`` (G,); -1 is the particle itself."""
        who, back = np.unique(parents, return_inverse=True)
        entry = self.numbers(parents, children)
        sparse = np.clip(1.0 / np.maximum(1.6 * state.density[who], 1e-3), 1.0, SPARSEST**3) ** (1.0 / 3.0)
        offset = np.einsum("gij,gj->gi", self._deformation(state, who)[back], self._places[entry])
        offset *= (sparse[back] ** self._stray[entry])[:, None]
        length = np.linalg.norm(offset, axis=1)
        offset *= np.minimum(1.0, FARTHEST * self.spacing / np.maximum(length, 1e-12))[:, None]
        places = state.positions[parents] + np.where((children >= 0)[:, None], offset, 0.0)
        places = self._drawn_in(state, places, parents)
        if self._ground is not None:
            point, normal = self._ground
            below = self._radius[entry] - (places - point) @ normal
            # Matter below the plane, beyond the edge of a table, falls on.
            caught = smoothstep((state.positions[parents] - point) @ normal, -0.5 * self.spacing, 0.0)
            lift = np.where(children >= 0, np.maximum(below, 0.0) * caught, 0.0)
            places = places + lift[:, None] * normal
        return places

    def _drawn_in(self, state: CloudState, places: Array, parents: Ints) -> Array:
        """Return ``places`` with those outside the envelope of dense matter moved inward to it."""
        weight = smoothstep(state.density[parents], 0.35, 0.55)
        which = np.flatnonzero(weight > 0)
        lack = BULK - state.field.at(places[which])
        which, lack = which[lack > 0], lack[lack > 0]
        slope = state.gradient[parents[which]]
        # Where the gradient vanishes, in the middle of a thin stream, there is no inward.
        step = slope * (lack / ((slope**2).sum(axis=1) + (LEVEL / self.spacing) ** 2))[:, None]
        length = np.linalg.norm(step, axis=1)
        step *= (weight[which] * np.minimum(1.0, 0.8 * self.spacing / np.maximum(length, 1e-12)))[:, None]
        moved = places.copy()
        moved[which] += step
        return moved

    def _facing(self, state: CloudState, eye: Array | None) -> NDArray[np.bool_]:
        if eye is None:
            return np.ones(len(state.positions), dtype=np.bool_)
        view = eye - state.positions
        cosine = -np.einsum("ni,ni->n", state.gradient, view)
        cosine /= np.maximum(np.linalg.norm(state.gradient, axis=1) * np.linalg.norm(view, axis=1), 1e-12)
        flat = np.linalg.norm(state.gradient, axis=1) * self.spacing < LEVEL
        return np.asarray((cosine > BEHIND) | flat | (state.density < 0.45))

    def _deformation(self, state: CloudState, who: Ints) -> Array:
        """Return A (n, 3, 3) of the particles ``who``: fitted to those of their neighbours at rest that are still near,
        and drawn towards the identity the more have gone.
        """
        offset = self._offsets[who]
        moved = state.positions[self._neighbours[who]] - state.positions[who][:, None, :]
        far = np.linalg.norm(moved, axis=2) / self.spacing
        weight = smoothstep(far, GONE, STILL_NEAR)[..., None]
        ridge = RIDGE * self.spacing**2 * np.eye(3)
        product = np.einsum("nki,nkj->nij", moved * weight, offset) + ridge
        f = product @ np.linalg.inv(np.einsum("nki,nkj->nij", offset * weight, offset) + ridge)
        size = np.sqrt((f**2).sum(axis=(1, 2)) / 3.0)
        return np.asarray(f * (np.clip(size, *STRETCH) / np.maximum(size, 1e-9))[:, None, None])


def _ball_sequence(count: int) -> Array:
    """Return points (count, 3) of the unit ball, of which any few in a row are spread evenly: the additive recurrence
    with the powers of the plastic number's analogue in three dimensions (M. Roberts, 2018).
    """
    g = 1.2207440846057596
    u = (np.arange(count)[:, None] * (1.0 / g ** np.arange(1, 4)) + 0.5) % 1.0
    cosine, around = 2.0 * u[:, 1] - 1.0, 2.0 * np.pi * u[:, 2]
    sine = np.sqrt(1.0 - cosine**2)
    return u[:, :1] ** (1.0 / 3.0) * np.stack([sine * np.cos(around), sine * np.sin(around), cosine], axis=1)
