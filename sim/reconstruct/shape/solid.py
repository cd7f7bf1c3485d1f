# SPDX-License-Identifier: MIT
"""The surface of a fitted primitive that keeps the object's outline, with what the primitive leaves out.

φ(x, y, t) over pixels and depth, as for inflated bodies: the primitive's inside, looked up where the shift of ``warp``
puts the pixel; joined with the inflated parts around the upright plane through its axis; cut by the outline and by
the ground. So the silhouette is the mask, the volume the primitive's, and the surface closed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..view.camera import ground_depth
from .crop import Crop
from .inflate import film_profile, signed_distance
from .mesh import GROUND_TOLERANCE_PX, BodyMesh, standing_mesh
from .primitives import Primitive, soft_min
from .surface import relax, surface_of_size
from .warp import Fitting

Points = NDArray[np.float64]
Faces = NDArray[np.int64]
FloatField = NDArray[np.float64]

BEVEL_CELLS = 2.2
"""Rounding of edges in cells of the grid: sharper ones would be cut into teeth."""
BEVEL_SHARE = 0.35
"""Largest rounding over the smallest extent."""


class SolidField:
    """φ of one primitive with its parts. t: pixels behind the depth of the primitive's middle."""

    def __init__(
        self, camera: Camera, crop: Crop, primitive: Primitive, fitted: Fitting, part_thickness: float, bevel: float
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

    def _add_parts(self, fitted: Fitting, thickness: float) -> None:
        crop, camera = self._crop, self._camera
        distance = np.minimum(signed_distance(fitted.parts) + crop.outset, crop.distance)
        self._square = film_profile(fitted.parts, distance, thickness)
        # Thinner the farther in, or a handle would come out again on the other side of the wall.
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
        """Pixels of the thinnest extent that the grid must not miss."""
        thin = self._primitive.least_extent / self.unit
        return thin if self._square is None else min(thin, 2.0 * self._half)

    def _world(self, points: Points, shifted: bool) -> Points:
        pixels = points[:, :2] + np.array([self._crop.left + 0.5, self._crop.top + 0.5])
        if shifted:
            at = points[:, 1::-1].T
            pixels = pixels + np.stack(
                [ndimage.map_coordinates(self._shift[..., i], at, order=1, mode="nearest") for i in (0, 1)], axis=-1
            )
        depth = np.maximum(self._middle + points[:, 2] * self.unit, 0.02 * self._middle)
        return np.asarray(self._camera.position + depth[:, None] * self._camera.rays(pixels))

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Body and ground (n), (n) at ``points`` (n, 3), in pixels."""
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
        """φ (n) at ``points`` (n, 3)."""
        body, ground = self.sample(points)
        return soft_min(body, ground, self._base_bevel)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """φ on a grid (x, y, t), its first corner (3,) and its steps (3,)."""
        height, width = self._crop.mask.shape
        # Depth runs along the ray: a thin thing seen at a slant is thicker there, but never thinner.
        steps = np.array([spacing, spacing, max(min(spacing, self.thinnest / 3.0), spacing / 4.0)])
        low, high = self._range
        first = np.array([0.25, 0.25, low - 2.37 * steps[2]])
        counts = (
            int((width - 1) // spacing) + 1,
            int((height - 1) // spacing) + 1,
            int((high - low) // steps[2]) + 6,
        )
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], indexing="ij"), axis=-1).reshape(-1, 2)
        outline = ndimage.map_coordinates(self._crop.distance, flat[:, ::-1].T, order=1, mode="nearest")
        near = outline > -2.0 * spacing
        points = np.column_stack([np.repeat(flat[near], counts[2], axis=0), np.tile(axes[2], int(near.sum()))])
        # Away from the outline φ is negative; how much does not matter.
        columns = np.repeat(np.minimum(outline, -1.0)[:, None], counts[2], axis=1)
        columns[near] = self.value(points).reshape(-1, counts[2])
        field = columns.reshape(counts)
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32), first, steps

    def depths(self, points: Points) -> tuple[Points, Points, Points]:
        """Photo pixels (n, 2), depth (n) and depth of the ground (n) of ``points`` (n, 3)."""
        pixels = points[:, :2] + np.array([self._crop.left + 0.5, self._crop.top + 0.5])
        depth = np.maximum(self._middle + points[:, 2] * self.unit, 0.02 * self._middle)
        return pixels, depth, ground_depth(self._camera, self._camera.rays(pixels))


def solid_mesh(
    camera: Camera, crop: Crop, primitive: Primitive, fitted: Fitting, target: int, part_thickness: float = 1.0
) -> tuple[BodyMesh, float]:
    """The closed surface of ``primitive`` with the outline of ``crop``, about ``target`` vertices, on the ground.

    Also the share of it that floated and was removed. Raises InputError when the outline is too thin for a closed
    surface.
    """
    area = float(crop.mask.sum())
    cell = max(0.5, float(np.sqrt(2.6 * area / target)))
    field = SolidField(camera, crop, primitive, fitted, part_thickness, BEVEL_CELLS * cell)
    points, faces, lost = surface_of_size(field, area, target)
    points = relax(field, points, faces)
    pixels, depth, ground = field.depths(points)
    near = np.abs(depth - ground) < GROUND_TOLERANCE_PX * field.unit
    depth = np.where(near, ground, np.minimum(depth, ground))
    return standing_mesh(camera, pixels, depth, faces), lost
