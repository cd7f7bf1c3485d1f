# SPDX-License-Identifier: MIT
"""A rigid body as the worlds of ``kernel`` know it: a sphere, or the corners of its convex hull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...errors import InputError
from ..capture import CaptureObject

Array = NDArray[np.float64]

ROUND = 0.97
"""Volume of the hull over that of the ball around it, above which a mesh is a ball that was cut into faces."""

MOST_CORNERS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidBody:
    """Shape and mass of a body of uniform density.

    center: (3,) m, rest frame, centre of mass. corners: (V, 3) m about it. radius: m around every corner; a sphere has
    one corner, its centre. inertia: (3, 3) m², per mass. area: m², mean cross-section. density: kg/m³. volume: m³.
    """

    center: Array
    corners: Array
    radius: float
    inertia: Array
    area: float
    density: float
    volume: float

    @property
    def round(self) -> bool:
        """Whether it is a sphere."""
        return len(self.corners) == 1

    @property
    def bound(self) -> float:
        """Largest distance of its surface to its centre, m."""
        return float(np.linalg.norm(self.corners, axis=1).max()) + self.radius

    @property
    def mass(self) -> float:
        """kg."""
        return self.density * self.volume


def rigid_body(item: CaptureObject) -> RigidBody:
    """The body of ``item``. Raises InputError for a mesh without volume."""
    vertices = np.unique(item.vertices[np.unique(item.faces)], axis=0) if len(item.faces) else item.vertices
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"object {item.name!r}: its mesh is flat ({type(error).__name__}): give a closed body"
        ) from None
    middle = 0.5 * (vertices[hull.vertices].min(axis=0) + vertices[hull.vertices].max(axis=0))
    reach = float(np.linalg.norm(vertices - middle, axis=1).max())
    if hull.volume > ROUND * 4 / 3 * np.pi * reach**3 or _spherical(vertices[hull.vertices], middle, reach):
        return RigidBody(
            center=middle,
            corners=np.zeros((1, 3)),
            radius=reach,
            inertia=0.4 * reach**2 * np.eye(3),
            area=np.pi * reach**2,
            density=item.belief.density_kg_m3,
            volume=4 / 3 * np.pi * reach**3,
        )
    mesh = trimesh.Trimesh(item.vertices, item.faces)
    if not mesh.is_watertight or mesh.volume <= 0:
        mesh = mesh.convex_hull
    mass = mesh.mass_properties
    center = np.asarray(mass.center_mass, dtype=np.float64)
    return RigidBody(
        center=center,
        corners=_few(vertices[hull.vertices]) - center,
        radius=0.0,
        inertia=np.asarray(mass.inertia, dtype=np.float64) / float(mass.mass),
        area=0.25 * float(hull.area),
        density=item.belief.density_kg_m3,
        volume=float(mesh.volume),
    )


def _spherical(points: Array, middle: Array, reach: float) -> bool:
    """Whether enough points lie on one sphere all around for its faces to be nothing but the mesh's coarseness."""
    distances = np.linalg.norm(points - middle, axis=1)
    return len(points) >= 40 and float(distances.min()) > 0.99 * reach


def _few(points: Array) -> Array:
    """At most ``MOST_CORNERS`` of ``points``, far from each other."""
    if len(points) <= MOST_CORNERS:
        return points
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < MOST_CORNERS:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]
