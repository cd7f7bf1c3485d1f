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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..scene.model import Camera
from .camera import ground_depth, on_ground
from .inflate import Silhouette

Points = NDArray[np.float64]

STABLE_MARGIN = 0.25
"""Distance of the centre of mass from the edge of the base over the base's inscribed radius, as far as reachable."""
MAX_YAW = np.radians(55.0)
ROUND_YAW_SHARE = 0.4
"""Things that are no boxes touch the ground in unseen places too: their visible contact tells less."""
LEAN = 0.6
"""Lean of the wall of things that are neither boxes nor balls, as a share of the angle of view below the horizontal."""
FOLD = 0.35
"""Width of the fold between floor and wall over the half thickness."""


@dataclass(frozen=True)
class Reference:
    """The surface that the silhouette is inflated about.

    camera: height 1 unit. origin: (3,) a point where the wall meets the ground; normal: (3,) unit, away from camera.
    unit_per_pixel: length of one pixel at the object. fold: units, softens the edge between ground and wall.
    back: thickness behind the reference over that in front, 1 or more.
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


@dataclass(frozen=True)
class Stance:
    """How well a body stands. margin: see STABLE_MARGIN, negative when it topples; base: (k, 2) hull on the ground."""

    margin: float
    base: Points
    centre_of_mass: NDArray[np.float64]


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


def stand(camera: Camera, silhouette: Silhouette) -> tuple[Reference, Stance]:
    """The reference surface on which the body stands best, and how it stands.

    The wall starts where a ball of this thickness would touch the ground, R tan(a/2) behind the lowest visible point
    for a view a below the horizontal, and moves back in steps until the body stands with STABLE_MARGIN.
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
    normal = np.cos(lean) * away - np.sin(lean) * np.array([0.0, 0.0, 1.0])
    outline = on_ground(camera, _lower_outline(silhouette))
    outline = outline[np.isfinite(outline).all(axis=1)]
    front = float((outline @ away).min()) if len(outline) else float(touch @ away)
    # The middle plane of a ball meets the ground before the line of sight that grazes it does.
    start = thick * (np.tan(declination / 2.0) - silhouette.roundness * np.tan(lean))
    back = 1.0 + 2.0 * np.sin(lean) * (1.0 - silhouette.roundness)
    pixels, heights = _samples(silhouette)
    best: tuple[Reference, Stance] | None = None
    for step in np.concatenate([[0.0], np.geomspace(0.08, 3.0, 16)]):
        reference = Reference(
            camera=camera,
            origin=away * (front + start + step * thick),
            normal=normal,
            unit_per_pixel=unit,
            fold=FOLD * thick,
            back=back,
        )
        stance = judge(reference, pixels, heights)
        if best is None or stance.margin > best[1].margin + 0.02:
            best = (reference, stance)
        if stance.margin >= STABLE_MARGIN:
            return reference, stance
    assert best is not None
    return best


def _samples(silhouette: Silhouette, count: int = 6000) -> tuple[Points, Points]:
    """Pixels (n, 2) spread evenly over the silhouette and h (n) there, in pixels."""
    step = max(1, int(np.sqrt(silhouette.mask.sum() / count)))
    rows, columns = np.nonzero(silhouette.mask[::step, ::step])
    rows, columns = rows * step, columns * step
    pixels = np.column_stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5])
    return pixels, np.sqrt(np.maximum(silhouette.square_height[rows, columns], 0.0))


def judge(reference: Reference, pixels: Points, heights: Points) -> Stance:
    """Centre of mass at uniform density and base of the body, from the matter that each pixel's ray holds.

    pixels (n, 2) must sample the silhouette evenly; heights (n) in pixels. A ray of unit depth r between depths
    a and b holds the volume ∝ (b³ − a³)/3 with first moment r (b⁴ − a⁴)/4.
    """
    middle, ground, rays = reference.depths(pixels)
    half = heights * reference.unit_per_pixel / np.linalg.norm(rays, axis=1)
    near, far = np.maximum(middle - half, 1e-6), np.minimum(middle + reference.back * half, ground)
    far = np.maximum(far, near)
    volume = (far**3 - near**3) / 3.0
    total = max(float(volume.sum()), 1e-300)
    centre = reference.camera.position + (rays * ((far**4 - near**4) / 4.0)[:, None]).sum(axis=0) / total
    resting = (middle + reference.back * half >= ground) & (half > 0)
    base = (reference.camera.position + ground[resting][:, None] * rays[resting])[:, :2]
    if len(base) < 3:
        return Stance(margin=-1.0, base=base, centre_of_mass=centre)
    try:
        hull = ConvexHull(base)
    except QhullError:
        return Stance(margin=-1.0, base=base, centre_of_mass=centre)
    corners = base[hull.vertices]
    inner = -(hull.equations[:, :2] @ corners.mean(axis=0) + hull.equations[:, 2]).max()
    distance = -(hull.equations[:, :2] @ centre[:2] + hull.equations[:, 2]).max()
    return Stance(margin=float(distance / max(inner, 1e-12)), base=corners, centre_of_mass=centre)
