# SPDX-License-Identifier: MIT
"""How safely a body stands: the margin of its centre of mass inside its base, and the margin that it should have.

What lies on the ground as a film thinner than half a grid cell holds no particle and carries nothing; it is no base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ...mpm.geometry.triangles import area_normals
from ...scene.bake_quality import COARSEST, load_quality

Points = NDArray[np.float64]

MARGIN_CELLS = 2.0
"""Least margin in grid cells: what stands on less is held by the rounding of one cell's contact."""
MARGIN_HEIGHT = 0.15
"""Least margin over the body's height: it stands on slopes of 17° if its centre of mass is half way up."""
FILM = 0.5
"""Least thickness in grid cells of what counts as base."""
FACES_UP = 0.2
"""Least upward part of the normal of a surface that lies over the base."""
ON_BASE = 1e-6
"""Share of a body's size within which a vertex belongs to its base."""


@dataclass(frozen=True)
class SupportMargin:
    """How a closed body of uniform density stands on the level through its lowest vertex; lengths in the mesh's unit.

    margin: from the foot of its centre of mass to the edge of the convex hull of its base, negative outside, -inf
    without a base. inradius: the same of the hull's own centre. height; volume; longest: largest extent along an axis.
    """

    margin: float
    inradius: float
    height: float
    volume: float
    longest: float

    @property
    def steadiness(self) -> float:
        """The margin over the one that the base allows: 1 for a cube, negative for what topples, -1 without a base."""
        return max(self.margin / self.inradius, -1.0) if self.inradius > 0.0 else -1.0

    @property
    def share(self) -> float:
        """The margin over the one that the body should have."""
        return self.margin / self.wanted

    @property
    def cell(self) -> float:
        """Side of a grid cell when the body is simulated alone in the coarsest quality."""
        quality = load_quality(COARSEST)
        filled = (self.volume * quality.particles_per_cell / quality.particles) ** (1 / 3)
        return float(min(filled, self.longest / quality.smallest_cells))

    @property
    def wanted(self) -> float:
        """The margin that the body should have."""
        return max(MARGIN_CELLS * self.cell, MARGIN_HEIGHT * self.height)


def support_of(vertices: Points, faces: NDArray[np.int64]) -> SupportMargin:
    """Return how the closed surface of ``vertices`` (V, 3) and ``faces`` (T, 3) stands; +Z is up."""
    extent = np.ptp(vertices, axis=0)
    a, b, c = (vertices[faces[:, corner]] - vertices.mean(axis=0) for corner in range(3))
    volumes = np.einsum("ti,ti->t", a, np.cross(b, c))
    total = float(volumes.sum())
    centre = vertices.mean(axis=0) + ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * total)
    stands = SupportMargin(-np.inf, 0.0, float(extent[2]), abs(total) / 6.0, float(extent.max()))
    base = _base(vertices, faces, ON_BASE * stands.longest, FILM * stands.cell)
    margin, inradius = stands.margin, stands.inradius
    if len(base) >= 3:
        try:
            hull = ConvexHull(base)
        except QhullError:
            pass
        else:
            margin = inside_hull(hull, centre[:2])
            inradius = inside_hull(hull, centroid(base[hull.vertices]))
    return replace(stands, margin=float(margin), inradius=float(inradius))


def _base(vertices: Points, faces: NDArray[np.int64], level: float, film: float) -> Points:
    """Places (n, 2) of the lowest vertices, to ``level``, over which the body is thicker than ``film``."""
    height = vertices[:, 2] - vertices[:, 2].min()
    normals = area_normals(vertices, faces)
    lowest = height < level
    up = (normals[:, 2] > FACES_UP * np.linalg.norm(normals, axis=1)) & ~lowest
    if not up.any() or not lowest.any():
        return vertices[lowest][:, :2]
    over = cKDTree(vertices[up][:, :2]).query(vertices[lowest][:, :2])[1]
    return np.asarray(vertices[lowest][height[up][over] > film][:, :2])


def inside_hull(hull: ConvexHull, point: NDArray[np.float64]) -> float:
    """Return the distance of ``point`` (2,) from the edge of ``hull`` (in the plane), negative outside."""
    return -float((hull.equations[:, :2] @ point + hull.equations[:, 2]).max())


def centroid(polygon: Points) -> NDArray[np.float64]:
    """Return the centroid (2,) of the area of a convex ``polygon`` (n, 2) with ordered corners."""
    first = polygon[0]
    a, b = polygon[1:-1] - first, polygon[2:] - first
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(first + ((a + b) * areas[:, None]).sum(axis=0) / (3.0 * areas.sum()))
