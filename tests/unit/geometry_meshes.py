# SPDX-License-Identifier: MIT
"""Meshes for the tests of geometry, and independent measures of them."""

from __future__ import annotations

import numpy as np
import trimesh
from physgen.sim.mpm.colliders import Surface

EPS32 = float(np.finfo(np.float32).eps)


def surface(mesh):
    return Surface(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces))


def joined(*meshes):
    return surface(trimesh.util.concatenate(meshes))


def box(size, at=(0, 0, 0)):
    return trimesh.creation.box(size).apply_translation(at)


def ball(radius=0.5, subdivisions=3, at=(0, 0, 0)):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def inverted(mesh):
    mesh = mesh.copy()
    mesh.invert()
    return mesh


def turned(mesh, angle=0.7, axis=(1, 2, 3)):
    return mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(angle, axis))


def mixed(mesh):
    """Every third face looks the wrong way."""
    third = np.arange(len(mesh.faces))[:, None] % 3 == 0
    return Surface(vertices=np.array(mesh.vertices), faces=np.where(third, mesh.faces[:, ::-1], mesh.faces))


def nodes(lattice):
    index = np.stack(np.meshgrid(*[np.arange(n) for n in lattice.distances.shape], indexing="ij"), axis=-1)
    return (lattice.origin + lattice.spacing * index).reshape(-1, 3)


def brute_distance(places, mesh):
    """To the nearest of all triangles, by trimesh's closest points."""
    triangles = np.asarray(mesh.triangles)
    best = np.full(len(places), np.inf)
    for triangle in triangles:
        # Only where the triangle's corners are near enough.
        least = np.linalg.norm(places - triangle[0], axis=1) - np.linalg.norm(triangle - triangle[0], axis=1).max()
        near = least < best
        close = trimesh.triangles.closest_point(np.repeat(triangle[None], near.sum(), axis=0), places[near])
        best[near] = np.minimum(best[near], np.linalg.norm(close - places[near], axis=1))
    return best


def solid_angle_winding(places, mesh):
    """Winding number by solid angles (van Oosterom and Strackee), nothing to do with lines."""
    total = np.zeros(len(places))
    for triangle in np.asarray(mesh.triangles):
        a, b, c = (corner - places for corner in triangle)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        top = np.einsum("ni,ni->n", a, np.cross(b, c))
        low = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total += 2 * np.arctan2(top, low)
    return total / (4 * np.pi)


def longest_edge(mesh):
    return mesh.edges_unique_length.max()
