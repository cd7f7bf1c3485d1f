# SPDX-License-Identifier: MIT
"""The visual hull of a set of views: the largest body that their masks allow, as a closed mesh.

Laurentini 1994: the visual hull projects into every silhouette; here a fraction of the views may dissent. It replaces
the NeuS of PhyCAGE equation 14: it needs no training, and contains the object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from ...errors import InputError
from ...mpm.geometry.triangles import batches, ranges, signed_volume
from ...scene.model import Camera
from .posed_images import Picture, View

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

NEAR_PLANE = 1e-9
"""Metres in front of the camera; triangles that reach behind it are skipped."""
MAX_FRAGMENTS = 2**21
"""Pairs of a triangle and a pixel processed at a time."""


def depth_buffer(vertices: Array, faces: Faces, camera: Camera) -> Array:
    """Return (H, W) metres along the optical axis to the nearest triangle at each pixel's centre; infinite where none.

    vertices: (V, 3) world metres; faces: (T, 3). NumPy only.
    """
    buffer = np.full(camera.width * camera.height, np.inf)
    seen = camera.project(vertices)
    corners = seen[faces]
    corners = corners[(corners[..., 2] > NEAR_PLANE).all(axis=1)]
    # A pixel's centre is at its index plus one half.
    low = np.ceil(corners[..., :2].min(axis=1) - 0.5)
    high = np.floor(corners[..., :2].max(axis=1) - 0.5)
    limit = np.array([camera.width - 1, camera.height - 1])
    low = np.clip(low, 0, limit + 1).astype(np.int64)
    high = np.clip(high, -1, limit).astype(np.int64)
    spans = np.maximum(high - low + 1, 0)
    for chosen in batches(spans[:, 0] * spans[:, 1], MAX_FRAGMENTS):
        _rasterise(buffer, corners[chosen], low[chosen], spans[chosen], camera.width)
    return buffer.reshape(camera.height, camera.width)


def _rasterise(buffer: Array, corners: Array, low: NDArray[np.int64], spans: NDArray[np.int64], width: int) -> None:
    sizes = spans[:, 0] * spans[:, 1]
    which, cell = ranges(np.zeros(len(sizes), np.int64), sizes)
    column = low[which, 0] + cell % spans[which, 0]
    row = low[which, 1] + cell // spans[which, 0]
    a, b, c = (corners[which, i, :2] for i in range(3))
    at = np.stack([column + 0.5, row + 0.5], axis=1)
    area = _cross_2d(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.stack([_cross_2d(b - at, c - at), _cross_2d(c - at, a - at), _cross_2d(a - at, b - at)]) / area
        # Within a triangle the inverse of depth is linear in image coordinates.
        depth = 1.0 / (weights / corners[which, :, 2].T).sum(axis=0)
    hit = (weights >= -1e-9).all(axis=0) & np.isfinite(depth)
    np.minimum.at(buffer, row[hit] * width + column[hit], depth[hit])


def _cross_2d(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


BLOCK_POINTS = 2**17
"""Points processed at a time."""


@dataclass(frozen=True)
class Silhouette:
    """A mask as a distance field. depth: (H, W) pixels from a pixel's centre to the outline, positive inside."""

    camera: Camera
    depth: Array

    @staticmethod
    def of(camera: Camera, mask: Picture) -> Silhouette:
        """Return the silhouette of ``mask`` (H, W) at half coverage; partial coverage locates it within a pixel."""
        inside = mask >= 0.5
        depth = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
        depth -= np.sign(depth) * 0.5
        edge = (np.abs(depth) <= 0.5) & (mask > 0) & (mask < 1)
        depth[edge] = mask[edge] - 0.5
        return Silhouette(camera, depth)

    def metres(self, points: Array) -> Array:
        """Return (n,) how far ``points`` (n, 3) are inside, in metres at their distance; NaN outside the image."""
        seen = self.camera.project(points)
        x, y, distance = seen.T
        known = (distance > 0) & (x >= 0) & (y >= 0) & (x <= self.camera.width) & (y <= self.camera.height)
        found = np.full(len(points), np.nan)
        at = np.stack([y[known] - 0.5, x[known] - 0.5])
        pixels = ndimage.map_coordinates(self.depth, at, order=1, mode="nearest")
        found[known] = pixels * distance[known] / max(self.camera.fx, self.camera.fy)
        return found


