# SPDX-License-Identifier: MIT
"""Stability of a standing body, and a broader base for it: the side that the photo does not show is made thicker.

The margin is that of the centre of mass inside the base. What lies on the ground as a film thinner than half a grid
cell holds no particle and carries nothing; it is no base.

Inflated bodies are round and would stand on a spot, where real things have settled and reach farther back. What faces
away from the camera moves farther from it along its own ray, all of it over most of the height, so that the back
stays upright, less where the body is thin, and no farther than the ground. Then the underside of that side settles
straight down, as far as the body hides it from the camera and as far around its centre of mass as it needs. Neither
the front nor the outline changes. A box that is too thin to stand safely gets a back that is farther away, and stays
a box but for its hidden edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ...mpm.geometry.triangles import area_normals
from ...scene.bake_quality import COARSEST, load_quality
from ...scene.model import Camera
from ...smoothstep import smoothstep
from ..camera.ground_camera import ground_depth
from .inflate import Silhouette

Points = NDArray[np.float64]

MARGIN_CELLS = 2.0
"""Least margin in grid cells: what stands on less is held by the rounding of one cell's contact."""
MARGIN_HEIGHT = 0.15
"""Least margin over the body's height: it stands on slopes of 17° if its centre of mass is half way up."""
FILM = 0.5
"""Least thickness in grid cells of what counts as base."""
FACES_UP = 0.2
"""Least upward part of the normal of a surface that lies over the base."""
ON_BASE = 1e-6
"""Share of a body's size within which a vertex belongs to its base."""


@dataclass(frozen=True)
class SupportMargin:
    """Stand of a closed body of uniform density on the level through its lowest vertex; lengths in the mesh's unit.

    margin: from the foot of its centre of mass to the edge of the convex hull of its base, negative outside, -inf
    without a base. inradius: the same of the hull's own centre. height; volume; longest: largest extent along an axis.
    foot: (2,) below the centre of mass.
    """

    margin: float
    inradius: float
    height: float
    volume: float
    longest: float
    foot: Points

    @property
    def steadiness(self) -> float:
        """Return the margin over the one that the base allows: 1 for a cube, below 0 if it topples, -1 without base."""
        return max(self.margin / self.inradius, -1.0) if self.inradius > 0.0 else -1.0

    @property
    def share(self) -> float:
        """Return the margin over the one that the body should have."""
        return self.margin / self.wanted

    @property
    def cell(self) -> float:
        """Return the side of a grid cell when the body is simulated alone in the coarsest quality."""
        quality = load_quality(COARSEST)
        filled = (self.volume * quality.particles_per_cell / quality.particles) ** (1 / 3)
        return float(min(filled, self.longest / quality.smallest_cells))

    @property
    def wanted(self) -> float:
        """Return the margin that the body should have."""
        return max(MARGIN_CELLS * self.cell, MARGIN_HEIGHT * self.height)


def support_of(vertices: Points, faces: NDArray[np.int64]) -> SupportMargin:
    """Return how the closed surface of ``vertices`` (V, 3) and ``faces`` (T, 3) stands; +Z is up."""
    extent = np.ptp(vertices, axis=0)
    a, b, c = (vertices[faces[:, corner]] - vertices.mean(axis=0) for corner in range(3))
    volumes = np.einsum("ti,ti->t", a, np.cross(b, c))
    total = float(volumes.sum())
    centre = vertices.mean(axis=0) + ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * total)
    stands = SupportMargin(-np.inf, 0.0, float(extent[2]), abs(total) / 6.0, float(extent.max()), centre[:2])
    base = _base(vertices, faces, ON_BASE * stands.longest, FILM * stands.cell)
    margin, inradius = stands.margin, stands.inradius
    if len(base) >= 3:
        try:
            hull = ConvexHull(base)
        except QhullError:
            pass
        else:
            margin = inside_hull(hull, centre[:2])
            inradius = inside_hull(hull, centroid(base[hull.vertices]))
    return replace(stands, margin=float(margin), inradius=float(inradius))


def _base(vertices: Points, faces: NDArray[np.int64], level: float, film: float) -> Points:
    """Places (n, 2) of the lowest vertices, to ``level``, over which the body is thicker than ``film``."""
    height = vertices[:, 2] - vertices[:, 2].min()
    normals = area_normals(vertices, faces)
    lowest = height < level
    up = (normals[:, 2] > FACES_UP * np.linalg.norm(normals, axis=1)) & ~lowest
    if not up.any() or not lowest.any():
        return vertices[lowest][:, :2]
    over = cKDTree(vertices[up][:, :2]).query(vertices[lowest][:, :2])[1]
    return np.asarray(vertices[lowest][height[up][over] > film][:, :2])


