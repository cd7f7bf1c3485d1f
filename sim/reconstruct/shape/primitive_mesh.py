# SPDX-License-Identifier: MIT
"""Meshes of fitted primitives that keep the object's outline.

A real can is dented and a real camera not quite where it was estimated, so outlines differ by a few pixels. Where the
two outlines run alongside, the primitive is warped in the photo's plane, less and less towards its inside; what
reaches out farther, such as a handle, is a part of its own. Without parts the body is a lattice of even quadrilaterals
moved by the warp; with parts it is the surface φ = 0 over pixels and depth: the warped primitive joined with the
inflated parts, cut by the outline and the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ...smoothstep import smoothstep
from ..camera.ground_camera import ground_depth
from .inflate import Crop, limb_profile, signed_distance
from .inflated_mesh import GROUND_TOLERANCE_PX, BodyMesh, standing_mesh
from .primitives import FINER, Box, Primitive, Sphere, SurfaceOfRevolution, soft_min
from .surface_mesh import RayField, relax, surface_of_size

Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

FARTHEST = (3.0, 0.07)
"""Largest distance between matching outlines: pixels, and share of the object's size; the larger one."""
ALONGSIDE = 0.75
"""Least cosine of the angle between matching outlines."""
FADE = 0.6
"""Depth inside the outline at which the shift vanishes, over the widest inscribed circle."""
SMOOTH = 0.02
"""Smoothing of the warp along the outline over the object's size: finer detail is mask noise."""
REFINED = (0.004, 0.15)
"""``SMOOTH`` and ``FADE`` of a second warp, for what the first one leaves: rounded corners."""
PART = (2.5, 0.02)
"""Least protrusion of a part: pixels, and share of the object's size; the larger one."""
REACH = 1.5
"""Depth of parts inside the primitive, over the radius of their widest inscribed circle."""
SQUEEZED, UNFOLDED_RIM = 0.2, 3.0
"""Area that a warp leaves of a pixel at least, and how far outside of the primitive, in pixels, that holds."""
UNFOLDING, UNFOLDING_ROUNDS = (1.5, 10.0), 16
"""Standard deviations of the smoothing where a warp folds, in pixels, from the first to the last of so many rounds."""
FARTHEST_SLID = 0.25
"""Largest share of its depth by which a point at the base follows the ground where the warp moves it; less above."""
SMALLEST_PART = 0.002
"""Least area of a part over the object's."""


@dataclass(frozen=True)
class OutlineWarp:
    """Warp from the object's outline to a primitive's, on a crop.

    shift: (h, w, 2) pixels x, y to add to a pixel of the object for its point on the primitive. parts: (h, w)
    protrusions that the primitive leaves out, each reaching a little into it; all False without any. fade: (h, w) 1
    outside the primitive, falling to 0 as far inside as the parts reach.
    """

    shift: Field
    parts: Mask
    fade: Field


def warp_to_outline(crop: Crop, primitive: Mask, *, smooth: float = SMOOTH, fade: float = FADE) -> OutlineWarp:
    """Return the warp between ``primitive`` (h, w), a fitted silhouette on the crop, and the crop's own mask.

    smooth, fade: as ``SMOOTH`` and ``FADE``.
    """
    mask = crop.mask
    size = float(np.sqrt(mask.sum()))
    own = signed_distance(primitive)
    towards = _gradient(ndimage.gaussian_filter(own, 1.0))
    rim = mask & ~ndimage.binary_erosion(mask)
    apart = crop.distance - own
    farthest = max(FARTHEST[0], FARTHEST[1] * size)
    alongside = (towards * _gradient(ndimage.gaussian_filter(crop.distance, 1.0))).sum(axis=0) > ALONGSIDE
    # At the photo's border the outline is not the object's.
    rim &= ndimage.binary_erosion(crop.photo, iterations=2)
    good = rim & (np.abs(apart) <= farthest) & alongside
    outward = np.zeros(mask.shape)
    if good.any():
        nearest = ndimage.distance_transform_edt(~good, return_distances=False, return_indices=True)
        outward = ndimage.gaussian_filter(apart[tuple(nearest)], max(1.5, smooth * size))
    weight = smoothstep(1.0 - own / max(fade * float(own.max()), 1e-9))
    shift = np.moveaxis(_unfolded(towards * (outward * weight), own > -UNFOLDED_RIM), 0, -1)
    parts, reach = _parts(mask, own + outward, size)
    return OutlineWarp(shift=shift, parts=parts, fade=np.clip(1.0 - (own + outward) / reach, 0.0, 1.0))


