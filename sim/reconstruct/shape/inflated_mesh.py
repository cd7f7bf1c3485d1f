# SPDX-License-Identifier: MIT
"""Meshes of inflated silhouettes on the ground: marching cubes over pixels and depth, relaxed.

Each pixel's ray holds material from ``ref − h`` to ``ref + b h``, cut where it enters the ground. The reference depth
is that of a wall facing the camera, or of the ground in front of the wall, whichever is nearer: the silhouette is kept
exactly, the base is flat, and the body reaches from its visible line of contact to behind the wall. The wall of a box
is upright; that of a sphere leans back until it is perpendicular to the view; other things lie between. A leaning body
is thicker behind (b > 1) so that it does not overhang. Moving the wall back enlarges the base, until the centre of
mass lies well above it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import ConvexHull, QhullError
from skimage.measure import marching_cubes

from ...errors import InputError
from ...scene.model import Camera
from ..camera.ground_camera import ground_depth, on_ground
from .depth_front import middle_surface
from .footing import footed
from .inflate import Silhouette
from .legs import standing_depth

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

WORTH_SAYING = 0.01
"""Share of the surface above which its removal gives a notice."""


def keep_main_part(points: Points, faces: Faces) -> tuple[Points, Faces, float]:
    """Return the connected part with the largest area, its vertices renumbered in order, and the removed share of the
    area.

    points: (V, 3); faces: (T, 3), not empty. Vertices without a face are removed as well.
    """
    count = len(points)
    ends = faces[:, [0, 1, 2, 1]].reshape(-1, 2)
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    parts, labels = sparse.csgraph.connected_components(links, directed=False)
    lost = 0.0
    if parts > 1:
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        areas = np.bincount(
            labels[faces[:, 0]], weights=np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=parts
        )
        keep = int(np.argmax(areas))
        lost = float(1.0 - areas[keep] / max(float(areas.sum()), 1e-300))
        faces = faces[labels[faces[:, 0]] == keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(faces.shape), lost


RELAXATION_ROUNDS = 6


class Field(Protocol):
    """A field φ(x, y, t) > 0 inside; x, y in crop pixels (centres at integers), t in pixels along the ray."""

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return body (n) and ground (n) at ``points`` (n, 3): φ is the smaller one."""

    def value(self, points: Points) -> Points:
        """φ (n) at ``points`` (n, 3)."""

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid of about ``spacing`` pixels, negative on its border, its first corner (3,) and its steps
        (3,)."""


def surface_of_size(field: Field, area: float, target: int) -> tuple[Points, Faces, float]:
    """Return the surface on a grid with about ``target`` vertices, and the share that was disconnected and removed.

    area: of the mask in pixels². Raises InputError when the mask is too thin for a closed surface.
    """
    # A round body has 2.6 vertices a cell, front and back.
    spacing = max(0.5, float(np.sqrt(2.6 * area / target)))
    for _ in range(3):
        points, faces, lost = _surface(field, spacing)
        ratio = len(points) / target
        finer = max(0.5, spacing * np.sqrt(ratio))
        if 0.8 < ratio < 1.25 or abs(finer / spacing - 1.0) < 0.05:
            break
        spacing = finer
    return points, faces, lost


def _surface(field: Field, spacing: float) -> tuple[Points, Faces, float]:
    grid, first, steps = field.grid(spacing)
    if not (grid > 0).any():
        raise InputError("the outline is too thin for a body; draw the box around a larger object")
    vertices, faces, _, _ = marching_cubes(grid, level=0.0, method="lewiner", allow_degenerate=True)
    points = first + vertices.astype(np.float64) * steps
    return keep_main_part(points, faces.astype(np.int64))


def relax(field: Field, points: Points, faces: Faces, rounds: int = RELAXATION_ROUNDS) -> Points:
    """Return ``points`` relaxed along the surface: moved towards the neighbours' mean, then back onto φ = 0.

    Vertices at the edge between base and body, and their neighbours, stay, or the edge would be rounded.
    """
    count = len(points)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    links = ((links + links.T) > 0).astype(np.float64)
    mean = sparse.diags(1.0 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links
    film, ground = field.sample(points)
    on_base = (ground < film).astype(np.float64)
    share = mean @ on_base
    free = (np.abs(share - on_base) < 1e-9)[:, None]
    for _ in range(rounds):
        gradient = _gradient(field, points)
        normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        move = mean @ points - points
        move -= (move * normal).sum(axis=1, keepdims=True) * normal
        moved = points + 0.5 * np.where(free, move, 0.0)
        for _ in range(2):
            gradient = _gradient(field, moved)
            step = field.value(moved)[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 1e-9)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            moved = moved - np.where(free, step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-12)), 0.0)
        points = moved
    return points


def _gradient(field: Field, points: Points, step: float = 0.5) -> Points:
    result = np.empty_like(points)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        result[:, axis] = (field.value(points + offset) - field.value(points - offset)) / (2.0 * step)
    return result


STABLE = 0.25
"""Target ``stability`` of a body."""
NO_BASE = -1.0
"""``stability`` of a body that touches the ground in fewer than three points."""
MAX_YAW = np.radians(55.0)
ROUND_YAW_SHARE = 0.4
"""Weight of the visible contact line for objects other than boxes, which also touch the ground in unseen points."""
LEAN = 0.3
"""Lean of the wall for objects that are neither boxes nor spheres, as a share of the viewing angle below the
horizontal."""
MOVED = 5
"""Steps of the wall before the unseen side is made thicker."""
THICKER, THICKEST = 0.06, 1.6
"""Increase of the unseen side's thickness with each further step, and its largest value, over the usual one."""
FOLD = 0.35
"""Width of the fold between floor and wall over the half thickness."""