def inside_hull(hull: ConvexHull, point: NDArray[np.float64]) -> float:
    """Return the distance of ``point`` (2,) from the edge of ``hull`` (in the plane), negative outside."""
    return -float((hull.equations[:, :2] @ point + hull.equations[:, 2]).max())


def centroid(polygon: Points) -> NDArray[np.float64]:
    """Return the centroid (2,) of the area of a convex ``polygon`` (n, 2) with ordered corners."""
    first = polygon[0]
    a, b = polygon[1:-1] - first, polygon[2:] - first
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(first + ((a + b) * areas[:, None]).sum(axis=0) / (3.0 * areas.sum()))


THICKEST = 1.5
"""Largest thickness that is added, over the body's half thickness."""
STEPS = 30
"""Thicknesses to try."""
COST = 1.0
"""Share of the wanted margin that a body has to gain for twice its volume; less is not worth its looks."""
SAFE = 1.5
"""Score of standing as safely as wanted; less counts as the share that is reached."""
WEDGE = 0.25
"""By how much more an addition low down alone has to gain: the back slopes to the ground."""
WHOLE = 0.3
"""Local half thickness, over the largest, from which all of it is added: less to limbs, ears and straps."""
LOWEST, RISE = 0.2, 0.6
"""Of an addition low down: the height over the body's above which nothing is added, for hardly any thickness, and how
much higher for each half thickness, or it would be a wedge."""
TOP = 2.5
"""Exponent of the superellipse by which the added thickness ends towards the top."""
SETTLED = (0.4, 0.2)
"""Heights over the body's between which the underside settles: not at all from the first, wholly below the second."""
UNDER = (0.1, 0.5)
"""Downward part of the normal between which a vertex belongs to the underside."""
HIDDEN_PX = 2.0
"""Least distance inside the outline of where settled vertices are seen."""
SEATS = (0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
"""Radii of the part of the underside that settles, over the wanted margin, to try before all of it does."""
BEHIND = (0.0, 0.5, 1.0)
"""Distances of its middle behind the foot of the centre of mass, over the wanted margin."""
SEAT_EDGE = 0.4
"""Width of the seat's edge over the body's half thickness."""
FALLS = 8
"""Steps in which settling is tried."""
LYING = 0.8
"""Share of the way to the ground that becomes all of it."""
LOWERED = 0.06
"""Height over the body's up to which the lowest vertices of a flat side that has moved away are put on the ground: its
lower edge lies between two rows of them."""
EVENED = 4
"""Rounds of smoothing of how far neighbours settle."""


def footed(
    camera: Camera,
    silhouette: Silhouette,
    vertices: Points,
    faces: NDArray[np.int64],
    *,
    on_legs: bool = False,
    flat: bool = False,
) -> tuple[Points, NDArray[np.bool_]]:
    """Return ``vertices`` (V, 3) with the unseen side as much thicker as the body needs to stand safely, and which of
    them moved (V,).

    camera: above the ground z = 0. on_legs: only what is low is made thicker. flat: the unseen side moves as a whole,
    as a box' does. As safely as ``support.SupportMargin.wanted`` says, or as is worth it.
    """
    plain = support_of(vertices, faces)
    best, highest = vertices, plain.share
    chosen: tuple[float, bool] | None = None
    if highest < 1.0:
        thicken = _Thickening(camera, silhouette, vertices, faces)
        # An upright back is preferred, but a body on legs stays as thick as it is.
        ways = ((True, 0.0),) if on_legs else ((False, 0.0),) if flat else ((False, 0.0), (True, WEDGE))
        for low, worse in ways:
            for extra in THICKEST * np.arange(STEPS + 1) / STEPS:
                made = thicken.by(extra, low=low, flat=flat)
                stands = support_of(made, faces)
                score = (1.0 if on_legs else SAFE) if stands.share >= 1.0 else stands.share
                score -= COST * (stands.volume / plain.volume - 1.0) + worse
                if score > highest:
                    best, highest, chosen = made, score, (extra, low)
                if stands.share >= 1.0:
                    break
        if chosen is not None and not flat:
            best = _on_a_seat(thicken, best, faces, *chosen)
    return best, (best != vertices).any(axis=1)


def _on_a_seat(thicken: _Thickening, whole: Points, faces: NDArray[np.int64], extra: float, low: bool) -> Points:
    """``whole`` (V, 3), thickened by ``extra``, with no more of its underside settled than it needs to stand as well:
    a round seat below its centre of mass, or a curtain would hang from it to the ground."""
    stands = support_of(whole, faces)
    enough = min(stands.share, 1.0)
    for radius in SEATS:
        for behind in BEHIND:
            seat = stands.foot + behind * stands.wanted * thicken.away
            made = thicken.by(extra, low=low, seat=(seat, radius * stands.wanted))
            if support_of(made, faces).share >= enough:
                return made
    return whole


def settled(camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64]) -> Points:
    """Return ``vertices`` (V, 3) with the unseen underside settled, and nothing thicker."""
    return _Thickening(camera, silhouette, vertices, faces).by(0.0, low=True)


