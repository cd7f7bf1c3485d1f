# SPDX-License-Identifier: MIT
"""Surfaces through the middle of an inflated body: a wall that faces the camera over the ground, legs, or a depth map.

The wall is first where the body touches the ground in the photo. Each further surface stands further back, so that the
body's base is larger.

Depth maps of networks have an unknown scale, disparities also an unknown shift. Both follow from the ground around the
object, whose depth the camera determines. A map that does not follow that ground, does not set the object off from it,
or bends it beyond belief, is left out with a notice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...robust_deviation import robust_deviation
from ...scene.model import Camera
from ..camera.depth_map import DepthMap
from ..camera.ground_camera import ground_depth, on_ground
from ..stage_cache import Notice
from .inflate import Silhouette
from .legs import standing_depth

Field = NDArray[np.float64]
Mask = NDArray[np.bool_]

AROUND = 0.6
"""Ground within this many object sizes determines scale and shift."""
LEAST_GROUND = 60
"""Ground pixels required."""
GROUND_ERROR = 0.04
"""Largest median relative error of the aligned ground."""
LEAST_KNOWN = 0.5
"""Smallest share of the object with a depth."""
SET_OFF = 0.35
"""Least share of the object's rise over the ground behind it that the map has to show."""
DEEPEST = 4.0
"""Largest range of depth inside the outline, over its largest thickness and its height."""
EDGE_PX = (2.0, 0.02)
"""Depth next to the outline is not used: pixels, and share of the object's size; the larger. Maps blur there."""
SMOOTH = 0.35
"""Smoothing of the middle surface over the local half thickness; finer detail belongs to the front alone."""
FRONT = (0.35, 2.5)
"""Range of the front's height over the middle surface, over the inflated height."""


