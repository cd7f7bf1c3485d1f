# SPDX-License-Identifier: MIT
"""The ground around the objects: positions on the plane, colours, and proxy bodies that shade it.

A shadow multiplies the light by nearly one factor in all channels. A pixel of log colour c that keeps the share s of
its light shows the texture c − log s, and the frequency of that colour on lit ground is the likelihood of s.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.equirectangular import LUMINANCE
from ...scene.model import Camera
from ...srgb import bytes_to_linear
from ..camera.ground_camera import on_ground
from ..shape.inflate import roundness
from .shadow_planes import ShadowPlane, ground_plane

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Values = NDArray[np.float64]

SAMPLES = 1000
"""Pixels of a mask that become points, in each layer of the body."""
FEWEST = 20
"""Fewest pixels of a mask with a shape."""
LAYERS = tuple(np.linspace(-1.0, 1.0, 9))
"""Depths of the layers over the half thickness."""
LEAN = 0.73
"""Lean of the wall that carries a round outline, over the viewing angle below the horizontal: from where a sphere's
lowest ray meets the ground to where its highest one touches it, at middling angles."""
FORWARD = 0.15
"""Distance of a round body's centre behind that wall, over its radius."""
ROUND = 0.5
"""``shape.inflate.roundness`` above which an outline is a sphere's."""
BOX_DEPTH = 0.8
"""Depth over width of all other bodies."""


@dataclass(frozen=True)
class ProxyBody:
    """Points (M, 3) on and in a body, world units; foot: (2,) where it meets the ground; height: of its top."""

    points: Points
    foot: Points
    height: float


