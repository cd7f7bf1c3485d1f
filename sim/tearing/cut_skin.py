# SPDX-License-Identifier: MIT
"""The skin of a body whose bonds break: cut along its triangles' edges, with walls where blocks part, one topology for
the whole bake.

Around every vertex near a broken bond, the blocks fall into groups that hold together to the end; the vertex gets a
copy for each group that one of its triangles belongs to. A copy follows those particles alone that are still joined to
its group through unbroken bonds nearby, so that copies coincide to the last bit until the crack between them opens.
Walls are the faces between parted blocks, smoothed; until they open, both sides of a wall coincide inside the body.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cache.torn_skin_file import TornSkin
from ..skinning import Binding, bind, deform
from .blocks import NEVER, Blocks, Refined, refine, touched_near
from .crack_copies import Copies, SkinSites, Walls, holds

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CARRIERS = 24
"""Particles that may carry a vertex at a crack; fewer do once some have parted from it."""
LEAST_BONDS = 4
"""Fewer broken bonds are stray particles, and tear nothing."""


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
            part = self.binding.rows(row)
            places[self.own[row]] = deform(part, positions, gradients, keep=self.until[row] > sample)
        return places


def _linear_map(before: NDArray[Any], after: NDArray[Any]) -> NDArray[Any]:
    """(3, 3) M that takes offsets in ``before`` (V, 3) to those in ``after`` in least squares."""
    if (before == after).all():
        return np.eye(3)
    return np.asarray(np.linalg.lstsq(before - before.mean(axis=0), after - after.mean(axis=0), rcond=None)[0])


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
    hold = holds(blocks, opens)
    tree = cKDTree(particles)
    home_of_face = blocks.cells[blocks.of_particle[tree.query(refined.vertices[refined.faces].mean(axis=1))[1]]]
    skin_sites = SkinSites(refined, blocks, hold, touched, tree, home_of_face)
    walls = Walls(refined, blocks, hold, opens)
    seams = _skin_vertices(refined, skin_sites)
    rims = _wall_vertices(refined, seams, walls, *walls.faces(skin_sites, home_of_face))
    matter = np.asarray(particles, dtype=np.float64)
    own = np.flatnonzero(seams.copy >= 0)
    carried = _joined(
        _carried(own, skin_sites.copies, seams.copy[own], skin_sites.places, matter, blocks),
        _carried(len(seams.base) + np.arange(len(rims.copy)), walls.copies, rims.copy, walls.places, matter, blocks),
    )
    return _torn_motion(start[0], refined, seams, rims, carried)


@dataclass(frozen=True, eq=False)
class _SkinVertices:
    """The vertices of the skin: the refined mesh's, then their further copies. corner: (T, 3) of each triangle. base:
    (N,) the mesh's vertex that each is; copy: (N,) its number among the copies, -1 for none."""

    corner: Indices
    base: Indices
    copy: Indices


@dataclass(frozen=True, eq=False)
class _WallVertices:
    """The vertices of the walls, numbered after the skin's. triangles: (Q, 3) of all walls. copy: (W,) the number of
    each vertex among the copies; place: (W, 3) m at rest; face, near: (W,) the skin's triangle nearest to it, and the
    corner of that."""

    triangles: Indices
    copy: Indices
    place: Array
    face: Indices
    near: Indices


@dataclass(frozen=True, eq=False)
class _Carried:
    """Vertices ``own`` (C,) by ``binding``; until: (C, k) sample until which each particle carries them; opens: (C,)
    sample in which they leave the mesh's motion."""

    own: Indices
    until: Indices
    opens: Indices
    binding: Binding


def _skin_vertices(refined: Refined, skin: SkinSites) -> _SkinVertices:
    """Number the copies of the skin's vertices, the mesh's own first."""
    pairs, at_pair = np.unique(
        np.stack([refined.faces.ravel(), skin.at_corner.ravel()], axis=1), axis=0, return_inverse=True
    )
    another = np.concatenate([[False], pairs[1:, 0] == pairs[:-1, 0]])
    number = pairs[:, 0].copy()
    number[another] = len(refined.vertices) + np.arange(int(another.sum()))
    base = np.concatenate([np.arange(len(refined.vertices)), pairs[another, 0]])
    copy = np.full(len(base), -1, dtype=np.int64)
    copy[number] = pairs[:, 1]
    return _SkinVertices(corner=number[at_pair.reshape(-1)].reshape(-1, 3), base=base, copy=copy)


def _wall_vertices(
    refined: Refined, skin: _SkinVertices, walls: Walls, wall_faces: Indices, wall_copies: Indices
) -> _WallVertices:
    """Number the walls' vertices after the skin's. wall_faces, wall_copies: as ``Walls.faces`` returns them."""
    number = np.full(len(walls.copies.point), -1, dtype=np.int64)
    number[wall_copies] = len(skin.base) + np.arange(len(wall_copies))
    point = walls.copies.point[wall_copies]
    face, place = walls.face[point], walls.places[point]
    return _WallVertices(
        triangles=np.where(
            wall_faces >= 0,
            number[np.maximum(wall_faces, 0)],
            skin.corner.ravel()[np.maximum(-2 - wall_faces, 0)],
        ),
        copy=wall_copies,
        place=place,
        face=face,
        near=np.linalg.norm(refined.vertices[refined.faces[face]] - place[:, None, :], axis=2).argmin(axis=1),
    )