@dataclass(frozen=True)
class MeasuredSurface:
    """The middle of a body by a depth map or by its feet, on the crop of its silhouette.

    depth: (h, w) along the optical axis, units. rise: (h, w) height of the visible front over it, pixels along the ray.
    left, top: of the crop, photo pixels. behind: (h, w) factor of the thickness behind it; None for 1.
    """

    depth: Points
    rise: Points
    left: int
    top: int
    behind: Points | None = None

    def sample(self, values: Points, pixels: Points) -> Points:
        """Return ``values`` (h, w) at photo ``pixels`` (n, 2)."""
        at = pixels - np.array([self.left + 0.5, self.top + 0.5])
        return np.asarray(ndimage.map_coordinates(values, at[:, ::-1].T, order=1, mode="nearest"))


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface about which the silhouette is inflated.

    camera: height 1 unit. origin: (3,) a point where the wall meets the ground; normal: (3,) unit, away from the
    camera. unit_per_pixel: length of one pixel at the object. fold: units, softens the edge between ground and wall.
    back: thickness behind the reference over that in front, 1 or more; 0 for nothing behind it. middle: replaces wall
    and ground by a measured surface.
    """

    camera: Camera
    origin: NDArray[np.float64]
    normal: NDArray[np.float64]
    unit_per_pixel: float
    fold: float
    back: float = 1.0
    middle: MeasuredSurface | None = None

    def depths(self, pixels: Points) -> tuple[Points, Points, Points]:
        """Return reference depth (n), ground depth (n) and rays (n, 3) through ``pixels`` (n, 2), along the optical
        axis."""
        rays = self.camera.rays(pixels)
        ground = ground_depth(self.camera, rays)
        if self.middle is not None:
            return np.minimum(self.middle.sample(self.middle.depth, pixels), ground), ground, rays
        facing = rays @ self.normal
        wall = np.where(
            facing > 0.05, ((self.origin - self.camera.position) @ self.normal) / np.maximum(facing, 0.05), np.inf
        )
        return _soft_min(wall, ground, self.fold), ground, rays


def _soft_min(first: Points, second: Points, width: float) -> Points:
    """A smooth minimum that never exceeds either, and equals the smaller one where they differ by ``width``."""
    smaller = np.minimum(first, second)
    with np.errstate(invalid="ignore"):
        apart = np.abs(first - second)
    blend = np.clip(1.0 - np.nan_to_num(apart, nan=np.inf, posinf=np.inf) / max(width, 1e-12), 0.0, 1.0)
    return smaller - blend**2 * width / 4.0


def contact_pixel(silhouette: Silhouette) -> NDArray[np.float64]:
    """Return the lowest point (2,) of the outline in photo pixels: middle of the lowest row."""
    rows = np.flatnonzero(silhouette.mask.any(axis=1))
    columns = np.flatnonzero(silhouette.mask[rows[-1]])
    return np.array([silhouette.left + (columns[0] + columns[-1] + 1) / 2.0, silhouette.top + rows[-1] + 1.0])


def _lower_outline(silhouette: Silhouette) -> Points:
    """Lowest outline point (n, 2) of each column, in photo pixels."""
    mask = silhouette.mask
    columns = np.flatnonzero(mask.any(axis=0))
    lowest = mask.shape[0] - np.argmax(mask[::-1, columns], axis=0)
    return np.column_stack([silhouette.left + columns + 0.5, silhouette.top + lowest.astype(np.float64)])


def contact_yaw(camera: Camera, silhouette: Silhouette) -> float:
    """Return the angle in radians about Z of the line of contact with the ground; 0 faces the camera.

    The edge of the lower convex hull below the centroid, projected to the ground. A short edge, as under a sphere, does
    not determine a direction.
    """
    outline = _lower_outline(silhouette)
    hull = _lower_hull(outline)
    centroid = silhouette.left + np.nonzero(silhouette.mask)[1].mean() + 0.5
    after = int(np.clip(np.searchsorted(hull[:, 0], centroid), 1, len(hull) - 1)) if len(hull) > 1 else 0
    if after == 0:
        return 0.0
    first, second = hull[after - 1], hull[after]
    share = (second[0] - first[0]) / max(1.0, np.ptp(outline[:, 0]))
    ends = on_ground(camera, np.stack([first, second]))
    if not np.isfinite(ends).all():
        return 0.0
    yaw = float(np.arctan2(ends[1, 1] - ends[0, 1], ends[1, 0] - ends[0, 0]))
    weight = float(np.clip((share - 0.3) / 0.3, 0.0, 1.0)) * (1.0 if silhouette.slab else ROUND_YAW_SHARE)
    return float(np.clip(yaw * weight, -MAX_YAW, MAX_YAW))


def _lower_hull(points: Points) -> Points:
    """Lower (largest y) convex chain of ``points`` sorted by x: Andrew's monotone chain."""
    chain: list[NDArray[np.float64]] = []
    for point in points:
        while len(chain) >= 2:
            a, b = chain[-2], chain[-1]
            if (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) < 0:
                break
            chain.pop()
        chain.append(point)
    return np.array(chain)


