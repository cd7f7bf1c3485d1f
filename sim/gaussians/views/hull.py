# SPDX-License-Identifier: MIT
"""The visual hull of a set of views: the largest body that their masks allow, as a closed mesh.

It holds the place of the paper's NeuS (PhyCAGE equation 14): it needs no training, and contains the object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...errors import InputError
from .carving import Lattice, Silhouette
from .depth import depth_buffer
from .view import Picture, View

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

LEAST_VIEWS = 3
SEARCH_CELLS = 32
"""Along each side of the box in which the object is looked for."""
SEARCH_DISSENT = 0.2
"""Share of views that may be wrong while nobody knows which."""
OUTLIER = 0.15
"""How much worse than the median of all views a mask may fit."""
TAKEN = 0.02
"""Share of all other masks that a right one cannot take away, but for the grid's coarseness."""
COVERED = 0.9
"""Share of a gap's pixels before which the other views have something."""
NOTABLE = 0.1
"""Share of unlike pixels that is told."""
UNFIT = 0.35
"""Share of unlike pixels beyond which masks are not of one object at rest."""


@dataclass(frozen=True, kw_only=True)
class HullOptions:
    """How the hull is carved. Raises InputError on a value out of range."""

    resolution: int = 96
    """Grid cells along the longest side of the object; 16 to 256."""

    dissent: float = 0.15
    """Share of the views that see a place and may have it outside, where the others would lack it; 0 to 0.45. 0 is the
    visual hull itself, through which every gap of any one mask cuts a tunnel."""

    def __post_init__(self) -> None:
        if not (isinstance(self.resolution, int) and 16 <= self.resolution <= 256):
            raise InputError(f"hull option resolution is {self.resolution!r}: give a whole number from 16 to 256")
        if not (math.isfinite(self.dissent) and 0 <= self.dissent <= 0.45):
            raise InputError(f"hull option dissent is {self.dissent!r}: give a share from 0 to 0.45")


@dataclass(frozen=True, eq=False)
class Hull:
    """A closed mesh and how well the masks agree on it.

    vertices: (V, 3) world metres; faces: (T, 3), outside counter-clockwise. disagreement: of each view by its name, the
    share of the pixels of its mask or of the hull's silhouette that belong to one of them only. left_out: names of
    views whose masks fit the others so badly that they were not used. notes: sentences for people.
    """

    vertices: Array
    faces: Faces
    disagreement: dict[str, float]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def visual_hull(views: Sequence[View], options: HullOptions | None = None) -> Hull:
    """The hull of ``views``, all of which need masks.

    Raises InputError when there are fewer than 3, one has no mask, or the masks are not of one object at one place;
    the views that fit worst are named.
    """
    options = options or HullOptions()
    silhouettes = _silhouettes(views)
    lattice = _around(views, silhouettes)
    good = _fitting(views, silhouettes, lattice)
    left_out = tuple(view.name for i, view in enumerate(views) if i not in good)
    used = [views[i] for i in good]
    kept, notes = _without_gaps(used, [silhouettes[i] for i in good], lattice, options.dissent)
    vertices, faces = _carved(used, kept, lattice.finer(options.resolution), options.dissent)
    if not len(faces):
        raise _unlike(views, _disagreements(views, vertices, faces))
    found = _disagreements(views, vertices, faces)
    if np.median(found) > UNFIT:
        raise _unlike(views, found)
    disagreement = {view.name: float(share) for view, share in zip(views, found, strict=True)}
    notes += [
        f"view {name!r} was left out: its mask and what the other views show differ in {disagreement[name]:.0%} of "
        "their pixels"
        for name in left_out
    ]
    notes += [
        f"view {name!r}: its mask and the hull differ in {share:.0%} of their pixels"
        for name, share in disagreement.items()
        if share > NOTABLE and name not in left_out
    ]
    return Hull(vertices, faces, disagreement, left_out, tuple(notes))


def _silhouettes(views: Sequence[View]) -> list[Silhouette]:
    if len(views) < LEAST_VIEWS:
        raise InputError(f"hull: {len(views)} views do not bound a body: give {LEAST_VIEWS} or more, from all around")
    return [Silhouette.of(view.camera, _mask(view)) for view in views]


def _mask(view: View) -> Picture:
    if view.mask is None:
        raise InputError(f"view {view.name!r} has no mask: give pictures with opacity, masks, or a plain backdrop")
    return view.mask


def _around(views: Sequence[View], silhouettes: Sequence[Silhouette]) -> Lattice:
    """A coarse grid that holds the object and hardly more."""
    centre, radius = _whereabouts(views)
    lattice = Lattice.around(centre - radius, centre + radius, SEARCH_CELLS)
    for _ in range(6):
        _, lenient = lattice.fields(silhouettes, SEARCH_DISSENT)
        places = np.argwhere(lenient > 0)
        if not len(places):
            raise _unlike(views, np.ones(len(views)))
        low = lattice.first + lattice.spacing * (places.min(axis=0) - 1)
        high = lattice.first + lattice.spacing * (places.max(axis=0) + 1)
        cut = (places.min(axis=0) == 0) | (places.max(axis=0) == np.array(lattice.shape) - 1)
        if cut.any():
            low, high = low - (high - low) / 2, high + (high - low) / 2
        elif np.ptp(places, axis=0).max() > 0.6 * SEARCH_CELLS:
            return Lattice.around(low, high, SEARCH_CELLS)
        lattice = Lattice.around(low, high, SEARCH_CELLS)
    return lattice