def _carried(own: Indices, copies: Copies, which: Indices, places: Array, particles: Array, blocks: Blocks) -> _Carried:
    """Return how the vertices ``own`` (C,), which are the copies ``which`` (C,) of ``places``, are carried."""
    point = copies.point[which]
    bound = bind(places, particles, neighbours=CARRIERS).rows(point)
    index, weights = bound.particles.copy(), bound.weights.copy()
    slot, outside = copies.slots(blocks.cells[blocks.of_particle[index]], point)
    width = copies.width[which]
    until = np.where(outside, -1, np.take_along_axis(width, slot, axis=1))
    # A group without a particle among the nearest ones is carried by one of its own.
    alone = np.flatnonzero((until < NEVER).all(axis=1))
    if len(alone):
        home = (width[alone] == NEVER).argmax(axis=1)
        shift = np.stack(np.unravel_index(home, (copies.size,) * 3), axis=1)
        block = blocks.grid[tuple((copies.low[point[alone]] + shift).T)]
        some = np.zeros(len(blocks.cells), dtype=np.int64)
        some[blocks.of_particle] = np.arange(len(blocks.of_particle))
        index[alone, -1], until[alone, -1], weights[alone, -1] = some[block], NEVER, 1.0
    rest = places[point]
    return _Carried(
        own=own,
        until=until,
        opens=np.where(width >= 0, width, NEVER).min(axis=1),
        binding=Binding(
            particles=index,
            weights=weights,
            offsets=rest[:, None, :] - particles[index],
            spacing=bound.spacing,
            rest=rest,
        ),
    )


def _joined(one: _Carried, other: _Carried) -> _Carried:
    """Return the vertices of both, one after the other."""
    return _Carried(
        own=np.concatenate([one.own, other.own]),
        until=np.concatenate([one.until, other.until]),
        opens=np.concatenate([one.opens, other.opens]),
        binding=Binding(
            **{
                part.name: np.concatenate([getattr(one.binding, part.name), getattr(other.binding, part.name)])
                for part in fields(Binding)
            }
        ),
    )


def _torn_motion(
    start: Array, refined: Refined, skin: _SkinVertices, walls: _WallVertices, carried: _Carried
) -> TornMotion:
    """Return the skin with its walls, and how it moves. start: (V, 3) the mesh before it was refined, m."""
    total = len(skin.base)
    first = int(carried.opens.min())
    # Walls, and vertices that the mesh does not have, have no other motion than their particles'.
    begun = (carried.own >= total) | (skin.base[np.minimum(carried.own, total - 1)] >= refined.before)
    opens = np.where(begun, first, carried.opens)
    used = np.flatnonzero(opens < NEVER)
    anchor = refined.faces[walls.face, walls.near]
    source, corners = _wall_sources(refined, skin, walls)
    torn = TornSkin(
        faces=np.concatenate([skin.corner, walls.triangles]).astype(np.int32),
        inside=np.concatenate([np.zeros(len(skin.corner), np.bool_), np.ones(len(walls.triangles), np.bool_)]),
        source=np.concatenate([refined.source, source]).astype(np.int32),
        corners=np.concatenate([refined.corners, corners]).astype(np.float32),
        parents=np.concatenate([refined.parents[skin.base], refined.parents[anchor]]).astype(np.int32),
        weights=np.concatenate([refined.weights[skin.base], refined.weights[anchor]]).astype(np.float32),
        first=first,
    )
    inside = np.einsum("vk,vki->vi", refined.weights[anchor], start[refined.parents[anchor]])
    return TornMotion(
        skin=torn,
        rest=start,
        depths=walls.place - inside,
        binding=carried.binding.rows(used),
        own=carried.own[used],
        until=carried.until[used],
        opens=opens[used],
    )


def _wall_sources(refined: Refined, skin: _SkinVertices, walls: _WallVertices) -> tuple[Indices, Array]:
    """Return the mesh's triangle (Q,) that each of the walls' takes what belongs to corners from, and where in it
    (Q, 3, 3): all corners at one place."""
    total = len(skin.base)
    face, place = np.full(total + len(walls.copy), -1, dtype=np.int64), np.zeros((total + len(walls.copy), 3))
    face[skin.corner.ravel()] = np.repeat(np.arange(len(refined.faces)), 3)
    place[skin.corner.ravel()] = refined.corners.reshape(-1, 3)
    face[total:], place[total:] = walls.face, refined.corners[walls.face, walls.near]
    of_wall = walls.triangles >= total
    # A skirt has corners of the skin, too; those of its wall count.
    first = walls.triangles[np.arange(len(walls.triangles)), of_wall.argmax(axis=1)]
    keep = np.where(of_wall.any(axis=1), first, walls.triangles[:, 0])
    return refined.source[face[keep]], np.repeat(place[keep][:, None, :], 3, axis=1)
