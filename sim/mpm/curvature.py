# SPDX-License-Identifier: MIT
"""How a surface bends at the points that sample it, so that round things roll. No Taichi.

A ball that touches the ground with the points of a mesh only is a polyhedron: it loses speed at every edge it rolls
over. A quadric is fitted around each point; where it fits, the point stands for a patch of that quadric, and the place
of the patch that faces the partner is what touches (``rigid_contact.patch``). Where it does not fit, at edges and
corners, the point stands for itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

NEIGHBOURS = 16
"""Points that a quadric is fitted to."""

FITS = 0.03
"""A quadric fits where its points lie within this share of the spacing of it (root of the mean square)."""

FLAT = 1e-3
"""A surface whose radius of curvature is more than ``spacing / FLAT`` counts as flat."""

PATCH = 11
"""Numbers of a patch: point (3), outer normal (3), direction (3) of the first principal curvature, radii of both
curvatures (0: flat or hollow, does not roll). The smoothness follows as twelfth in ``rigid``'s table."""


def patches(points: Array, normals: Array, spacing: float) -> tuple[Array, NDArray[np.bool_]]:
    """Patches (N, ``PATCH``) for surface points (N, 3) with outer normals (N, 3), and whether (N,) each is smooth."""
    count = len(points)
    out = np.zeros((count, PATCH))
    out[:, :3], out[:, 3:6] = points, normals
    k = min(NEIGHBOURS, count)
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.maximum(np.linalg.norm(first, axis=1), 1e-30)[:, None]
    out[:, 6:9] = first
    if k < 8:
        return out, np.zeros(count, dtype=bool)
    second = np.cross(normals, first)
    near = cKDTree(points).query(points, k=k)[1]
    arms = points[near] - points[:, None]
    x, y, z = (np.einsum("nkc,nc->nk", arms, axis) / spacing for axis in (first, second, normals))
    basis = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=2)
    square = np.einsum("nki,nkj->nij", basis, basis) + 1e-9 * np.eye(6)
    fit = np.linalg.solve(square, np.einsum("nki,nk->ni", basis, z)[..., None])[..., 0]
    residual = np.sqrt(np.mean((np.einsum("nki,ni->nk", basis, fit) - z) ** 2, axis=1))
    facing = np.einsum("nkc,nc->nk", normals[near], normals).min(axis=1) > 0.5
    smooth = (residual < FITS) & facing & (np.hypot(fit[:, 1], fit[:, 2]) < 0.3)
    normal = normals - fit[:, 1:2] * first - fit[:, 2:3] * second
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # Curvatures of the graph z(x, y), of which the slope is small; bending away from the normal is positive.
    bend = -np.stack([fit[:, [3, 4]], fit[:, [4, 5]]], axis=1)
    curvatures, axes = np.linalg.eigh(bend)
    direction = axes[:, 0, :1] * first + axes[:, 1, :1] * second
    direction -= np.einsum("nc,nc->n", direction, normal)[:, None] * normal
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-30)[:, None]
    radii = np.where(curvatures > FLAT, spacing / np.maximum(curvatures, FLAT), 0.0)
    bent = smooth & (radii > 0).any(axis=1)
    out[bent, :3] += spacing * fit[bent, :1] * normals[bent]
    out[bent, 3:6], out[bent, 6:9], out[bent, 9:11] = normal[bent], direction[bent], radii[bent]
    return out, smooth
