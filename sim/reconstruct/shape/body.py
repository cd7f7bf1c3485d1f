# SPDX-License-Identifier: MIT
"""Stand the inflated silhouette on the ground, so that it stays there.

Every pixel's ray holds matter from ``ref − h`` to ``ref + b h``, cut where it enters the ground. The reference depth
is that of a wall facing the camera, or of the ground in front of the wall, whichever is nearer: the silhouette is kept
exactly, the base is flat, and the body reaches from the line where it visibly touches the ground to behind the wall.
The wall of a box is upright. That of a ball leans back until it is square to the view, or the ball would become an egg;
other things lie between. What leans is filled behind (b > 1) so that it does not hang over. Moving the wall back
enlarges the base, until the centre of mass lies well above it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...scene.model import Camera
from ..view.camera import ground_depth, on_ground
from .inflate import Silhouette

Points = NDArray[np.float64]

STABLE = 0.25
"""``stability`` that a body gets, as far as it is reachable."""
NO_BASE = -1.0
"""``stability`` of what touches the ground in fewer than three points."""
MAX_YAW = np.radians(55.0)
ROUND_YAW_SHARE = 0.4
"""Things that are no boxes touch the ground in unseen places too: their visible contact tells less."""
LEAN = 0.3
"""Lean of the wall of things that are neither boxes nor balls, as a share of the angle of view below the horizontal."""
FOLD = 0.35
"""Width of the fold between floor and wall over the half thickness."""


@dataclass(frozen=True)
class Reference:
    """The surface that the silhouette is inflated about.

    camera: height 1 unit. origin: (3,) a point where the wall meets the ground; normal: (3,) unit, away from camera.
    unit_per_pixel: length of one pixel at the object. fold: units, softens the edge between ground and wall.
    back: thickness behind the reference over that in front, 1 or more; 0 for nothing behind it.
    """

    camera: Camera
    origin: NDArray[np.float64]
    normal: NDArray[np.float64]
    unit_per_pixel: float
    fold: float
    back: float = 1.0

    def depths(self, pixels: Points) -> tuple[Points, Points, Points]:
        """Reference depth (n), ground depth (n) and rays (n, 3) through ``pixels`` (n, 2), along the optical axis."""
        rays = self.camera.rays(pixels)
        ground = ground_depth(self.camera, rays)
        facing = rays @ self.normal
        wall = np.where(
            facing > 0.05, ((self.origin - self.camera.position) @ self.normal) / np.maximum(facing, 0.05), np.inf
        )
        return _soft_min(wall, ground, self.fold), ground, rays


def _soft_min(first: Points, second: Points, width: float) -> Points:
    """A smooth minimum that never exceeds either, and equals the smaller one where they differ by ``width``."""
    smaller = np.minimum(first, second)
    with np.errstate(invalid="ignore"):
        apart = np.abs(first - second)
    blend = np.clip(1.0 - np.nan_to_num(apart, nan=np.inf, posinf=np.inf) / max(width, 1e-12), 0.0, 1.0)
    return smaller - blend**2 * width / 4.0


def contact_pixel(silhouette: Silhouette) -> NDArray[np.float64]:
    """The lowest point (2,) of the outline in photo pixels: middle of the lowest row."""
    rows = np.flatnonzero(silhouette.mask.any(axis=1))
    columns = np.flatnonzero(silhouette.mask[rows[-1]])
    return np.array([silhouette.left + (columns[0] + columns[-1] + 1) / 2.0, silhouette.top + rows[-1] + 1.0])


def _lower_outline(silhouette: Silhouette) -> Points:
    """Lowest outline point (n, 2) of each column, in photo pixels."""
    mask = silhouette.mask
    columns = np.flatnonzero(mask.any(axis=0))
    lowest = mask.shape[0] - np.argmax(mask[::-1, columns], axis=0)
    return np.column_stack([silhouette.left + columns + 0.5, silhouette.top + lowest.astype(np.float64)])


def contact_yaw(camera: Camera, silhouette: Silhouette) -> float:
    """Angle in radians about Z of the line along which the object touches the ground; 0 faces the camera.

    The edge of the lower convex hull below the centroid, as seen on the ground. A short edge, as under a ball, says
    nothing about direction.
    """
    outline = _lower_outline(silhouette)
    hull = _lower_hull(outline)
    centroid = silhouette.left + np.nonzero(silhouette.mask)[1].mean() + 0.5
    after = int(np.clip(np.searchsorted(hull[:, 0], centroid), 1, len(hull) - 1)) if len(hull) > 1 else 0
    if after == 0:
        return 0.0
    first, second = hull[after - 1], hull[after]
    share = (second[0] - first[0]) / max(1.0, np.ptp(outline[:, 0]))
    ends = on_ground(camera, np.stack([first, second]))
    if not np.isfinite(ends).all():
        return 0.0
    yaw = float(np.arctan2(ends[1, 1] - ends[0, 1], ends[1, 0] - ends[0, 0]))
    weight = float(np.clip((share - 0.3) / 0.3, 0.0, 1.0)) * (1.0 if silhouette.slab else ROUND_YAW_SHARE)
    return float(np.clip(yaw * weight, -MAX_YAW, MAX_YAW))


def _lower_hull(points: Points) -> Points:
    """Lower (largest y) convex chain of ``points`` sorted by x: Andrew's monotone chain."""
    chain: list[NDArray[np.float64]] = []
    for point in points:
        while len(chain) >= 2:
            a, b = chain[-2], chain[-1]
            if (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) < 0:
                break
            chain.pop()
        chain.append(point)
    return np.array(chain)


