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

from ...errors import InputError
from .posed_images import Picture, View
from .silhouettes import Silhouette, VoxelGrid, depth_buffer

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


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