def reference_surfaces(camera: Camera, silhouette: Silhouette) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces to try, the most natural one first.

    The wall starts where a sphere of this thickness would touch the ground, R tan(a/2) behind the lowest visible point
    for a view a below the horizontal, and moves back in steps, which enlarges the base. After the first ones the unseen
    side is thicker as well: moving alone would leave a flap on the ground in front.
    """
    contact = contact_pixel(silhouette)
    ray = camera.rays(contact)
    touch = on_ground(camera, contact)
    depth = float(ground_depth(camera, ray))
    unit = depth / camera.fx
    thick = silhouette.half_thickness * unit
    declination = float(np.arctan2(-ray[2], np.hypot(ray[0], ray[1])))
    lean = 0.0 if silhouette.slab else declination * (LEAN + (1.0 - LEAN) * silhouette.roundness)
    yaw = contact_yaw(camera, silhouette)
    away = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    outline = on_ground(camera, _lower_outline(silhouette))
    outline = outline[np.isfinite(outline).all(axis=1)]
    front = float((outline @ away).min()) if len(outline) else float(touch @ away)
    # The middle plane of a sphere meets the ground before the tangent line of sight does.
    start = thick * (np.tan(declination / 2.0) - silhouette.roundness * np.tan(lean))
    for number, step in enumerate(np.concatenate([[0.0], np.geomspace(0.08, 3.0, 12)])):
        yield ReferenceSurface(
            camera=camera,
            origin=away * (front + start + step * thick),
            normal=np.cos(lean) * away - np.sin(lean) * np.array([0.0, 0.0, 1.0]),
            unit_per_pixel=unit,
            fold=FOLD * thick,
            back=(1.0 + 0.6 * np.sin(lean) * (1.0 - silhouette.roundness))
            * min(1.0 + THICKER * max(number - MOVED, 0), THICKEST),
        )


BOOTS = (1.0, 1.6, 2.4, 3.5, 5.0)
"""Thickness of legs behind their middle, over that in front, to try until the body stands."""


def standing_surfaces(camera: Camera, silhouette: Silhouette) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces of a body on legs, each leg as far away as its foot; none if it has no legs."""
    found = standing_depth(camera, silhouette.mask, silhouette.distance, silhouette.left, silhouette.top)
    if found is None:
        return
    away, legs = found
    plain = next(reference_surfaces(camera, silhouette))
    height, width = silhouette.mask.shape
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels)
    depth = ((away.ravel() - camera.position[1]) / np.maximum(rays[:, 1], 0.05)).reshape(height, width)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    low = ndimage.gaussian_filter(legs.astype(np.float64), 2.0)
    for boot in BOOTS:
        surface = MeasuredSurface(depth, inflated, silhouette.left, silhouette.top, 1.0 + (boot - 1.0) * low)
        yield replace(plain, middle=surface, back=1.0)