def references(camera: Camera, silhouette: Silhouette) -> Iterator[Reference]:
    """Reference surfaces to try, the most natural one first.

    The wall starts where a ball of this thickness would touch the ground, R tan(a/2) behind the lowest visible point
    for a view a below the horizontal, and moves back in steps, which enlarges the base.
    """
    contact = contact_pixel(silhouette)
    ray = camera.rays(contact)
    touch = on_ground(camera, contact)
    depth = float(ground_depth(camera, ray))
    unit = depth / camera.fx
    thick = silhouette.half_thickness * unit
    declination = float(np.arctan2(-ray[2], np.hypot(ray[0], ray[1])))
    lean = 0.0 if silhouette.slab else declination * (LEAN + (1.0 - LEAN) * silhouette.roundness)
    yaw = contact_yaw(camera, silhouette)
    away = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    outline = on_ground(camera, _lower_outline(silhouette))
    outline = outline[np.isfinite(outline).all(axis=1)]
    front = float((outline @ away).min()) if len(outline) else float(touch @ away)
    # The middle plane of a ball meets the ground before the line of sight that grazes it does.
    start = thick * (np.tan(declination / 2.0) - silhouette.roundness * np.tan(lean))
    for step in np.concatenate([[0.0], np.geomspace(0.08, 3.0, 12)]):
        yield Reference(
            camera=camera,
            origin=away * (front + start + step * thick),
            normal=np.cos(lean) * away - np.sin(lean) * np.array([0.0, 0.0, 1.0]),
            unit_per_pixel=unit,
            fold=FOLD * thick,
            back=1.0 + 0.6 * np.sin(lean) * (1.0 - silhouette.roundness),
        )


def stability(vertices: Points, faces: NDArray[np.int64]) -> float:
    """How safely a closed body of uniform density stands on z = 0; negative when it topples.

    The distance of its centre of mass from the edge of the convex hull of what touches the ground, over the distance
    of the hull's middle from that edge; -1 when fewer than three points touch it.
    """
    size = float(np.ptp(vertices, axis=0).max())
    base = vertices[vertices[:, 2] < 1e-6 * size][:, :2]
    if len(base) < 3:
        return NO_BASE
    try:
        hull = ConvexHull(base)
    except QhullError:
        return NO_BASE
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    volumes = np.einsum("ti,ti->t", a, np.cross(b, c))
    centre = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volumes.sum())

    def inside(point: NDArray[np.float64]) -> float:
        return -float((hull.equations[:, :2] @ point + hull.equations[:, 2]).max())

    return inside(centre[:2]) / max(inside(_centroid(base[hull.vertices])), 1e-12)


def _centroid(polygon: Points) -> NDArray[np.float64]:
    """Of the area of a convex ``polygon`` (n, 2) whose corners go round."""
    first = polygon[0]
    a, b = polygon[1:-1] - first, polygon[2:] - first
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(first + ((a + b) * areas[:, None]).sum(axis=0) / (3.0 * areas.sum()))
