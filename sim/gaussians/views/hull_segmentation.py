# SPDX-License-Identifier: MIT
"""Segmentation of a visual hull into objects: vertex labels by voting over views, and the foreground's closed body.

Voting replaces Part123's semantic field (PhyCAGE equation 14), which integrates labels that need not agree. A labelled
surface is open where the objects touch (PhyCAGE's V₂), but a collision boundary has to be closed. So the volume is
labelled and not the surface: a point in the hull belongs to the object of the nearest vertex, as long as it is near the
hull's surface or outside the other object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.geometry.signed_distance import DistanceLattice, signed_distance
from ...mpm.geometry.triangles import area_normals
from .posed_images import FOREGROUND, Labels, View
from .silhouettes import VoxelGrid, depth_buffer

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

CONFIDENT_PIXELS = 2.0
"""Distance in pixels from a label boundary at which a vote has full weight: outlines are rarely exact."""
GRAZING = 0.15
"""Cosine between surface normal and line of sight below which a view does not vote."""
SLACK_PIXELS = 0.5
"""Depth tolerance of visibility, in pixel sizes at the vertex."""
MIN_WEIGHT = 0.1
"""Total weight of votes up to which a vertex is only seen along outlines, and follows the nearest one with more."""
PRIOR_WEIGHT = 0.5
"""Weight of the uniform prior in votes: a single grazing vote does not decide a vertex."""
MAX_CONTRADICTION = 0.35
"""Fraction of a view's votes that are outvoted above which its labels are considered wrong."""


