# SPDX-License-Identifier: MIT
"""Boxes, spheres and surfaces of revolution on the ground z = 0, and outlines to fit them to.

World axes: Z up. ``inside`` is open below, so that the ground itself cuts the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

GUESSED = 0.1
"""Weight of guessed outline behind an occluder."""
BORDER = 1.5
"""Outline nearer than this to the photo's border, in pixels, is the photo's end and not the object's."""


@dataclass(frozen=True)
class Outline:
    """Points evenly along the outline of a mask.

    points: (n, 2) photo pixels; weights: (n,) 0 (unknown) to 1; size: square root of the area in pixels.
    """

    points: Points
    weights: NDArray[np.float64]
    size: float

    def thinned(self, count: int) -> Outline:
        """Return about ``count`` of the points."""
        step = max(1, len(self.points) // count)
        return Outline(self.points[::step], self.weights[::step], self.size)


def outline_of(full: Mask, seen: Mask | None = None, count: int = 400) -> Outline:
    """Return the outer outline of ``full`` (H, W), which must not be empty, as about ``count`` points.

    Outline next to pixels in ``full`` but not in ``seen`` has a lower weight, and at the photo's border none.
    """
    contours, _ = cv2.findContours(full.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=cv2.contourArea)[:, 0, :].astype(np.float64)
    # Centres of border pixels are half a pixel inside the outline; smooth and move out by that.
    loop = longest + 0.5
    smooth = ndimage.gaussian_filter1d(loop, 1.0, axis=0, mode="wrap") if len(loop) > 8 else loop
    tangent = np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0)
    length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]]) / length
    area = float(cv2.contourArea(longest.astype(np.float32), oriented=True))
    smooth = smooth + 0.5 * normal * (1.0 if area > 0 else -1.0)
    smooth = smooth[_even(smooth, count)]
    height, width = full.shape
    x, y = smooth[:, 0], smooth[:, 1]
    inner = (x > BORDER) & (y > BORDER) & (x < width - BORDER) & (y < height - BORDER)
    weights = inner.astype(np.float64)
    hidden = full & ~seen if seen is not None else np.zeros_like(full)
    if hidden.any():
        reach = ndimage.binary_dilation(hidden, iterations=2)
        rows, columns = np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)
        weights *= np.where(reach[rows, columns], GUESSED, 1.0)
    return Outline(points=smooth, weights=weights, size=float(np.sqrt(full.sum())))


