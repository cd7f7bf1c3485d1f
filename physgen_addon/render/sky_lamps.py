# SPDX-License-Identifier: GPL-3.0-or-later
"""An environment map as a few lamps at infinity, for engines whose shadows come from lamps only. Needs no bpy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.scene.equirectangular import LUMINANCE
from ...sim.scene.equirectangular import directions as sky_directions


@dataclass(frozen=True)
class SkyLamp:
    """A disc in the sky.

    direction: towards it, unit vector (3,). irradiance: RGB (3,) of a surface that faces it. angle: diameter, radians.
    """

    direction: NDArray[np.float64]
    irradiance: NDArray[np.float64]
    angle: float


@dataclass(frozen=True)
class _Region:
    """Rows and columns of the map."""

    rows: slice
    columns: slice


def sky_lamps(
    radiance: NDArray[np.floating], normal: NDArray[np.floating], *, above: int, below: int
) -> tuple[list[SkyLamp], list[SkyLamp]]:
    """Return lamps that approximate the equirectangular map ``radiance`` (H, W, 3); at most so many each.

    The first list is above the ground with unit ``normal`` and lights it exactly as the map does; the second is below
    it and lights the objects. Regions of equal flux by recursive halving across the longer side: P. Debevec, "A Median
    Cut Algorithm for Light Probe Sampling", SIGGRAPH 2005 posters. There a lamp has its region's sum, which is too
    bright for wide regions; here it has the region's irradiance vector.
    """
    directions, solid_angle = sky_directions(*radiance.shape[:2])
    colour = np.nan_to_num(radiance[..., :3].astype(np.float64))
    up = directions @ np.asarray(normal, dtype=float) > 0
    lamps = []
    for side, count in ((up, above), (~up, below)):
        weight = solid_angle * side
        flux = (colour @ LUMINANCE) * weight
        regions = _median_cut(flux, directions[..., 2], count)
        found = [
            _lamp(colour, directions, weight, region) for region in regions if flux[region.rows, region.columns].any()
        ]
        lamps.append(found)
    over, under = lamps
    cosine = np.clip(directions @ np.asarray(normal, dtype=float), 0.0, None)
    exact = np.einsum("hwc,hw,hw->c", colour, cosine, solid_angle)
    got = sum((lamp.irradiance * max(float(lamp.direction @ normal), 0.0) for lamp in over), np.zeros(3))
    share = np.divide(exact, got, out=np.ones(3), where=got > 0)
    return [SkyLamp(lamp.direction, lamp.irradiance * share, lamp.angle) for lamp in over], under


def _median_cut(flux: NDArray[np.float64], height: NDArray[np.float64], count: int) -> list[_Region]:
    """Return at most ``count`` regions of about equal ``flux`` (H, W); ``height`` (H, W) is the sine of the
    latitude.
    """
    lit = np.argwhere(flux > 0)
    if not len(lit):
        return []
    (top, left), (bottom, right) = lit.min(axis=0), lit.max(axis=0) + 1
    regions = [_Region(slice(top, bottom), slice(left, right))]
    while len(regions) < count:
        regions.sort(key=lambda region: float(flux[region.rows, region.columns].sum()), reverse=True)
        halves = next(((r, h) for r in regions if (h := _halves(flux, height, r)) is not None), None)
        if halves is None:
            break
        regions.remove(halves[0])
        regions += halves[1]
    return regions


def _halves(flux: NDArray[np.float64], height: NDArray[np.float64], region: _Region) -> list[_Region] | None:
    """Return ``region`` in two of equal flux, across its longer side on the sphere; None for a single pixel."""
    part = flux[region.rows, region.columns]
    rows, columns = part.shape
    sine = height[region.rows, 0]
    narrowing = math.sqrt(max(1.0 - float(sine[np.abs(sine).argmin()]) ** 2, 0.0))
    # A column is as wide as a row is high at the horizon, and narrower towards the zenith.
    across = columns > 1 and (rows == 1 or columns * narrowing >= rows)
    if not across and rows == 1:
        return None
    total = np.cumsum(part.sum(axis=0 if across else 1))
    cut = int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(total) - 1))
    if across:
        middle = region.columns.start + cut
        return [
            _Region(region.rows, slice(region.columns.start, middle)),
            _Region(region.rows, slice(middle, region.columns.stop)),
        ]
    middle = region.rows.start + cut
    return [
        _Region(slice(region.rows.start, middle), region.columns),
        _Region(slice(middle, region.rows.stop), region.columns),
    ]


def _lamp(
    colour: NDArray[np.float64], directions: NDArray[np.float64], weight: NDArray[np.float64], region: _Region
) -> SkyLamp:
    part = (region.rows, region.columns)
    # The irradiance of a surface with normal n is n·vector while all of the region is in front of it.
    vectors = np.einsum("hwc,hw,hwd->cd", colour[part], weight[part], directions[part])
    mean = LUMINANCE @ vectors
    direction = mean / max(float(np.linalg.norm(mean)), 1e-30)
    solid_angle = float(weight[part].sum())
    half = math.acos(float(np.clip(1.0 - solid_angle / (2 * math.pi), -1.0, 1.0)))
    return SkyLamp(direction, np.clip(vectors @ direction, 0.0, None), 2 * half)