def aligned_depth(depth: DepthMap, camera: Camera, full: Mask, others: Mask) -> Field | None:
    """Return depth along the optical axis (H, W) in the unit of ``camera``, NaN where unknown; None if it cannot be
    aligned by the ground around ``full`` (H, W).

    others: (H, W) pixels that are not ground.
    """
    rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
    size = max(len(rows), len(columns))
    reach = max(8, round(AROUND * size))
    window = np.zeros_like(full)
    window[
        max(0, int(rows[len(rows) // 3])) : int(rows[-1]) + reach,
        max(0, int(columns[0]) - reach) : int(columns[-1]) + reach,
    ] = True
    window &= ~ndimage.binary_dilation(full | others, iterations=max(3, round(0.02 * size)))
    window &= np.isfinite(depth.values)
    y, x = np.nonzero(window)
    step = max(1, len(y) // 20_000)
    y, x = y[::step], x[::step]
    truth = ground_depth(camera, camera.rays(np.column_stack([x + 0.5, y + 0.5])))
    good = np.isfinite(truth) & (truth < 50.0)
    if good.sum() < LEAST_GROUND:
        return None
    y, x, truth = y[good], x[good], truth[good]
    values = depth.values[y, x].astype(np.float64)
    # In inverse depth the ground is linear in the pixel, and noise grows with distance as networks' does.
    inverse = values if depth.disparity else 1.0 / values
    slope, shift = _line(1.0 / truth, inverse, with_shift=depth.disparity)
    if not slope > 0:
        return None
    nearness = ((depth.values if depth.disparity else 1.0 / depth.values) - shift) / slope
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(nearness > 1e-6, 1.0 / nearness, np.nan).astype(np.float64)
    error = np.abs(found[y, x] / truth - 1.0)
    if not np.isfinite(error).mean() > 0.9 or float(np.nanmedian(error)) > GROUND_ERROR:
        return None
    return found


def _line(truth: Field, values: Field, *, with_shift: bool) -> tuple[float, float]:
    """Slope and shift of ``values`` over ``truth``, with outliers reweighted away (Tukey's biweight)."""
    weights = np.ones(len(truth))
    slope, shift = 1.0, 0.0
    for _ in range(12):
        if with_shift:
            mean_t, mean_v = np.average(truth, weights=weights), np.average(values, weights=weights)
            spread = float((weights * (truth - mean_t) ** 2).sum())
            slope = float((weights * (truth - mean_t) * (values - mean_v)).sum()) / max(spread, 1e-30)
            shift = float(mean_v - slope * mean_t)
        else:
            slope = float((weights * truth * values).sum()) / max(float((weights * truth**2).sum()), 1e-30)
        residual = values - slope * truth - shift
        scale = max(float(robust_deviation(residual)), 1e-12 * float(np.abs(values).max()) + 1e-300)
        weights = np.clip(1.0 - (residual / (4.7 * scale)) ** 2, 0.0, 1.0) ** 2
        if weights.sum() <= 0:
            break
    return slope, shift


def front_of(
    depth: DepthMap, camera: Camera, silhouette: Silhouette, full: Mask, others: Mask, name: str, notice: Notice
) -> Field | None:
    """Return the depth (h, w) along the optical axis of the visible front on the crop of ``silhouette``, NaN where it
    is not known; None, with a notice, if the map contradicts the outline or the ground.

    full: (H, W) the object's mask; others: (H, W) pixels of other objects.
    """
    found = aligned_depth(depth, camera, full, others)
    if found is None:
        notice(f"{name}: the depth map does not follow the ground around it; its shape comes from its outline alone")
        return None
    height, width = silhouette.mask.shape
    padded = np.pad(found, max(height, width), constant_values=np.nan)
    top, left = silhouette.top + max(height, width), silhouette.left + max(height, width)
    crop = padded[top : top + height, left : left + width]
    margin = max(EDGE_PX[0], EDGE_PX[1] * float(np.sqrt(silhouette.mask.sum())))
    margin = min(margin, 0.5 * float(silhouette.distance.max()))
    inner = silhouette.mask & (silhouette.distance > margin)
    known = inner & np.isfinite(crop)
    if known.sum() < LEAST_KNOWN * max(1, int(inner.sum())):
        notice(f"{name}: the depth map knows too little of it; its shape comes from its outline alone")
        return None
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
    pixels = pixels + np.array([silhouette.left, silhouette.top])
    ground = ground_depth(camera, camera.rays(pixels.reshape(-1, 2))).reshape(height, width)
    rows = np.flatnonzero(silhouette.mask.any(axis=1))
    contact = float(ground[rows[-1], np.flatnonzero(silhouette.mask[rows[-1]]).mean().astype(int)])
    unit = contact / camera.fx
    # A wall at the contact rises over the ground behind it by ``rise``; the map has to show a good part of that.
    rise = np.minimum(ground, 4.0 * contact) - contact
    upper = known & (rise > 0.25 * float(rise[known].max()))
    shown = (np.minimum(ground, 4.0 * contact) - crop)[upper]
    if not upper.any() or float(np.median(shown / np.maximum(rise[upper], 1e-9))) < SET_OFF:
        notice(f"{name}: the depth map does not set it off from the ground; its shape comes from its outline alone")
        return None
    low, high = (float(v) for v in np.quantile(crop[known], [0.02, 0.98]))
    bound = DEEPEST * unit * (2.0 * silhouette.half_thickness + 0.5 * len(rows))
    if high - low > bound or not 0.4 * contact < low < 2.0 * contact:
        notice(
            f"{name}: the depth map gives it {(high - low) / contact:.0%} of its distance as depth, which contradicts "
            "its outline; its shape comes from its outline alone"
        )
        return None
    return np.asarray(np.where(known & (np.abs(crop - np.median(crop[known])) < bound), crop, np.nan))


def middle_surface(front: Field, silhouette: Silhouette, per_depth: Field) -> tuple[Field, Field]:
    """Return the depth (h, w) of the surface about which the silhouette is inflated so that its front is ``front``, and
    the front's height (h, w) over it in pixels along the ray.

    front: (h, w) depth, NaN where unknown. per_depth: (h, w) depth of one pixel along the ray.
    """
    height = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    known = np.isfinite(front)
    raw = np.where(known, front + height * per_depth, 0.0)
    # Means over more and more of the surroundings, each where the finer one knows nothing.
    sigma = max(2.0, SMOOTH * silhouette.half_thickness)
    middle, weight = _mean(raw, known, sigma)
    nearest = ndimage.distance_transform_edt(weight < 0.05, return_distances=False, return_indices=True)
    middle = np.where(weight < 0.05, middle[tuple(nearest)], middle)
    middle = np.where(weight < 0.05, ndimage.gaussian_filter(middle, sigma), middle)
    rise = np.where(known, (middle - np.where(known, front, 0.0)) / per_depth, height)
    rise = np.clip(rise, FRONT[0] * height, FRONT[1] * height)
    # From the last pixel that is known to the outline the front runs into the inflated one.
    share = ndimage.gaussian_filter(known.astype(np.float64), 2.0)
    share = np.clip(2.0 * share - 1.0, 0.0, 1.0)
    return middle, share * rise + (1.0 - share) * height


def _mean(values: Field, known: Mask, sigma: float) -> tuple[Field, Field]:
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma)
    return ndimage.gaussian_filter(np.where(known, values, 0.0), sigma) / np.maximum(weight, 1e-9), weight


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
