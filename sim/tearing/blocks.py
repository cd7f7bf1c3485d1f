# SPDX-License-Identifier: MIT
"""Matter as cubic blocks on a lattice at rest, the bonds between neighbours, and when each of them opens.

A bond is the line between the mean places of two neighbouring blocks' particles. It is broken once it is ``BROKEN``
times as long as at rest, with nothing in its middle, and longer than the matter's own deformation says: what flows is
filled up by its neighbours, and what is merely stretched knows that it is. It counts as open from the sample on in
which it began to part, and for good.

Near cracks, triangles are made as small as the blocks, with the mesh's own vertices first and unmoved.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from ..errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SIDE = 1.6
"""Side of a block over the particle spacing: about four particles, none of which says alone where it is."""
BROKEN, OPENING = 3.0, 1.3
"""Length of a bond over that at rest from which on it is broken, and at which such a bond began to part."""
UNEXPLAINED = 1.5
"""Length of a broken bond over that which the deformation gradients of its two blocks predict, at least."""
LEFT = 1.5
"""Sides by which a particle has moved away from its block when it belongs to it no more."""
EMPTY = 1.0
"""Distance in particle spacings from the middle of a broken bond to the nearest particle, at least."""
NEVER = np.iinfo(np.int32).max
"""Sample in which what never opens does."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of N particles.

    origin: (3,) corner of the lattice, m. side: of a block, m. spacing: of the particles, m. cells: (B, 3) place of
    each block in the lattice. grid: lattice of block numbers, -1 where there is none; two cells wider than the matter
    on all sides. of_particle: (N,) the block of each particle. bonds: (E, 2) neighbouring blocks, the second one step
    further along ``axes`` (E,), 0 to 2. centres: (B, 3) mean place at rest of each block's particles, m.
    """

    origin: Array
    side: float
    spacing: float
    cells: Indices
    grid: Indices
    of_particle: Indices
    bonds: Indices
    axes: Indices
    centres: Array

    def means(self, values: NDArray[np.floating]) -> Array:
        """Return the mean (B, ...) over each block's particles of ``values`` (N, ...)."""
        flat = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
        count = np.maximum(np.bincount(self.of_particle, minlength=len(self.cells)), 1)
        sums = [np.bincount(self.of_particle, column, minlength=len(self.cells)) for column in flat.T]
        return np.asarray((np.array(sums) / count).T.reshape(len(self.cells), *values.shape[1:]))

    def lattice(self, points: NDArray[np.floating]) -> Indices:
        """Return the cells (P, 3) in which ``points`` (P, 3) lie."""
        return np.floor((points - self.origin) / self.side).astype(np.int64)


def make_blocks(particles: NDArray[np.floating], volume: float) -> Blocks:
    """Return the blocks of ``particles`` (N, 3) at rest, m, which fill ``volume`` m³ together.

    Raises InputError for fewer than two particles, and what is not finite.
    """
    particles = np.asarray(particles, dtype=np.float64)
    if len(particles) < 2 or not np.isfinite(particles).all() or not 0 < volume < np.inf:
        raise InputError(f"tearing: {len(particles)} particles in {volume:g} m³ form no blocks; choose a finer quality")
    spacing = (volume / len(particles)) ** (1.0 / 3.0)
    side = SIDE * spacing
    low = particles.min(axis=0)
    # So that the matter's own middle is a lattice plane's: a symmetrical body gets symmetrical blocks.
    count = np.ceil((particles.max(axis=0) - low) / side + 1e-9)
    origin = 0.5 * (low + particles.max(axis=0)) - (0.5 * count + 2.0) * side
    cell = np.floor((particles - origin) / side).astype(np.int64)
    shape = tuple((count + 5).astype(int))
    flat = np.ravel_multi_index(tuple(cell.T), shape)
    taken, of_particle = np.unique(flat, return_inverse=True)
    grid = np.full(shape, -1, dtype=np.int64)
    grid.flat[taken] = np.arange(len(taken))
    cells = np.stack(np.unravel_index(taken, shape), axis=1)
    bonds, axes = [], []
    for axis in range(3):
        further = cells.copy()
        further[:, axis] += 1
        there = grid[tuple(further.T)]
        first = np.flatnonzero(there >= 0)
        bonds.append(np.stack([first, there[first]], axis=1))
        axes.append(np.full(len(first), axis))
    made = Blocks(
        origin=origin,
        side=float(side),
        spacing=float(spacing),
        cells=cells,
        grid=grid,
        of_particle=of_particle.reshape(-1),
        bonds=np.concatenate(bonds),
        axes=np.concatenate(axes),
        centres=np.empty(0),
    )
    object.__setattr__(made, "centres", made.means(particles))
    return made