def hull_depths(points: Array, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
    """Return two depths (n,) of ``points`` (n, 3) inside the hull in metres, negative outside: strict and lenient.

    The strict one is the least depth in any view. The lenient one ignores the fraction ``dissent`` of the views that
    see a point and place it furthest out. A point in view of fewer than half of the cameras is outside.
    """
    found = np.empty((2, len(points)))
    for start in range(0, len(points), BLOCK_POINTS):
        block = points[start : start + BLOCK_POINTS]
        depths = np.stack([silhouette.metres(block) for silhouette in silhouettes], axis=1)
        seen = np.isfinite(depths).sum(axis=1)
        # NaN sorts last, so the dissenting views come first.
        depths.sort(axis=1)
        passed = np.minimum(np.floor(dissent * seen + 1e-9).astype(np.int64), len(silhouettes) - 1)
        least = np.stack([depths[:, 0], np.take_along_axis(depths, passed[:, None], axis=1)[:, 0]])
        found[:, start : start + BLOCK_POINTS] = np.where((seen >= 2) & (2 * seen >= len(silhouettes)), least, -np.inf)
    return found[0], found[1]


@dataclass(frozen=True)
class VoxelGrid:
    """Nodes of a regular grid. first: (3,) position of the first node, m; spacing: m; shape: nodes along x, y, z."""

    first: Array
    spacing: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(low: Array, high: Array, cells: int) -> VoxelGrid:
        """Return a grid with ``cells`` along the longest side of the box, and two more all around it."""
        spacing = float((high - low).max()) / cells
        counts = np.ceil((high - low) / spacing).astype(int) + 5
        first = (low + high) / 2 - spacing * (counts - 1) / 2
        return VoxelGrid(first, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))

    def finer(self, cells: int) -> VoxelGrid:
        """Return a grid over the same box with ``cells`` along its longest side."""
        inner = self.spacing * (np.array(self.shape) - 5)
        middle = self.first + self.spacing * (np.array(self.shape) - 1) / 2
        return VoxelGrid.around(middle - inner / 2, middle + inner / 2, cells)

    def points(self, which: NDArray[np.int64] | None = None) -> Array:
        """Return (n, 3) positions in metres of the nodes with flat indices ``which`` (n,), z fastest, or of all."""
        numbers = np.arange(int(np.prod(self.shape))) if which is None else which
        return np.asarray(self.first + self.spacing * np.stack(np.unravel_index(numbers, self.shape), axis=1))

    def fields(self, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
        """Return ``hull_depths`` at all nodes, each (nx, ny, nz); beyond three cells from the surface only the sign.

        Every second node is evaluated first, the others only where a surface can be near.
        """
        halves = (-(-np.array(self.shape) // 2) + 1).tolist()
        coarse = VoxelGrid(self.first, 2 * self.spacing, (halves[0], halves[1], halves[2]))
        reach = 4 * coarse.spacing
        known = [
            np.clip(field, -reach, reach).reshape(coarse.shape)
            for field in hull_depths(coarse.points(), silhouettes, dissent)
        ]
        found = np.stack([_upsampled(field, self.shape).ravel() for field in known])
        near = np.flatnonzero((np.abs(found) < 3 * self.spacing).any(axis=0))
        found[:, near] = np.clip(hull_depths(self.points(near), silhouettes, dissent), -reach, reach)
        return found[0].reshape(self.shape), found[1].reshape(self.shape)

    def surface(self, field: Array) -> tuple[Array, Faces]:
        """Return vertices (V, 3) and faces (T, 3) of the closed surface around the nodes where ``field`` is positive;
        empty arrays where there are no such nodes."""
        field = field.copy()
        border = np.ones(self.shape, dtype=bool)
        border[1:-1, 1:-1, 1:-1] = False
        field[border] = np.minimum(field[border], -0.5 * self.spacing)
        # A node exactly on the surface would produce triangles without area.
        field[np.abs(field) < 1e-6 * self.spacing] = -1e-6 * self.spacing
        if field.max() <= 0:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        points, triangles, _, _ = marching_cubes(field, level=0.0, spacing=(self.spacing,) * 3)
        faces = triangles.astype(np.int64)
        points = points.astype(np.float64) + self.first
        return points, faces[:, ::-1].copy() if signed_volume(points, faces) < 0 else faces


def _upsampled(field: Array, shape: tuple[int, int, int]) -> Array:
    """Return ``field`` upsampled by 2 along each axis by linear interpolation, cropped to ``shape``."""
    for axis, length in enumerate(shape):
        between = np.repeat(field, 2, axis=axis)
        odd, after = [slice(None)] * 3, [slice(None)] * 3
        odd[axis], after[axis] = slice(1, -1, 2), slice(2, None, 2)
        between[tuple(odd)] = (between[tuple(odd)] + between[tuple(after)]) / 2
        kept = [slice(None)] * 3
        kept[axis] = slice(0, length)
        field = between[tuple(kept)]
    return field


MIN_VIEWS = 3
SEARCH_CELLS = 32
"""Along each side of the box in which the object is searched."""
SEARCH_DISSENT = 0.2
"""Fraction of views that may be wrong before outliers are identified."""
OUTLIER_DISAGREEMENT = 0.15
"""Disagreement above the median of all views from which a mask is doubtful."""
MAX_CUT_AWAY = 0.02
"""Fraction of the other masks that a correct mask may carve away; the grid is coarse."""
COVERED = 0.9
"""Fraction of a gap's pixels that the other views' hull must cover for the gap to be an error."""
REPORTED_DISAGREEMENT = 0.1
"""Fraction of differing pixels from which a note is given."""
MAX_DISAGREEMENT = 0.35
"""Median fraction of differing pixels above which the masks are not of one object at rest."""


@dataclass(frozen=True, kw_only=True)
class HullOptions:
    """Options of ``visual_hull``. Raises InputError on a value out of range."""

    resolution: int = 96
    """Grid cells along the longest side of the object; 16 to 256."""

    dissent: float = 0.15
    """Fraction of the views that see a point and may place it outside where the others need it; 0 to 0.45. 0 is the
    exact visual hull, through which every gap of any one mask cuts a tunnel."""

    def __post_init__(self) -> None:
        if not (isinstance(self.resolution, int) and 16 <= self.resolution <= 256):
            raise InputError(f"hull option resolution is {self.resolution!r}: give a whole number from 16 to 256")
        if not (math.isfinite(self.dissent) and 0 <= self.dissent <= 0.45):
            raise InputError(f"hull option dissent is {self.dissent!r}: give a fraction from 0 to 0.45")


@dataclass(frozen=True, eq=False)
class Hull:
    """A closed mesh and how well the masks agree on it.

    vertices: (V, 3) world metres; faces: (T, 3), counter-clockwise from outside. disagreement: by view name, the pixels
    in only one of its mask and the hull's silhouette over those in either. left_out: names of views whose masks fit the
    others too badly to be used. notes: sentences for the user.
    """

    vertices: Array
    faces: Faces
    disagreement: dict[str, float]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def visual_hull(views: Sequence[View], options: HullOptions | None = None) -> Hull:
    """Return the visual hull of ``views``, all of which need masks.

    Raises InputError for fewer than 3 views, a view without a mask, and masks that are not of one object at rest,
    naming the views that fit worst.
    """
    options = options or HullOptions()
    silhouettes = _silhouettes(views)
    grid = _search_grid(views, silhouettes)
    good = _consistent_views(views, silhouettes, grid)
    left_out = tuple(view.name for i, view in enumerate(views) if i not in good)
    used = [views[i] for i in good]
    kept, notes = _close_gaps(used, [silhouettes[i] for i in good], grid, options.dissent)
    vertices, faces = _carve(used, kept, grid.finer(options.resolution), options.dissent)
    if not len(faces):
        raise _inconsistent_masks(views, _disagreements(views, vertices, faces))
    found = _disagreements(views, vertices, faces)
    if np.median(found) > MAX_DISAGREEMENT:
        raise _inconsistent_masks(views, found)
    disagreement = {view.name: float(share) for view, share in zip(views, found, strict=True)}
    notes += [
        f"view {name!r} was left out: its mask and the hull of the other views differ in {disagreement[name]:.0%} of "
        "their pixels"
        for name in left_out
    ]
    notes += [
        f"view {name!r}: its mask and the hull differ in {share:.0%} of their pixels"
        for name, share in disagreement.items()
        if share > REPORTED_DISAGREEMENT and name not in left_out
    ]
    return Hull(vertices, faces, disagreement, left_out, tuple(notes))


def _silhouettes(views: Sequence[View]) -> list[Silhouette]:
    if len(views) < MIN_VIEWS:
        raise InputError(f"hull: {len(views)} views do not bound a body: give at least {MIN_VIEWS}, from all around")
    return [Silhouette.of(view.camera, _mask(view)) for view in views]


def _mask(view: View) -> Picture:
    if view.mask is None:
        raise InputError(f"view {view.name!r} has no mask: give images with opacity, masks, or a plain background")
    return view.mask


def _search_grid(views: Sequence[View], silhouettes: Sequence[Silhouette]) -> VoxelGrid:
    """Return a coarse grid that tightly contains the object."""
    centre, radius = _approximate_sphere(views)
    grid = VoxelGrid.around(centre - radius, centre + radius, SEARCH_CELLS)
    for _ in range(6):
        _, lenient = grid.fields(silhouettes, SEARCH_DISSENT)
        places = np.argwhere(lenient > 0)
        if not len(places):
            raise _inconsistent_masks(views, np.ones(len(views)))
        low = grid.first + grid.spacing * (places.min(axis=0) - 1)
        high = grid.first + grid.spacing * (places.max(axis=0) + 1)
        cut = (places.min(axis=0) == 0) | (places.max(axis=0) == np.array(grid.shape) - 1)
        if cut.any():
            low, high = low - (high - low) / 2, high + (high - low) / 2
        elif np.ptp(places, axis=0).max() > 0.6 * SEARCH_CELLS:
            return VoxelGrid.around(low, high, SEARCH_CELLS)
        grid = VoxelGrid.around(low, high, SEARCH_CELLS)
    return grid


def _approximate_sphere(views: Sequence[View]) -> tuple[Array, float]:
    """Return the point (3,) nearest to the rays through all masks' centres, and a radius of the object, m."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    boxes: list[tuple[View, Array]] = []
    for view in views:
        rows, columns = np.nonzero(_mask(view) >= 0.5)
        if not len(rows):
            continue
        corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]], dtype=np.float64)
        boxes.append((view, corners))
        ray = view.camera.rays(corners.mean(axis=0))
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        normal += across
        right += across @ view.camera.position
    if len(boxes) < MIN_VIEWS:
        raise InputError("hull: the masks are empty: check that the object is white in them and the rest black")
    centre = np.linalg.lstsq(normal, right, rcond=None)[0]
    radii = []
    for view, corners in boxes:
        focal = min(view.camera.fx, view.camera.fy)
        radii.append(float(np.ptp(corners, axis=0).max()) * float(view.camera.project(centre)[2]) / focal)
    radius = float(np.median(radii))
    if radius <= 0:
        raise InputError("hull: the cameras look away from where their views intersect: check their poses and axes")
    return centre, radius


def _consistent_views(views: Sequence[View], silhouettes: Sequence[Silhouette], grid: VoxelGrid) -> list[int]:
    """Return the indices of the views whose masks are consistent. Raises InputError where over a third are not.

    A mask that differs from the hull of most views may just be more informative, as the one from the narrow side is. It
    is wrong where it contains what the others rule out, or carves away what they show.
    """
    _, lenient = grid.fields(silhouettes, SEARCH_DISSENT)
    mesh = grid.surface(lenient)
    unlike, bare = _disagreements(views, *mesh), _uncovered_fractions(views, *mesh)
    doubtful = np.flatnonzero(unlike > np.median(unlike) + OUTLIER_DISAGREEMENT)
    good = [i for i in range(len(views)) if i not in doubtful.tolist()]
    strict, _ = grid.fields([silhouettes[i] for i in good], 0.0)
    if strict.max() > 0:
        sure = [views[i] for i in good]
        before = _uncovered_fractions(sure, *grid.surface(strict))
        for i in doubtful[bare[doubtful] <= OUTLIER_DISAGREEMENT]:
            with_it, _ = grid.fields([silhouettes[j] for j in (*good, i)], 0.0)
            if with_it.max() > 0:
                after = _uncovered_fractions(sure, *grid.surface(with_it))
                if (after - before).mean() < MAX_CUT_AWAY:
                    good.append(int(i))
    if len(good) < max(MIN_VIEWS, 2 * len(views) / 3):
        raise _inconsistent_masks(views, unlike)
    return sorted(good)


def _close_gaps(
    views: Sequence[View], silhouettes: Sequence[Silhouette], grid: VoxelGrid, dissent: float
) -> tuple[list[Silhouette], list[str]]:
    """Return the silhouettes with those gaps filled that the other views contradict, and a note on each.

    A tunnel cut by such a gap is visible in no other silhouette, so it could not be detected afterwards.
    """
    _, lenient = grid.fields(silhouettes, dissent)
    vertices, faces = grid.surface(lenient)
    found, notes = [], []
    for view, silhouette in zip(views, silhouettes, strict=True):
        mask = _mask(view) >= 0.5
        gaps = ndimage.binary_fill_holes(mask) & ~mask
        if gaps.any():
            regions, count = ndimage.label(gaps)
            hull = np.isfinite(depth_buffer(vertices, faces, view.camera))
            covered = np.atleast_1d(ndimage.mean(hull, regions, np.arange(1, count + 1)))
            closed = np.isin(regions, 1 + np.flatnonzero(covered > COVERED))
            if closed.any():
                silhouette = Silhouette.of(view.camera, np.where(closed, np.float32(1), _mask(view)))
                notes.append(f"view {view.name!r}: a gap of {int(closed.sum())} pixels inside its mask was filled")
        found.append(silhouette)
    return found, notes


def _carve(
    views: Sequence[View], silhouettes: Sequence[Silhouette], grid: VoxelGrid, dissent: float
) -> tuple[Array, Faces]:
    """Return the strict hull, and the lenient one where the strict one lacks something that several views show.

    The lenient hull is thicker everywhere, as few views bound each point of a surface: it is used only where needed.
    """
    strict, lenient = grid.fields(silhouettes, dissent)
    vertices, faces = grid.surface(strict)
    if not len(faces):
        return grid.surface(lenient)
    open_places = np.flatnonzero((strict.ravel() <= 0) & (lenient.ravel() > 0))
    points = grid.points(open_places)
    lacking = np.zeros(len(points), dtype=np.int64)
    for view in views:
        bare = (_mask(view) >= 0.5) & ~np.isfinite(depth_buffer(vertices, faces, view.camera))
        # Along the outline a pixel more or less is due to the grid.
        bare = ndimage.binary_opening(bare, np.ones((3, 3), dtype=bool))
        if bare.any():
            pixels = np.floor(view.camera.project(points)[:, :2])
            known = ((pixels >= 0) & (pixels < (view.camera.width, view.camera.height))).all(axis=1)
            column, row = pixels[known].astype(np.int64).T
            lacking[known] += bare[row, column]
    wanted = np.zeros(strict.size, dtype=bool)
    wanted[open_places[lacking >= 2]] = True
    if not wanted.any():
        return vertices, faces
    near = ndimage.binary_dilation(wanted.reshape(strict.shape), iterations=2)
    return grid.surface(np.where(near, lenient, strict))


def _disagreements(views: Sequence[View], vertices: Array, faces: Faces) -> Array:
    """Return (n,), for each view, the pixels in only one of its mask and the mesh's silhouette over those in either."""
    found = []
    for view in views:
        hull = np.isfinite(depth_buffer(vertices, faces, view.camera))
        mask = _mask(view) >= 0.5
        found.append(float((hull ^ mask).sum()) / max(1, int((hull | mask).sum())))
    return np.array(found)


def _uncovered_fractions(views: Sequence[View], vertices: Array, faces: Faces) -> Array:
    """Return (n,), for each view, the fraction of its mask that the mesh does not cover."""
    found = []
    for view in views:
        mask = _mask(view) >= 0.5
        empty = mask & ~np.isfinite(depth_buffer(vertices, faces, view.camera))
        found.append(float(empty.sum()) / max(1, int(mask.sum())))
    return np.array(found)


def _inconsistent_masks(views: Sequence[View], disagreement: Array) -> InputError:
    worst = [views[i].name for i in np.argsort(-disagreement, kind="stable")[:3]]
    return InputError(
        f"hull: the masks of {len(views)} views are not of one object at rest; they fit worst in {', '.join(worst)}: "
        "check these masks, and that the cameras belong to the images"
    )
