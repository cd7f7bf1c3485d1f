# SPDX-License-Identifier: MIT
"""Meshes of the generated bodies, points on them and whether a camera sees them."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from .rigid_world import Array, Body


def body_mesh(body: Body) -> tuple[Array, NDArray[np.int64]]:
    """(V, 3) m and (F, 3) of the body in its rest frame."""
    if body.shape == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=body.half[0])
    else:
        mesh = trimesh.creation.box(extents=2 * np.array(body.half))
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def surface_points(body: Body, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """``count`` points on the body's surface and their outward normals, (K, 3) each, spread at random."""
    if body.shape == "sphere":
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return normal * body.half[0], normal
    half = np.array(body.half)
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    axis = rng.choice(3, size=count, p=areas / areas.sum())
    # Marks sit off the edges, where nobody could track them.
    points = rng.uniform(-0.85, 0.85, (count, 3)) * half
    sign = rng.choice([-1.0, 1.0], size=count)
    normal = np.zeros((count, 3))
    normal[np.arange(count), axis] = sign
    points[np.arange(count), axis] = sign * half[axis]
    return points, normal


def facing(points: Array, normals: Array, eye: Array) -> Array:
    """Cosine between a point's normal and its direction to ``eye``: (T, K). points, normals: (T, K, 3)."""
    to_eye = eye - points
    return np.asarray((to_eye * normals).sum(axis=2) / np.linalg.norm(to_eye, axis=2))
