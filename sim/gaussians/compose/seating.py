# SPDX-License-Identifier: MIT
"""Deformable parts seated in the fixed ones, and on the ground, so that a composition stands under gravity.

The optimisation ends where nothing penetrates, with some air left between the parts and a base that is as uneven as its
particles. A rigid ring then slides down its finger until the air is used up, and a head rocks on its neck. What is soft
would lie against its neighbour on the whole area of contact and bulge beside it. So vertices near another part move out
along their normals by up to a thickness well below what the image shows: in the contact until the air is closed, beside
it by all of the thickness, which makes a groove that the other part sits in. A base within the thickness of the ground
becomes flat."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...mpm.colliders import Surface
from ...mpm.geometry.signed_distance import DistanceLattice
from ...mpm.geometry.triangles import area_normals
from ...scene.model import Ground
from ...smoothstep import smoothstep
from .composition_parts import CompositionPart, nearest_weights, part_distances, resolve_penetration

Array = NDArray[np.float64]

REACH = 4.0
"""Thicknesses from another part within which a vertex moves by the whole thickness; none beyond twice that. Several
spacings of a mesh, else the groove has no wall."""

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
    """Return ``surface`` with its vertices near ``others``, and near the ``ground``, moved by up to ``thickness`` m.

    others: signed distances to the other parts' surfaces, metres. Vertices keep their order.
    """
    vertices = surface.vertices
    normals = area_normals(vertices, surface.faces)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    weight = smoothstep(_least_distance(others, vertices), 2.0 * REACH * thickness, REACH * thickness)
    near = np.flatnonzero(weight > 0)
    room, way = thickness * weight[near], np.zeros(len(near))
    for _ in range(ITERATIONS):
        free = _least_distance(others, vertices[near] + way[:, None] * normals[near])
        way = np.clip(way + free, 0.0, room)
    moved = vertices.copy()
    moved[near] += way[:, None] * normals[near]
    resolved = resolve_penetration(Surface(vertices=moved, faces=surface.faces), others)
    return resolved if ground is None else _on_ground(resolved, ground, thickness)


def _least_distance(lattices: Sequence[DistanceLattice], points: Array) -> Array:
    """Return the distance (N,) in metres to the nearest of the surfaces, negative inside."""
    return np.asarray(np.min([lattice.at(points)[0] for lattice in lattices], axis=0), dtype=np.float64)


def _on_ground(surface: Surface, ground: Ground, thickness: float) -> Surface:
    """Return ``surface`` flat where it is lower than ``thickness``; heights up to twice that are stretched.

    What reaches farther below the ground than twice that stays as it is: it is not on it, but through it.
    """
    heights = ground.heights(surface.vertices)
    if heights.min() < -2.0 * thickness:
        return surface
    wanted = np.where(heights < 2.0 * thickness, np.maximum(0.0, 2.0 * (heights - thickness)), heights)
    down = (wanted - heights)[:, None] * np.asarray(ground.unit_normal)
    return Surface(vertices=surface.vertices + down, faces=surface.faces)