def proxy_body(mask: Mask, camera: Camera) -> ProxyBody | None:
    """Return a body with the mask ``mask`` (H, W), as thick as round, on the ground z = 0, or None if it cannot stand.

    Each pixel of the mask is put on a wall through the object's lowest point and given the thickness of a round body.
    None: an empty mask, or one whose lowest point lies above the horizon.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return None
    step = max(1, int(np.sqrt(len(rows) / SAMPLES)))
    kept = (rows % step == 0) & (columns % step == 0)
    if kept.sum() < FEWEST:
        kept = np.ones(len(rows), dtype=bool)
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    deep = distance[rows, columns].astype(np.float64)
    rays = camera.rays(np.column_stack([columns + 0.5, rows + 0.5]))
    # The steepest ray meets the ground nearest to the camera; average over a few, as single pixels are unreliable.
    fall = -rays[:, 2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1), 1e-9)
    lowest = fall >= np.quantile(fall, 1.0 - min(0.02, 30.0 / len(fall))) - 1e-9
    pixel = np.array([columns[lowest].mean() + 0.5, rows[lowest].max() + 0.5])
    foot = on_ground(camera, pixel)
    if not np.isfinite(foot).all():
        return None
    away = foot[:2] - camera.position[:2]
    reach = max(float(np.linalg.norm(away)), 1e-9)
    away = away / reach if reach > 1e-9 else np.array([0.0, 1.0])
    radius = float(deep.max()) * float(np.linalg.norm(foot - camera.position)) / camera.fx
    depth = 2.0 * BOX_DEPTH * radius
    crop = mask[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    round_body = len(rows) >= FEWEST and roundness(crop) > ROUND
    if not round_body:
        # The highest ray passes the far upper edge, the lowest one the near lower edge.
        top = camera.position[2] - float(np.quantile(fall, 0.01)) * (reach + depth)
        lean = float(np.arctan2(depth, max(top, 0.2 * depth)))
    else:
        lean = LEAN * float(np.arctan2(camera.position[2], reach))
    normal = np.array([*(-away * np.cos(lean)), np.sin(lean)])
    toward = rays[kept] @ normal
    usable = toward < -1e-6
    along = ((foot - camera.position) @ normal) / np.where(usable, toward, -1.0)
    wall = camera.position + along[:, None] * rays[kept]
    usable &= (along > 0) & (np.linalg.norm(wall - foot, axis=1) < 20.0 * radius)
    back = np.array([*away, 0.0])
    if not round_body:
        behind = (wall - foot) @ back
        half = 0.5 * depth * _across(rows, columns)[kept]
        offsets = [0.5 * depth + layer * half - behind for layer in LAYERS]
    else:
        half = np.sqrt(np.clip(deep[kept] * (2.0 * deep.max() - deep[kept]), 0.0, None)) * along / camera.fx
        offsets = [FORWARD * radius + layer * half for layer in LAYERS]
    points = np.concatenate([(wall + offset[:, None] * back)[usable] for offset in offsets])
    points[:, 2] = np.maximum(points[:, 2], 0.0)
    if not len(points):
        return None
    return ProxyBody(points=points, foot=foot[:2], height=float(points[:, 2].max()))


def _across(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Values:
    """Depth of a body at these pixels over that in its middle, between a box and a cylinder."""
    left, right = np.full(rows.max() + 1, np.iinfo(np.int64).max), np.full(rows.max() + 1, -1)
    np.minimum.at(left, rows, columns)
    np.maximum.at(right, rows, columns)
    place = (2.0 * columns - left[rows] - right[rows]) / (right[rows] - left[rows] + 1.0)
    return np.asarray((1.0 - place**4) ** 0.25)


OBJECT_SIDE, SMALLEST_SIDE = 130, 24
"""Largest size in pixels of the largest object, and least size of the smallest if possible."""
MOST_PIXELS = 45_000
REACH = 3.0
"""Range of a shadow around an object, over its height: light 18° high."""
USUAL = 1.0
"""Distance over an object's height beyond which the ground's colour is weighted down: a wall may begin."""
DARKEST = 2e-3
"""Linear light below which ratios are unreliable: one step in eight bits is a third of it."""


@dataclass(frozen=True)
class GroundPixels:
    """Ground near the objects in a small picture.

    rows, columns: (N,) of the pixels. places: (N, 2) on the plane z = 0. colour: (N, 3) natural logarithm of the linear
    light. weight: (N,) confidence that they are the ground on which the objects stand. known: (h, w) 1 on these pixels.
    object_side: pixels of the largest object. extent: of the ground near the objects, with what a wall takes of it, or
    None for that of ``places``.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    places: Values
    colour: Values
    weight: Values
    known: NDArray[np.float32]
    object_side: float
    extent: float | None = None
    _weights: dict[float, NDArray[np.float32]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def picture(self, values: NDArray[np.generic], elsewhere: float = 0.0) -> NDArray[np.float32]:
        """Return ``values`` (N,) in the small picture (h, w), ``elsewhere`` off the ground."""
        found = np.full(self.known.shape, elsewhere, dtype=np.float32)
        found.reshape(-1)[self._flat] = values
        return found

    def blurred(self, values: NDArray[np.generic], sigma: float) -> Values:
        """Return Gaussian means (N,) of ``values`` (N,) over ``sigma`` pixels of ground."""
        total = cv2.GaussianBlur(self.picture(values), (0, 0), sigma).reshape(-1)[self._flat]
        return np.asarray(total / self._weight(sigma), dtype=np.float64)

    @functools.cached_property
    def _flat(self) -> NDArray[np.int64]:
        """Indices (N,) of the pixels in the flattened small picture."""
        return np.asarray(self.rows * self.known.shape[1] + self.columns)

    def _weight(self, sigma: float) -> NDArray[np.float32]:
        """Share (N,) of ground within ``sigma`` pixels; kept, as many values are blurred alike."""
        if sigma not in self._weights:
            around = cv2.GaussianBlur(self.known, (0, 0), sigma).reshape(-1)[self._flat]
            self._weights[sigma] = np.maximum(around, np.float32(1e-6))
        return self._weights[sigma]


def ground_pixels(
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    camera: Camera,
    bodies: Sequence[ProxyBody],
    stay: Mask | None = None,
    plane: ShadowPlane | None = None,
) -> GroundPixels | None:
    """Return the ground around ``bodies`` in ``pixels`` (H, W, 3) sRGB, or None if none is in view.

    masks: (H, W) of all objects; stay: (H, W) things that are no objects. Both, and the pixels along their outlines,
    are excluded. plane: what takes the place of the ground z = 0 of ``camera``, with ``bodies`` in its frame.
    """
    height, width = pixels.shape[:2]
    sides = [max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) for mask in masks if mask.any()]
    shrink = min(1.0, max(OBJECT_SIDE / max(sides), min(SMALLEST_SIDE / min(sides), 1.0)))
    coarse = _centres(width, height, (max(1, width // 8), max(1, height // 8)))
    plane = plane or ground_plane((height, width))
    area = float(_near(plane.places(camera, coarse), bodies).mean()) * width * height
    shrink = min(shrink, math.sqrt(MOST_PIXELS / max(area, 1.0)))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    # Pixels along an outline mix object and ground: exclude them from the mean.
    seam = max(1, round(0.5 / shrink))
    covered = np.logical_or.reduce([*masks, ~plane.region] if stay is None else [*masks, ~plane.region, stay])
    open_ground = (cv2.dilate(covered.astype(np.uint8), np.ones((2 * seam + 1,) * 2, np.uint8)) == 0).astype(np.float32)
    share = cv2.resize(open_ground, size, interpolation=cv2.INTER_AREA)
    light = cv2.resize(bytes_to_linear(pixels) * open_ground[..., None], size, interpolation=cv2.INTER_AREA)
    places = plane.places(camera, _centres(width, height, size))
    near = _near(places, bodies)
    use = near & (share > 0.3)
    if not use.any():
        return None
    # On less ground a smooth field would bend more, and pass soft shadows off as its own.
    extent = None if plane.region.all() else float(np.ptp(places[near][:, :2], axis=0).max())
    linear = light[use] / share[use][:, None]
    rows, columns = np.nonzero(use)
    return GroundPixels(
        rows=rows,
        columns=columns,
        places=places[use][:, :2],
        colour=np.log(np.maximum(linear.astype(np.float64), DARKEST)),
        weight=1.0 / (1.0 + (_distance(places[use], bodies) / USUAL) ** 2),
        known=use.astype(np.float32),
        object_side=max(sides) * shrink,
        extent=extent,
    )


def _centres(width: int, height: int, size: tuple[int, int]) -> Values:
    """Positions in the photo (h, w, 2) of the pixels of a picture of ``size`` (w, h)."""
    x, y = (np.arange(size[0]) + 0.5) * (width / size[0]), (np.arange(size[1]) + 0.5) * (height / size[1])
    return np.stack(np.meshgrid(x, y), axis=-1)


def _near(places: Values, bodies: Sequence[ProxyBody]) -> Mask:
    """Whether ``places`` (..., 3) are within reach of a shadow of one of the ``bodies``; never above the horizon."""
    return (_distance(places, bodies) < REACH) & np.isfinite(places).all(axis=-1)


def _distance(places: Values, bodies: Sequence[ProxyBody]) -> Values:
    """Distance of ``places`` (..., 3) from the nearest of the ``bodies``, over that one's height."""
    nearest = np.full(places.shape[:-1], np.inf)
    with np.errstate(invalid="ignore"):
        for body in bodies:
            low, high = body.points[:, :2].min(axis=0), body.points[:, :2].max(axis=0)
            outside = np.maximum(np.maximum(low - places[..., :2], places[..., :2] - high), 0.0)
            nearest = np.fmin(nearest, np.linalg.norm(outside, axis=-1) / max(body.height, 1e-9))
    return nearest


BINS = (240, 13, 13)
LOW, HIGH = np.array([-3.2, -0.65, -0.65]), np.array([1.6, 0.65, 0.65])
"""Range of luminance and two chromas about the smooth part, natural logarithms."""
_PER_UNIT = np.array(BINS) / (HIGH - LOW)
FINEST = np.array([1.0, 0.6, 0.6])
"""Least smoothing of the histogram, in bins."""
OTHER = 0.02
"""Share of outliers: pixels of any colour that are not ground."""


def relative_colour(colour: Values, smooth: Values) -> Values:
    """Return log luminance and two log chromas (N, 3) of log colours (N, 3) relative to the ``smooth`` part (N, 3).

    A chroma is weighted by its weaker channel: the little blue of a yellow floor is mostly noise.
    """
    off = colour - smooth
    usual = np.exp(np.median(smooth, axis=0))
    present = np.minimum(1.0, 3.0 * usual / usual.sum())
    red, blue = min(present[0], present[1]), min(present[2], present[1])
    return np.column_stack([off @ LUMINANCE, red * (off[:, 0] - off[:, 1]), blue * (off[:, 2] - off[:, 1])])


def fit_smooth(colour: Values, terms: Values, weight: Values) -> Values:
    """Return coefficients (6, 3) of the smooth part of ``colour`` (N, 3) in ``terms`` (N, 6), robust against texture.

    weight: (N,) of each pixel.
    """
    # Texture may pass for curvature: regularise it a little.
    prior = np.diag([1e-9, 0.002, 0.002, 0.01, 0.01, 0.01]) * max(float(weight.sum()), 1.0)
    current = weight
    found = np.zeros((terms.shape[1], 3))
    for _ in range(6):
        weighted = terms * current[:, None]
        found = np.linalg.solve(weighted.T @ terms + prior, weighted.T @ colour)
        apart = colour - terms @ found
        chroma = apart - (apart @ LUMINANCE)[:, None]
        current = weight
        for off in (np.abs(apart @ LUMINANCE), np.linalg.norm(chroma, axis=1)):
            scale = max(0.02, 1.48 * float(np.median(off[weight >= 0.5 * weight.max()])))
            current = current / np.maximum(1.0, off / (1.5 * scale))
    return np.asarray(found)


class GroundTexture:
    """Likelihood of colours on lit ground: a smoothed histogram of ``samples`` (N, 3) of ``relative_colour``.

    weight: (N,) of each sample. grain: (3,) difference of neighbouring pixels; the histogram is no finer, or it would
    fit its own samples and reject all others.
    """

    def __init__(self, samples: Values, weight: Values, grain: Values) -> None:
        counts = np.zeros(BINS)
        np.add.at(counts.reshape(-1), self._bins(samples), weight)
        width = np.maximum(grain * _PER_UNIT * max(len(samples), 2) ** (-1.0 / 7.0), FINEST)
        counts = ndimage.gaussian_filter(counts, width, mode="nearest")
        self._density = (1.0 - OTHER) * counts / max(float(counts.sum()), 1e-12) + OTHER / counts.size
        self._logs: dict[tuple[float, float], Values] = {}

    def likelihood(self, samples: Values, spread: float = 0.0, tint: float = 0.0) -> Values:
        """Return the log likelihood (N,) of ``samples`` (N, 3) on lit ground.

        spread, tint: uncertainty of their log luminance and chromas after an approximate shadow was removed.
        """
        key = (round(spread, 3), round(tint, 3))
        if key not in self._logs:
            width = np.array([spread, tint, tint]) * _PER_UNIT
            blurred = np.log(ndimage.gaussian_filter(self._density, width, mode="nearest"))
            # All pixels of a shadow share its depth and tint: their uncertainty must not count once per pixel.
            self._logs[key] = blurred + float((self._density * (np.log(self._density) - blurred)).sum())
        return np.asarray(self._logs[key].reshape(-1)[self._bins(samples)])

    @staticmethod
    def _bins(samples: Values) -> NDArray[np.int64]:
        """Flat indices (N,) of the bins of ``samples`` (N, 3)."""
        flat = np.zeros(len(samples), dtype=np.int64)
        for values, low, per_unit, count in zip(samples.T, LOW, _PER_UNIT, BINS, strict=True):
            place = ((values - low) * per_unit).astype(np.int64)
            flat *= count
            flat += place.clip(0, count - 1, out=place)
        return flat


def pixel_noise(ground: GroundPixels, samples: Values) -> Values:
    """Return the robust standard deviation (3,) of ``samples`` (N, 3) between neighbouring pixels."""
    found = []
    for column in samples.T:
        picture = ground.picture(column, np.nan)
        steps = np.abs(np.diff(picture, axis=1))
        steps = steps[np.isfinite(steps)]
        found.append(1.05 * float(np.median(steps)) if len(steps) else 0.0)
    return np.array(found)
