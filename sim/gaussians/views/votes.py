# SPDX-License-Identifier: MIT
"""Whose each vertex of a mesh is, by the labels of the views that see it: labels of pictures become one of the body.

It holds the place of Part123's semantic field (PhyCAGE equation 14), which integrates labels that need not agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from ...errors import InputError
from .depth import depth_buffer
from .view import FOREGROUND, Labels, View

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

SURE_PIXELS = 2.0
"""Distance of a pixel from where labels change, from which its vote counts fully: outlines are hardly ever exact."""
GRAZING = 0.15
"""Cosine between the surface's normal and the line of sight below which a view does not see a place well."""
SLACK_PIXELS = 0.5
"""How far behind the nearest surface around its pixel a vertex may lie and be seen, in sizes of a pixel there."""
WELL_SEEN = 0.1
"""Weight of all votes on a vertex up to which it lies along outlines only, and goes by the nearest that has more."""
UNSURE = 0.5
"""Weight of a prior for all labels alike, in votes: one grazing vote alone does not settle a vertex."""
CONTRADICTION = 0.35
"""Share of a view's votes that the others outvote from which its labels are thought to be wrong."""


@dataclass(frozen=True, kw_only=True)
class VoteOptions:
    """How votes become labels. Raises InputError on a value out of range."""

    smoothing: float = 2.0
    """How much a vertex' neighbours count, in natural logarithms of odds when all agree; 0 (not at all) to 20."""

    sweeps: int = 12
    """How often neighbours are asked; 1 to 200."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.smoothing) and 0 <= self.smoothing <= 20):
            raise InputError(f"vote option smoothing is {self.smoothing!r}: give a number from 0 to 20")
        if not (isinstance(self.sweeps, int) and 1 <= self.sweeps <= 200):
            raise InputError(f"vote option sweeps is {self.sweeps!r}: give a whole number from 1 to 200")


@dataclass(frozen=True, eq=False)
class Votes:
    """labels: (V,) of each vertex, 1 the background object, 2 the foreground object and so on.

    conflict: share of all votes that are not of the label that their vertex has. conflicts: the same of each view by
    its name. unseen: share of vertices that no labelled view sees well, which go by the nearest that one sees.
    left_out: names of views whose labels contradict the others. notes: sentences for people.
    """

    labels: Labels
    conflict: float
    conflicts: dict[str, float]
    unseen: float
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Part:
    """One object's share of a labelled mesh. indices: (n,) its vertices, V_label of the paper, a partition of V.

    vertices: (m, 3) and faces: (k, 3): the open surface of the triangles of which most corners are its own.
    """

    label: int
    indices: NDArray[np.int64]
    vertices: Array
    faces: Faces


def vote(vertices: Array, faces: Faces, views: Sequence[View], options: VoteOptions | None = None) -> Votes:
    """The labels of ``vertices`` (V, 3) of the closed mesh with ``faces`` (T, 3), by the labels of ``views``.

    A view votes on a vertex that it sees (by a depth buffer of the mesh) with what stands at its pixel, the more the
    straighter it looks there and the further the pixel is from an outline. Neighbours then settle what is doubtful: the
    mean field of a Potts model (Krähenbühl and Koltun 2011, equation 4, with the mesh's edges as pairs).

    Raises InputError when no view has labels, only one object is labelled, or the views contradict each other, which
    are named.
    """
    options = options or VoteOptions()
    voting = [view for view in views if view.labels is not None]
    highest = max((int(view.labels.max()) for view in voting if view.labels is not None), default=0)
    if highest < FOREGROUND:
        raise InputError(
            "votes: the views label no two objects: give labels/NAME.png, or masks/OBJECT/NAME.png of each object"
        )
    ballots = _ballots(vertices, faces, voting, highest)
    labels, shares = _counted(vertices, faces, ballots, options)
    limit = max(CONTRADICTION, 2 * float(np.median(shares)))
    good = [i for i, share in enumerate(shares) if share <= limit]
    if len(good) < 2 * len(voting) / 3 or np.median(shares) > CONTRADICTION:
        worst = [voting[i].name for i in np.argsort(-shares, kind="stable")[:3]]
        raise InputError(
            f"votes: the labels of {len(voting)} views contradict each other, most in {', '.join(worst)}: check that 1 "
            "and 2 mean the same object in all, and that the cameras belong to the pictures"
        )
    left_out = tuple(view.name for i, view in enumerate(voting) if i not in good)
    if left_out:
        labels, _ = _counted(vertices, faces, ballots[good], options)
    cast, lost = _lost(ballots, labels)
    conflicts = {view.name: float(a / max(b, 1e-12)) for view, a, b in zip(voting, lost, cast, strict=True)}
    notes = tuple(
        f"view {name!r} was left out: {conflicts[name]:.0%} of its labels contradict the other views"
        for name in left_out
    )
    return Votes(
        labels=labels,
        conflict=float(lost[good].sum() / max(cast[good].sum(), 1e-12)),
        conflicts=conflicts,
        unseen=float((ballots[good].sum(axis=(0, 2)) <= WELL_SEEN).mean()),
        left_out=left_out,
        notes=notes,
    )


def split(vertices: Array, faces: Faces, labels: Labels) -> tuple[Part, ...]:
    """V = V1 + V2 + …: the parts of the mesh by ``labels`` (V,), from 1 on; InputError when an object has no vertex."""
    found = []
    corners = labels[faces]
    # Most corners: the middle one of three sorted. Of three different ones that is as good as any.
    owner = np.sort(corners, axis=1)[:, 1]
    for label in range(1, int(labels.max(initial=FOREGROUND)) + 1):
        indices = np.flatnonzero(labels == label)
        own = faces[owner == label]
        if not len(indices) or not len(own):
            raise InputError(f"split: no view shows object {label} on the surface: check its masks")
        used, local = np.unique(own, return_inverse=True)
        found.append(Part(label, indices, vertices[used], local.reshape(-1, 3).astype(np.int64)))
    return tuple(found)


def _ballots(vertices: Array, faces: Faces, views: Sequence[View], highest: int) -> Array:
    """(views, V, highest) weight of each view's vote for each label."""
    normals = _normals(vertices, faces)
    found = np.zeros((len(views), len(vertices), highest))
    for ballot, view in zip(found, views, strict=True):
        assert view.labels is not None
        seen, facing = _seen(vertices, normals, faces, view)
        column, row = np.floor(view.camera.project(vertices[seen])[:, :2]).astype(np.int64).T
        label = view.labels[row, column]
        weight = facing * _sureness(view.labels)[row, column]
        voting = label > 0
        ballot[seen[voting], label[voting] - 1] = weight[voting]
    return found


def _seen(vertices: Array, normals: Array, faces: Faces, view: View) -> tuple[NDArray[np.int64], Array]:
    """Indices (n,) of the vertices that ``view`` sees, and how straight (n,) it looks at them: a cosine."""
    camera = view.camera
    line = camera.position - vertices
    facing = np.einsum("ij,ij->i", line, normals) / np.maximum(np.linalg.norm(line, axis=1), 1e-12)
    x, y, depth = camera.project(vertices).T
    known = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (facing > GRAZING)
    places = np.flatnonzero(known)
    # Within a pixel a slanted surface goes back as far as it does to the next ones.
    buffer = ndimage.maximum_filter(depth_buffer(vertices, faces, camera), size=3, mode="nearest")
    nearest = buffer[y[places].astype(np.int64), x[places].astype(np.int64)]
    slack = SLACK_PIXELS * depth[places] / min(camera.fx, camera.fy)
    places = places[depth[places] <= nearest + slack]
    return places, facing[places]


def _sureness(labels: Labels) -> Array:
    """(H, W) 0 to 1, rising with the distance from where ``labels`` change."""
    change = np.zeros(labels.shape, dtype=bool)
    for axis in range(2):
        differs = np.diff(labels, axis=axis) != 0
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        change[tuple(first)] |= differs
        change[tuple(second)] |= differs
    if not change.any():
        return np.ones(labels.shape)
    # A pixel at the change itself keeps a little, or thin things would have no vote at all.
    return np.asarray(np.clip((ndimage.distance_transform_edt(~change) + 0.1) / SURE_PIXELS, 0, 1))


def _counted(vertices: Array, faces: Faces, ballots: Array, options: VoteOptions) -> tuple[Labels, Array]:
    """Labels (V,), and of each view the share of its votes that are outvoted."""
    total = ballots.sum(axis=0)
    odds = total + UNSURE / total.shape[1]
    seen = total.sum(axis=1) > WELL_SEEN
    if not seen.any():
        raise InputError("votes: no view sees anything of the mesh where it has labels: check the cameras")
    if not seen.all():
        _, nearest = cKDTree(vertices[seen]).query(vertices[~seen])
        odds[~seen] = total[~seen] + odds[seen][nearest]
    evidence = np.log(odds / odds.sum(axis=1, keepdims=True))
    neighbours = _neighbours(len(vertices), faces)
    belief = odds / odds.sum(axis=1, keepdims=True)
    for _ in range(options.sweeps if options.smoothing else 0):
        rise = evidence + options.smoothing * (neighbours @ belief)
        rise = np.exp(rise - rise.max(axis=1, keepdims=True))
        belief = rise / rise.sum(axis=1, keepdims=True)
    labels = (belief.argmax(axis=1) + 1).astype(np.int8)
    cast, lost = _lost(ballots, labels)
    return labels, lost / np.maximum(cast, 1e-12)


def _lost(ballots: Array, labels: Labels) -> tuple[Array, Array]:
    """Of each view, the weight of all its votes and of those for another label than the vertex has."""
    cast = ballots.sum(axis=(1, 2))
    won = ballots[:, np.arange(len(labels)), labels.astype(np.int64) - 1].sum(axis=1)
    return cast, cast - won


def _neighbours(count: int, faces: Faces) -> sparse.csr_matrix:
    """(V, V) each row the mean over the vertices that an edge joins to one."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    weights = 1.0 / np.bincount(edges[:, 0], minlength=count)[edges[:, 0]]
    return sparse.csr_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(count, count))


def _normals(vertices: Array, faces: Faces) -> Array:
    """(V, 3) unit normals, of the triangles around each vertex by their area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(across[:, i], 3), minlength=len(vertices)) for i in range(3)], axis=1
    )
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30))