def measured_surfaces(camera: Camera, silhouette: Silhouette, front: Points) -> Iterator[ReferenceSurface]:
    """Yield reference surfaces, thicker and thicker, whose visible front is ``front`` (h, w): depth, NaN where
    unknown."""
    plain = next(reference_surfaces(camera, silhouette))
    height, width = silhouette.mask.shape
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
    per_depth = (plain.unit_per_pixel / np.linalg.norm(camera.rays(pixels), axis=1)).reshape(height, width)
    middle, rise = middle_surface(front, silhouette, per_depth)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    for step in (0.0, 0.15, 0.3, 0.5, 0.75, 1.0, 1.5):
        # The front stays where it was measured: the middle moves back, and the front rises as much over it.
        surface = MeasuredSurface(
            middle + step * inflated * per_depth, rise + step * inflated, silhouette.left, silhouette.top
        )
        yield replace(plain, middle=surface, back=1.0 + step)


def stability(vertices: Points, faces: NDArray[np.int64]) -> float:
    """Return how safely a closed body of uniform density stands on z = 0; negative if it topples.

    The distance of its centre of mass from the edge of the convex hull of its contact points, over the distance of the
    hull's centre from that edge; -1 for fewer than three contact points.
    """
    size = float(np.ptp(vertices, axis=0).max())
    base = vertices[vertices[:, 2] < 1e-6 * size][:, :2]
    if len(base) < 3:
        return NO_BASE
    try:
        hull = ConvexHull(base)
    except QhullError:
        return NO_BASE
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    volumes = np.einsum("ti,ti->t", a, np.cross(b, c))
    centre = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volumes.sum())

    def inside(point: NDArray[np.float64]) -> float:
        return -float((hull.equations[:, :2] @ point + hull.equations[:, 2]).max())

    return inside(centre[:2]) / max(inside(_centroid(base[hull.vertices])), 1e-12)


def _centroid(polygon: Points) -> NDArray[np.float64]:
    """Centroid of the area of a convex ``polygon`` (n, 2) with ordered corners."""
    first = polygon[0]
    a, b = polygon[1:-1] - first, polygon[2:] - first
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.asarray(first + ((a + b) * areas[:, None]).sum(axis=0) / (3.0 * areas.sum()))


BARE_THICKNESS = 0.8
"""Thickness of objects that are neither round nor boxes, over their widest inscribed circle: few are as deep as
wide."""
FLAT = 0.0
"""``ReferenceSurface.back`` of a body entirely in front of its reference surface."""
GROUND_TOLERANCE_PX = 0.75
"""Vertices nearer to the ground than this are put onto it; marching cubes leaves them slightly off."""


@dataclass(frozen=True)
class BodyMesh:
    """A closed triangle surface. vertices: (V, 3) world units; faces: (T, 3), counter-clockwise from outside.

    pixels: (V, 2) photo pixels at which the camera sees each vertex. colours: (V, 2) photo pixels whose colours the
    vertices have; None for ``pixels``.
    """

    vertices: Points
    faces: Faces
    pixels: Points
    colours: Points | None = None


