# SPDX-License-Identifier: MIT
"""The points that cracks double: those of a skin along them, and those of the walls between parted blocks.

Around every point, the blocks of its window fall into groups that hold together to the end; each group has its own copy
of the point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .blocks import NEVER, Blocks, Refined

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROUGH, SMOOTHING, INSIDE = 0.12, 3, 0.12
"""Of walls: unevenness in sides of a block; smoothing steps; how far below the skin their rims end, in sides."""
SKIRT = 1.8
"""Distance in sides from a crack in the skin to the rim of the wall beneath that is joined to it, at most."""


@dataclass(frozen=True, eq=False)
class Copies:
    """Copies of points. slot: (P, S) the copy that belongs to each cell of a point's window, -1 where none does; point:
    (C,) of each copy; width: (C, S) sample until which it is joined to each cell, -1: never was. low: (P, 3) first cell
    of each window of ``size``³ = S cells."""

    slot: Indices
    point: Indices
    width: Indices
    low: Indices
    size: int

    def slots(self, cells: Indices, points: Indices) -> tuple[Indices, NDArray[np.bool_]]:
        """Return the place of ``cells`` (N, k, 3) in the windows of ``points`` (N,), and whether they are outside.

        Both (N, k); a cell outside has the place of the window's first.
        """
        cell = cells - self.low[points][:, None, :]
        outside = ((cell < 0) | (cell >= self.size)).any(axis=2)
        cell = np.where(outside[..., None], 0, cell)
        return (cell[..., 0] * self.size + cell[..., 1]) * self.size + cell[..., 2], outside


def holds(blocks: Blocks, opens: Indices) -> Indices:
    """Return (3, lattice) until when each cell holds to the next along each axis; -1 where there is no bond."""
    hold = np.full((3, *blocks.grid.shape), -1, dtype=np.int64)
    cells = blocks.cells[blocks.bonds[:, 0]]
    hold[(blocks.axes, *cells.T)] = opens
    return hold


def copies_of(low: Indices, size: int, blocks: Blocks, hold: Indices) -> Copies:
    """Return the copies of points whose windows of ``size``³ cells begin at ``low`` (P, 3)."""
    shift = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    cells = np.clip(low[:, None, None, None, :] + shift, 0, np.array(blocks.grid.shape) - 1)
    at = tuple(np.moveaxis(cells, -1, 0))
    there = (blocks.grid[at] >= 0).reshape(len(low), -1)
    link = [hold[(axis, *at)] for axis in range(3)]
    count = size**3
    point, source = np.nonzero(there)
    width = np.full((len(point), size, size, size), -1, dtype=np.int64)
    width.reshape(len(point), -1)[np.arange(len(point)), source] = NEVER
    links = [each[point] for each in link]
    for _ in range(count):
        before = width.copy()
        for axis in range(3):
            low_part, high_part = [slice(None)] * 4, [slice(None)] * 4
            low_part[axis + 1], high_part[axis + 1] = slice(0, size - 1), slice(1, size)
            a, b, h = tuple(low_part), tuple(high_part), links[axis][tuple(low_part)]
            width[b] = np.maximum(width[b], np.minimum(width[a], h))
            width[a] = np.maximum(width[a], np.minimum(width[b], h))
        if (width == before).all():
            break
    flat = width.reshape(len(point), count)
    # The first cell of a group that holds for ever is its name.
    key, first, of_pair = np.unique(
        point * count + (flat == NEVER).argmax(axis=1), return_index=True, return_inverse=True
    )
    slot = np.full((len(low), count), -1, dtype=np.int64)
    slot[point, source] = of_pair.reshape(-1)
    return Copies(slot=slot, point=key // count, width=flat[first], low=low, size=size)


class SkinSites:
    """The skin's vertices near cracks: places that they share, and the copy at every corner of every triangle."""

    SIZE = 3

    def __init__(
        self,
        refined: Refined,
        blocks: Blocks,
        hold: Indices,
        touched: NDArray[np.bool_],
        tree: cKDTree,
        home_of_face: Indices,
    ) -> None:
        places, site = np.unique(refined.vertices, axis=0, return_inverse=True)
        site = site.reshape(-1)
        centre = blocks.cells[blocks.of_particle[tree.query(places)[1]]]
        # What lies between the ends of a cut edge cannot follow them.
        added = np.zeros(len(places), dtype=np.bool_)
        added[site[refined.before :]] = True
        near = np.flatnonzero(touched[tuple(centre.T)] | added)
        self.places, low = places[near], centre[near] - 1
        number = np.full(len(places), -1, dtype=np.int64)
        number[near] = np.arange(len(near))
        self.copies = copies_of(low, self.SIZE, blocks, hold)
        at = number[site][refined.faces]
        self.at_corner = np.full_like(at, -1)
        if not len(near):
            return
        offset = home_of_face[:, None, :] - low[at]
        beside = ((offset < 0) | (offset >= self.SIZE)).any(axis=2)
        offset = np.where(beside[..., None], 1, offset)
        slot = (offset[..., 0] * self.SIZE + offset[..., 1]) * self.SIZE + offset[..., 2]
        self.at_corner = np.where(at >= 0, self.copies.slot[at, slot], -1)