def regrouped(blocks: Blocks, particles: NDArray[np.floating], positions: NDArray[np.floating]) -> Blocks:
    """Return ``blocks`` without blocks that a crack runs through: particles that have left most of their block by the
    time they are at ``positions`` (N, 3) belong to the neighbouring block that they moved with. particles: (N, 3) at
    rest, m."""
    shift = np.asarray(positions, dtype=np.float64) - particles
    order = np.argsort(blocks.of_particle, kind="stable")
    start = np.searchsorted(blocks.of_particle[order], np.arange(len(blocks.cells)))
    common = np.zeros((len(blocks.cells), 3))
    for block, members in enumerate(np.split(order, start[1:])):
        if len(members):
            moved = shift[members]
            # The member that the others are closest to.
            apart = np.linalg.norm(moved[:, None] - moved, axis=2)
            common[block] = moved[np.minimum(apart, LEFT * blocks.side).sum(axis=1).argmin()]
    away = np.linalg.norm(shift - common[blocks.of_particle], axis=1)
    left = np.flatnonzero(np.isfinite(away) & (away > LEFT * blocks.side))
    if not len(left):
        return blocks
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = blocks.cells[blocks.of_particle[left]][:, None, :] + steps
    there = blocks.grid[tuple(np.moveaxis(cells, -1, 0))]
    off = np.linalg.norm(shift[left][:, None, :] - common[there], axis=2)
    off = np.where((there >= 0) & np.isfinite(off), off, np.inf)
    best = off.argmin(axis=1)
    row = np.flatnonzero(off[np.arange(len(left)), best] < LEFT * blocks.side)
    of_particle = blocks.of_particle.copy()
    of_particle[left[row]] = there[row, best[row]]
    made = dataclasses.replace(blocks, of_particle=of_particle)
    return dataclasses.replace(made, centres=made.means(np.asarray(particles, dtype=np.float64)))


def stretches(blocks: Blocks, positions: NDArray[np.floating]) -> Array:
    """Return the length (E,) of every bond over that at rest, with the particles at ``positions`` (N, 3); 1 if not
    finite."""
    now, rest = blocks.means(positions), blocks.centres
    a, b = blocks.bonds.T
    # Blocks at the skin may hold little: of two that nearly coincide at rest no ratio means anything.
    before = np.maximum(np.linalg.norm(rest[b] - rest[a], axis=1), 0.7 * blocks.side)
    found = np.linalg.norm(now[b] - now[a], axis=1) / before
    return np.where(np.isfinite(found), found, 1.0)


def broken(
    blocks: Blocks, positions: NDArray[np.floating], gradients: NDArray[np.floating] | None, ratio: Array
) -> NDArray[np.bool_]:
    """Return which bonds (E,) are broken.

    positions: (N, 3), m. gradients: (N, 3, 3) deformation gradients that know of stretching alone; None for matter
    that has none. ratio: of ``stretches``.
    """
    result = np.zeros(len(ratio), dtype=np.bool_)
    long = np.flatnonzero(ratio >= BROKEN)
    if not len(long):
        return result
    now = blocks.means(positions)
    a, b = blocks.bonds[long].T
    sound = np.isfinite(positions).all(axis=1)
    distance, _ = cKDTree(positions[sound]).query(0.5 * (now[a] + now[b]))
    parted = distance > EMPTY * blocks.spacing
    if gradients is not None:
        usual = np.where(np.isfinite(gradients), gradients, 0.0)
        mean = blocks.means(usual)
        offset = blocks.centres[b] - blocks.centres[a]
        said = np.linalg.norm(np.einsum("eij,ej->ei", 0.5 * (mean[a] + mean[b]), offset), axis=1)
        parted &= np.linalg.norm(now[b] - now[a], axis=1) > UNEXPLAINED * said
    result[long] = parted
    return result


class OpeningTimes:
    """When each bond opens, from samples taken in order; samples that are left out count as closed."""

    def __init__(self, blocks: Blocks) -> None:
        self._blocks = blocks
        self._since = np.full(len(blocks.bonds), NEVER, dtype=np.int64)
        self._opens = np.full(len(blocks.bonds), NEVER, dtype=np.int64)
        self._last = -2

    def add(self, sample: int, positions: NDArray[np.floating], gradients: NDArray[np.floating] | None) -> None:
        """Take in ``sample``, later than all before; arguments as of ``broken``."""
        ratio = stretches(self._blocks, positions)
        if sample != self._last + 1:
            self._since[:] = NEVER
        self._last = sample
        apart = ratio >= OPENING
        self._since = np.where(apart, np.minimum(self._since, sample), NEVER)
        fresh = broken(self._blocks, positions, gradients, ratio) & (self._opens == NEVER)
        self._opens[fresh] = self._since[fresh]

    @property
    def opens(self) -> Indices:
        """First sample (E,) in which each bond is open, ``NEVER`` for those that hold."""
        return self._opens