def _whereabouts(views: Sequence[View]) -> tuple[Array, float]:
    """The point (3,) nearest to the rays through the middles of all masks, and a radius that holds the object, m."""
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
    if len(boxes) < LEAST_VIEWS:
        raise InputError("hull: the masks are empty: check that white is the object in them, and black is outside")
    centre = np.linalg.lstsq(normal, right, rcond=None)[0]
    radii = []
    for view, corners in boxes:
        focal = min(view.camera.fx, view.camera.fy)
        radii.append(float(np.ptp(corners, axis=0).max()) * float(view.camera.project(centre)[2]) / focal)
    radius = float(np.median(radii))
    if radius <= 0:
        raise InputError("hull: the cameras look away from where their pictures meet: check their poses and axes")
    return centre, radius


def _fitting(views: Sequence[View], silhouettes: Sequence[Silhouette], lattice: Lattice) -> list[int]:
    """Numbers of the views whose masks fit together; InputError where a third or more do not.

    A mask that is unlike what most views leave may just say more than they do, as the one from the narrow side does. It
    is wrong where it has what the others rule out, or takes away what they show.
    """
    _, lenient = lattice.fields(silhouettes, SEARCH_DISSENT)
    mesh = lattice.surface(lenient)
    unlike, bare = _disagreements(views, *mesh), _bare(views, *mesh)
    doubtful = np.flatnonzero(unlike > np.median(unlike) + OUTLIER)
    good = [i for i in range(len(views)) if i not in doubtful.tolist()]
    strict, _ = lattice.fields([silhouettes[i] for i in good], 0.0)
    if strict.max() > 0:
        sure = [views[i] for i in good]
        before = _bare(sure, *lattice.surface(strict))
        for i in doubtful[bare[doubtful] <= OUTLIER]:
            with_it, _ = lattice.fields([silhouettes[j] for j in (*good, i)], 0.0)
            if with_it.max() > 0:
                after = _bare(sure, *lattice.surface(with_it))
                if (after - before).mean() < TAKEN:
                    good.append(int(i))
    if len(good) < max(LEAST_VIEWS, 2 * len(views) / 3):
        raise _unlike(views, unlike)
    return sorted(good)


def _without_gaps(
    views: Sequence[View], silhouettes: Sequence[Silhouette], lattice: Lattice, dissent: float
) -> tuple[list[Silhouette], list[str]]:
    """The silhouettes without gaps that so few masks have that the others close them, and a note on each.

    No silhouette shows a tunnel that such a gap would cut, so what the hull lacks could not tell of it.
    """
    _, lenient = lattice.fields(silhouettes, dissent)
    vertices, faces = lattice.surface(lenient)
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
                notes.append(
                    f"view {view.name!r}: {int(closed.sum())} pixels inside its mask were taken as the object's"
                )
        found.append(silhouette)
    return found, notes


def _carved(
    views: Sequence[View], silhouettes: Sequence[Silhouette], lattice: Lattice, dissent: float
) -> tuple[Array, Faces]:
    """The hull of all silhouettes, and of most where it lacks something that several views show.

    The hull of most is thicker everywhere, as few views bound each place of a surface: it is taken only where needed.
    """
    strict, lenient = lattice.fields(silhouettes, dissent)
    vertices, faces = lattice.surface(strict)
    if not len(faces):
        return lattice.surface(lenient)
    open_places = np.flatnonzero((strict.ravel() <= 0) & (lenient.ravel() > 0))
    points = lattice.points(open_places)
    lacking = np.zeros(len(points), dtype=np.int64)
    for view in views:
        bare = (_mask(view) >= 0.5) & ~np.isfinite(depth_buffer(vertices, faces, view.camera))
        # Along the outline a pixel more or less is the grid's doing.
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
    return lattice.surface(np.where(near, lenient, strict))


def _disagreements(views: Sequence[View], vertices: Array, faces: Faces) -> Array:
    """(n) of each view, the pixels that its mask or the mesh's silhouette has alone over those of both."""
    found = []
    for view in views:
        hull = np.isfinite(depth_buffer(vertices, faces, view.camera))
        mask = _mask(view) >= 0.5
        found.append(float((hull ^ mask).sum()) / max(1, int((hull | mask).sum())))
    return np.array(found)


def _bare(views: Sequence[View], vertices: Array, faces: Faces) -> Array:
    """(n) of each view, the share of its mask before which there is nothing of the mesh."""
    found = []
    for view in views:
        mask = _mask(view) >= 0.5
        empty = mask & ~np.isfinite(depth_buffer(vertices, faces, view.camera))
        found.append(float(empty.sum()) / max(1, int(mask.sum())))
    return np.array(found)


def _unlike(views: Sequence[View], disagreement: Array) -> InputError:
    worst = [views[i].name for i in np.argsort(-disagreement, kind="stable")[:3]]
    return InputError(
        f"hull: the masks of {len(views)} views are not of one object at one place; they fit worst in "
        f"{', '.join(worst)}: check these masks, and that the cameras belong to the pictures"
    )