def _unfolded(shift: Field, where: Mask) -> Field:
    """``shift`` (2, h, w), smoothed around the pixels of ``where`` (h, w) at which moving back by it would squeeze or
    fold the picture: a surface that follows it would cross itself."""
    for sigma in np.geomspace(*UNFOLDING, UNFOLDING_ROUNDS):
        (xx, xy), (yx, yy) = ((gradient[1], gradient[0]) for gradient in (np.gradient(part) for part in shift))
        folded = ((1.0 - xx) * (1.0 - yy) - xy * yx < SQUEEZED) & where
        if not folded.any():
            break
        share = np.clip(3.0 * ndimage.gaussian_filter(folded.astype(float), sigma) * sigma, 0.0, 1.0)
        shift = shift + share * (ndimage.gaussian_filter(shift, (0.0, sigma, sigma)) - shift)
    return shift


def _gradient(field: Field) -> Field:
    """Unit gradient (2, h, w), x and y."""
    rows, columns = np.gradient(field)
    length = np.maximum(np.hypot(rows, columns), 1e-6)
    return np.stack([columns / length, rows / length])


def _parts(mask: Mask, warped: Field, size: float) -> tuple[Mask, float]:
    """Parts of ``mask`` outside of the body whose distance, after the shift, is ``warped``; and their depth inside
    it."""
    least = max(PART[0], PART[1] * size)
    beyond = mask & (warped < -0.5)
    labels, count = ndimage.label(beyond, np.ones((3, 3)))
    if not count:
        return np.zeros_like(mask), 1.0
    index = np.arange(1, count + 1)
    reach = -ndimage.minimum(warped, labels, index)
    area = ndimage.sum_labels(beyond, labels, index)
    keep = index[(reach > least) & (area > SMALLEST_PART * mask.sum())]
    if not len(keep):
        return np.zeros_like(mask), 1.0
    part = np.isin(labels, keep)
    inscribed = float(ndimage.distance_transform_edt(part).max())
    # As deep as the part is wide, so that it does not thin out at its joint.
    reach = REACH * inscribed + 2.0
    inward = ndimage.distance_transform_edt(~part) <= reach
    return np.asarray(part | (mask & inward & (warped > -0.5))), reach


Points = NDArray[np.float64]
Faces = NDArray[np.int64]

NARROW = 0.25
"""Width of the strip along an edge over that of other quadrilaterals: smooth shading stays flat up to it."""
FEWEST = 4
"""Quadrilaterals along each edge of the lattice, at least."""


def cube_surface(counts: tuple[int, int, int]) -> tuple[NDArray[np.int64], Faces]:
    """Return lattice coordinates (V, 3) and triangles (T, 3), outward, of the surface of a block of ``counts``
    cubes."""
    shape = tuple(n + 1 for n in counts)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    quads = []
    for axis in range(3):
        for end in (0, counts[axis]):
            face = np.take(grid, end, axis=axis)
            # np.take keeps the order of the other two axes: x, z for axis 1.
            if axis == 1:
                face = np.swapaxes(face, 0, 1)
            index = np.ravel_multi_index(tuple(np.moveaxis(face, -1, 0)), shape)
            a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
            quad = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
            quads.append(quad if end else quad[:, ::-1])
    quad = np.concatenate(quads)
    used, renumbered = np.unique(quad, return_inverse=True)
    quad = renumbered.reshape(-1, 4)
    at = np.stack(np.unravel_index(used, shape), axis=-1)
    # The shorter diagonal is unknown here; alternate, so that no direction is preferred.
    even = (at[quad[:, 0]].sum(axis=1) % 2 == 0)[:, None]
    one = np.where(even, quad[:, [0, 1, 2]], quad[:, [1, 2, 3]])
    two = np.where(even, quad[:, [0, 2, 3]], quad[:, [1, 3, 0]])
    return at, np.concatenate([one, two])