def _even(loop: Points, count: int) -> NDArray[np.int64]:
    """Indices of about ``count`` points of the closed ``loop`` (n, 2), evenly by length."""
    steps = np.linalg.norm(np.diff(loop, axis=0, append=loop[:1]), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    wanted = np.linspace(0.0, along[-1], min(count, len(loop)))
    return np.unique(np.searchsorted(along, wanted).clip(0, len(loop) - 1))


def hull_polygon(pixels: Points) -> Points:
    """Return the convex hull (m, 2) of ``pixels`` (n, 2)."""
    index = cv2.convexHull(pixels.astype(np.float32), returnPoints=False)[:, 0]
    return pixels[index]


def distance_to_convex(points: Points, polygon: Points) -> NDArray[np.float64]:
    """Return the signed distance (n,) of ``points`` (n, 2) to a convex ``polygon`` (m, 2), positive inside."""
    # One row an edge, one array a component, in place: the fits spend most of their time here.
    ends = np.concatenate((polygon[1:], polygon[:1]))
    (start_x, start_y), (edge_x, edge_y) = polygon.T[..., None], (ends - polygon).T[..., None]
    squared = np.maximum(edge_x**2 + edge_y**2, 1e-12)
    offset_x, offset_y = points[:, 0] - start_x, points[:, 1] - start_y
    along = offset_x * edge_x
    along += offset_y * edge_y
    along /= squared
    np.clip(along, 0.0, 1.0, out=along)
    cross = edge_x * offset_y
    cross -= edge_y * offset_x
    offset_x -= along * edge_x
    offset_y -= along * edge_y
    offset_x *= offset_x
    offset_y *= offset_y
    offset_x += offset_y
    distance = np.sqrt(offset_x.min(axis=0))
    inside = (cross.min(axis=0) >= 0) | (cross.max(axis=0) <= 0)
    return np.where(inside, distance, -distance)


CIRCLE = 48
"""Points on a circle whose hull approximates it; the area is 0.3 % too small."""
_TURN = 2.0 * np.pi * np.arange(CIRCLE) / CIRCLE
_RING = np.cos(_TURN), np.sin(_TURN)
FINER = 4
SUNK = 0.01
"""Depth by which a sphere is sunk into the ground, over its radius: it rests on a small disc instead of a point."""


class Primitive(Protocol):
    """A parametric body that stands on the ground z = 0; lengths in the camera's unit, points in world axes."""

    @property
    def name(self) -> str:
        """Return the name of its shape: ``box``, ``cylinder`` or ``sphere``."""

    @property
    def height(self) -> float:
        """Return the height of its top above the ground."""

    @property
    def centre(self) -> Points:
        """Return its middle (3,)."""

    @property
    def least_extent(self) -> float:
        """Return its smallest extent."""

    def pieces(self, camera: Camera) -> list[Points]:
        """Return points (n, 3) of convex pieces: the union of the pieces' projected hulls is the outline."""

    def inside(self, points: Points, rounding: float) -> Points:
        """Return the distance (n,) from the surface at ``points`` (n, 3), positive inside; edges rounded by
        ``rounding``."""


def soft_min(first: Points, second: Points, width: float) -> Points:
    """Return a smooth minimum that never exceeds either and is the smaller one where they differ by ``width`` or
    more."""
    blend = np.clip(1.0 - np.abs(first - second) / max(width, 1e-12), 0.0, 1.0)
    return np.minimum(first, second) - blend**2 * width / 4.0


@dataclass(frozen=True)
class Box:
    """An upright box. x, y: centre of its base; yaw: radians about Z of its width's direction; width, depth, height."""

    x: float
    y: float
    yaw: float
    width: float
    depth: float
    height: float
    name: str = "box"

    @property
    def centre(self) -> Points:
        """Return its middle (3,)."""
        return np.array([self.x, self.y, self.height / 2.0])

    @property
    def least_extent(self) -> float:
        """Return its smallest extent."""
        return min(self.width, self.depth, self.height)

    @property
    def axes(self) -> tuple[Points, Points]:
        """Return the unit vectors (2,) of width and depth in the ground."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([cosine, sine]), np.array([-sine, cosine])

    def corners(self) -> Points:
        """Return the corners (8, 3): index bits 1, 2, 4 are the far end of width, depth and height."""
        across, along = self.axes
        bits = np.arange(8)
        u = ((bits & 1) - 0.5) * self.width
        v = ((bits >> 1 & 1) - 0.5) * self.depth
        ground = np.array([self.x, self.y]) + u[:, None] * across + v[:, None] * along
        return np.column_stack([ground, (bits >> 2) * self.height])

    def pieces(self, camera: Camera) -> list[Points]:
        """Return its corners (8, 3), one piece."""
        return [self.corners()]

    def inside(self, points: Points, rounding: float) -> Points:
        """Return the distance (n,) from the nearest face, soft where two are equally near."""
        across, along = self.axes
        offset = points[:, :2] - np.array([self.x, self.y])
        sides = soft_min(
            self.width / 2.0 - np.abs(offset @ across), self.depth / 2.0 - np.abs(offset @ along), rounding
        )
        return soft_min(sides, self.height - points[:, 2], rounding)


@dataclass(frozen=True)
class Sphere:
    """A sphere. x, y: contact point; squash: height over width, 0.8 for a mandarin."""

    x: float
    y: float
    radius: float
    squash: float = 1.0
    name: str = "sphere"

    @property
    def centre(self) -> Points:
        """Return its middle (3,)."""
        return np.array([self.x, self.y, self.squash * self.radius * (1.0 - SUNK)])

    @property
    def height(self) -> float:
        """Return the height of its top above the ground."""
        return self.squash * self.radius * (2.0 - SUNK)

    @property
    def least_extent(self) -> float:
        """Return its smallest diameter."""
        return 2.0 * self.radius * min(1.0, self.squash)

    @property
    def axes(self) -> Points:
        """Return its semi-axes (3,) along x, y and z."""
        return self.radius * np.array([1.0, 1.0, self.squash])

    def pieces(self, camera: Camera) -> list[Points]:
        """Return points (CIRCLE, 3) of the ellipse in which the cone of sight touches it, one piece."""
        # In units of its semi-axes it is a unit sphere, and lines stay lines.
        towards = (self.centre - camera.position) / self.axes
        distance = float(np.linalg.norm(towards))
        axis = towards / distance
        sine = min(1.0 / distance, 0.999)
        first = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
        ring = _RING[0][:, None] * first + _RING[1][:, None] * second
        return [self.centre + self.axes * (ring * np.sqrt(1.0 - sine**2) - axis * sine)]

    def inside(self, points: Points, rounding: float) -> Points:
        """Return the distance (n,) from the surface, to first order: exact on it (Taubin, PAMI 1991)."""
        scaled = (points - self.centre) / self.axes
        length = np.linalg.norm(scaled, axis=1)
        slope = np.linalg.norm(scaled / self.axes, axis=1) / np.maximum(length, 1e-12)
        return (1.0 - length) / np.maximum(slope, 1e-12)


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A surface of revolution about the vertical through x, y: a cylinder has two equal radii.

    heights: rising from 0; radii: at these, linear between; at least two, all above zero but the last.
    """

    x: float
    y: float
    heights: tuple[float, ...]
    radii: tuple[float, ...]
    name: str = "cylinder"

    @property
    def centre(self) -> Points:
        """Return the middle (3,) of its axis."""
        return np.array([self.x, self.y, self.height / 2.0])

    @property
    def height(self) -> float:
        """Return the height of its top above the ground."""
        return self.heights[-1]

    @property
    def least_extent(self) -> float:
        """Return its height or its largest diameter, whichever is smaller."""
        return min(self.height, 2.0 * max(self.radii))

    def circle(self, height: float, radius: float) -> Points:
        """Return points (CIRCLE, 3) around the axis."""
        # A polygon with the circle's area approximates it better than the inscribed one.
        wide = radius * np.sqrt(2.0 * np.pi / CIRCLE / np.sin(2.0 * np.pi / CIRCLE))
        points = np.empty((CIRCLE, 3))
        points[:, 0], points[:, 1], points[:, 2] = self.x + wide * _RING[0], self.y + wide * _RING[1], height
        return points

    def pieces(self, camera: Camera) -> list[Points]:
        """Return the rims (2 · CIRCLE, 3) of the frustum between every two heights."""
        rings = [self.circle(h, r) for h, r in zip(self.heights, self.radii, strict=True)]
        return [np.concatenate(pair) for pair in pairwise(rings)]

    def inside(self, points: Points, rounding: float) -> Points:
        """Return the distance (n,) from the mantle or the top, soft where both are equally near."""
        heights, radii = np.array(self.heights), np.array(self.radii)
        slopes = np.diff(radii) / np.maximum(np.diff(heights), 1e-12)
        z = points[:, 2]
        rho = np.hypot(points[:, 0] - self.x, points[:, 1] - self.y)
        radius = np.interp(z, heights, radii)
        radius += np.where(z < 0, slopes[0] * z, 0.0) + np.where(z > self.height, slopes[-1] * (z - self.height), 0.0)
        middles = (heights[1:] + heights[:-1]) / 2.0
        slope = np.interp(z, middles, slopes)
        return soft_min((radius - rho) / np.sqrt(1.0 + slope**2), self.height - z, rounding)


def rasterize(primitive: Primitive, camera: Camera, shape: tuple[int, int], left: float, top: float) -> Mask:
    """Return the primitive's silhouette as a mask of ``shape`` (h, w) whose first pixel is at ``left``, ``top`` in the
    photo."""
    # OpenCV also fills border pixels: at a finer scale that is an eighth of a pixel.
    image = np.zeros((shape[0] * FINER, shape[1] * FINER), np.uint8)
    for polygon in polygons(primitive, camera):
        corners = np.round(((polygon - [left, top]) * FINER - 0.5) * 16).clip(-(2**30), 2**30).astype(np.int32)
        cv2.fillConvexPoly(image, corners, 255, shift=4)
    return np.asarray(cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > 127)


def polygons(primitive: Primitive, camera: Camera) -> Sequence[Points]:
    """Return convex polygons (m, 2) in photo pixels whose union is the primitive's outline; () if it reaches behind the
    camera."""
    result = []
    for piece in primitive.pieces(camera):
        projected = camera.project(piece)
        if not (projected[:, 2] > 1e-6).all():
            return ()
        result.append(hull_polygon(projected[:, :2]))
    return result