@dataclass(frozen=True, kw_only=True)
class VoteOptions:
    """Options of ``vote_labels``. Raises InputError on a value out of range."""

    smoothing: float = 2.0
    """Log odds that a vertex' neighbours contribute when all agree; 0 (none) to 20."""

    sweeps: int = 12
    """Mean-field iterations; 1 to 200."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.smoothing) and 0 <= self.smoothing <= 20):
            raise InputError(f"vote option smoothing is {self.smoothing!r}: give a number from 0 to 20")
        if not (isinstance(self.sweeps, int) and 1 <= self.sweeps <= 200):
            raise InputError(f"vote option sweeps is {self.sweeps!r}: give a whole number from 1 to 200")


@dataclass(frozen=True, eq=False)
class LabelVotes:
    """Result of ``vote_labels``. labels: (V,) of each vertex, 1 the background object, 2 the foreground object, ….

    conflict: fraction of all votes that are outvoted. conflicts: the same by view name. unseen: fraction of vertices
    that no labelled view sees well, which follow the nearest seen one. left_out: names of views whose labels contradict
    the others. notes: sentences for the user.
    """

    labels: Labels
    conflict: float
    conflicts: dict[str, float]
    unseen: float
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def vote_labels(vertices: Array, faces: Faces, views: Sequence[View], options: VoteOptions | None = None) -> LabelVotes:
    """Return labels of ``vertices`` (V, 3) of the closed mesh with ``faces`` (T, 3), voted for by labelled ``views``.

    A view votes on every vertex that it sees (by the mesh's depth buffer) with the label of its pixel. The vote's
    weight grows with the cosine of the viewing angle and with the distance from label boundaries. The votes are then
    smoothed over neighbours by the mean field of a Potts model (Krähenbühl and Koltun 2011, equation 4, with the mesh's
    edges as pairs).

    Raises InputError when no view has labels, only one object is labelled, or views contradict each other, naming them.
    """
    options = options or VoteOptions()
    voting = [view for view in views if view.labels is not None]
    highest = max((int(view.labels.max()) for view in voting if view.labels is not None), default=0)
    if highest < FOREGROUND:
        raise InputError(
            "votes: the views do not label two objects: give labels/NAME.png, or masks/OBJECT/NAME.png of each object"
        )
    ballots = _ballots(vertices, faces, voting, highest)
    labels, shares = _labels_from_ballots(vertices, faces, ballots, options)
    limit = max(MAX_CONTRADICTION, 2 * float(np.median(shares)))
    good = [i for i, share in enumerate(shares) if share <= limit]
    if len(good) < 2 * len(voting) / 3 or np.median(shares) > MAX_CONTRADICTION:
        worst = [voting[i].name for i in np.argsort(-shares, kind="stable")[:3]]
        raise InputError(
            f"votes: the labels of {len(voting)} views contradict each other, most in {', '.join(worst)}: check that 1 "
            "and 2 mean the same object in all, and that the cameras belong to the images"
        )
    left_out = tuple(view.name for i, view in enumerate(voting) if i not in good)
    if left_out:
        labels, _ = _labels_from_ballots(vertices, faces, ballots[good], options)
    cast, lost = _outvoted(ballots, labels)
    conflicts = {view.name: float(a / max(b, 1e-12)) for view, a, b in zip(voting, lost, cast, strict=True)}
    notes = tuple(
        f"view {name!r} was left out: {conflicts[name]:.0%} of its labels contradict the other views"
        for name in left_out
    )
    return LabelVotes(
        labels=labels,
        conflict=float(lost[good].sum() / max(cast[good].sum(), 1e-12)),
        conflicts=conflicts,
        unseen=float((ballots[good].sum(axis=(0, 2)) <= MIN_WEIGHT).mean()),
        left_out=left_out,
        notes=notes,
    )


def _ballots(vertices: Array, faces: Faces, views: Sequence[View], highest: int) -> Array:
    """Return (views, V, highest) weights of each view's vote for each label."""
    normals = area_normals(vertices, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    found = np.zeros((len(views), len(vertices), highest))
    for ballot, view in zip(found, views, strict=True):
        assert view.labels is not None
        seen, facing = _visible_vertices(vertices, normals, faces, view)
        column, row = np.floor(view.camera.project(vertices[seen])[:, :2]).astype(np.int64).T
        label = view.labels[row, column]
        weight = facing * _label_confidence(view.labels)[row, column]
        voting = label > 0
        ballot[seen[voting], label[voting] - 1] = weight[voting]
    return found


def _visible_vertices(vertices: Array, normals: Array, faces: Faces, view: View) -> tuple[NDArray[np.int64], Array]:
    """Return indices (n,) of the vertices that ``view`` sees, and the cosines (n,) of the viewing angle."""
    camera = view.camera
    line = camera.position - vertices
    facing = np.einsum("ij,ij->i", line, normals) / np.maximum(np.linalg.norm(line, axis=1), 1e-12)
    x, y, depth = camera.project(vertices).T
    known = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (facing > GRAZING)
    places = np.flatnonzero(known)
    # Within a pixel a slanted surface recedes as far as it does to the next pixels.
    buffer = ndimage.maximum_filter(depth_buffer(vertices, faces, camera), size=3, mode="nearest")
    nearest = buffer[y[places].astype(np.int64), x[places].astype(np.int64)]
    slack = SLACK_PIXELS * depth[places] / min(camera.fx, camera.fy)
    places = places[depth[places] <= nearest + slack]
    return places, facing[places]


def _label_confidence(labels: Labels) -> Array:
    """Return (H, W) weights 0 to 1, rising with the distance from boundaries of ``labels``."""
    change = np.zeros(labels.shape, dtype=bool)
    for axis in range(2):
        differs = np.diff(labels, axis=axis) != 0
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        change[tuple(first)] |= differs
        change[tuple(second)] |= differs
    if not change.any():
        return np.ones(labels.shape)
    # A pixel at the boundary itself keeps a little weight, or thin objects would have no vote at all.
    return np.asarray(np.clip((ndimage.distance_transform_edt(~change) + 0.1) / CONFIDENT_PIXELS, 0, 1))


def _labels_from_ballots(vertices: Array, faces: Faces, ballots: Array, options: VoteOptions) -> tuple[Labels, Array]:
    """Return labels (V,), and for each view the fraction of its votes that are outvoted."""
    total = ballots.sum(axis=0)
    odds = total + PRIOR_WEIGHT / total.shape[1]
    seen = total.sum(axis=1) > MIN_WEIGHT
    if not seen.any():
        raise InputError("votes: no view sees the mesh where it has labels: check the cameras")
    if not seen.all():
        _, nearest = cKDTree(vertices[seen]).query(vertices[~seen])
        odds[~seen] = total[~seen] + odds[seen][nearest]
    evidence = np.log(odds / odds.sum(axis=1, keepdims=True))
    neighbours = _neighbour_means(len(vertices), faces)
    belief = odds / odds.sum(axis=1, keepdims=True)
    for _ in range(options.sweeps if options.smoothing else 0):
        rise = evidence + options.smoothing * (neighbours @ belief)
        rise = np.exp(rise - rise.max(axis=1, keepdims=True))
        belief = rise / rise.sum(axis=1, keepdims=True)
    labels = (belief.argmax(axis=1) + 1).astype(np.int8)
    cast, lost = _outvoted(ballots, labels)
    return labels, lost / np.maximum(cast, 1e-12)


def _outvoted(ballots: Array, labels: Labels) -> tuple[Array, Array]:
    """Return for each view the weight of all its votes, and of those for another label than the vertex got."""
    cast = ballots.sum(axis=(1, 2))
    won = ballots[:, np.arange(len(labels)), labels.astype(np.int64) - 1].sum(axis=1)
    return cast, cast - won


def _neighbour_means(count: int, faces: Faces) -> sparse.csr_matrix:
    """Return the matrix (V, V) that averages over the neighbours of each vertex."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    weights = 1.0 / np.bincount(edges[:, 0], minlength=count)[edges[:, 0]]
    return sparse.csr_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(count, count))


MIN_PIECE_VOLUME = 0.05
"""Volume relative to the largest piece below which a piece comes from wrong labels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForegroundBody:
    """The foreground object as a closed body."""

    surface: Surface
    """Closed, world metres, counter-clockwise from outside."""

    seen: Surface
    """The open part of ``surface`` along the hull, visible in the views; without the cut against the other object."""


def foreground_body(
    hull: Surface,
    labels: Labels,
    label: int,
    *,
    other: Surface,
    thickness: float,
    inset: float,
    spacing: float,
) -> ForegroundBody:
    """Return the body of the object ``label`` in the closed ``hull`` with ``labels`` (V,) of its vertices.

    other: closed surface of the object behind it, without the foreground. thickness: metres under the hull's surface
    that always belong to the foreground, even inside ``other``: penetration is resolved by the composition, a missing
    body is not. inset: metres that the surface lies under the hull, see ``pair_fit.pixel_size``. spacing: metres
    between lattice nodes. Raises InputError when nothing of the object is left.
    """
    lattice = signed_distance(hull, spacing, margin=2 * spacing)
    shape = (lattice.distances.shape[0], lattice.distances.shape[1], lattice.distances.shape[2])
    places = VoxelGrid(lattice.origin, lattice.spacing, shape)
    points = places.points()
    under = -lattice.distances.ravel().astype(np.float64)
    behind = -signed_distance(other, spacing, margin=spacing).at(points)[0]
    near_own, near_others = _vertex_distances(points, hull, labels == label)
    # Metres, each positive where a point belongs to the object: inside the hull, nearer to its own vertices than to
    # others', and either close to the hull's surface or outside the other object.
    field = np.minimum.reduce([under - inset, (near_others - near_own) / 2, np.maximum(thickness - under, -behind)])
    field = _without_small_pieces(field.reshape(places.shape))
    if field.max() <= 0:
        raise InputError(
            f"foreground: nothing of object {label} is left in the hull of the views: check its labels, or use images "
            f"of higher resolution (a pixel is {inset:.3g} m now)"
        )
    vertices, faces = places.surface(field)
    seen = faces[_along_hull(vertices[faces].mean(axis=1), lattice, inset)]
    if not len(seen):
        raise InputError(f"foreground: no view sees object {label}: check its labels")
    return ForegroundBody(
        surface=Surface(vertices=vertices, faces=faces),
        seen=Surface(vertices=vertices, faces=seen),
    )


def _vertex_distances(points: Array, hull: Surface, own: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return (n,) distances of ``points`` to the nearest own vertex, and to the nearest of others."""
    near = [
        cKDTree(hull.vertices[which]).query(points)[0] if which.any() else np.full(len(points), np.inf)
        for which in (own, ~own)
    ]
    return near[0], near[1]


def _without_small_pieces(field: Array) -> Array:
    """Return ``field`` with positive components removed that are too small to be part of the object."""
    pieces, count = ndimage.label(field > 0)
    if count < 2:
        return field
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    crumbs = sizes < MIN_PIECE_VOLUME * sizes.max()
    crumbs[0] = False
    return np.where(crumbs[pieces], -np.abs(field), field)


def _along_hull(points: Array, hull: DistanceLattice, inset: float) -> NDArray[np.bool_]:
    """Return which of ``points`` (n, 3) of the body's surface lie along the hull, not along the cut."""
    depths = -hull.at(points)[0]
    return np.asarray(depths < inset + 0.5 * hull.spacing)