def primitive_mesh(primitive: Primitive, target: int) -> tuple[Points, Faces]:
    """Return vertices (V, 3), about ``target``, and triangles (T, 3) of a closed primitive, world units."""
    extents = _extents(primitive)
    # A block of a × b × c cubes has about 2 (ab + bc + ca) vertices on its surface.
    a, b, c = extents
    cell = np.sqrt(2.0 * (a * b + b * c + c * a) / target)
    counts = tuple(max(FEWEST, round(float(e / cell))) for e in extents)
    at, faces = cube_surface((counts[0], counts[1], counts[2]))
    unit = np.stack([_spaced(counts[i], primitive)[at[:, i]] for i in range(3)], axis=-1)
    if isinstance(primitive, Box):
        across, along = primitive.axes
        ground = 0.5 * (primitive.width * unit[:, :1] * across + primitive.depth * unit[:, 1:2] * along)
        foot = np.array([primitive.x, primitive.y])
        return np.column_stack([foot + ground, primitive.height * (unit[:, 2] + 1.0) / 2.0]), faces
    if isinstance(primitive, Sphere):
        bent = np.tan(unit * np.pi / 4.0)
        points = primitive.centre + primitive.axes * bent / np.linalg.norm(bent, axis=1, keepdims=True)
        return np.column_stack([points[:, :2], np.maximum(points[:, 2], 0.0)]), faces
    assert isinstance(primitive, SurfaceOfRevolution)
    heights, radii = np.array(primitive.heights), np.array(primitive.radii)
    z = primitive.height * (unit[:, 2] + 1.0) / 2.0
    radius = np.interp(z, heights, radii)
    # Map a square to a disc: rings by the larger coordinate, even angles along each side.
    ring = np.abs(unit[:, :2]).max(axis=1)
    bent = np.tan(unit[:, :2] / np.maximum(ring, 1e-12)[:, None] * np.pi / 4.0)
    direction = bent / np.maximum(np.linalg.norm(bent, axis=1, keepdims=True), 1e-12)
    ground = np.array([primitive.x, primitive.y]) + (ring * radius)[:, None] * direction
    return np.column_stack([ground, z]), faces


def _extents(primitive: Primitive) -> tuple[float, float, float]:
    if isinstance(primitive, Box):
        return primitive.width, primitive.depth, primitive.height
    if isinstance(primitive, Sphere):
        return (primitive.radius * np.pi / 2.0,) * 3
    assert isinstance(primitive, SurfaceOfRevolution)
    side = float(np.mean(primitive.radii)) * np.pi / 2.0
    return side, side, primitive.height


def _spaced(count: int, primitive: Primitive) -> Points:
    """Lattice planes (count + 1,) from -1 to 1: even, but narrow at the ends of primitives with edges."""
    if isinstance(primitive, Sphere):
        return np.linspace(-1.0, 1.0, count + 1)
    steps = np.ones(count)
    steps[[0, -1]] = NARROW
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum() * 2.0 - 1.0


def bent_mesh(camera: Camera, crop: Crop, primitive: Primitive, fitted: OutlineWarp, target: int) -> BodyMesh:
    """Return ``primitive`` warped by ``fitted`` towards the outline of ``crop``, standing on the ground."""
    vertices, faces = primitive_mesh(primitive, target)
    projected = camera.project(vertices)
    pixels = _bent(crop, projected[:, :2], fitted)
    pixels = _refined(crop, pixels, faces)
    depth = projected[:, 2]
    before, after = (ground_depth(camera, camera.rays(p)) for p in (projected[:, :2], pixels))
    low = np.clip(1.0 - vertices[:, 2] / primitive.height, 0.0, 1.0)
    with np.errstate(invalid="ignore"):
        slid = np.where(np.isfinite(after) & np.isfinite(before), after / before, 1.0)
    # Towards the horizon the ground runs away: what is high above it must not follow.
    slid = np.clip(slid, 1.0 - FARTHEST_SLID * low, 1.0 + FARTHEST_SLID * low)
    depth = depth * (1.0 + low * (slid - 1.0))
    on_ground = vertices[:, 2] <= 1e-9 * primitive.height
    depth = np.where(on_ground, after, np.minimum(depth, after))
    return standing_mesh(camera, pixels, depth, faces)


