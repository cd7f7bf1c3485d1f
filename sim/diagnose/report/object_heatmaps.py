# SPDX-License-Identifier: MIT
"""Objects coloured by where the discrepancy sits, by a perceptual colour map.

Equal steps in value are equal steps of lightness in Oklab [Ottosson 2020, *A perceptual color space for image
processing*]."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from ...html import Markup, Picture, element, join, label, shortened
from ..capture import Capture, CaptureObject
from ..diagnosis import Diagnosis
from .diagnosis_charts import round_up
from .mesh_raster import Raster, View, rasterise, simplified
from .number_format import counted, finite_or_zero, number_text, percent_text, tick_text

Array = NDArray[np.float64]

_LIGHTNESS = (0.32, 0.92)
_HUE = (-75.0, 100.0)
"""Degrees, from violet over red to yellow."""
_CHROMA = (0.13, 0.155, 0.15, 0.14, 0.13)

_LMS_FROM_OKLAB = np.array(
    [[1.0, 0.3963377774, 0.2158037573], [1.0, -0.1055613458, -0.0638541728], [1.0, -0.0894841775, -1.2914855480]]
)
_RGB_FROM_LMS = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


_GREY = 0.6
_STEPS = 512


def colours(shares: Array) -> Array:
    """Return sRGB (…, 3) in [0, 1] for shares (…) in [0, 1]; grey for NaN."""
    known = np.isfinite(shares)
    index = np.round(np.clip(np.where(known, shares, 0.0), 0.0, 1.0) * _STEPS).astype(np.int64)
    return np.where(known[..., None], _table()[index], _GREY)


@cache
def _table() -> Array:
    t = np.linspace(0.0, 1.0, _STEPS + 1)
    lightness = _LIGHTNESS[0] + (_LIGHTNESS[1] - _LIGHTNESS[0]) * t
    hue = np.radians(_HUE[0] + (_HUE[1] - _HUE[0]) * t)
    chroma = np.interp(t, np.linspace(0, 1, len(_CHROMA)), _CHROMA)
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    linear = np.clip((lab @ _LMS_FROM_OKLAB.T) ** 3 @ _RGB_FROM_LMS.T, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def hex_colour(share: float) -> str:
    """Return the colour of one share as ``#rrggbb``."""
    red, green, blue = (round(float(c) * 255) for c in colours(np.array(share)))
    return f"#{red:02x}{green:02x}{blue:02x}"


VIEWS = (("from the front", View(azimuth=30, elevation=24)), ("from behind", View(azimuth=210, elevation=24)))

MAX_OBJECTS = 4
"""Objects shown: those with the largest shares."""

_WIDTH, _HEIGHT, _TOP = 300, 240, 24
_SUPERSAMPLED = 3
_STORED = 1.5
"""Stored pixels per CSS pixel."""

_NEIGHBOURS = 24
_CELLS = 120
"""Cells along the largest visible extent; the colour is constant within a cell."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Tracked points of one object over all trials: (N, 3) m in its rest frame, and (N,) mean scores in m/s²."""

    points: Array
    means: Array


def object_scores(diagnosis: Diagnosis, capture: Capture, index: int) -> Scores:
    """Return mean ``point_score`` over time of the points on object ``index``, without points never scored."""
    points, means = [np.empty((0, 3))], [np.empty(0)]
    for trial in capture.trials:
        arrays = diagnosis.trials.get(trial.name)
        if arrays is None or arrays.point_score.ndim != 2 or arrays.point_score.shape[1] != len(trial.object_index):
            continue
        good = np.isfinite(arrays.point_score)
        count = good.sum(axis=0)
        mean = np.where(good, arrays.point_score, 0.0).sum(axis=0) / np.maximum(count, 1)
        chosen = (trial.object_index == index) & (count > 0)
        points.append(trial.rest_points[chosen])
        means.append(mean[chosen])
    return _merged(np.concatenate(points), np.concatenate(means))


