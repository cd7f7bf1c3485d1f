# SPDX-License-Identifier: MIT
"""The foreground object as a closed body, out of a hull of both objects whose vertices are labelled.

A labelled surface is open where the objects touch (PhyCAGE's V₂), and a boundary of a simulation has to be closed. So
the body is labelled and not the surface: a place in the hull belongs to the object that owns the nearest vertex, as
long as it is near the surface or outside the other object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.distance import DistanceLattice, signed_distance
from ..views.carving import Lattice
from ..views.view import Labels

Array = NDArray[np.float64]

CRUMB = 0.05
"""Share of the largest piece's volume below which a piece is a wrong label and not a part of the object."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Foreground:
    """The foreground object's body."""

    surface: Surface
    """Closed, world metres, outside counter-clockwise."""

    seen: Surface
    """The open part of ``surface`` along the hull, without where it was cut from the other object: where the views
    look at it."""


def foreground_body(
    hull: Surface,
    labels: Labels,
    label: int,
    *,
    other: Surface,
    thickness: float,
    inset: float,
    spacing: float,
) -> Foreground:
    """The body of the object ``label`` in the closed ``hull`` with ``labels`` (V,) of its vertices.

    other: closed surface of the object behind it, as it looks without the foreground. thickness: metres under the
    hull's surface that are the foreground's own in any case, also inside ``other``: two things that touch are resolved
    by the optimisation, one without a body is lost. inset: metres that the surface lies under the hull, see
    ``start.pixel_size``. spacing: metres of the lattice. Raises InputError when nothing of the object is left.
    """
    lattice = signed_distance(hull, spacing, margin=2 * spacing)
    shape = (lattice.distances.shape[0], lattice.distances.shape[1], lattice.distances.shape[2])
    places = Lattice(lattice.origin, lattice.spacing, shape)
    points = places.points()
    under = -lattice.distances.ravel().astype(np.float64)
    behind = -signed_distance(other, spacing, margin=spacing).at(points)[0]
    near_own, near_others = _reaches(points, hull, labels == label)
    # Each of them metres above 0 where a place is the object's: inside the hull, nearer to its own vertices than to
    # others', and either close to the hull's surface or not inside the other object.
    field = np.minimum.reduce([under - inset, (near_others - near_own) / 2, np.maximum(thickness - under, -behind)])
    field = _without_crumbs(field.reshape(places.shape))
    if field.max() <= 0:
        raise InputError(
            f"foreground: nothing of object {label} is left in the hull of the views: check its labels, or give "
            f"pictures of more pixels (one is {inset:.3g} m now)"
        )
    vertices, faces = places.surface(field)
    seen = faces[_along_hull(vertices[faces].mean(axis=1), lattice, inset)]
    if not len(seen):
        raise InputError(f"foreground: no view looks at object {label}: check its labels")
    return Foreground(
        surface=Surface(vertices=vertices, faces=faces),
        seen=Surface(vertices=vertices, faces=seen),
    )


def _reaches(points: Array, hull: Surface, own: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(n,) distances of ``points`` to the nearest vertex of its own, and to the nearest of others."""
    near = [
        cKDTree(hull.vertices[which]).query(points)[0] if which.any() else np.full(len(points), np.inf)
        for which in (own, ~own)
    ]
    return near[0], near[1]


def _without_crumbs(field: Array) -> Array:
    """``field`` without pieces of places above 0 that are too small to be meant."""
    pieces, count = ndimage.label(field > 0)
    if count < 2:
        return field
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    crumbs = sizes < CRUMB * sizes.max()
    crumbs[0] = False
    return np.where(crumbs[pieces], -np.abs(field), field)


def _along_hull(points: Array, hull: DistanceLattice, inset: float) -> NDArray[np.bool_]:
    """Which of ``points`` (n, 3) of the body's surface lie as deep as the inset put them, and not where it was cut."""
    depths = -hull.at(points)[0]
    return np.asarray(depths < inset + 0.5 * hull.spacing)