def _refined(crop: Crop, pixels: Points, faces: Faces) -> Points:
    """Photo pixels (V, 2) of a mesh, moved until its silhouette is the outline: a smooth warp leaves corners out, and
    rounded edges fall short."""
    smooth, fade = REFINED
    return _bent(crop, pixels, warp_to_outline(crop, _silhouette(crop, pixels, faces), smooth=smooth, fade=fade))


def _bent(crop: Crop, pixels: Points, warp: OutlineWarp) -> Points:
    """Photo pixels (V, 2) moved by ``warp``. It maps the object to the primitive; vertices move the other way."""
    at = pixels - np.array([crop.left + 0.5, crop.top + 0.5])
    shift = (ndimage.map_coordinates(warp.shift[..., i], at[:, ::-1].T, order=1, mode="nearest") for i in (0, 1))
    return np.asarray(pixels - np.stack(list(shift), axis=-1))


def _silhouette(crop: Crop, pixels: Points, faces: Faces) -> Mask:
    """Pixels (h, w) of ``crop`` that triangles (T, 3) with corners at photo ``pixels`` (V, 2) cover."""
    image = np.zeros((crop.mask.shape[0] * FINER, crop.mask.shape[1] * FINER), np.uint8)
    corners = ((pixels - [crop.left, crop.top]) * FINER - 0.5) * 16
    for triangle in np.round(corners).astype(np.int32)[faces]:
        cv2.fillConvexPoly(image, triangle, 255, shift=4)
    return np.asarray(cv2.resize(image, crop.mask.shape[::-1], interpolation=cv2.INTER_AREA) > 127)


FloatField = NDArray[np.float64]

BEVEL_CELLS = 2.2
"""Rounding of edges in cells of the grid: sharper ones would be jagged."""
BEVEL_SHARE = 0.35
"""Largest rounding over the smallest extent."""


