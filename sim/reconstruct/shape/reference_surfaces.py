# SPDX-License-Identifier: MIT
"""Surfaces through the middle of an inflated body: a wall that faces the camera over the ground, legs, or a depth map.

The wall is first where the body touches the ground in the photo. Each further surface stands further back, so that the
body's base is larger.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import ground_depth, on_ground
from .depth_front import middle_surface
from .inflate import Silhouette
from .legs import standing_depth

Points = NDArray[np.float64]

MAX_YAW = np.radians(55.0)
ROUND_YAW_SHARE = 0.4
"""Weight of the visible contact line for objects other than boxes, which also touch the ground in unseen points."""
LEAN = 0.3
"""Lean of the wall for objects that are neither boxes nor spheres, as a share of the viewing angle below the
horizontal."""
MOVED = 5
"""Steps of the wall before the unseen side is made thicker."""
THICKER, THICKEST = 0.06, 1.6
"""Increase of the unseen side's thickness with each further step, and its largest value, over the usual one."""
FOLD = 0.35
"""Width of the fold between floor and wall over the half thickness."""


@dataclass(frozen=True)
class MeasuredSurface:
    """The middle of a body by a depth map or by its feet, on the crop of its silhouette.

    depth: (h, w) along the optical axis, units. rise: (h, w) height of the visible front over it, pixels along the ray.
    left, top: of the crop, photo pixels. behind: (h, w) factor of the thickness behind it; None for 1.
    """

    depth: Points
    rise: Points
    left: int
    top: int
    behind: Points | None = None

    def sample(self, values: Points, pixels: Points) -> Points:
        """Return ``values`` (h, w) at photo ``pixels`` (n, 2)."""
        at = pixels - np.array([self.left + 0.5, self.top + 0.5])
        return np.asarray(ndimage.map_coordinates(values, at[:, ::-1].T, order=1, mode="nearest"))


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface about which the silhouette is inflated.

    camera: height 1 unit. origin: (3,) a point where the wall meets the ground; normal: (3,) unit, away from the
    camera. unit_per_pixel: length of one pixel at the object. fold: units, softens the edge between ground and wall.
    back: thickness behind the reference over that in front, 1 or more; 0 for nothing behind it. middle: replaces wall
    and ground by a measured surface.
    """

    camera: Camera
    origin: NDArray[np.float64]
    normal: NDArray[np.float64]
    unit_per_pixel: float
    fold: float
    back: float = 1.0
    middle: MeasuredSurface | None = None

    def depths(self, pixels: Points) -> tuple[Points, Points, Points]:
        """Return reference depth (n), ground depth (n) and rays (n, 3) through ``pixels`` (n, 2), along the optical
        axis."""
        rays = self.camera.rays(pixels)
        ground = ground_depth(self.camera, rays)
        if self.middle is not None:
            return np.minimum(self.middle.sample(self.middle.depth, pixels), ground), ground, rays
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
    """Return the lowest point (2,) of the outline in photo pixels: middle of the lowest row."""
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
    """Return the angle in radians about Z of the line of contact with the ground; 0 faces the camera.

    The edge of the lower convex hull below the centroid, projected to the ground. A short edge, as under a sphere, does
    not determine a direction.
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


def reference_surfaces(camera: Camera, silhouette: Silhouette) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces to try, the most natural one first.

    The wall starts where a sphere of this thickness would touch the ground, R tan(a/2) behind the lowest visible point
    for a view a below the horizontal, and moves back in steps, which enlarges the base. After the first ones the unseen
    side is thicker as well: moving alone would leave a flap on the ground in front.
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
    # The middle plane of a sphere meets the ground before the tangent line of sight does.
    start = thick * (np.tan(declination / 2.0) - silhouette.roundness * np.tan(lean))
    for number, step in enumerate(np.concatenate([[0.0], np.geomspace(0.08, 3.0, 12)])):
        yield ReferenceSurface(
            camera=camera,
            origin=away * (front + start + step * thick),
            normal=np.cos(lean) * away - np.sin(lean) * np.array([0.0, 0.0, 1.0]),
            unit_per_pixel=unit,
            fold=FOLD * thick,
            back=(1.0 + 0.6 * np.sin(lean) * (1.0 - silhouette.roundness))
            * min(1.0 + THICKER * max(number - MOVED, 0), THICKEST),
        )


FEET = (1.0, 1.3, 1.7, 2.2, 3.0)
"""Lengths of feet over the width of their legs, to try until the body stands: a person's are 3."""
PAWS = 1.7
"""The longest of them on more than two legs: paws and hooves are short."""


def standing_surfaces(camera: Camera, silhouette: Silhouette) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces of a body on legs, each leg as far away as its foot; none if it has no legs.

    Longer feet begin where the photo shows them and reach as far behind the leg as before it, so that the body stands
    over their middle; a foot that only went back would carry nothing in front.
    """
    found = standing_depth(camera, silhouette.mask, silhouette.distance, silhouette.left, silhouette.top)
    if found is None:
        return
    plain = next(reference_surfaces(camera, silhouette))
    height, width = silhouette.mask.shape
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    low = ndimage.gaussian_filter(found.low, 2.0)
    for length in FEET:
        if length > PAWS and found.legs > 2:
            break
        away = found.away + (length - 1.0) * found.radius - camera.position[1]
        depth = (away.ravel() / np.maximum(rays[:, 1], 0.05)).reshape(height, width)
        longer = 1.0 + (length - 1.0) * low
        surface = MeasuredSurface(depth, inflated * longer, silhouette.left, silhouette.top, longer)
        yield replace(plain, middle=surface, back=1.0)


def measured_surfaces(camera: Camera, silhouette: Silhouette, front: Points) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces, thicker and thicker, whose visible front is ``front`` (h, w): depth, NaN where
    unknown."""
    plain = next(reference_surfaces(camera, silhouette))
    height, width = silhouette.mask.shape
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
    per_depth = (plain.unit_per_pixel / np.linalg.norm(camera.rays(pixels), axis=1)).reshape(height, width)
    middle, rise = middle_surface(front, silhouette, per_depth)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    for step in (0.0, 0.15, 0.3, 0.5, 0.75, 1.0, 1.5):
        # The front stays where it was measured: the middle moves back, and the front rises as much over it.
        surface = MeasuredSurface(
            middle + step * inflated * per_depth, rise + step * inflated, silhouette.left, silhouette.top
        )
        yield replace(plain, middle=surface, back=1.0 + step)
