# SPDX-License-Identifier: MIT
"""Objects coloured by where the discrepancy sits, with a small rasteriser and a perceptual colour map.

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


MAX_TRIANGLES = 12_000
"""Larger meshes are decimated first; the difference is not visible at this size."""

_CREASE = math.cos(math.radians(28))
_SMOOTH = math.cos(math.radians(35))


@dataclass(frozen=True, kw_only=True)
class View:
    """View direction in degrees: azimuth 0 looks along +y, 90 along -x; +z is up."""

    azimuth: float
    elevation: float

    @property
    def axes(self) -> Array:
        """Return (3, 3): right, up and towards the viewer as rows."""
        turn, lift = math.radians(self.azimuth), math.radians(self.elevation)
        right = np.array([math.cos(turn), math.sin(turn), 0.0])
        towards = np.array([math.cos(lift) * math.sin(turn), -math.cos(lift) * math.cos(turn), math.sin(lift)])
        return np.stack([right, np.cross(towards, right), towards])


@dataclass(frozen=True, kw_only=True)
class Raster:
    """G-buffer of H rows and W columns, the first row at the top.

    face: (H, W) triangle index, -1 for background. place: (H, W, 3) m in the mesh's frame, NaN for background.
    normal: (H, W, 3) unit, smoothed on smooth surfaces. depth: (H, W) m towards the viewer, -inf for background.
    edge: (H, W) silhouette or crease.
    """

    face: NDArray[np.int64]
    place: Array
    normal: Array
    depth: Array
    edge: NDArray[np.bool_]


def simplified(
    vertices: Array, faces: NDArray[np.int64], limit: int = MAX_TRIANGLES
) -> tuple[Array, NDArray[np.int64]]:
    """Return the mesh with at most ``limit`` triangles, by vertex clustering in ever larger cells."""
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    cells = 160.0
    while len(faces) > limit and cells > 2:
        keys = np.floor((vertices - vertices.min(axis=0)) / max(extent, 1e-12) * cells).astype(np.int64)
        _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], merged.reshape(-1)[faces]
        different = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[different]
        cells /= 1.4
    return vertices, faces


def rasterise(
    vertices: Array,
    faces: NDArray[np.int64],
    view: View,
    *,
    width: int,
    height: int,
    centre: Array,
    pixels_per_m: float,
) -> Raster:
    """Return the mesh (V, 3), (F, 3) rendered orthographically from ``view``, centred on ``centre`` (3,)."""
    axes = view.axes
    seen = (vertices - centre) @ axes.T
    places = seen[:, :2] * (pixels_per_m, -pixels_per_m) + (width / 2, height / 2)
    normals = _face_normals(vertices, faces)
    corners = _corner_normals(len(vertices), faces, normals)
    face = np.full((height, width), -1, dtype=np.int64)
    depth = np.full((height, width), -np.inf)
    place = np.full((height, width, 3), np.nan)
    normal = np.zeros((height, width, 3))
    for index, triangle in enumerate(faces):
        a, b, c = places[triangle]
        low = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c) - 0.5), 0).astype(int)
        high = np.minimum(np.floor(np.maximum(np.maximum(a, b), c) - 0.5), (width - 1, height - 1)).astype(int)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if (high < low).any() or abs(area) < 1e-12:
            continue
        x = np.arange(low[0], high[0] + 1)[None, :] + 0.5
        y = np.arange(low[1], high[1] + 1)[:, None] + 0.5
        second = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        third = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        weights = np.stack([1 - second - third, second, third], axis=-1)
        z = weights @ seen[triangle, 2]
        window = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
        nearer = (weights >= -1e-9).all(axis=-1) & (z > depth[window])
        if not nearer.any():
            continue
        depth[window][nearer] = z[nearer]
        face[window][nearer] = index
        place[window][nearer] = weights[nearer] @ vertices[triangle]
        normal[window][nearer] = weights[nearer] @ corners[index]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    # Inside-out and open meshes still look right when every normal faces the viewer.
    normal = np.where((normal @ axes[2] < 0)[..., None], -normal, normal)
    return Raster(face=face, place=place, normal=normal, depth=depth, edge=_edges(face, depth, normals, pixels_per_m))


def _face_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))


def _corner_normals(count: int, faces: NDArray[np.int64], normals: Array) -> Array:
    """Return (F, 3, 3): the mean normal around each corner, or the triangle's own at sharp edges."""
    around = np.zeros((count, 3))
    for corner in range(3):
        np.add.at(around, faces[:, corner], normals)
    length = np.linalg.norm(around, axis=1, keepdims=True)
    around /= np.where(length > 0, length, 1.0)
    corners = around[faces]
    smooth = (np.einsum("fcj,fj->fc", corners, normals) > _SMOOTH)[..., None]
    return np.where(smooth, corners, normals[:, None, :])


def _edges(face: NDArray[np.int64], depth: Array, normals: Array, pixels_per_m: float) -> NDArray[np.bool_]:
    covered = face >= 0
    edge = np.zeros(face.shape, dtype=bool)
    if not len(normals):
        return edge
    step = 6.0 / pixels_per_m
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        one, two = face[here], face[there]
        line = covered[here] != covered[there]
        # Only between two triangles.
        row, column = np.nonzero((one != two) & covered[here] & covered[there])
        bend = np.einsum("ij,ij->i", normals[one[row, column]], normals[two[row, column]])
        jump = np.abs(depth[here][row, column] - depth[there][row, column]) > step
        line[row, column] = (np.abs(bend) < _CREASE) | jump
        edge[here] |= line
        edge[there] |= line & covered[there]
    return edge & covered


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