class _Thickening:
    """The unseen vertices of one body, and how far each may move away along its ray."""

    def __init__(self, camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64]) -> None:
        ends = (
            np.concatenate([faces, np.roll(faces, 1, axis=1)]).reshape(-1),
            np.concatenate([np.roll(faces, 1, axis=1), faces]).reshape(-1),
        )
        self._ends = ends
        self._vertices, self._camera, self._silhouette = vertices, camera, silhouette
        projected = camera.project(vertices)
        self._rays = camera.rays(projected[:, :2])
        # Depths, along the optical axis: what each vertex moves for one half thickness, and at most.
        half = silhouette.half_thickness * float(np.median(projected[:, 2])) / camera.fx
        at = projected[:, :2] - (silhouette.left + 0.5, silhouette.top + 0.5)
        square = ndimage.map_coordinates(silhouette.square_height, at[:, ::-1].T, order=1, mode="nearest")
        share = np.sqrt(np.maximum(square, 0.0)) / silhouette.half_thickness
        normals = area_normals(vertices, faces)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        unseen = np.einsum("ij,ij->i", normals, camera.position - vertices) < 0.0
        height = vertices[:, 2] / vertices[:, 2].max()
        whole = np.where(unseen, np.minimum(share / WHOLE, 1.0), 0.0)
        self._height = np.clip(height, 0.0, 1.0)
        self._thick = half
        towards = vertices[:, :2].mean(axis=0) - camera.position[:2]
        self.away = towards / max(float(np.linalg.norm(towards)), 1e-300)
        self._step = half * whole / np.linalg.norm(self._rays, axis=1)
        self._settle = whole * smoothstep(-normals[:, 2], *UNDER) * smoothstep(height, *SETTLED)
        self._room = np.maximum(ground_depth(camera, self._rays) - projected[:, 2], 0.0)

    def by(self, extra: float, *, low: bool, flat: bool = False, seat: tuple[Points, float] | None = None) -> Points:
        """Return the vertices (V, 3) with ``extra`` half thicknesses added and settled, none below the ground.

        low: only low down, less and less towards a height that rises with ``extra``. flat: the same at all heights.
        seat: middle (2,) and radius of what settles; None for all of the underside.
        """
        if flat:
            profile = np.ones_like(self._height)
        elif low:
            profile = np.clip(1.0 - self._height / (LOWEST + RISE * extra), 0.0, 1.0)
        else:
            profile = (1.0 - self._height**TOP) ** (1.0 / TOP)
        moved = extra * self._step * profile
        made = self._vertices + np.minimum(moved, self._room)[:, None] * self._rays
        made[(moved > 0.0) & (moved >= self._room), 2] = 0.0
        if flat:
            low_rows = np.flatnonzero((moved > 0.0) & (made[:, 2] < LOWERED * made[:, 2].max()))
            below = made[low_rows] * (1.0, 1.0, 0.0)
            made[low_rows[self._inside(below) > HIDDEN_PX], 2] = 0.0
        return self._settled(made, seat)

    def _inside(self, points: Points) -> Points:
        """Pixels (n,) inside the outline at which ``points`` (n, 3) are seen."""
        at = self._camera.project(points)[:, :2] - (self._silhouette.left + 0.5, self._silhouette.top + 0.5)
        inside = ndimage.map_coordinates(self._silhouette.distance, at[:, ::-1].T, order=1, mode="nearest")
        return np.asarray(inside, dtype=np.float64)

    def _settled(self, made: Points, seat: tuple[Points, float] | None) -> Points:
        settle = self._settle
        if seat is not None:
            middle, radius = seat
            away = np.linalg.norm(made[:, :2] - middle, axis=1)
            settle = settle * smoothstep(away, radius + SEAT_EDGE * self._thick, radius)
        fallen, open_ = np.zeros(len(made)), settle > 0.0
        for fall in np.arange(1, FALLS + 1) / FALLS:
            inside = self._inside(made[open_] * (1.0, 1.0, 1.0 - fall))
            open_[np.flatnonzero(open_)[inside < HIDDEN_PX]] = False
            fallen[open_] = fall
        # What nearly lies does.
        made[:, 2] *= 1.0 - np.minimum(self._even(fallen * settle) / LYING, fallen)
        return made

    def _even(self, share: Points) -> Points:
        """``share`` (V,) without teeth, nowhere more."""
        first, second = self._ends
        even = share.copy()
        np.minimum.at(even, first, share[second])
        for _ in range(EVENED):
            even = np.bincount(first, even[second], len(share)) / np.maximum(
                np.bincount(first, minlength=len(share)), 1
            )
            even = np.minimum(even, share)
        return even
