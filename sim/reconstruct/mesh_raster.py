# SPDX-License-Identifier: MIT
"""Textured triangle meshes to pictures: a z-buffer in numpy, perspective-correct, without lights.

It shows bodies as they are painted: the report's turntables and the benchmarks look at colours, not at shading.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

PLAIN = 190
"""Grey value of surfaces without texture and colours, 0 to 255."""
MOST_LEVELS = 4
"""Halvings of a texture that are made for minification; more would mix the charts of an atlas."""
CHUNK = 1_500_000
"""Pairs of triangle and pixel that are tested at a time: about 60 MB."""
NEAR = 1e-6
"""Triangles that come this near, in metres along the optical axis, are left out."""


@dataclass(frozen=True, eq=False)
class Paint:
    """What a surface wears: ``texture`` (h, w, 3) uint8 at ``uv`` (V, 2), else ``colours`` (V, 3) 0 to 255.

    uv: first row of the texture at v = 1; values outside 0 to 1 repeat it.
    """

    texture: NDArray[np.uint8] | None = None
    uv: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Fragments:
    """What each of (h, w) pixels sees.

    face: (h, w) index of the nearest triangle, -1 for none. weights: (h, w, 3) of its corners, perspective-correct,
    summing to 1. depth: (h, w) along the optical axis in the unit of the input, infinite for none.
    """

    face: NDArray[np.int64]
    weights: Floats
    depth: Floats

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(h, w) whether anything is seen."""
        return self.face >= 0

    def interpolated(self, faces: Ints, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (n, c) ``values`` (V, c) of vertices at the covered pixels, row by row."""
        seen = self.covered
        corners = np.asarray(values)[faces[self.face[seen]]]
        return np.asarray(np.einsum("nk,nkc->nc", self.weights[seen], corners), dtype=np.float64)


def paint_of(mesh: trimesh.Trimesh) -> Paint:
    """Return what ``mesh`` wears: its texture, else its vertices' colours, else plain grey."""
    uv = getattr(mesh.visual, "uv", None)
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None:
        return Paint(texture=np.asarray(image.convert("RGB"), dtype=np.uint8), uv=np.asarray(uv, dtype=np.float64))
    if isinstance(mesh.visual, trimesh.visual.ColorVisuals) and mesh.visual.kind == "vertex":
        return Paint(colours=np.asarray(mesh.visual.vertex_colors, dtype=np.float64)[:, :3])
    return Paint(colours=np.full((len(mesh.vertices), 3), float(PLAIN)))


def rasterise(projected: NDArray[np.floating], faces: Ints, size: tuple[int, int]) -> Fragments:
    """Return the nearest triangles in a picture of ``size`` (height, width).

    projected: (V, 3) x, y in pixels, the centre of the top left one at (0.5, 0.5), and depth > 0 along the optical
    axis. faces: (T, 3), seen from both sides. Triangles with a corner nearer than ``NEAR`` are left out. 1/depth is
    linear on the screen, and so are w/depth of the barycentric coordinates w (Heckbert and Moreton, Interpolation for
    Polygon Texture Mapping and Shading, 1991).
    """
    height, width = size
    seen = np.asarray(projected, dtype=np.float64)
    inverse = np.zeros(height * width, dtype=np.float32)
    nearest = np.full(height * width, -1, dtype=np.int64)
    corners = seen[faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    with np.errstate(invalid="ignore"):
        low = np.ceil(corners[..., :2].min(axis=1) - 0.5)
        high = np.floor(corners[..., :2].max(axis=1) - 0.5)
        good = (corners[..., 2].min(axis=1) > NEAR) & (np.abs(area) > 1e-12) & np.isfinite(low + high).all(axis=1)
        low = np.maximum(low, 0)
        high = np.minimum(high, (width - 1, height - 1))
        good &= (high >= low).all(axis=1)
    chosen = np.flatnonzero(good)
    first = low[chosen].astype(np.int64)
    span = high[chosen].astype(np.int64) - first + 1
    planes = _planes(corners[chosen], area[chosen])
    count = span.prod(axis=1)
    for part in _chunks(count):
        _fill(inverse, nearest, chosen[part], first[part], span[part], count[part], planes[part], width)
    return _fragments(inverse, nearest, seen, faces, size)


def _planes(corners: NDArray[np.float64], area: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3): second and third barycentric coordinate and 1/depth as (x, y, 1) . plane on the screen."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    planes = np.empty((len(corners), 3, 3))
    planes[:, 0, 0], planes[:, 0, 1] = (c[:, 1] - a[:, 1]) / area, -(c[:, 0] - a[:, 0]) / area
    planes[:, 1, 0], planes[:, 1, 1] = -(b[:, 1] - a[:, 1]) / area, (b[:, 0] - a[:, 0]) / area
    planes[:, :2, 2] = -(planes[:, :2, 0] * a[:, :1] + planes[:, :2, 1] * a[:, 1:2])
    near = 1.0 / corners[..., 2]
    planes[:, 2] = planes[:, 0] * (near[:, 1] - near[:, 0])[:, None] + planes[:, 1] * (near[:, 2] - near[:, 0])[:, None]
    planes[:, 2, 2] += near[:, 0]
    return planes


def _chunks(count: Ints) -> list[slice]:
    """Consecutive slices of triangles with at most ``CHUNK`` pairs each, or a single triangle."""
    ends = np.cumsum(count)
    slices, start = [], 0
    while start < len(count):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + CHUNK, side="right")))
        slices.append(slice(start, stop))
        start = stop
    return slices


