# SPDX-License-Identifier: MIT
"""The skin of a body whose bonds break: cut along its triangles' edges, with walls where blocks part, one topology for
the whole bake.

Around every vertex near a broken bond, the blocks fall into groups that hold together to the end; the vertex gets a
copy for each group that one of its triangles belongs to. A copy follows those particles alone that are still joined to
its group through unbroken bonds nearby, so that copies coincide to the last bit until the crack between them opens.
Walls are the faces between parted blocks, smoothed; until they open, both sides of a wall coincide inside the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cache.torn_skin_file import TornSkin
from ..skinning import Binding, bind, deform
from .blocks import NEVER, Blocks, Refined, refine, touched_near

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CARRIERS = 24
"""Particles that may carry a vertex at a crack; fewer do once some have parted from it."""
ROUGH, SMOOTHING, INSIDE = 0.12, 3, 0.12
"""Of walls: unevenness in sides of a block; smoothing steps; how far below the skin their rims end, in sides."""
LEAST_BONDS = 4
"""Fewer broken bonds are stray particles, and tear nothing."""
SKIRT = 1.8
"""Distance in sides from a crack in the skin to the rim of the wall beneath that is joined to it, at most."""


@dataclass(frozen=True, eq=False)
class TornMotion:
    """How the vertices of ``skin`` move. own: (C,) those that do not always follow the mesh, with ``binding``, the
    sample ``until`` (C, k) which each of its particles carries them, and ``opens`` (C,), from which on they differ.
    rest: (V, 3) the whole mesh at rest; depths: (W, 3) from their parents to the walls' vertices, the last
    ones, at rest; m."""

    skin: TornSkin
    rest: Array
    depths: Array
    binding: Binding
    own: Indices
    until: Indices
    opens: Indices

    def vertices(
        self,
        sample: int,
        regular: NDArray[np.floating],
        positions: NDArray[np.floating] | None,
        gradients: NDArray[np.floating] | None,
    ) -> Array:
        """Return the vertices (V', 3) in ``sample``, world metres.

        regular: (V, 3) of the whole mesh then. positions, gradients: of the particles, (N, 3) and (N, 3, 3); may be
        None before ``skin.first``.
        """
        regular = np.array(regular, dtype=np.float64)
        parents, weights = self.skin.parents, self.skin.weights.astype(np.float64)
        places = np.einsum("vk,vki->vi", weights, regular[parents])
        whole = weights[:, 0] == 1.0
        places[whole] = regular[parents[whole, 0]]
        walls = len(self.depths)
        if walls:
            # Nobody sees them before the first crack; they have to be inside.
            places[-walls:] += np.matmul(self.depths, _linear_map(self.rest, regular))
        row = np.flatnonzero(self.opens <= sample)
        if len(row) and positions is not None and gradients is not None:
            part = Binding(
                particles=self.binding.particles[row],
                weights=self.binding.weights[row],
                offsets=self.binding.offsets[row],
                spacing=self.binding.spacing[row],
                rest=self.binding.rest[row],
            )
            places[self.own[row]] = deform(part, positions, gradients, keep=self.until[row] > sample)
        return places


def _linear_map(before: NDArray[Any], after: NDArray[Any]) -> NDArray[Any]:
    """(3, 3) M that takes offsets in ``before`` (V, 3) to those in ``after`` in least squares."""
    if (before == after).all():
        return np.eye(3)
    return np.asarray(np.linalg.lstsq(before - before.mean(axis=0), after - after.mean(axis=0), rcond=None)[0])


@dataclass(frozen=True, eq=False)
class _Copies:
    """Copies of points: ``slot`` (P, S): the copy that belongs to each cell of a point's window, -1 where none does;
    point: (C,) of each copy; width: (C, S) sample until which it is joined to each cell, -1: never was."""

    slot: Indices
    point: Indices
    width: Indices


def tear(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    particles: NDArray[np.floating],
    blocks: Blocks,
    opens: Indices,
) -> TornMotion | None:
    """Return the torn skin of the mesh ``vertices`` (V, 3), ``faces`` (T, 3), both at rest, and how it moves; None
    where nothing parts.

    opens: (E,) first sample in which each bond of ``blocks`` is open.
    """
    if int((opens < NEVER).sum()) < LEAST_BONDS or len(particles) <= CARRIERS:
        return None
    touched = touched_near(blocks, opens)
    start = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    refined = refine(*start, blocks.side, touched, blocks)
    hold = _holds(blocks, opens)
    tree = cKDTree(particles)
    home_of_face = blocks.cells[blocks.of_particle[tree.query(refined.vertices[refined.faces].mean(axis=1))[1]]]
    skin_sites = _SkinSites(refined, blocks, hold, touched, tree, home_of_face)
    walls = _Walls(refined, blocks, hold, opens)
    wall_faces, wall_copies = walls.faces(skin_sites, home_of_face)
    return _assemble(
        start[0], refined, np.asarray(particles, dtype=np.float64), blocks, skin_sites, walls, wall_faces, wall_copies
    )


def _holds(blocks: Blocks, opens: Indices) -> Indices:
    """(3, lattice) until when each cell holds to the next along each axis; -1 where there is no bond."""
    hold = np.full((3, *blocks.grid.shape), -1, dtype=np.int64)
    cells = blocks.cells[blocks.bonds[:, 0]]
    hold[(blocks.axes, *cells.T)] = opens
    return hold


def _copies(low: Indices, size: int, blocks: Blocks, hold: Indices) -> _Copies:
    """Copies of points whose windows of ``size``³ cells begin at ``low`` (P, 3)."""
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
    return _Copies(slot=slot, point=key // count, width=flat[first])


class _SkinSites:
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
        self.places, self.low = places[near], centre[near] - 1
        number = np.full(len(places), -1, dtype=np.int64)
        number[near] = np.arange(len(near))
        self.copies = _copies(self.low, self.SIZE, blocks, hold)
        at = number[site][refined.faces]
        self.at_corner = np.full_like(at, -1)
        if not len(near):
            return
        offset = home_of_face[:, None, :] - self.low[at]
        beside = ((offset < 0) | (offset >= self.SIZE)).any(axis=2)
        offset = np.where(beside[..., None], 1, offset)
        slot = (offset[..., 0] * self.SIZE + offset[..., 1]) * self.SIZE + offset[..., 2]
        self.at_corner = np.where(at >= 0, self.copies.slot[at, slot], -1)


class _Walls:
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
        self.quads, self.low = found.reshape(-1, 4), points - 1
        self.copies = _copies(self.low, 2, blocks, hold)
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
        away = np.abs(self.low[point][:, None, :] + shift - cell[:, None, :]).sum(axis=2)
        away = np.where(self.copies.slot[point] >= 0, away, 1000)
        return np.asarray(self.copies.slot[point, away.argmin(axis=1)])

    def faces(self, skin: _SkinSites, home_of_face: Indices) -> tuple[Indices, Indices]:
        """Walls as triangles (W, 3) of copies, those of the skin's corners encoded as -2 - corner; and their skirts."""
        sides = []
        for cells, order in ((self._a, (0, 1, 2, 3)), (self._b, (3, 2, 1, 0))):
            quad = np.stack([self._copy(self.quads[:, i], cells) for i in order], axis=1)
            sides += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
        walls = np.concatenate(sides)
        found = np.concatenate([walls, self._skirts(skin, home_of_face)])
        return found, np.unique(found[found >= 0])

    def _skirts(self, skin: _SkinSites, home_of_face: Indices) -> Indices:
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


def _assemble(
    start: Array,
    refined: Refined,
    particles: Array,
    blocks: Blocks,
    skin: _SkinSites,
    walls: _Walls,
    wall_faces: Indices,
    wall_copies: Indices,
) -> TornMotion:
    """Number the copies, the mesh's own vertices first, and bind those that ever leave the mesh's motion."""
    pairs, at_pair = np.unique(
        np.stack([refined.faces.ravel(), skin.at_corner.ravel()], axis=1), axis=0, return_inverse=True
    )
    another = np.concatenate([[False], pairs[1:, 0] == pairs[:-1, 0]])
    number = pairs[:, 0].copy()
    number[another] = len(refined.vertices) + np.arange(int(another.sum()))
    corner = number[at_pair.reshape(-1)].reshape(-1, 3)
    base = np.concatenate([np.arange(len(refined.vertices)), pairs[another, 0]])
    copy = np.full(len(base), -1, dtype=np.int64)
    copy[number] = pairs[:, 1]
    total = len(base)
    of_wall = np.full(len(walls.copies.point), -1, dtype=np.int64)
    of_wall[wall_copies] = total + np.arange(len(wall_copies))
    shown = np.where(
        wall_faces >= 0, of_wall[np.maximum(wall_faces, 0)], corner.ravel()[np.maximum(-2 - wall_faces, 0)]
    )
    face = walls.face[walls.copies.point[wall_copies]]
    places = walls.places[walls.copies.point[wall_copies]]
    near = np.linalg.norm(refined.vertices[refined.faces[face]] - places[:, None, :], axis=2).argmin(axis=1)
    anchor = refined.faces[face, near]
    parents = np.concatenate([refined.parents[base], refined.parents[anchor]])
    weights = np.concatenate([refined.weights[base], refined.weights[anchor]])
    # The triangles of the skin that walls take what belongs to corners from, and where in them.
    own_face, own_corner = (
        np.full(total + len(wall_copies), -1, dtype=np.int64),
        np.zeros((total + len(wall_copies), 3)),
    )
    own_face[corner.ravel()] = np.repeat(np.arange(len(refined.faces)), 3)
    own_corner[corner.ravel()] = refined.corners.reshape(-1, 3)
    own_face[total:], own_corner[total:] = face, refined.corners[face, near]
    owner = own_face[shown[:, 0]]
    wall_vertex = shown >= total
    keep = np.where(wall_vertex.any(axis=1), shown[np.arange(len(shown)), wall_vertex.argmax(axis=1)], shown[:, 0])
    owner = own_face[keep]
    moving = np.flatnonzero(copy >= 0)
    motion = [
        _bound(moving, skin.copies, copy[moving], skin.low, 3, skin.places, particles, blocks),
        _bound(
            total + np.arange(len(wall_copies)),
            walls.copies,
            wall_copies,
            walls.low,
            2,
            walls.places,
            particles,
            blocks,
        ),
    ]
    joined = [np.concatenate(parts) for parts in zip(*motion, strict=True)]
    own, until, opens, index, share, offsets, spacing, rest = joined
    first = int(opens.min())
    # Walls, and vertices that the mesh does not have, have no other motion than their particles'.
    begun = (own >= total) | (base[np.minimum(own, total - 1)] >= refined.before)
    opens = np.where(begun, first, opens)
    used = np.flatnonzero(opens < NEVER)
    torn = TornSkin(
        faces=np.concatenate([corner, shown]).astype(np.int32),
        inside=np.concatenate([np.zeros(len(corner), np.bool_), np.ones(len(shown), np.bool_)]),
        source=np.concatenate([refined.source, refined.source[owner]]).astype(np.int32),
        corners=np.concatenate([refined.corners, np.repeat(own_corner[keep][:, None, :], 3, axis=1)]).astype(
            np.float32
        ),
        parents=parents.astype(np.int32),
        weights=weights.astype(np.float32),
        first=first,
    )
    binding = Binding(
        particles=index[used], weights=share[used], offsets=offsets[used], spacing=spacing[used], rest=rest[used]
    )
    return TornMotion(
        skin=torn,
        rest=start,
        depths=places - np.einsum("vk,vki->vi", refined.weights[anchor], start[refined.parents[anchor]]),
        binding=binding,
        own=own[used],
        until=until[used],
        opens=opens[used],
    )


def _bound(
    own: Indices,
    copies: _Copies,
    which: Indices,
    low: Indices,
    size: int,
    places: Array,
    particles: Array,
    blocks: Blocks,
) -> tuple[Indices, Indices, Indices, Indices, Array, Array, Array, Array]:
    """The vertices ``own`` (C,), which are the copies ``which``: until when each particle carries them, when they leave
    the mesh's motion, and their binding's parts."""
    point = copies.point[which]
    bound = bind(places, particles, neighbours=CARRIERS)
    index, weights = bound.particles[point].copy(), bound.weights[point].copy()
    cell = blocks.cells[blocks.of_particle[index]] - low[point][:, None, :]
    outside = ((cell < 0) | (cell >= size)).any(axis=2)
    cell = np.where(outside[..., None], 0, cell)
    slot = (cell[..., 0] * size + cell[..., 1]) * size + cell[..., 2]
    width = copies.width[which]
    until = np.where(outside, -1, np.take_along_axis(width, slot, axis=1))
    # A group without a particle among the nearest ones is carried by one of its own.
    alone = np.flatnonzero((until < NEVER).all(axis=1))
    if len(alone):
        home = (width[alone] == NEVER).argmax(axis=1)
        shift = np.stack(np.unravel_index(home, (size,) * 3), axis=1)
        block = blocks.grid[tuple((low[point[alone]] + shift).T)]
        some = np.zeros(len(blocks.cells), dtype=np.int64)
        some[blocks.of_particle] = np.arange(len(blocks.of_particle))
        index[alone, -1], until[alone, -1], weights[alone, -1] = some[block], NEVER, 1.0
    rest = places[point]
    joined = np.where(width >= 0, width, NEVER).min(axis=1)
    return (
        own,
        until,
        joined,
        index,
        weights,
        rest[:, None, :] - particles[index],
        bound.spacing[point],
        rest,
    )