def _merged(points: Array, means: Array) -> Scores:
    """Return the distinct points of all trials with the mean of their scores."""
    if not len(points):
        return Scores(points=points, means=means)
    places, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    index = index.reshape(-1)
    return Scores(points=places, means=np.bincount(index, weights=means) / np.bincount(index))


def object_pictures(diagnosis: Diagnosis, capture: Capture) -> list[Picture]:
    """Return two views of every object shown, then the legend, all on one colour scale from 0."""
    shares = {o.name: o.share for o in diagnosis.where.objects}
    order = sorted(range(len(capture.objects)), key=lambda i: -finite_or_zero(shares.get(capture.objects[i].name, 0.0)))
    chosen = [(capture.objects[i], object_scores(diagnosis, capture, i)) for i in order[:MAX_OBJECTS]]
    largest = max((float(s.means.max()) for _, s in chosen if len(s.means)), default=0.0)
    top = round_up(largest)
    pictures = [
        _view(item, scores, top, name, view, shares.get(item.name, math.nan))
        for item, scores in chosen
        for name, view in VIEWS
    ]
    return [*pictures, _legend(top)]


def _view(item: CaptureObject, scores: Scores, top: float, name: str, view: View, share: float) -> Picture:
    low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
    centre = (low + high) / 2
    scale = _pixels_per_m(item.vertices - centre)
    vertices, faces = simplified(item.vertices, item.faces)
    raster = rasterise(
        vertices,
        faces,
        view,
        width=_WIDTH * _SUPERSAMPLED,
        height=_HEIGHT * _SUPERSAMPLED,
        centre=centre,
        pixels_per_m=scale * _SUPERSAMPLED,
    )
    url = "data:image/png;base64," + base64.b64encode(_png(raster, scores, top, view)).decode("ascii")
    known = len(scores.means) > 0
    mean = (
        f"{number_text(float(scores.means.min()))} to {number_text(float(scores.means.max()))} m/s²"
        if known
        else "none"
    )
    title = f"{shortened(item.name, 40)}, {name}"
    return Picture(
        width=_WIDTH,
        height=_HEIGHT + _TOP,
        title=title,
        description=(
            f"Mean discrepancy at its {counted(len(scores.means), 'tracked point')}: {mean}. "
            f"Share of the total discrepancy: {percent_text(share)}."
        ),
        body=join(
            [
                label(shortened(item.name, 24), 0, 14, class_="ink strong"),
                label(name, _WIDTH, 14, class_="quiet", anchor="end"),
                element("image", x=0, y=_TOP, width=_WIDTH, height=_HEIGHT, href=url),
                *_dots(raster, scores, view, centre, scale),
                None if known else label("no tracked point has a score", _WIDTH / 2, _HEIGHT, anchor="middle"),
            ]
        ),
    )


def _pixels_per_m(vertices: Array) -> float:
    """Return one scale for all views at which the mesh fills the largest."""
    half = np.max([np.abs(vertices @ view.axes[:2].T).max(axis=0) for _, view in VIEWS], axis=0)
    return float((np.array([_WIDTH, _HEIGHT]) * 0.46 / np.maximum(half, 1e-9)).min())


