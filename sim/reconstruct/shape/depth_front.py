# SPDX-License-Identifier: MIT
"""The visible front of a body from a depth map: aligned by the ground around it, and checked against its outline.

Depth maps of networks have an unknown scale, disparities also an unknown shift. Both follow from the ground around the
object, whose depth the camera determines. A map that does not follow that ground, does not set the object off from it,
or bends it beyond belief, is left out with a notice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.depth_map import DepthMap
from ..camera.ground_camera import ground_depth
from ..stage_cache import Notice
from .inflate import Silhouette

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
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-12 * float(np.abs(values).max()) + 1e-300)
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