def _fill(
    inverse: Floats,
    nearest: Ints,
    triangles: Ints,
    first: Ints,
    span: Ints,
    count: Ints,
    planes: NDArray[np.float64],
    width: int,
) -> None:
    """Test all pixels of the triangles' boxes and write the nearest hits into ``inverse`` depth and ``nearest``."""
    owner = np.repeat(np.arange(len(count)), count)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    # Coordinates relative to the box keep single precision exact enough, at half the time of double.
    across = span[:, 0].astype(np.int32)[owner]
    row = (offset // across).astype(np.int32)
    column = (offset - row * across.astype(np.int64)).astype(np.int32)
    corner = np.einsum("nkj,nj->nk", planes, np.concatenate([first + 0.5, np.ones((len(first), 1))], axis=1))
    slopes = np.concatenate([planes[:, :, :2].reshape(-1, 6), corner], axis=1).astype(np.float32)
    x, y = column.astype(np.float32), row.astype(np.float32)
    second = slopes[owner, 0] * x + slopes[owner, 1] * y + slopes[owner, 6]
    third = slopes[owner, 2] * x + slopes[owner, 3] * y + slopes[owner, 7]
    # A pixel's centre on an edge belongs to both triangles: rounding leaves no gaps.
    hit = np.flatnonzero((second >= -1e-6) & (third >= -1e-6) & (second + third <= 1 + 2e-6))
    of = owner[hit]
    near = slopes[of, 4] * x[hit] + slopes[of, 5] * y[hit] + slopes[of, 8]
    pixel = (first[of, 1] + row[hit]) * width + first[of, 0] + column[hit]
    better = np.flatnonzero(near > inverse[pixel])
    np.maximum.at(inverse, pixel[better], near[better])
    won = better[near[better] == inverse[pixel[better]]]
    nearest[pixel[won]] = triangles[of[won]]


def _fragments(
    inverse: Floats, nearest: Ints, seen: NDArray[np.float64], faces: Ints, size: tuple[int, int]
) -> Fragments:
    height, width = size
    pixels = np.flatnonzero(nearest >= 0)
    corners = seen[faces[nearest[pixels]]]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    place = np.stack([pixels % width + 0.5, pixels // width + 0.5], axis=-1)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    second = ((place[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (place[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    third = ((b[:, 0] - a[:, 0]) * (place[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (place[:, 0] - a[:, 0])) / area
    flat = np.clip(np.stack([1.0 - second - third, second, third], axis=-1), 0.0, 1.0) / corners[..., 2]
    weights = np.zeros((height * width, 3), dtype=np.float32)
    weights[pixels] = flat / flat.sum(axis=1, keepdims=True)
    depth = np.full(height * width, np.inf, dtype=np.float32)
    depth[pixels] = 1.0 / inverse[pixels]
    return Fragments(
        face=nearest.reshape(height, width),
        weights=weights.reshape(height, width, 3),
        depth=depth.reshape(height, width),
    )


def colours(fragments: Fragments, projected: NDArray[np.floating], faces: Ints, paint: Paint) -> Floats:
    """Return (n, 3), 0 to 255, of the covered pixels, row by row: the texture, bilinear and filtered, or the colours.

    Each triangle takes the halving of the texture whose texels are about as large as its pixels (Williams, Pyramidal
    Parametrics, 1983), so that a fine texture does not sparkle.
    """
    if paint.texture is None or paint.uv is None:
        if paint.colours is None:
            return np.full((int(fragments.covered.sum()), 3), float(PLAIN), dtype=np.float32)
        return fragments.interpolated(faces, paint.colours).astype(np.float32)
    uv = fragments.interpolated(faces, paint.uv)
    outside = (uv < 0) | (uv > 1)
    uv[outside] %= 1.0
    levels = _levels(fragments, projected, faces, paint)
    picture = np.zeros((len(uv), 3), dtype=np.float32)
    texture = paint.texture
    for level in range(int(levels.max(initial=0)) + 1):
        if level:
            half = (max(1, texture.shape[1] // 2), max(1, texture.shape[0] // 2))
            texture = np.asarray(cv2.resize(texture, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        mine = np.flatnonzero(levels == level)
        if len(mine):
            picture[mine] = _looked_up(texture, uv[mine])
    return picture


def _levels(fragments: Fragments, projected: NDArray[np.floating], faces: Ints, paint: Paint) -> Ints:
    """(n,) halvings of the texture for each covered pixel."""
    assert paint.texture is not None
    assert paint.uv is not None
    used, index = np.unique(fragments.face[fragments.covered], return_inverse=True)
    texels = _areas(paint.uv[faces[used]] * (paint.texture.shape[1], paint.texture.shape[0]))
    pixels = _areas(np.asarray(projected)[faces[used]][..., :2])
    level = np.round(0.5 * np.log2(np.maximum(texels, 1e-9) / np.maximum(pixels, 1e-9)))
    deepest = min(MOST_LEVELS, int(np.log2(max(1, min(paint.texture.shape[:2])))))
    return np.asarray(np.clip(level, 0, deepest).astype(np.int64)[index.reshape(-1)])


def _areas(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2)


def _looked_up(texture: NDArray[np.uint8], uv: NDArray[np.float64]) -> Floats:
    """Bilinear, (n, 3). ``cv2.remap`` takes at most 32767 columns and rows of places."""
    height, width = texture.shape[:2]
    # OpenCV counts from the middle of the top left texel.
    x = (uv[:, 0] * width - 0.5).astype(np.float32)
    y = ((1.0 - uv[:, 1]) * height - 0.5).astype(np.float32)
    columns = 4096
    rows = -(-len(uv) // columns)
    places = np.zeros((2, rows * columns), dtype=np.float32)
    places[0, : len(uv)], places[1, : len(uv)] = x, y
    found = cv2.remap(
        texture,
        places[0].reshape(rows, columns),
        places[1].reshape(rows, columns),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(found, dtype=np.float32).reshape(-1, 3)[: len(uv)]