def _png(raster: Raster, scores: Scores, top: float, view: View) -> bytes:
    height, width = raster.face.shape
    covered = raster.face >= 0
    rgb = np.full((height, width, 3), 0.6)
    rgb[covered] = colours(_smooth(scores, raster.place[covered]) / top)
    light = view.axes.T @ np.array([-0.45, 0.6, 0.66])
    # Weak shading, so that colours can be compared with the legend.
    shade = 0.80 + 0.20 * np.clip(raster.normal @ light, 0.0, 1.0)
    shade = np.where(raster.edge, 0.55, shade)
    rgb = rgb * shade[..., None]
    values = np.concatenate([rgb * covered[..., None], covered[..., None].astype(np.float64)], axis=-1)
    size = (round(_WIDTH * _STORED), round(_HEIGHT * _STORED))
    # Resampled with premultiplied alpha, so that the silhouette does not pick up the background.
    layers = [
        np.asarray(Image.fromarray(values[..., i].astype(np.float32), mode="F").resize(size, Image.Resampling.BOX))
        for i in range(4)
    ]
    alpha = np.clip(layers[3], 0.0, 1.0)
    small = np.stack([*(layer / np.maximum(alpha, 1e-6) for layer in layers[:3]), alpha], axis=-1)
    buffer = io.BytesIO()
    image = Image.fromarray(np.round(np.clip(small, 0, 1) * 255).astype(np.uint8), mode="RGBA")
    image.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _smooth(scores: Scores, places: Array) -> Array:
    """Return ``_interpolated`` at places (N, 3), computed once per cell."""
    if not len(places):
        return np.empty(0)
    low = places.min(axis=0)
    cells = ((places - low) / max(float(np.ptp(places, axis=0).max()), 1e-12) * _CELLS).astype(np.int64)
    keys = (cells[:, 0] * (_CELLS + 1) + cells[:, 1]) * (_CELLS + 1) + cells[:, 2]
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    return np.asarray(_interpolated(scores, places[first])[index.reshape(-1)])


def _interpolated(scores: Scores, places: Array) -> Array:
    """Return scores at places (N, 3): mean of the nearest tracked points, weighted by inverse squared distance."""
    if not len(scores.means):
        return np.full(len(places), np.nan)
    count = min(_NEIGHBOURS, len(scores.means))
    distance, nearest = cKDTree(scores.points).query(places, k=count)
    distance, nearest = distance.reshape(-1, count), nearest.reshape(-1, count)
    extent = float(np.ptp(scores.points, axis=0).max())
    # Zero at the farthest of them, so that no seam shows where the set of neighbours changes.
    weight = 1.0 / (distance**2 + (0.05 * extent) ** 2 + 1e-18)
    if count == _NEIGHBOURS:
        weight *= np.clip(1.0 - (distance / distance[:, -1:].clip(1e-12)) ** 2, 0.0, None) ** 2 + 1e-9
    return np.asarray((weight * scores.means[nearest]).sum(axis=1) / weight.sum(axis=1))


def _dots(raster: Raster, scores: Scores, view: View, centre: Array, scale: float) -> list[Markup]:
    """Return a dot for each visible tracked point."""
    height, width = raster.face.shape
    found = []
    for point in scores.points:
        right, up, towards = (point - centre) @ view.axes.T
        x, y = _WIDTH / 2 + right * scale, _HEIGHT / 2 - up * scale
        column, row = round(x * _SUPERSAMPLED), round(y * _SUPERSAMPLED)
        if not (0 <= column < width and 0 <= row < height):
            continue
        if towards >= raster.depth[row, column] - 4 / scale:
            found.append(
                element("circle", cx=x, cy=y + _TOP, r=1.5, fill="#ffffff", stroke="#1a1e24", stroke_width=0.7)
            )
    return found


def _legend(top: float) -> Picture:
    steps, width = 60, _WIDTH
    bar = [
        element(
            "rect", x=i * width / steps, y=20, width=width / steps + 0.5, height=12, fill=hex_colour((i + 0.5) / steps)
        )
        for i in range(steps)
    ]
    ticks = [
        label(tick_text(float(f"{share * top:.6g}")), share * width, 47, class_="quiet", anchor=anchor, size=11)
        for share, anchor in ((0.0, None), (0.5, "middle"), (1.0, "end"))
    ]
    return Picture(
        width=width,
        height=54,
        title="Scale of the colours",
        description=f"From 0 (dark violet) to {number_text(top)} m/s² (light yellow). Dots are tracked points.",
        body=join([label("mean missing force per mass, m/s²", 0, 12, class_="quiet"), *bar, *ticks]),
    )