class _DepthField:
    """φ(x, y, t) > 0 inside: x, y in crop pixels (centres at integers), t in pixels along the ray from the reference.

    φ = min(h² − t², 2 h_max (t_ground − t)): the inflated silhouette, cut by the ground; t / b for t behind the
    reference, where the body is b times as thick, and in front of a measured middle for t as high as it was measured.
    """

    def __init__(self, silhouette: Silhouette, reference: ReferenceSurface) -> None:
        self._square = silhouette.square_height
        height, width = self._square.shape
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
        middle, ground, rays = reference.depths(pixels)
        self.half_thickness = silhouette.half_thickness
        self._back = reference.back
        self._measured = reference.middle is not None
        cap = 8.0 * self._back * self.half_thickness + 16.0
        with np.errstate(invalid="ignore"):
            below = (ground - middle) * np.linalg.norm(rays, axis=1) / reference.unit_per_pixel
        self._ground = np.minimum(np.nan_to_num(below, nan=cap, posinf=cap), cap).reshape(height, width)
        self._steep = np.ones_like(self._square)
        self._gentle = np.ones_like(self._square)
        self._front = self._behind = self.half_thickness
        if reference.middle is not None:
            inflated = np.sqrt(np.maximum(self._square, 0.25))
            self._steep = inflated / np.maximum(reference.middle.rise, 0.2 * inflated)
            self._front = max(self._front, float(reference.middle.rise.max()))
            if reference.middle.behind is not None:
                self._gentle = 1.0 / reference.middle.behind
                self._behind = max(self._behind, float((inflated * reference.middle.behind).max()))

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return both arguments of the minimum (n), (n) at ``points`` (n, 3) as x, y, t."""
        at = points[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        steep, gentle = self._slopes(at)
        t = points[:, 2]
        return self._film(square, steep, gentle, t), 2.0 * self.half_thickness * (ground - t)

    def _slopes(self, at: Points) -> tuple[Points, Points]:
        """Factors of t in front of and behind the middle at ``at`` (2, n), each (n) or (1) where they are 1."""
        if not self._measured:
            return np.ones(1), np.ones(1)
        steep = ndimage.map_coordinates(self._steep, at, order=1, mode="nearest")
        return steep, ndimage.map_coordinates(self._gentle, at, order=1, mode="nearest")

    def _film(self, square: Points, steep: Points, gentle: Points, t: Points) -> Points:
        if self._back == FLAT:
            return np.asarray(np.minimum(square - (steep * t) ** 2, -2.0 * self.half_thickness * t))
        return np.asarray(square - np.where(t > 0, gentle * t / self._back, steep * t) ** 2)

    def value(self, points: Points) -> Points:
        """φ (n) at ``points`` (n, 3)."""
        film, ground = self.sample(points)
        return np.minimum(film, ground)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid (x, y, t) of ``spacing`` pixels, the grid's first corner (3,) and its spacing along each
        axis.

        Thin bodies get finer steps in depth, or they would fall between two layers of the grid.
        """
        steps = np.array([spacing, spacing, min(spacing, self.half_thickness / 3.0)])
        height, width = self._square.shape
        extents = (self._front, self._back * self._behind)
        front, behind = (int(np.ceil(extent / steps[2])) + 2 for extent in extents)
        # Half a cell off t = 0, so that no grid node lies exactly on the surface along the outline.
        first = np.array([0.25, 0.25, -(front + 0.5) * steps[2]])
        counts = (
            int((width - 1) // spacing) + 1,
            int((height - 1) // spacing) + 1,
            front + behind + 2,
        )
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        at = flat[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = 2.0 * self.half_thickness * ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        steep, gentle = (slope if len(slope) == 1 else slope.reshape(*counts[:2], 1) for slope in self._slopes(at))
        shape = (counts[0], counts[1], 1)
        t = axes[2][None, None, :]
        film = self._film(square.reshape(shape), steep, gentle, t)
        field = np.minimum(film, ground.reshape(shape) - 2.0 * self.half_thickness * t)
        # A closed surface needs a negative border.
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32), first, steps


def inflated_mesh(
    camera: Camera, silhouette: Silhouette, target: int = 12_000, *, flat: bool = False, front: Points | None = None
) -> tuple[BodyMesh, float, float]:
    """Return the closed surface of the body with about ``target`` vertices, standing on the ground.

    Also its stability and the share of its surface that was disconnected and removed. The first reference surface with
    which it stands safely is used, or the best. Stability is evaluated on the mesh itself: the contact is often a
    narrow strip, which anything coarser would miss.

    flat: nothing behind the reference surface. front: (h, w) depth along the optical axis of the visible front on the
    silhouette's crop, units, NaN where unknown; None inflates about a wall, or about legs where they stand. Raises
    InputError when the silhouette is too thin for a closed surface.
    """
    best: tuple[ReferenceSurface, Points, Faces, float, float] | None = None
    if front is not None:
        choices = measured_surfaces(camera, silhouette, front)
    elif silhouette.slab or flat:
        choices = reference_surfaces(camera, silhouette)
    else:
        choices = chain(standing_surfaces(camera, silhouette), reference_surfaces(camera, silhouette))
    on_legs = False
    for reference in choices:
        # Moved back, legs would become flaps on the ground: only what would topple otherwise is.
        if on_legs and reference.middle is None and best is not None and best[4] > 0.0:
            break
        on_legs |= front is None and reference.middle is not None
        if flat:
            reference = replace(reference, back=FLAT)
        field = _DepthField(silhouette, reference)
        points, faces, lost = surface_of_size(field, float(silhouette.mask.sum()), target)
        # One round brings the base onto the ground; the rest is for the one that is taken.
        points = relax(field, points, faces, 1)
        body = _to_world(silhouette, reference, points, faces)
        margin = stability(body.vertices, body.faces)
        if best is None or margin > best[4]:
            best = (reference, points, faces, lost, margin)
        # A relief need not stand by itself, as long as it touches the ground: moving it back only enlarges it.
        if margin >= STABLE or (flat and margin > NO_BASE):
            break
    assert best is not None
    reference, points, faces, lost, _ = best
    points = relax(_DepthField(silhouette, reference), points, faces, RELAXATION_ROUNDS - 1)
    body = _to_world(silhouette, reference, points, faces)
    if not flat:
        body = _footed(camera, silhouette, body)
    return body, stability(body.vertices, body.faces), lost


def _footed(camera: Camera, silhouette: Silhouette, body: BodyMesh) -> BodyMesh:
    """``body`` with a broader base where nobody sees it."""
    vertices, moved = footed(camera, silhouette, body.vertices, body.faces)
    pixels = np.where(moved[:, None], camera.project(vertices)[:, :2], body.pixels)
    return replace(body, vertices=vertices, pixels=pixels)


def shadow_mesh(camera: Camera, silhouette: Silhouette, target: int = 3000) -> BodyMesh:
    """Return the plain inflated mask: neither moved back nor thickened for stability.

    Used for casting shadows, which need the object's true position but no stability. Raises InputError as
    ``inflated_mesh`` does.
    """
    thin = 1.0 if silhouette.slab else 1.0 - (1.0 - BARE_THICKNESS) * (1.0 - silhouette.roundness)
    silhouette = replace(silhouette, square_height=silhouette.square_height * thin**2)
    reference = replace(next(reference_surfaces(camera, silhouette)), back=1.0)
    points, faces, _ = surface_of_size(_DepthField(silhouette, reference), float(silhouette.mask.sum()), target)
    return _to_world(silhouette, reference, points, faces)


def _to_world(silhouette: Silhouette, reference: ReferenceSurface, points: Points, faces: Faces) -> BodyMesh:
    pixels = points[:, :2] + np.array([silhouette.left + 0.5, silhouette.top + 0.5])
    middle, ground, rays = reference.depths(pixels)
    per_depth = reference.unit_per_pixel / np.linalg.norm(rays, axis=1)
    depth = np.maximum(middle + points[:, 2] * per_depth, 0.02 * middle)
    near_ground = np.abs(depth - ground) < GROUND_TOLERANCE_PX * per_depth
    depth = np.where(near_ground, ground, np.minimum(depth, ground))
    return standing_mesh(reference.camera, pixels, depth, faces)


def standing_mesh(camera: Camera, pixels: Points, depth: Points, faces: Faces) -> BodyMesh:
    """Return the closed surface with vertices at ``depth`` (V,) along the rays through ``pixels`` (V, 2), on the
    ground."""
    position = camera.position
    vertices = position + depth[:, None] * camera.rays(pixels)
    # Scaling about the centre of projection moves nothing in the photo: bring the lowest point onto the ground.
    lowest = float(vertices[:, 2].min())
    factor = position[2] / (position[2] - lowest)
    vertices = position + factor * (vertices - position)
    vertices[np.abs(vertices[:, 2]) < 1e-9 * position[2], 2] = 0.0
    if _volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return BodyMesh(vertices=vertices, faces=faces, pixels=pixels)


def _volume(vertices: Points, faces: Faces) -> float:
    a, b, c = (vertices[faces[:, i]] - vertices.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