def opening_times(
    blocks: Blocks, samples: Iterable[tuple[int, NDArray[np.floating], NDArray[np.floating] | None]]
) -> Indices:
    """Return the first sample (E,) in which each bond is open; ``samples``: number, positions, gradients in order."""
    times = OpeningTimes(blocks)
    for sample in samples:
        times.add(*sample)
    return times.opens


STEPS = 12
MOST_TRIANGLES = 400_000
"""Beyond, triangles stay as large as they are."""
NEAR = 2.0
"""Distance in sides of a block from a parted one, within which triangles are made smaller."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A mesh whose first V vertices are those ``before``. faces: (T, 3); source: (T,) the triangle each is part of;
    corners: (T, 3, 3) barycentric coordinates in it; parents, weights: (V', 3) vertices before, and shares,
    that each lies
    between."""

    vertices: Array
    before: int
    faces: Indices
    source: Indices
    corners: Array
    parents: Indices
    weights: Array


def touched_near(blocks: Blocks, opens: Indices) -> NDArray[np.bool_]:
    """Return which cells of the lattice have a block in their 3³ neighbourhood that a broken bond belongs to."""
    found = np.zeros(blocks.grid.shape, dtype=np.bool_)
    cells = blocks.cells[np.unique(blocks.bonds[opens < NEVER])]
    found[tuple(cells.T)] = True
    return np.asarray(binary_dilation(found, np.ones((3, 3, 3), np.bool_)))


def refine(vertices: Array, faces: Indices, side: float, touched: NDArray[np.bool_], blocks: Blocks) -> Refined:
    """Return the mesh with edges of at most ``side`` m where cells of ``blocks`` are ``touched``."""
    cells = np.argwhere(touched)
    tree = cKDTree(blocks.origin + (cells + 0.5) * blocks.side)
    source, corners = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    original, places = faces, vertices
    for _ in range(STEPS):
        ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, of_face = np.unique(ends, axis=0, return_inverse=True)
        of_face = of_face.reshape(3, -1).T
        a, b = places[edges[:, 0]], places[edges[:, 1]]
        length = np.linalg.norm(b - a, axis=1)
        marked = length > side
        away = tree.query(0.5 * (a + b)[marked])[0]
        marked[marked] = away < 0.5 * length[marked] + NEAR * blocks.side
        if not marked.any() or len(faces) > MOST_TRIANGLES:
            break
        middle = np.full(len(edges), -1, dtype=np.int64)
        middle[marked] = len(places) + np.arange(int(marked.sum()))
        places = np.concatenate([places, 0.5 * (a + b)[marked]])
        faces, source, corners = _split(faces, source, corners, middle[of_face])
    parents, weights = np.repeat(np.arange(len(places))[:, None], 3, axis=1), np.tile((1.0, 0.0, 0.0), (len(places), 1))
    added = faces >= len(vertices)
    parents[faces[added]] = original[np.repeat(source, 3).reshape(-1, 3)[added]]
    weights[faces[added]] = corners[added]
    return Refined(
        vertices=places,
        before=len(vertices),
        faces=faces,
        source=source,
        corners=corners,
        parents=parents,
        weights=weights,
    )


def _split(faces: Indices, source: Indices, corners: Array, middle: Indices) -> tuple[Indices, Indices, Array]:
    """Triangles split at the vertices ``middle`` (T, 3) of their edges 01, 12, 20; -1 where an edge stays."""
    count = (middle >= 0).sum(axis=1)
    # Rotate so that of one marked edge it is 01, of two the unmarked one is 20.
    turn = np.where(count == 1, (middle >= 0).argmax(axis=1), np.where(count == 2, (middle < 0).argmax(axis=1) + 1, 0))
    order = (np.arange(3) + turn[:, None]) % 3
    faces, middle = np.take_along_axis(faces, order, axis=1), np.take_along_axis(middle, order, axis=1)
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    six = np.concatenate([faces, middle], axis=1)
    halves = 0.5 * (corners + corners[:, [1, 2, 0]])
    places = np.concatenate([corners, halves], axis=1)
    patterns = {
        0: ((0, 1, 2),),
        1: ((0, 3, 2), (3, 1, 2)),
        2: ((0, 3, 4), (3, 1, 4), (0, 4, 2)),
        3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    }
    made = []
    for marks, triangles in patterns.items():
        row = np.flatnonzero(count == marks)
        made += [(six[row][:, t], source[row], places[row][:, t]) for t in (list(t) for t in triangles)]
    new_faces, new_source, new_corners = (np.concatenate(parts) for parts in zip(*made, strict=True))
    order = np.argsort(new_source, kind="stable")
    return new_faces[order], new_source[order], new_corners[order]