class SolidField(RayField):
    """φ of one primitive with its parts. t: pixels behind the depth of the primitive's centre."""

    def __init__(
        self, camera: Camera, crop: Crop, primitive: Primitive, fitted: OutlineWarp, part_thickness: float, bevel: float
    ) -> None:
        """part_thickness: depth over width of the parts. bevel: rounding of edges in pixels."""
        self._camera, self._crop, self._primitive = camera, crop, primitive
        self._middle = float(camera.project(primitive.centre)[2])
        self.unit = self._middle / camera.fx
        self._bevel = min(bevel * self.unit, BEVEL_SHARE * primitive.least_extent)
        self._base_bevel = min(0.6 * bevel, 0.2 * primitive.least_extent / self.unit)
        self._shift = fitted.shift
        corners = np.concatenate(primitive.pieces(camera))
        below = np.column_stack([corners[:, :2], np.zeros(len(corners))])
        extent = camera.project(np.concatenate([corners, below, [primitive.centre]]))[:, 2]
        radius = primitive.least_extent / 2.0
        low = min(float(extent.min()), self._middle - radius)
        high = max(float(extent.max()), self._middle + radius)
        self._range = ((low - self._middle) / self.unit, (high - self._middle) / self.unit)
        self._square: FloatField | None = None
        if fitted.parts.any():
            self._add_parts(fitted, part_thickness)

    def _add_parts(self, fitted: OutlineWarp, thickness: float) -> None:
        crop, camera = self._crop, self._camera
        distance = np.minimum(signed_distance(fitted.parts) + crop.outset, crop.distance)
        self._square = limb_profile(distance, thickness)
        # Thinner farther in, or a handle would emerge on the other side of the wall.
        self._square = np.where(self._square > 0, self._square * fitted.fade**2, self._square)
        self._half = float(np.sqrt(max(float(self._square.max()), 0.25)))
        rays = camera.rays(crop.pixels())
        away = self._primitive.centre - camera.position
        away[2] = 0.0
        away /= max(float(np.linalg.norm(away)), 1e-12)
        facing = np.maximum(rays @ away, 0.05)
        plane = (self._primitive.centre - camera.position) @ away / facing
        # Never so deep that the ground cuts the part away.
        ground = ground_depth(camera, rays) - 0.7 * self._half * self.unit
        ground = np.minimum(ground, 4.0 * self._middle)
        middle = soft_min(plane, ground, self._half * self.unit)
        self._part_t = ((middle - self._middle) / self.unit).reshape(crop.mask.shape)
        at = self._part_t[fitted.parts]
        self._range = (
            min(self._range[0], float(at.min()) - self._half),
            max(self._range[1], float(at.max()) + self._half),
        )

    @property
    def thinnest(self) -> float:
        """Return pixels of the thinnest extent that the grid must resolve."""
        thin = self._primitive.least_extent / self.unit
        return thin if self._square is None else min(thin, 2.0 * self._half)

    def _world(self, points: Points, shifted: bool) -> Points:
        places = points[:, :2]
        if shifted:
            at = points[:, 1::-1].T
            moved = [ndimage.map_coordinates(self._shift[..., i], at, order=1, mode="nearest") for i in (0, 1)]
            return self.world(places, points[:, 2], np.stack(moved, axis=-1))
        return self.world(places, points[:, 2])

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return body and ground (n), (n) at ``points`` (n, 3), in pixels."""
        at = points[:, 1::-1].T
        body = self._primitive.inside(self._world(points, True), self._bevel) / self.unit
        if self._square is not None:
            square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
            middle = ndimage.map_coordinates(self._part_t, at, order=1, mode="nearest")
            part = (square - (points[:, 2] - middle) ** 2) / (2.0 * self._half)
            body = np.maximum(body, part)
        outline = ndimage.map_coordinates(self._crop.distance, at, order=1, mode="nearest")
        ground = self._world(points, False)[:, 2] / self.unit
        return np.minimum(body, outline), ground

    def value(self, points: Points) -> Points:
        """Return φ (n,) at ``points`` (n, 3)."""
        body, ground = self.sample(points)
        return soft_min(body, ground, self._base_bevel)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid (x, y, t), its first corner (3,) and its steps (3,)."""
        height, width = self._crop.mask.shape
        # Depth runs along the ray: a thin object seen at a slant is thicker along it, never thinner.
        steps = np.array([spacing, spacing, max(min(spacing, self.thinnest / 3.0), spacing / 4.0)])
        low, high = self._range
        first = np.array([0.25, 0.25, low - 2.37 * steps[2]])
        counts = (
            int((width - 1) // spacing) + 1,
            int((height - 1) // spacing) + 1,
            int((high - low) // steps[2]) + 6,
        )
        return self.sampled(first, steps, counts), first, steps


def solid_mesh(
    camera: Camera, crop: Crop, primitive: Primitive, fitted: OutlineWarp, target: int, part_thickness: float = 1.0
) -> tuple[BodyMesh, float]:
    """Return the closed surface of ``primitive`` with the outline of ``crop``, about ``target`` vertices, on the
    ground.

    Also the share of it that was disconnected and removed. Raises InputError when the outline is too thin for a closed
    surface.
    """
    area = float(crop.mask.sum())
    cell = max(0.5, float(np.sqrt(2.6 * area / target)))
    field = SolidField(camera, crop, primitive, fitted, part_thickness, BEVEL_CELLS * cell)
    points, faces, lost = surface_of_size(field, area, target)
    points = relax(field, points, faces)
    pixels, depth, ground = field.depths(points)
    near = np.abs(depth - ground) < GROUND_TOLERANCE_PX * field.unit
    pixels = _refined(crop, pixels, faces)
    ground = ground_depth(camera, camera.rays(pixels))
    depth = np.where(near, ground, np.minimum(depth, ground))
    return standing_mesh(camera, pixels, depth, faces), lost
