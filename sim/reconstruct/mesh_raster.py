# SPDX-License-Identifier: MIT
"""Triangle meshes to pixels: a z-buffer in numpy, perspective-correct, and the unlit colours of a textured mesh.

1/depth is linear on the screen, and so are w/depth of the barycentric coordinates w (Heckbert and Moreton,
Interpolation for Polygon Texture Mapping and Shading, 1991).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from ..scene.model import Camera

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Points = NDArray[np.float64]
Number = TypeVar("Number", bound=np.generic)

CHUNK = 200_000
"""Pairs of triangle and pixel that are tested at a time."""
NEAR = 1e-9
"""Triangles that come this near, as depth, are left out."""
DEPTH_CELLS = 256
"""Cells along the longer side of the depth map of ``seen_faces``."""
BEHIND = 0.015
"""Depth tolerance of visible faces over the extent."""
PLAIN = 190
"""Grey value of surfaces without texture and colours, 0 to 255."""
MOST_LEVELS = 4
"""Halvings of a texture that are made for minification; more would mix the charts of an atlas."""


def doubled_area(corners: NDArray[np.floating]) -> Points:
    """Return twice the signed area (T,) of triangles (T, 3, 2 or more) in x and y."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.asarray((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def fragments(
    at: Points, faces: Ints, size: tuple[int, int], use: NDArray[np.bool_]
) -> Iterator[tuple[Ints, Ints, Points]]:
    """Yield, in batches of n, the pixels whose centres triangles cover: triangle (n,), pixel (n,), coordinates (n, 3).

    at: (N, 3) x, y in pixels, the centre of the top left one at (0.5, 0.5), and depth of the vertices. faces: (T, 3);
    ``use`` (T,) of them. size: width, height; pixels are counted row by row. The coordinates are barycentric on the
    screen. Triangles with a corner behind ``NEAR`` and those seen edge-on are left out; the others are covered from
    either side, and a centre on a common edge by both.
    """
    width, height = size
    corner = at[faces]
    with np.errstate(invalid="ignore"):
        area = doubled_area(corner)
        low = np.maximum(np.ceil(corner[..., :2].min(axis=1) - 0.5), 0)
        high = np.minimum(np.floor(corner[..., :2].max(axis=1) - 0.5), (width - 1, height - 1))
        span = (high - low + 1).clip(0)
        kept = np.flatnonzero(
            use & (corner[..., 2] > NEAR).all(axis=1) & (np.abs(area) > 1e-12) & (span > 0).all(axis=1)
        )
    low, span, area = low[kept].astype(np.int64), span[kept].astype(np.int64), area[kept]
    a, b, c = (corner[kept, k, :2] for k in range(3))
    edges = [(p, q - p) for p, q in ((b, c), (c, a), (a, b))]
    counts = span[:, 0] * span[:, 1]
    ends = np.cumsum(counts)
    start = 0
    while start < len(kept):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + CHUNK, side="right")))
        face = np.repeat(np.arange(start, stop), counts[start:stop])
        offset = np.arange(done, ends[stop - 1]) - (ends - counts)[face]
        rows = offset // span[face, 0]
        columns = offset - rows * span[face, 0] + low[face, 0]
        rows += low[face, 1]
        flat: list[Points] = []
        # What one edge leaves out, the next needs not look at.
        for p, way in edges:
            x, y = columns + 0.5 - p[face, 0], rows + 0.5 - p[face, 1]
            flat.append((way[face, 0] * y - way[face, 1] * x) / area[face])
            inside = flat[-1] >= -1e-9
            face, rows, columns = face[inside], rows[inside], columns[inside]
            flat = [values[inside] for values in flat]
        yield kept[face], rows * width + columns, np.stack(flat, axis=1)
        start = stop


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """P pixels of a grid that show a mesh, row by row.

    rows, columns: (P,). faces: (P,) the nearest triangle. corners: (P, 3) its barycentric coordinates in space, summing
    to 1. depth: (P,).
    """

    rows: Ints
    columns: Ints
    faces: Ints
    corners: Points
    depth: Points

    def interpolated(self, faces: Ints, values: NDArray[np.floating]) -> Points:
        """Return ``values`` (N, C) at the vertices of ``faces`` (T, 3), interpolated at the pixels (P, C)."""
        return np.asarray(np.einsum("pk,pkc->pc", self.corners, np.asarray(values)[faces[self.faces]]))

    def on_grid(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        """Return (height, width) whether anything is seen, on the grid of ``size`` (width, height)."""
        covered = np.zeros(size[::-1], dtype=bool)
        covered[self.rows, self.columns] = True
        return covered

    def spread(self, values: NDArray[Number], size: tuple[int, int]) -> NDArray[Number]:
        """Return ``values`` (P, C) on the grid (height, width, C) of ``size`` (width, height), the nearest ones where
        nothing is seen; zero everywhere if nothing is."""
        # Not all that rasterises needs SciPy.
        from scipy import ndimage

        result = np.zeros((size[1], size[0], values.shape[1]), dtype=values.dtype)
        if not len(self.rows):
            return result
        result[self.rows, self.columns] = values
        nearest = ndimage.distance_transform_edt(~self.on_grid(size), return_distances=False, return_indices=True)
        return np.asarray(result[tuple(nearest)])


def rasterise(at: Points, faces: Ints, size: tuple[int, int], use: NDArray[np.bool_] | None = None) -> VisiblePixels:
    """Return the nearest triangles ``faces`` (T, 3) at the pixels of a grid of ``size`` (width, height).

    at: (N, 3) x, y in pixels and depth of the vertices, as in ``fragments``. use: (T,) which triangles are drawn, all
    by default. Among equal depths the first triangle wins.
    """
    width, height = size
    depths = at[:, 2][faces]
    best_depth = np.full(width * height, np.inf)
    best_face = np.full(width * height, -1, dtype=np.int64)
    best_corners = np.zeros((width * height, 3))
    for face, cell, flat in fragments(at, faces, size, np.ones(len(faces), dtype=bool) if use is None else use):
        weight = flat / depths[face]
        depth = 1.0 / weight.sum(axis=1)
        nearer = np.flatnonzero(depth < best_depth[cell])
        np.minimum.at(best_depth, cell[nearer], depth[nearer])
        # Of several values for one place numpy keeps the last.
        won = nearer[depth[nearer] == best_depth[cell[nearer]]][::-1]
        best_face[cell[won]] = face[won]
        best_corners[cell[won]] = weight[won] * depth[won, None]
    found = np.flatnonzero(best_face >= 0)
    return VisiblePixels(found // width, found % width, best_face[found], best_corners[found], best_depth[found])


def depth_range(at: Points, faces: Ints, size: tuple[int, int]) -> tuple[Points, Points]:
    """Return nearest and farthest depth (height, width) of a mesh, +inf and -inf where there is none; see
    ``rasterise``."""
    width, height = size
    near, far = np.full(width * height, np.inf), np.full(width * height, -np.inf)
    depths = at[:, 2][faces]
    for face, cell, flat in fragments(at, faces, size, np.ones(len(faces), dtype=bool)):
        depth = 1.0 / (flat / depths[face]).sum(axis=1)
        np.minimum.at(near, cell, depth)
        np.maximum.at(far, cell, depth)
    return near.reshape(height, width), far.reshape(height, width)


def visible_pixels(
    camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64], scale: float = 1.0
) -> VisiblePixels:
    """Return the nearest surface at the pixel centres of the photo scaled by ``scale``.

    Back faces, and faces behind the camera or reaching there, are left out.
    """
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    at = camera.project(vertices)
    at[:, :2] *= (size[0] / camera.width, size[1] / camera.height)
    # Pixel rows run downward: a front face is oriented the other way round in the image.
    return rasterise(at, faces, size, doubled_area(at[faces]) < 0)


def seen_faces(camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the faces (T,) towards the camera whose centres are in front of all others."""
    corner = camera.project(vertices)[faces]
    towards = (doubled_area(corner) < 0) & (corner[..., 2] > NEAR).all(axis=1)
    extent = float(np.ptp(corner[..., :2].reshape(-1, 2), axis=0).max())
    scale = min(1.0, DEPTH_CELLS / max(extent, 1.0))
    shown = visible_pixels(camera, vertices, faces, scale)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    depth = np.full(size[::-1], np.inf)
    depth[shown.rows, shown.columns] = shown.interpolated(faces, camera.project(vertices)[:, 2:])[:, 0]
    middle = corner.mean(axis=1)
    x, y = ((middle[:, i] * scale).clip(0, size[i] - 1).astype(np.int64) for i in (0, 1))
    slack = BEHIND * float(np.ptp(vertices, axis=0).max())
    return np.asarray(towards & (middle[:, 2] <= depth[y, x] + slack))


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of a surface: ``texture`` (h, w, 3) uint8 at ``uv`` (V, 2), else ``colours`` (V, 3) 0 to 255.

    uv: first row of the texture at v = 1; values outside 0 to 1 repeat it.
    """

    texture: NDArray[np.uint8] | None = None
    uv: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


def paint_of(mesh: trimesh.Trimesh) -> Paint:
    """Return the colours of ``mesh``: its texture, else its vertices' colours, else plain grey."""
    uv = getattr(mesh.visual, "uv", None)
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None:
        return Paint(texture=np.asarray(image.convert("RGB"), dtype=np.uint8), uv=np.asarray(uv, dtype=np.float64))
    if isinstance(mesh.visual, trimesh.visual.ColorVisuals) and mesh.visual.kind == "vertex":
        return Paint(colours=np.asarray(mesh.visual.vertex_colors, dtype=np.float64)[:, :3])
    return Paint(colours=np.full((len(mesh.vertices), 3), float(PLAIN)))


def colours(shown: VisiblePixels, projected: NDArray[np.floating], faces: Ints, paint: Paint) -> Floats:
    """Return (P, 3), 0 to 255, of the pixels ``shown``: the texture, bilinear and filtered, or the colours.

    Each triangle takes the halving of the texture whose texels are about as large as its pixels (Williams, Pyramidal
    Parametrics, 1983), so that a fine texture does not sparkle.
    """
    if paint.texture is None or paint.uv is None:
        if paint.colours is None:
            return np.full((len(shown.faces), 3), float(PLAIN), dtype=np.float32)
        return shown.interpolated(faces, paint.colours).astype(np.float32)
    uv = shown.interpolated(faces, paint.uv)
    outside = (uv < 0) | (uv > 1)
    uv[outside] %= 1.0
    levels = _levels(shown, projected, faces, paint)
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


def _levels(shown: VisiblePixels, projected: NDArray[np.floating], faces: Ints, paint: Paint) -> Ints:
    """(P,) halvings of the texture for each pixel."""
    assert paint.texture is not None
    assert paint.uv is not None
    used, index = np.unique(shown.faces, return_inverse=True)
    texels = _areas(paint.uv[faces[used]] * (paint.texture.shape[1], paint.texture.shape[0]))
    pixels = _areas(np.asarray(projected)[faces[used]][..., :2])
    level = np.round(0.5 * np.log2(np.maximum(texels, 1e-9) / np.maximum(pixels, 1e-9)))
    deepest = min(MOST_LEVELS, int(np.log2(max(1, min(paint.texture.shape[:2])))))
    return np.asarray(np.clip(level, 0, deepest).astype(np.int64)[index.reshape(-1)])


def _areas(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(np.abs(doubled_area(corners)) / 2)


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