class Walls:
    """Lattice points at the faces between parted blocks, and the walls' vertices there."""

    def __init__(self, refined: Refined, blocks: Blocks, hold: Indices, opens: Indices) -> None:
        parted = np.flatnonzero(opens < NEVER)
        self._refined, self._blocks = refined, blocks
        self._a, self._b = blocks.cells[blocks.bonds[parted, 0]], blocks.cells[blocks.bonds[parted, 1]]
        axis = blocks.axes[parted]
        quads = np.repeat(self._a[:, None, :], 4, axis=1)
        rows = np.arange(len(parted))
        for corner, (u, v) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            quads[rows, corner, axis] += 1
            quads[rows, corner, (axis + 1) % 3] += u
            quads[rows, corner, (axis + 2) % 3] += v
        points, found = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
        self.quads = found.reshape(-1, 4)
        self.copies = copies_of(points - 1, 2, blocks, hold)
        self.places = self._shaped(blocks.origin + blocks.side * points)

    def _shaped(self, places: Array) -> Array:
        """``places`` smoothed, roughened, and drawn under the skin."""
        pairs = np.concatenate([self.quads[:, [i, (i + 1) % 4]] for i in range(4)])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        degree = np.maximum(np.bincount(pairs.ravel(), minlength=len(places)), 1)
        for _ in range(SMOOTHING):
            sums = np.zeros_like(places)
            np.add.at(sums, pairs[:, 0], places[pairs[:, 1]])
            np.add.at(sums, pairs[:, 1], places[pairs[:, 0]])
            places = 0.5 * places + 0.5 * sums / degree[:, None]
        side = self._blocks.side
        places = places + np.random.default_rng(0).uniform(-ROUGH, ROUGH, places.shape) * side
        from trimesh.triangles import closest_point

        triangles = self._refined.vertices[self._refined.faces]
        self.face = cKDTree(triangles.mean(axis=1)).query(places)[1]
        nearest = triangles[self.face]
        on_skin = closest_point(nearest, places)
        normal = np.cross(nearest[:, 1] - nearest[:, 0], nearest[:, 2] - nearest[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
        above = np.einsum("ij,ij->i", places - on_skin, normal) > -INSIDE * side
        return np.where(above[:, None], on_skin - INSIDE * side * normal, places)

    def _copy(self, point: Indices, cell: Indices) -> Indices:
        """The copy of each lattice ``point`` (Q,) on the side of ``cell`` (Q, 3), or of the nearest cell in its
        window."""
        shift = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        away = np.abs(self.copies.low[point][:, None, :] + shift - cell[:, None, :]).sum(axis=2)
        away = np.where(self.copies.slot[point] >= 0, away, 1000)
        return np.asarray(self.copies.slot[point, away.argmin(axis=1)])

    def faces(self, skin: SkinSites, home_of_face: Indices) -> tuple[Indices, Indices]:
        """Walls as triangles (W, 3) of copies, those of the skin's corners encoded as -2 - corner; and their skirts."""
        sides = []
        for cells, order in ((self._a, (0, 1, 2, 3)), (self._b, (3, 2, 1, 0))):
            quad = np.stack([self._copy(self.quads[:, i], cells) for i in order], axis=1)
            sides += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
        walls = np.concatenate(sides)
        found = np.concatenate([walls, self._skirts(skin, home_of_face)])
        return found, np.unique(found[found >= 0])

    def _skirts(self, skin: SkinSites, home_of_face: Indices) -> Indices:
        """Triangles from the skin's cut edges to the rims of the walls beneath them."""
        faces = self._refined.faces
        corner = np.arange(3 * len(faces)).reshape(-1, 3)
        start, end = corner.ravel(), corner[:, [1, 2, 0]].ravel()
        _, at = np.unique(self._refined.vertices, axis=0, return_inverse=True)
        at, copy = at.reshape(-1)[faces].ravel(), skin.at_corner.ravel()
        low, high = np.minimum(at[start], at[end]), np.maximum(at[start], at[end])
        turned = at[start] > at[end]
        first, second = np.where(turned, copy[end], copy[start]), np.where(turned, copy[start], copy[end])
        edge, group = np.unique(low * (at.max() + 1) + high, return_inverse=True)
        group = group.reshape(-1)
        most = np.full((2, len(edge)), -2), np.full((2, len(edge)), 2**62)
        for row, values in enumerate((first, second)):
            np.maximum.at(most[0][row], group, values)
            np.minimum.at(most[1][row], group, values)
        cut = np.flatnonzero((most[0] != most[1]).any(axis=0)[group])
        if not len(cut) or not len(self.places):
            return np.empty((0, 3), dtype=np.int64)
        tree = cKDTree(self.places)
        spots = self._refined.vertices[faces.ravel()]
        away_s, rim_s = tree.query(spots[start[cut]])
        away_e, rim_e = tree.query(spots[end[cut]])
        good = np.maximum(away_s, away_e) < SKIRT * self._blocks.side
        cut, rim_s, rim_e = cut[good], rim_s[good], rim_e[good]
        home = home_of_face[cut // 3]
        foot_s, foot_e = self._copy(rim_s, home), self._copy(rim_e, home)
        u, v = -2 - start[cut], -2 - end[cut]
        one, two = np.stack([v, u, foot_s], axis=1), np.stack([v, foot_s, foot_e], axis=1)
        return np.concatenate([one, two[foot_s != foot_e]])
